"""The frames of a review: their scenes, drawn seldom while nothing moves, and their painting."""

import math
from collections.abc import Iterable, Iterator
from itertools import tee
from typing import NamedTuple

from shapecat.arrays import F8
from shapecat.geometry import IDENTITY, transform
from shapecat.outputs.colouring import Coloured, with_colour
from shapecat.outputs.review_cloud import PaintedCloud, paint
from shapecat.outputs.review_images import Picture, picture_of
from shapecat.recordings import MessageError, Recording
from shapecat.runs.run_info import RunInfo
from shapecat.types import Frame, LabelledFrame

__all__ = ["PaintedFrame", "ReviewFrame", "choose_scenes", "paint_frame", "with_clouds"]

_SOON_NS, _LATE_NS = 90_000_000, 240_000_000
"""From a scene to the next one: at least, and at most where the frames differ."""
_STILL_M = 0.015
"""What has moved so far is drawn as soon as it may be."""


class ReviewFrame(NamedTuple):
    """A frame to be written, with its points and its image if its scene is drawn."""

    labelled: LabelledFrame
    frame: Frame | None = None
    coloured: Coloured | None = None


def with_clouds(
    frames: Iterable[LabelledFrame], recording: Recording, run: RunInfo
) -> Iterator[ReviewFrame]:
    """Yield all frames of a run, with the clouds and images of those whose scene is drawn.

    Raises
    ------
    OutputError : the recording does not hold one of them any more.
    """
    first, second = tee(choose_scenes(frames, fixed=run["fixed_frame"] is not None))
    read = with_colour((labelled for labelled, drawn in first if drawn), recording, run)
    for labelled, drawn in second:
        yield ReviewFrame(*next(read)) if drawn else ReviewFrame(labelled)


def choose_scenes(
    frames: Iterable[LabelledFrame], *, fixed: bool
) -> Iterator[tuple[LabelledFrame, bool]]:
    """Tell which frames have their scene drawn: none that repeats, few while nothing moves.

    Parameters
    ----------
    fixed : objects are shown in a frame in which those that stand still keep their place, so that
        a camera that moves does not move the scene.
    """
    last: dict[str, LabelledFrame] = {}  # drawn of each topic
    for labelled in frames:
        before = last.get(labelled.topic)
        drawn = before is None or _is_due(labelled, before, fixed=fixed)
        if drawn:
            last[labelled.topic] = labelled
        yield labelled, drawn


def _is_due(labelled: LabelledFrame, before: LabelledFrame, *, fixed: bool) -> bool:
    """Return whether a scene is worth drawing after the one drawn before it."""
    passed_ns = labelled.stamp_ns - before.stamp_ns
    if _first_seen(labelled) == _first_seen(before) or 0 <= passed_ns < _SOON_NS:
        return False
    if not 0 <= passed_ns < _LATE_NS:
        return True
    now, then = (_places(each, fixed=fixed) for each in (labelled, before))
    return now.keys() != then.keys() or any(math.dist(now[k], then[k]) > _STILL_M for k in now)


def _first_seen(labelled: LabelledFrame) -> int:
    return labelled.index if labelled.reused_from is None else labelled.reused_from


def _places(labelled: LabelledFrame, *, fixed: bool) -> dict[int, F8]:
    """Return where the tracks are, in the fixed frame if it is known."""
    pose = labelled.fixed_from_sensor if fixed else None
    return {
        o.track: transform(pose or IDENTITY, (o.full or o.box).center) for o in labelled.objects
    }


class PaintedFrame(NamedTuple):
    """A frame ready to be written.

    ``clouds`` are None where the scene is not drawn; ``damage`` is what is wrong with the image.
    """

    labelled: LabelledFrame
    frame: Frame | None
    clouds: tuple[PaintedCloud, PaintedCloud] | None
    picture: Picture | None
    damage: str


def paint_frame(chosen: ReviewFrame, *, limit: int) -> PaintedFrame:
    """Paint the clouds and the masks of a frame; without colour if its image is damaged."""
    labelled, frame, coloured = chosen
    damage, parts = "", (labelled.planes, labelled.objects)
    if frame is None:
        return PaintedFrame(labelled, None, None, None, "")
    if coloured is not None:
        try:
            clouds = paint(frame, *parts, limit=limit, view=coloured.view)
            return PaintedFrame(labelled, frame, clouds, picture_of(labelled, coloured), "")
        except MessageError as error:
            damage = f"{coloured.view.image.topic}: {error}"
    return PaintedFrame(labelled, frame, paint(frame, *parts, limit=limit), None, damage)
