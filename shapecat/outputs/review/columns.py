"""Rows of the review's entities over time, held back and sent as columns.

A call for each row costs ten times as much, and Rerun keeps a record of each chunk. So an entity is
written when enough rows, or enough numbers, are held back.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

__all__ = ["At", "Columns", "curve"]

At = tuple[int, int]
"""Stamp in nanoseconds, and frame number."""

_ROWS, _NUMBERS = 256, 1 << 17
"""An entity is written when it holds this many rows, or this many numbers in them."""

_Draw = Callable[[Sequence[Any]], Iterable[rr.ComponentColumn]]


@dataclass
class _Buffer:
    """The rows of an entity that are not written yet."""

    draw: _Draw
    at: list[At] = field(default_factory=list)
    rows: list[Any] = field(default_factory=list)
    size: int = 0


class Columns:
    """Holds back the rows of all entities, and writes them as columns."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        """Start without rows."""
        self._stream = stream
        self._buffers: dict[str, _Buffer] = {}

    def add(self, entity: str, at: At, row: Any, draw: _Draw, *, size: int = 1) -> None:
        """Add a row of an entity.

        Parameters
        ----------
        draw : converts the rows of this entity to columns.
        size : number of values that the row keeps in memory.
        """
        buffer = self._buffers.setdefault(entity, _Buffer(draw))
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
            self._stream.send_columns(entity, _times_of(buffer.at), buffer.draw(buffer.rows))
            self._buffers[entity] = _Buffer(buffer.draw)


def curve(rows: Sequence[Sequence[float]]) -> Iterable[rr.ComponentColumn]:
    """Return the columns of a plot with one or several lines: a row has one value per line."""
    values = np.array(rows, np.float64)
    columns = rr.Scalars.columns(scalars=values.ravel())
    yield from columns.partition([values.shape[1]] * len(values))


def _times_of(at: Sequence[At]) -> list[rr.TimeColumn]:
    """Return the columns of both timelines."""
    stamps, indices = np.array(at, np.int64).T
    return [
        rr.TimeColumn("sensor_time", timestamp=stamps.astype("datetime64[ns]")),
        rr.TimeColumn("frame", sequence=indices),
    ]
