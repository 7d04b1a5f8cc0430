"""The centres of the objects of each frame, and how far objects moved between two frames."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from shapecat.arrays import F8
from shapecat.runs.tables.reading import (
    Key,
    frame_rows,
    keys_of,
    numbers,
    numbers_or_nan,
)

__all__ = ["APART_S", "CENTERS", "GAP_S", "Centers", "centers_of", "moved_m"]

APART_S = 0.3
"""Minimum time between two compared frames, so that even a slow camera has moved."""
GAP_S = 2.0
"""Maximum time between two compared frames, so that they show the same objects."""
_FRAME = ("topic", "frame")
CENTERS = {"frames": (*_FRAME, "stamp_ns"), "detections": (*_FRAME, "center", "center_fixed")}
"""The tables and columns that `centers_of` needs."""


class Centers(NamedTuple):
    """The centres (n, 3) of a frame's objects, metres, in the sensor frame and the fixed frame.

    ``fixed`` is NaN if the pose of the sensor is unknown.
    """

    stamp_ns: int
    sensor: F8
    fixed: F8


def centers_of(frames: pa.Table, detections: pa.Table) -> Iterator[tuple[Key, Centers]]:
    """Yield each frame and the centres of its objects, of which there may be none.

    ``frames`` and ``detections`` are parts of the tables for the same frames.
    """
    rows = frame_rows(detections)
    in_sensor, in_fixed = (numbers_or_nan(detections[name]) for name in ("center", "center_fixed"))
    for key, stamp in zip(keys_of(frames), numbers(frames["stamp_ns"]).tolist(), strict=True):
        span = rows.get(key, slice(0, 0))
        yield key, Centers(stamp, in_sensor[span], in_fixed[span])


def moved_m(previous: F8, current: F8) -> float:
    """Return the median distance from ``current`` centres to the nearest previous one, metres.

    ``current`` (n, 3) and ``previous`` (m, 3) are not empty; the result is NaN if they are NaN.
    """
    distances = np.linalg.norm(current[:, None] - previous, axis=2)
    return float(np.median(distances.min(axis=1)))
