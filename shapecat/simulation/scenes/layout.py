"""Place objects on supports and on each other without collisions."""

from functools import cached_property

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8, Record
from shapecat.geometry import IDENTITY, compose
from shapecat.simulation.scenes.footprints import Footprint, footprint, inside, overlap
from shapecat.simulation.scenes.worlds import PlacedObject, Support, pose_from_yaw
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.distractors import make_distractor
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.simulation.shapes.stable_poses import StablePose, choose_stable_pose
from shapecat.types import UNKNOWN, Pose

__all__ = ["SUPPORTING", "Layout", "Piece", "make_piece", "place_piece"]

_LYING = {"can": 0.2, "bottle": 0.22, "cup": 0.12, "box": 0.7}
"""Probability that an object of a category lies; a lying box rests on any of its sides."""
_UPSIDE_DOWN = {"cup": 0.06, "bowl": 0.06, "plate": 0.03}
"""Probability that an open object stands on its rim."""
_WIDEST_M = 0.42
"""Maximum length and width of an object; larger ones are not placed."""
SUPPORTING = {"box", "can"}
"""Categories that other objects are stacked on."""
_SMALLEST_TOP_M = 0.035
"""Minimum width of a top face that supports another object."""
_EDGE_M = 0.01
"""Minimum distance of the contact area from the edge of the support."""


class Piece(Record):
    """An object to be placed, with its stable pose; other fields are as in `PlacedObject`."""

    category: str
    kind: str
    mesh: Mesh
    stable_pose: StablePose

    @cached_property
    def footprint(self) -> Footprint:
        """Its footprint in its stable pose."""
        return footprint(self.mesh, self.stable_pose.pose)


def make_piece(category: str, rng: Generator) -> Piece:
    """Make a random object with a random resting pose.

    ``category`` is one of the shape categories, or ``unknown`` for a distractor. Balls, distractors
    and objects without a stable pose of the drawn kind stay upright.
    """
    if category == UNKNOWN:
        kind, mesh = make_distractor(rng)
    else:
        kind, mesh = category, make_object(category, rng)
    pose_name = _draw_resting_pose(category, rng)
    stable_pose = StablePose(IDENTITY, "upright")
    if pose_name != "upright" and category not in {"ball", UNKNOWN}:
        stable_pose = choose_stable_pose(mesh, pose_name, rng) or stable_pose
    return Piece(category, kind, mesh, stable_pose)


def place_piece(
    piece: Piece, track: int, pose: Pose, support: Support, on_track: int | None
) -> PlacedObject:
    """Return a piece as a placed object with the number ``track``.

    Parameters
    ----------
    pose : ``world_from_mesh`` of the piece, placed in its stable pose.
    support : the support below the piece.
    on_track : number of the object that the piece stands on; None if it stands on ``support``.
    """
    resting_pose = piece.stable_pose.name
    return PlacedObject(
        track,
        piece.category,
        piece.kind,
        piece.mesh,
        pose,
        support.name if on_track is None else None,
        on_track,
        lying=resting_pose == "lying" and piece.category != "box",
        upside_down=resting_pose == "upside_down",
    )


def _draw_resting_pose(category: str, rng: Generator) -> str:
    draw = rng.random()
    upside_down = _UPSIDE_DOWN.get(category, 0.0)
    if draw < upside_down:
        return "upside_down"
    return "lying" if draw < upside_down + _LYING.get(category, 0.0) else "upright"


