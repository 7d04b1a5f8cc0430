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
        found = [
            (parent, Node("object", k))
            for k, candidate in enumerate(self.scene.candidates)
            for parent in self._parents_of_object(candidate)
        ]
        for k in range(len(self.scene.planes)):
            lower = self._below_plane(k)
            if lower is not None:
                found.append((lower, Node("plane", k)))
        return tuple(sorted(set(found)))

    @property
    def roots(self) -> tuple[Node, ...]:
        """The nodes that stand on nothing: planes in order of height, then objects."""
        upper = {b for _, b in self.edges}
        return tuple(node for node in self.nodes if node not in upper)

    def parents(self, node: Node) -> tuple[Node, ...]:
        """Return the nodes that ``node`` stands on directly."""
        return tuple(a for a, b in self.edges if b == node)

    def children(self, node: Node) -> tuple[Node, ...]:
        """Return the nodes directly on ``node``: planes in order of height, then objects."""
        upper = {b for a, b in self.edges if a == node}
        return tuple(n for n in self.nodes if n in upper)

    def above(self, node: Node) -> tuple[Node, ...]:
        """Return all nodes that ``node`` supports, directly or indirectly, each once."""
        seen: set[Node] = set()
        open_nodes = [node]
        while open_nodes:
            fresh = [n for n in self.children(open_nodes.pop()) if n not in seen]
            seen.update(fresh)
            open_nodes.extend(fresh)
        return tuple(n for n in self.nodes if n in seen)

    def objects_on(self, plane: int, *, direct: bool = False) -> tuple[int, ...]:
        """Return the indices of the objects on a plane; if ``direct``, only those touching it."""
        reach = self.children if direct else self.above
        return tuple(n.index for n in reach(Node("plane", plane)) if n.kind == "object")

    def count(self, plane: int, *, direct: bool = False) -> int:
        """Return the number of objects on a plane."""
        return len(self.objects_on(plane, direct=direct))

    def highest(self, plane: int) -> int | None:
        """Return the index of the object on a plane that has the highest top, or None."""
        return max(self.objects_on(plane), key=lambda k: (self._top(k), -k), default=None)

    def lowest(self, plane: int) -> int | None:
        """Return the index of the object on a plane that has the lowest top, or None."""
        return min(self.objects_on(plane), key=lambda k: (self._top(k), k), default=None)

    def nearest(self, plane: int) -> int | None:
        """Return the index of the object on a plane that is nearest to the sensor, or None."""
        return min(self.objects_on(plane), key=lambda k: (self._range(k), k), default=None)

    def farthest(self, plane: int) -> int | None:
        """Return the index of the object on a plane that is farthest from the sensor, or None."""
        return max(self.objects_on(plane), key=lambda k: (self._range(k), -k), default=None)

    def objects_on_objects(self) -> tuple[tuple[int, int], ...]:
        """Return pairs (lower, upper) of objects, by index; the upper stands on the lower."""
        return tuple(
            (c.on_candidate, k)
            for k, c in enumerate(self.scene.candidates)
            if c.on_candidate is not None
        )

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
                apart = np.linalg.norm(level @ (candidate.box.center - middle))
                if apart < 0.5 * min(candidate.box.size[:2]):
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

    def _range(self, k: int) -> float:
        return float(np.linalg.norm(self.scene.candidates[k].box.center))


def _covers(plane: Plane, point: F8) -> bool:
    """Return whether a point is within the convex outline of a plane, seen from above."""
    level = gravity_rotation(plane.normal)[:2]
    outline, (x, y) = plane.outline @ level.T, level @ point
    sides = np.roll(outline, -1, axis=0) - outline
    turns = sides[:, 0] * (y - outline[:, 1]) - sides[:, 1] * (x - outline[:, 0])
    return len(outline) > 2 and bool((turns >= 0).all() or (turns <= 0).all())


def format_tree(scene: Scene, describe: Callable[[Scene, Node], str] | None = None) -> str:
    """Return the hierarchy as indented text, one node per line.

    A node with several parents is printed under each, marked ``=`` after the first time.

    Parameters
    ----------
    describe : returns the text for a node; by default its kind, index and size.

    Examples
    --------
    >>> format_tree(Scene([0, -1, 0], (), ()))
    'no plane, no object'
    """
    hierarchy = Hierarchy(scene)
    lines: list[str] = []
    printed: set[Node] = set()
    describe = describe or _described

    def add(node: Node, depth: int) -> None:
        again = "= " if node in printed else ""
        lines.append("  " * depth + again + describe(scene, node))
        if node not in printed:
            printed.add(node)
            for child in hierarchy.children(node):
                add(child, depth + 1)

    for root in hierarchy.roots:
        add(root, 0)
    return "\n".join(lines) or "no plane, no object"


def _described(scene: Scene, node: Node) -> str:
    if node.kind == "plane":
        plane = scene.planes[node.index]
        return f"plane {node.index}: {plane.height_m:.2f} m high, {plane.area_m2:.2f} m2"
    candidate = scene.candidates[node.index]
    x, y, z = candidate.box.size
    flags = [
        text
        for text, flag in (("cut", candidate.touches_border), ("occluded", candidate.occluded))
        if flag
    ]
    note = f" ({', '.join(flags)})" if flags else ""
    return (
        f"object {node.index}: {x:.2f} x {y:.2f} x {z:.2f} m, {len(candidate.indices)} points{note}"
    )
