"""The paths of tracks in the review."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from shapecat.arrays import F8
from shapecat.outputs.review.columns import At, Columns
from shapecat.outputs.review.shapes import PATHS

__all__ = ["Paths"]

_STEP_M = 0.015
"""An object must move this far, in metres, before its path gets another position."""
_POINTS = 500
"""Maximum number of positions of a path; the oldest are dropped."""


@dataclass
class _Path:
    """The category of a track, and its latest positions (3,), metres."""

    category: str
    places: list[F8] = field(default_factory=list)

    @property
    def drawn(self) -> bool:
        """Whether the path has at least two positions."""
        return len(self.places) > 1

    def grow(self, place: F8) -> bool:
        """Add a position if the object has moved; return whether the drawn path has changed."""
        if self.places and np.linalg.norm(place - self.places[-1]) <= _STEP_M:
            return False
        self.places.append(place)
        del self.places[:-_POINTS]
        return self.drawn


class Paths:
    """The paths of tracks, by Rerun entity; an entity is rewritten when its paths grow or end."""

    def __init__(self, columns: Columns) -> None:
        """Start without paths; those that grow or end are written to ``columns``."""
        self._columns = columns
        self._paths: dict[str, dict[int, _Path]] = {}

    def add(
        self, entity: str, at: At, positions: Mapping[int, tuple[str, F8]], ended: Iterable[int]
    ) -> None:
        """Add the category and position (3,) of each track in a frame; remove those that ended.

        A track that several sensors see has a path in the entity of each; when it ends, all its
        paths are removed.
        """
        gone, entity_paths = set(ended), self._paths.setdefault(entity, {})
        changed = set()
        for other_entity, other_paths in self._paths.items():
            removed = [other_paths.pop(number) for number in gone & other_paths.keys()]
            if any(path.drawn for path in removed):
                changed.add(other_entity)
        for number, (category, place) in positions.items():
            if entity_paths.setdefault(number, _Path(category)).grow(place):
                changed.add(entity)
        for other_entity in sorted(changed):
            self._write(other_entity, at)

    def _write(self, entity: str, at: At) -> None:
        entity_paths = self._paths[entity].values()
        strips = [(path.category, np.array(path.places)) for path in entity_paths if path.drawn]
        size = sum(places.size for _, places in strips)
        self._columns.add(entity, at, strips, PATHS, size=size)
