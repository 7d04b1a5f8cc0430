"""Values over time in the review: held back, and sent by the column."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

__all__ = ["At", "Curves", "times_of"]

At = tuple[int, int]
"""Stamp in nanoseconds, and number of the frame."""


class Curves:
    """Values over time, held back and sent as columns: a log call each would cost more."""

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._pending: dict[str, list[tuple[At, Sequence[float]]]] = {}

    def add(self, entity: str, at: At, values: Sequence[float]) -> bool:
        """Hold back values at a stamp and a frame; return whether the entity is new."""
        new = entity not in self._pending
        self._pending.setdefault(entity, []).append((at, values))
        return new

    def send(self) -> None:
        """Write what is held back."""
        for entity, rows in self._pending.items():
            if not rows:
                continue
            values = np.concatenate([np.asarray(row[1], np.float64) for row in rows])
            width = len(rows[0][1])
            self._stream.send_columns(
                entity,
                times_of([row[0] for row in rows]),
                rr.Scalars.columns(scalars=values).partition([width] * len(rows)),
            )
            rows.clear()


def times_of(at: Sequence[At]) -> list[rr.TimeColumn]:
    """Return columns of stamps and of frames."""
    stamps, indices = np.array(at, np.int64).T
    return [
        rr.TimeColumn("sensor_time", timestamp=stamps.astype("datetime64[ns]")),
        rr.TimeColumn("frame", sequence=indices),
    ]
