"""What the review writes over time: rows of an entity, held back and sent by the column.

A call for each row costs ten times as much, and Rerun remembers every chunk it wrote. So an entity
is written when it holds enough rows, or enough numbers.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import rerun as rr

__all__ = ["At", "Columns", "curve"]

At = tuple[int, int]
"""Stamp in nanoseconds, and number of the frame."""

_ROWS, _NUMBERS = 256, 1 << 17
"""Rows, and numbers in them, that an entity holds."""

_Draw = Callable[[Sequence[Any]], Iterable[rr.ComponentColumn]]


@dataclass
class _Held:
    """Rows of an entity that are not written yet."""

    draw: _Draw
    at: list[At] = field(default_factory=list)
    rows: list[Any] = field(default_factory=list)
    size: int = 0


class Columns:
    """The one place that holds back what frames show."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        """Begin without rows."""
        self._stream = stream
        self._held: dict[str, _Held] = {}

    def add(self, entity: str, at: At, row: Any, draw: _Draw, *, size: int = 1) -> None:
        """Add a row of an entity.

        Parameters
        ----------
        draw : makes columns of the rows of this entity.
        size : how many numbers the row keeps in memory.
        """
        held = self._held.setdefault(entity, _Held(draw))
        held.at.append(at)
        held.rows.append(row)
        held.size += size
        if len(held.rows) >= _ROWS or held.size >= _NUMBERS:
            self._send(entity)

    def send(self) -> None:
        """Write all that is held back."""
        for entity in self._held:
            self._send(entity)

    def _send(self, entity: str) -> None:
        held = self._held[entity]
        if held.rows:
            self._stream.send_columns(entity, _times_of(held.at), held.draw(held.rows))
            self._held[entity] = _Held(held.draw)


def curve(rows: Sequence[Sequence[float]]) -> Iterable[rr.ComponentColumn]:
    """Return the values of a curve of one or several lines."""
    values = np.array(rows, np.float64)
    columns = rr.Scalars.columns(scalars=values.ravel())
    yield from columns.partition([values.shape[1]] * len(values))


def _times_of(at: Sequence[At]) -> list[rr.TimeColumn]:
    """Return columns of stamps and of frames."""
    stamps, indices = np.array(at, np.int64).T
    return [
        rr.TimeColumn("sensor_time", timestamp=stamps.astype("datetime64[ns]")),
        rr.TimeColumn("frame", sequence=indices),
    ]
