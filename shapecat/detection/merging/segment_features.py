"""Traits: what the statistics of pieces say: how wide, round, hollow or closed on top they are."""

import math

import numpy as np

from shapecat.arrays import F4
from shapecat.detection.merging.segments import (
    BAND_M,
    BANDS,
    COUNT,
    FAR,
    FITTED,
    LEFT,
    RIGHTMOST,
    SIDE,
    SIDE2,
    SIDETURN,
    TOP,
    TURN,
    TURN2,
    Pieces,
)
from shapecat.jit import kernel

__all__ = [
    "LID_M",
    "apart",
    "behind",
    "lid_share",
    "roundness_of",
    "slope_of",
    "top_band",
    "width_of",
]

LID_M = 0.02
"""A top is closed by what faces up within this depth of it."""


@kernel(leaf=True)
def width_of(row: F4) -> float:
    """Return the lateral extent of a piece, metres; ``row`` is its row of `Pieces.shape`."""
    return float(row[RIGHTMOST] - row[LEFT])


@kernel(leaf=True)
def apart(a: F4, b: F4) -> float:
    """Return the lateral distance of the middles of two pieces, metres."""
    return float(abs(a[LEFT] + a[RIGHTMOST] - b[LEFT] - b[RIGHTMOST]) / 2)


@kernel(leaf=True)
def behind(a: F4, b: F4) -> float:
    """Return how much farther away than piece ``b`` piece ``a`` is on average, metres."""
    return float(a[FAR] / a[COUNT] - b[FAR] / b[COUNT])


@kernel(leaf=True)
def slope_of(row: F4) -> float:
    """Return by how much the lateral normal changes across a piece.

    2 for a whole cylinder seen from outside, -2 from inside, 0 for a plane.
    """
    spread, _, both = _moments(row)
    return float(both / max(spread, 1e-9) * width_of(row))


@kernel(leaf=True)
def roundness_of(row: F4) -> float:
    """Return the correlation of the lateral normal with the lateral position.

    1 for what is turned about an upright axis; the faces of a box, and tops that are level, do not
    turn steadily.
    """
    spread, turning, both = _moments(row)
    return float(both / math.sqrt(max(spread * turning, 1e-12)))


@kernel(leaf=True)
def _moments(row: F4) -> tuple[float, float, float]:
    """Return the sums of squares of the lateral position and normal, and of products of both."""
    n = max(row[FITTED], np.float32(1))
    spread = row[SIDE2] - row[SIDE] * row[SIDE] / n
    turning = row[TURN2] - row[TURN] * row[TURN] / n
    return spread, turning, row[SIDETURN] - row[SIDE] * row[TURN] / n


@kernel(leaf=True)
def lid_share(pieces: Pieces, p: int, depth: float) -> float:
    """Return what faces up within ``depth`` of the top of a piece, by its width squared."""
    row = pieces.shape[p]
    top = top_band(row)
    area = 0.0
    for band in range(max(top - int(depth / BAND_M), 0), top + 1):
        area += pieces.lid[p, band]
    return float(area / max(width_of(row) ** 2, 1e-9))


@kernel(leaf=True)
def top_band(row: F4) -> int:
    """Return the last band of height in which a piece has anything."""
    return min(int(row[TOP] / BAND_M), BANDS - 1)
