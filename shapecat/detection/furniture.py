"""Furniture: pieces that are no object but parts of tables and shelves, walls, or noise."""

import numpy as np

from shapecat.arrays import Bool
from shapecat.detection.heights import LEAST_M, NOISE
from shapecat.detection.pieces import AREA, COUNT, FAR, LEFT, RIGHTMOST, RIM, TOP, Pieces

__all__ = ["is_no_object"]

RIM_LINKS, RIM_SHARE = 8, 0.1
FAINT, FAINT_M2 = 2.5, 3e-3
"""A piece this small must rise so many times above the least height of an object cell."""


def is_no_object(pieces: Pieces, *, largest_m: float) -> Bool:
    """Return for each piece whether it is no object, (n + 1,) bool.

    The edge of a board and the legs below it meet the board from below; walls and the sides of
    shelves are larger than ``largest_m``; noise of the plane is small and low.
    """
    shape = pieces.shape
    rim = pieces.single[:, RIM]
    edge = (rim >= RIM_LINKS) & (rim >= RIM_SHARE * pieces.boundary)
    large = shape[:, RIGHTMOST] - shape[:, LEFT] > largest_m
    depth = shape[:, FAR] / shape[:, COUNT].clip(1)
    low = shape[:, TOP] < FAINT * (LEAST_M + NOISE * depth**2)
    faint = low & (shape[:, AREA] < FAINT_M2)
    return np.asarray(edge | large | faint)
