"""Read the frames of a recording that the options of a run select."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from shapecat.cameras.colour import ColourView
from shapecat.recordings import FrameRange, Recording, Stream, choose_streams
from shapecat.recordings.colour_frames import KnownImages, frames_with_colour
from shapecat.recordings.colour_streams import ColourStream, pair_colours
from shapecat.recordings.messages import Needed
from shapecat.runs.run_info import Options
from shapecat.types import Frame

__all__ = ["count_frames", "read_frames"]


def read_frames(
    recording: Recording,
    options: Options,
    *,
    skipped: Counter[str],
    streams: Sequence[Stream] | None = None,
    colours: Mapping[str, ColourStream] | None = None,
    needed: Needed = None,
    same_images: KnownImages = None,
) -> Iterator[tuple[Frame, ColourView | None]]:
    """Read the selected frames, each with its colour image, or None.

    Parameters
    ----------
    streams, colours : the selected streams, and the colour stream of each topic; None to find them.
    skipped, needed : as for `shapecat.recordings.frames`.
    same_images : as for `frames_with_colour`.

    Raises
    ------
    ConfigError : the options select no frames.
    NoStreamError : a topic is missing or not usable.
    """
    if streams is None:
        streams = choose_streams(recording, options["topics"])
    if colours is None:
        colours = pair_colours(recording, streams, options["color"])
    return frames_with_colour(
        recording,
        streams,
        colours,
        FrameRange(options["start_s"], options["end_s"], options["every"]),
        skipped=skipped,
        needed=needed,
        same_images=same_images,
    )


def count_frames(streams: Sequence[Stream], options: Options) -> int | None:
    """Return the approximate number of selected frames; None if it is not known in advance."""
    if options["start_s"] is not None or options["end_s"] is not None:
        return None
    return sum(-(-(stream.count or 0) // options["every"]) for stream in streams) or None