class Layout:
    """Objects on supports, placed one by one without overlap; ``objects`` lists them.

    Parameters
    ----------
    gap : minimum distance between footprints, metres; may change between objects.
    headroom : maximum height of an object's top above its support, metres.
    enclosed : whether no part of an object may extend beyond the edges of its support.
    """

    def __init__(
        self, rng: Generator, *, gap: float, headroom: float = 1.0, enclosed: bool = False
    ) -> None:
        self.objects: list[PlacedObject] = []
        self.gap = gap
        self._rng = rng
        self._headroom = headroom
        self._enclosed = enclosed
        self._places: list[Footprint] = []
        self._base_supports: list[Support] = []

    def put(
        self, category: str, support: Support, half: F8, *, stack: float = 0.0, attempts: int = 6
    ) -> bool:
        """Place a new object; return whether there was room for it.

        Parameters
        ----------
        half : (2,) half the size in x and y, metres, of the area around the support's centre in
            which to place it.
        stack : probability of first trying to place it on another object.
        attempts : number of objects to make and try before giving up.
        """
        for _ in range(attempts):
            piece = make_piece(category, self._rng)
            size = piece.footprint
            if size.high > self._headroom or np.ptp(size.outline, axis=0).max() > _WIDEST_M:
                continue
            if self._rng.random() < stack and self._put_on_object(piece):
                return True
            if self.put_piece(piece, support, half):
                return True
        return False

    def put_piece(self, piece: Piece, support: Support, half: F8) -> bool:
        """Try 40 random positions of an object on a support; return whether it was placed.

        ``half`` (2,) is as for `put`.
        """
        middle = support.outline[:, :2].mean(axis=0)
        for _ in range(40):
            spot = middle + self._rng.uniform(-half, half)
            turn = self._random_yaw_pose(np.array([*spot, support.height]))
            placed = piece.footprint.moved(turn)
            if self._fits(placed, support):
                self._add(piece, turn, placed, support, None)
                return True
        return False

    def reserve_position(self, k: int, support: Support, half: F8) -> F8 | None:
        """Reserve a second position for object ``k``, which keeps its first one.

        ``half`` (2,) is as for `put`.

        Returns
        -------
        The translation (3,) of its pose there, metres, or None if there is no room.
        """
        item, middle = self.objects[k], support.outline[:, :2].mean(axis=0)
        first = self._places[k]
        for _ in range(200):
            spot = np.round(middle + self._rng.uniform(-half, half), 6)
            place = np.array([*spot, item.pose.translation[2]])
            placed = first.moved(Pose(np.eye(3), place - item.pose.translation))
            if self._fits(placed, support):
                self._places.append(placed)
                return place
        return None

    def _put_on_object(self, piece: Piece) -> bool:
        candidates = [k for k in range(len(self.objects)) if self._can_support(k)]
        if not candidates or piece.category == "ball":
            return False
        for _ in range(8):
            k = candidates[int(self._rng.integers(len(candidates)))]
            below = self._places[k]
            slack = 0.25 * np.ptp(below.top, axis=0)
            spot = [*below.top.mean(axis=0) + self._rng.uniform(-slack, slack), below.high]
            turn = self._random_yaw_pose(np.array(spot))
            placed = piece.footprint.moved(turn)
            if _supports(below, placed) and self._fits(placed, self._base_supports[k]):
                self._add(piece, turn, placed, self._base_supports[k], self.objects[k].track)
                return True
        return False

    def _random_yaw_pose(self, place: F8) -> Pose:
        """Return a pose with a random yaw and the translation ``place`` (3,)."""
        angle = self._rng.uniform(0, 2 * np.pi)
        return pose_from_yaw(angle, np.round(place, 6))

    def _fits(self, placed: Footprint, support: Support) -> bool:
        on_board = placed.low < support.height + 1e-4
        edge = support.outline[:, :2]
        if on_board and not inside(placed.contact, edge, _EDGE_M):
            return False
        if self._enclosed and not inside(placed.outline, edge, 0.003):
            return False
        if placed.high > support.height + self._headroom:
            return False
        beside = [p for p in self._places if p.low < placed.high and p.high > placed.low + 1e-6]
        return not any(overlap(placed.outline, p.outline, self.gap) for p in beside)

    def _can_support(self, k: int) -> bool:
        top = self._places[k].top
        flat = len(top) > 2 and float(np.ptp(top, axis=0).min()) > _SMALLEST_TOP_M
        return flat and self.objects[k].category in SUPPORTING

    def _add(
        self, piece: Piece, turn: Pose, placed: Footprint, support: Support, on_track: int | None
    ) -> None:
        """Add a piece, moved by ``turn``; ``placed`` is its footprint there.

        ``support`` is the support below it, also if it stands on the object ``on_track``.
        """
        pose = compose(turn, piece.stable_pose.pose)
        self.objects.append(place_piece(piece, len(self.objects), pose, support, on_track))
        self._places.append(placed)
        self._base_supports.append(support)


def _supports(below: Footprint, above: Footprint) -> bool:
    """Return whether the middle 60 % of the contact area of ``above`` is on top of ``below``."""
    middle = above.contact.mean(axis=0)
    return inside(middle + 0.6 * (above.contact - middle), below.top, 0.002)
