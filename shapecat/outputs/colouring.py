"""Pair labelled frames with their depth and colour images from the recording."""

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import islice

from shapecat.cameras.colour import ColourView
from shapecat.colour.image_masks import mask_of
from shapecat.colour.masks import Mask
from shapecat.errors import OutputError
from shapecat.recordings import Recording
from shapecat.recordings.colour_motion import view_at_its_time
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.runs.run_info import RunInfo
from shapecat.runs.selection import read_frames
from shapecat.types import Frame, LabelledFrame

__all__ = ["Coloured", "PairedFrame", "with_colour"]

_AHEAD = 4
"""Number of labelled frames that are read in advance."""


@dataclass(frozen=True)
class Coloured:
    """The colour image of a frame, and the mask on it of each object of the frame, in order."""

    view: ColourView
    masks: tuple[Mask, ...]


PairedFrame = tuple[LabelledFrame, Frame, Coloured | None]
"""A labelled frame, its depth image or cloud, and its colour image if it has one."""


def with_colour(
    labelled: Iterable[LabelledFrame], recording: Recording, run: RunInfo
) -> Iterator[PairedFrame]:
    """Pair labelled frames with the frames and colour images of the recording.

    From an indexed file, only the requested frames are read.

    Parameters
    ----------
    labelled : the requested frames, in the order of the recording.

    Yields
    ------
    The labelled frame, its frame in the recording, and its colour image with masks, or None.

    Raises
    ------
    OutputError : the recording no longer holds one of the frames.
    """
    awaited = _Awaited(labelled, run)
    # Images are found by log time: after a clock is set back, several have the same stamp.
    read = read_frames(
        recording,
        run["options"],
        needed=awaited.needs,
        same_images=awaited.image_of,
    )
    transforms = cache(partial(TransformWindow.of, recording, run["options"]["topics"]))
    for label in awaited:
        for frame, view in read:
            if (label.topic, label.index) == (frame.topic, frame.index):
                pose, moved = label.fixed_from_sensor, view
                if pose is not None:
                    moved = view_at_its_time(view, frame, pose, run["fixed_frame"], transforms)
                yield label, frame, _coloured(label, moved)
                break
        else:
            msg = f"{recording.path}: has changed since it was processed; process it again"
            raise OutputError(msg)


class _Awaited:
    """The requested frames; a few are read in advance, to know which messages are needed."""

    def __init__(self, frames: Iterable[LabelledFrame], run: RunInfo) -> None:
        self._topics, self._colours = set(run["options"]["topics"]), {*run["color"].values()}
        self._source = iter(frames)
        self._next = deque(islice(self._source, _AHEAD))

    def __iter__(self) -> Iterator[LabelledFrame]:
        """Yield the frames; each is awaited until the next one is requested."""
        while self._next:
            yield self._next[0]
            self._next.popleft()
            self._next.extend(islice(self._source, 1))

    def needs(self, topic: str, log_time_ns: int) -> bool:
        """Return whether a depth or colour message belongs, or may belong, to an awaited frame.

        Only the next few awaited frames are known. A message at the time of the last of these, or
        later, may belong to a frame after them. Messages of other topics are always needed.
        """
        if topic not in self._topics | self._colours:
            return True
        times = [m.log_time_ns for one in self._next if (m := one.masks) and m.topic == topic]
        if topic in self._topics:
            times += [one.log_time_ns for one in self._next]
        later = len(self._next) == _AHEAD and log_time_ns >= max(times, default=0)
        return later or log_time_ns in times

    def image_of(self, topic: str, number: int) -> int | None:
        """Return the log time, ns, of a frame's colour image; None if there is none.

        Parameters
        ----------
        topic, number : topic and number of the frame, one of the next few awaited.
        """
        named = (one for one in self._next if (one.topic, one.index) == (topic, number))
        masks = next((one.masks for one in named), None)
        return None if masks is None else masks.log_time_ns


def _coloured(labelled: LabelledFrame, view: ColourView | None) -> Coloured | None:
    """Return a frame's colour image with the masks of its objects; None if either is missing."""
    if view is None or labelled.masks is None:
        return None
    masks = labelled.masks
    return Coloured(view, tuple(mask_of(masks, item.detections) for item in labelled.objects))
