"""Scene graph: which objects and planes stand on which (the hierarchy of thesis 4.5)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from shapecat.arrays import F8
from shapecat.geometry import gravity_rotation
from shapecat.types import Candidate, Plane, Scene

__all__ = ["Hierarchy", "Node", "format_tree"]

ON_TOP_M = 0.04
"""A plane nearer than this to the top of an object is the object's top, metres."""


@dataclass(frozen=True, order=True)
class Node:
    """A plane or an object; ``index`` is its index in `Scene.planes` or `Scene.candidates`."""

    kind: Literal["plane", "object"]
    index: int


@dataclass(frozen=True)
class Hierarchy:
    """The support graph of a scene, with one node for each plane and each object.

    A node may have several parents.

    Examples
    --------
    >>> Hierarchy(Scene([0, -1, 0], (), ())).roots
    ()
    """

    scene: Scene

    @cached_property
    def nodes(self) -> tuple[Node, ...]:
        """All nodes: planes in order of height, then objects."""
        planes = [Node("plane", k) for k in range(len(self.scene.planes))]
        return (*planes, *(Node("object", k) for k in range(len(self.scene.candidates))))

    @cached_property
    def edges(self) -> tuple[tuple[Node, Node], ...]:
        """Pairs (lower, upper) of nodes; the upper stands directly on the lower."""
        pairs = [
            (parent, Node("object", k))
            for k, candidate in enumerate(self.scene.candidates)
            for parent in self._parents_of_object(candidate)
        ]
        for k in range(len(self.scene.planes)):
            lower = self._below_plane(k)
            if lower is not None:
                pairs.append((lower, Node("plane", k)))
        return tuple(sorted(set(pairs)))

    @property
    def roots(self) -> tuple[Node, ...]:
        """The nodes that stand on nothing: planes in order of height, then objects."""
        upper = {b for _, b in self.edges}
        return tuple(node for node in self.nodes if node not in upper)

    def children(self, node: Node) -> tuple[Node, ...]:
        """Return the nodes directly on ``node``: planes in order of height, then objects."""
        upper = {b for a, b in self.edges if a == node}
        return tuple(n for n in self.nodes if n in upper)

    def _parents_of_object(self, candidate: Candidate) -> Iterable[Node]:
        if candidate.on_candidate is not None:
            yield Node("object", candidate.on_candidate)
        if candidate.plane is not None and (
            candidate.on_candidate is None or candidate.support_m == 0
        ):
            yield Node("plane", candidate.plane)

    def _below_plane(self, k: int) -> Node | None:
        """Return the object whose top is plane k, or else the highest plane below its middle."""
        planes = self.scene.planes
        middle = planes[k].outline.mean(axis=0)
        for n, candidate in enumerate(self.scene.candidates):
            if candidate.plane != k and abs(self._top(n) - self._height(middle)) < ON_TOP_M:
                level = gravity_rotation(self.scene.up)[:2]
                distance = np.linalg.norm(level @ (candidate.box.center - middle))
                if distance < 0.5 * min(candidate.box.size[:2]):
                    return Node("object", n)
        for lower in reversed(range(k)):
            if _covers(planes[lower], middle):
                return Node("plane", lower)
        return None

    def _height(self, point: F8) -> float:
        return float(self.scene.up @ point)

    def _top(self, k: int) -> float:
        box = self.scene.candidates[k].box
        return self._height(box.center) + float(box.size[2]) / 2


def _covers(plane: Plane, point: F8) -> bool:
    """Return whether a point is within the convex outline of a plane, seen from above."""
    level = gravity_rotation(plane.normal)[:2]
    outline, (x, y) = plane.outline @ level.T, level @ point
    sides = np.roll(outline, -1, axis=0) - outline
    turns = sides[:, 0] * (y - outline[:, 1]) - sides[:, 1] * (x - outline[:, 0])
    return len(outline) > 2 and bool((turns >= 0).all() or (turns <= 0).all())


def format_tree(scene: Scene, describe: Callable[[Node], str]) -> str:
    """Return the hierarchy as indented text, one node per line.

    A node with several parents is printed under each, marked ``=`` after the first time.

    Examples
    --------
    >>> format_tree(Scene([0, -1, 0], (), ()), str)
    'no plane, no object'
    """
    hierarchy = Hierarchy(scene)
    lines: list[str] = []
    printed: set[Node] = set()

    def add(node: Node, depth: int) -> None:
        prefix = "= " if node in printed else ""
        lines.append("  " * depth + prefix + describe(node))
        if node not in printed:
            printed.add(node)
            for child in hierarchy.children(node):
                add(child, depth + 1)

    for root in hierarchy.roots:
        add(root, 0)
    return "\n".join(lines) or "no plane, no object"
