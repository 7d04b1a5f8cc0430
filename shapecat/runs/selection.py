"""Read the frames of a recording that the options of a run select."""

from collections.abc import Iterator, Sequence

from shapecat.cameras.colour import ColourView
from shapecat.recordings import FrameRange, Recording, Stream, choose_streams
from shapecat.recordings.colour_frames import KnownImages, frames_with_colour
from shapecat.recordings.colour_streams import pair_colours
from shapecat.recordings.messages import Needed
from shapecat.runs.run_info import Options
from shapecat.types import Frame

__all__ = ["count_frames", "read_frames"]


def read_frames(
    recording: Recording,
    options: Options,
    *,
    needed: Needed = None,
    same_images: KnownImages = None,
) -> Iterator[tuple[Frame, ColourView | None]]:
    """Read the selected frames, each with its colour image, or None; leave out unreadable ones.

    Parameters
    ----------
    needed, same_images : as for `frames_with_colour`.

    Raises
    ------
    ConfigError : ``start_s``, ``end_s`` or ``every`` is invalid.
    NoStreamError : a topic is missing or not usable.
    """
    streams = choose_streams(recording, options["topics"])
    return frames_with_colour(
        recording,
        streams,
        pair_colours(recording, streams, options["color"]),
        FrameRange(options["start_s"], options["end_s"], options["every"]),
        needed=needed,
        same_images=same_images,
    )


def count_frames(streams: Sequence[Stream], options: Options) -> int | None:
    """Return the approximate number of selected frames; None if it is not known in advance."""
    if options["start_s"] is not None or options["end_s"] is not None:
        return None
    return sum(-(-(stream.count or 0) // options["every"]) for stream in streams) or None
