"""Furniture: pieces that are parts of tables and shelves, walls, or too large for an object."""

from shapecat.arrays import Bool
from shapecat.detection.pieces import LEFT, RIGHTMOST, RIM, Pieces

__all__ = ["is_furniture"]

RIM_LINKS = 8
RIM_SHARE = 0.1


def is_furniture(pieces: Pieces, *, largest_m: float) -> Bool:
    """Return for each piece whether it is no object, (n + 1,) bool.

    The edge of a board and the legs below it meet the board from below; walls and the sides of
    shelves are larger than ``largest_m``.
    """
    rim = pieces.single[:, RIM]
    edge = (rim >= RIM_LINKS) & (rim >= RIM_SHARE * pieces.boundary)
    large = pieces.shape[:, RIGHTMOST] - pieces.shape[:, LEFT] > largest_m
    return edge | large
