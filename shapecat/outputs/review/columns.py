"""Collect the rows of the review's entities over time, and write them as columns.

A call for each row costs ten times as much, and Rerun keeps a record of each chunk. So an entity is
written when its buffer holds enough rows, or enough numbers.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import rerun as rr

__all__ = ["At", "Columns", "Drawing", "curve"]

At = tuple[int, int]
"""Stamp in nanoseconds, and frame number."""

_ROWS = 256
"""An entity is written when it holds this many rows."""
_NUMBERS = 1 << 17
"""An entity is written earlier if its rows hold this many numbers."""


class Drawing(NamedTuple):
    """The function that turns the rows of an entity into columns, and the entity's static style."""

    columns: Callable[[Sequence[Any]], Iterable[rr.ComponentColumn]]
    style: rr.AsComponents | None = None


@dataclass
class _Buffer:
    """The rows of an entity that are not written yet."""

    drawing: Drawing
    at: list[At] = field(default_factory=list)
    rows: list[Any] = field(default_factory=list)
    size: int = 0


class Columns:
    """Holds back the rows of all entities, and writes them as columns."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        """Start without rows."""
        self._stream = stream
        self._buffers: dict[str, _Buffer] = {}

    def add(self, entity: str, at: At, row: Any, drawing: Drawing, *, size: int = 1) -> None:
        """Add a row of an entity; the first row also writes the style of the entity.

        Parameters
        ----------
        at : stamp (ns) and number of the frame.
        row : what ``drawing`` converts to columns.
        drawing : the same for all rows of this entity.
        size : number of values that the row keeps in memory.
        """
        if entity not in self._buffers:
            self._buffers[entity] = _Buffer(drawing)
            if drawing.style is not None:
                self._stream.log(entity, drawing.style, static=True)
        buffer = self._buffers[entity]
        buffer.at.append(at)
        buffer.rows.append(row)
        buffer.size += size
        if len(buffer.rows) >= _ROWS or buffer.size >= _NUMBERS:
            self._send(entity)

    def send(self) -> None:
        """Write all rows that are held back."""
        for entity in self._buffers:
            self._send(entity)

    def _send(self, entity: str) -> None:
        buffer = self._buffers[entity]
        if buffer.rows:
            columns = buffer.drawing.columns(buffer.rows)
            self._stream.send_columns(entity, _times_of(buffer.at), columns)
            self._buffers[entity] = _Buffer(buffer.drawing)


def curve(rows: Sequence[Sequence[float]]) -> Iterable[rr.ComponentColumn]:
    """Return the columns of a plot with one or several lines: a row has one value per line."""
    values = np.array(rows, np.float64)
    columns = rr.Scalars.columns(scalars=values.ravel())
    yield from columns.partition([values.shape[1]] * len(values))


def _times_of(at: Sequence[At]) -> list[rr.TimeColumn]:
    """Return the columns of the timelines ``sensor_time`` and ``frame``."""
    stamps, indices = np.array(at, np.int64).T
    return [
        rr.TimeColumn("sensor_time", timestamp=stamps.astype("datetime64[ns]")),
        rr.TimeColumn("frame", sequence=indices),
    ]
