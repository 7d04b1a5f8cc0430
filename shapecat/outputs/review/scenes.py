"""Choose the frames of a review whose scene is drawn."""

import math
from collections.abc import Collection, Iterable, Iterator
from itertools import tee
from typing import NamedTuple

from shapecat.arrays import F8
from shapecat.geometry import IDENTITY, transform
from shapecat.outputs.colouring import Coloured, with_colour
from shapecat.recordings import Recording
from shapecat.runs.run_info import RunInfo
from shapecat.types import Frame, LabelledFrame

__all__ = ["ReviewFrame", "choose_scenes", "with_clouds"]

_SOON_NS = 90_000_000
"""Shortest time between two drawn scenes."""
_LATE_NS = 240_000_000
"""Longest time between two drawn scenes, unless one only repeats the other."""
_STILL_M = 0.015
"""If an object has moved farther than this, the scene is drawn as soon as allowed."""


class ReviewFrame(NamedTuple):
    """A frame to write, with its points and colour image if its scene is drawn."""

    labelled: LabelledFrame
    frame: Frame | None = None
    coloured: Coloured | None = None


def with_clouds(
    frames: Iterable[LabelledFrame],
    recording: Recording,
    run: RunInfo,
    placed: Collection[str] = (),
) -> Iterator[ReviewFrame]:
    """Yield all frames of a run; those whose scene is drawn have their points and colour image.

    ``placed`` is as for `choose_scenes`.

    Raises
    ------
    OutputError : the recording no longer holds one of the frames.
    """
    chosen = choose_scenes(frames, fixed=run["fixed_frame"] is not None, placed=placed)
    first, second = tee(chosen)
    read = with_colour((labelled for labelled, drawn in first if drawn), recording, run)
    for labelled, drawn in second:
        yield ReviewFrame(*next(read)) if drawn else ReviewFrame(labelled)


def choose_scenes(
    frames: Iterable[LabelledFrame], *, fixed: bool, placed: Collection[str] = ()
) -> Iterator[tuple[LabelledFrame, bool]]:
    """Yield each frame, and whether its scene is drawn.

    Repeated scenes are not drawn, and scenes in which nothing moves are drawn less often.

    Parameters
    ----------
    fixed : whether motion is measured in the fixed frame, where a moving camera does not count.
    placed : topics whose scenes are drawn only if the pose in the fixed frame is known.
    """
    last: dict[str, LabelledFrame] = {}  # last drawn frame of each topic
    for labelled in frames:
        before = last.get(labelled.topic)
        drawn = labelled.topic not in placed or labelled.fixed_from_sensor is not None
        drawn = drawn and (before is None or _is_due(labelled, before, fixed=fixed))
        if drawn:
            last[labelled.topic] = labelled
        yield labelled, drawn


def _is_due(labelled: LabelledFrame, before: LabelledFrame, *, fixed: bool) -> bool:
    """Return whether to draw a scene, given the last one drawn."""
    passed_ns = labelled.stamp_ns - before.stamp_ns
    if _first_seen(labelled) == _first_seen(before) or 0 <= passed_ns < _SOON_NS:
        return False
    if not 0 <= passed_ns < _LATE_NS:
        return True
    places, earlier = (_places(each, fixed=fixed) for each in (labelled, before))
    return places.keys() != earlier.keys() or any(
        math.dist(places[k], earlier[k]) > _STILL_M for k in places
    )


def _first_seen(labelled: LabelledFrame) -> int:
    return labelled.index if labelled.reused_from is None else labelled.reused_from


def _places(labelled: LabelledFrame, *, fixed: bool) -> dict[int, F8]:
    """Return the centre (3,) of each track's box, metres, in the sensor frame.

    If ``fixed`` and the pose is known, it is in the fixed frame.
    """
    pose = labelled.fixed_from_sensor if fixed else None
    return {
        o.track: transform(pose or IDENTITY, (o.full or o.box).center) for o in labelled.objects
    }
