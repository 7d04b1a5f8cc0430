"""Joins: the rules that bring the pieces of one object together, in their order."""

from collections.abc import Collection

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import Cells
from shapecat.detection.occluders import join_around, join_behind
from shapecat.detection.parts import Sight, join_parts, trees
from shapecat.detection.pieces import CONTACT, COUNT, Pieces, depths_of, is_group, merge
from shapecat.detection.surfaces import Surfaces
from shapecat.jit import kernel

__all__ = ["join_pieces"]


def join_pieces(
    pieces: Pieces, cells: Cells, surfaces: Surfaces, labels: I4, up: F8, rules: Collection[str]
) -> None:
    """Apply the rules named in ``rules``; `Pieces.group` holds the result."""
    if "small" in rules:
        _join_small(pieces, cells.small(depths_of(pieces)))
    if "parts" in rules:
        join_parts(pieces, Sight.of(cells, up), trees())
    if "occluder" in rules:
        join_behind(pieces, cells.w, cells.lens, surfaces.normal, labels)
        join_around(pieces)


@kernel
def _join_small(pieces: Pieces, small: F4) -> None:
    """Join a piece smaller than about 9 cm2 to what it touches most."""
    n = pieces.group.size
    again = True
    while again:
        again = False
        for p in range(1, n):
            if not is_group(pieces, p) or pieces.shape[p, COUNT] >= small[p]:
                continue
            q = np.argmax(pieces.pairs[CONTACT, p])
            if pieces.pairs[CONTACT, p, q] > 0:
                merge(pieces, q, p)
                again = True
