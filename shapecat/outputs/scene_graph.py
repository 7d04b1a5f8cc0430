"""Scene graph: what each object or plane stands on (the hierarchy of thesis 4.5)."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from shapecat.arrays import F8
from shapecat.geometry import gravity_rotation
from shapecat.types import Candidate, Plane, Scene

__all__ = ["Node", "format_tree"]

_ON_TOP_M = 0.04
"""Largest difference in height between an object's top and a plane fitted to this top, metres."""


@dataclass(frozen=True)
class Node:
    """A plane or an object; ``index`` is its index in `Scene.planes` or `Scene.candidates`."""

    kind: Literal["plane", "object"]
    index: int


def format_tree(scene: Scene, describe: Callable[[Node], str]) -> str:
    """Return the scene as an indented tree, one node per line; planes come before objects.

    ``describe`` returns the text of a node. A node that stands on several others is printed under
    each of them; after the first time, it is marked ``=`` and printed without what stands on it.

    Examples
    --------
    >>> format_tree(Scene([0, -1, 0], (), ()), str)
    'no plane, no object'
    """
    children = defaultdict[Node | None, list[Node]](list)
    for k in range(len(scene.planes)):
        children[_below_plane(scene, k)].append(Node("plane", k))
    for k, candidate in enumerate(scene.candidates):
        for parent in _below_object(candidate):
            children[parent].append(Node("object", k))
    lines: list[str] = []
    printed: set[Node] = set()

    def add(node: Node, depth: int) -> None:
        prefix = "= " if node in printed else ""
        lines.append("  " * depth + prefix + describe(node))
        if node not in printed:
            printed.add(node)
            for child in children[node]:
                add(child, depth + 1)

    for root in children[None]:
        add(root, 0)
    return "\n".join(lines) or "no plane, no object"


def _below_object(candidate: Candidate) -> Sequence[Node | None]:
    """Return the object and the plane on which an object stands directly; [None] if neither."""
    below: list[Node | None] = []
    if candidate.on_candidate is not None:
        below.append(Node("object", candidate.on_candidate))
    if candidate.plane is not None and (candidate.on_candidate is None or candidate.support_m == 0):
        below.append(Node("plane", candidate.plane))
    return below or [None]


def _below_plane(scene: Scene, k: int) -> Node | None:
    """Return the object whose top is plane ``k``, or else the highest plane below its middle.

    The result is None if there is neither.
    """
    middle = scene.planes[k].outline.mean(axis=0)
    level = gravity_rotation(scene.up)[:2]
    for n, candidate in enumerate(scene.candidates):
        top = float(scene.up @ candidate.box.center) + float(candidate.box.size[2]) / 2
        if candidate.plane != k and abs(top - float(scene.up @ middle)) < _ON_TOP_M:
            distance = np.linalg.norm(level @ (candidate.box.center - middle))
            if distance < 0.5 * min(candidate.box.size[:2]):
                return Node("object", n)
    for lower in reversed(range(k)):
        if _covers(scene.planes[lower], middle):
            return Node("plane", lower)
    return None


def _covers(plane: Plane, point: F8) -> bool:
    """Return whether a point (3,) is within the convex outline of a plane, seen from above."""
    level = gravity_rotation(plane.normal)[:2]
    outline, (x, y) = plane.outline @ level.T, level @ point
    sides = np.roll(outline, -1, axis=0) - outline
    turns = sides[:, 0] * (y - outline[:, 1]) - sides[:, 1] * (x - outline[:, 0])
    return len(outline) > 2 and bool((turns >= 0).all() or (turns <= 0).all())
