"""The frames of a review: their scenes, drawn seldom while nothing moves, and their painting."""

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from shapecat.arrays import F8
from shapecat.geometry import IDENTITY, transform
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.review_cloud import PaintedCloud, paint
from shapecat.outputs.review_images import Picture, picture_of
from shapecat.recordings import MessageError
from shapecat.types import Frame, LabelledFrame

__all__ = ["PaintedFrame", "ReviewFrame", "choose_scenes", "paint_frame"]

_SOON_NS, _LATE_NS = 90_000_000, 240_000_000
"""From a scene to the next one: at least, and at most where the frames differ."""
_STILL_M = 0.015
"""What has moved so far is drawn as soon as it may be."""


class ReviewFrame(NamedTuple):
    """A frame to be written, and whether its scene is drawn."""

    labelled: LabelledFrame
    frame: Frame
    coloured: Coloured | None
    drawn: bool


def choose_scenes(
    frames: Iterable[tuple[LabelledFrame, Frame, Coloured | None]], *, fixed: bool
) -> Iterator[ReviewFrame]:
    """Choose the frames whose scene is drawn: none that repeats, few while nothing moves.

    Parameters
    ----------
    fixed : objects are shown in a frame in which those that stand still keep their place, so that
        a camera that moves does not move the scene.
    """
    last: dict[str, LabelledFrame] = {}  # drawn of each topic
    for labelled, frame, coloured in frames:
        before = last.get(labelled.topic)
        drawn = before is None or _is_due(labelled, before, fixed=fixed)
        if drawn:
            last[labelled.topic] = labelled
        yield ReviewFrame(labelled, frame, coloured, drawn)


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
    frame: Frame
    clouds: tuple[PaintedCloud, PaintedCloud] | None
    picture: Picture | None
    damage: str


def paint_frame(chosen: ReviewFrame, *, limit: int) -> PaintedFrame:
    """Paint the clouds and the masks of a frame; without colour if its image is damaged."""
    labelled, frame, coloured, drawn = chosen
    damage, parts = "", (labelled.planes, labelled.objects)
    if coloured is not None:
        try:
            clouds = paint(frame, *parts, limit=limit, view=coloured.view) if drawn else None
            return PaintedFrame(labelled, frame, clouds, picture_of(labelled, coloured), "")
        except MessageError as error:
            damage = f"{coloured.view.image.topic}: {error}"
    clouds = paint(frame, *parts, limit=limit) if drawn else None
    return PaintedFrame(labelled, frame, clouds, None, damage)
