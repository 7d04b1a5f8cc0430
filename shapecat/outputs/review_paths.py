"""The paths of tracks in the review."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from shapecat.arrays import F8
from shapecat.outputs.review_columns import At, Columns
from shapecat.outputs.review_shapes import paths

__all__ = ["Paths"]

_STEP_M, _POINTS = 0.015, 500
"""A path grows when its object has moved so far; places it keeps."""


@dataclass
class _Path:
    """Where a track has been."""

    category: str
    places: list[F8] = field(default_factory=list)

    @property
    def drawn(self) -> bool:
        """Whether there is a line to draw."""
        return len(self.places) > 1

    def grow(self, place: F8) -> bool:
        """Add a place; return whether there is more to draw."""
        if self.places and np.linalg.norm(place - self.places[-1]) <= _STEP_M:
            return False
        self.places.append(place)
        del self.places[:-_POINTS]
        return self.drawn


class Paths:
    """Paths of tracks by entity, written all at once when one grows or ends."""

    def __init__(self, columns: Columns) -> None:
        """Begin without paths."""
        self._columns = columns
        self._paths: dict[str, dict[int, _Path]] = {}

    def add(
        self, entity: str, at: At, seen: Mapping[int, tuple[str, F8]], ended: Iterable[int]
    ) -> None:
        """Take the category and the place of each track that a frame shows."""
        known = self._paths.setdefault(entity, {})
        gone = [known.pop(number) for number in ended if number in known]
        grown = [
            known.setdefault(number, _Path(category)).grow(place)
            for number, (category, place) in seen.items()
        ]
        if any(grown) or any(path.drawn for path in gone):
            ways = [(path.category, np.array(path.places)) for path in known.values() if path.drawn]
            size = sum(places.size for _, places in ways)
            self._columns.add(entity, at, ways, paths, size=size)
