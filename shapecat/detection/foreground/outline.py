"""Outlines of low parts: the outline of an object is a step, that of depth error is not."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.depth_grid import row_and_column
from shapecat.detection.foreground.settings import LOW, OUTLINES
from shapecat.jit import kernel

__all__ = ["Limits", "Outline", "is_object", "measure_outline", "width_of_part"]


class Limits(NamedTuple):
    """Limits for the low parts of one plane.

    Attributes
    ----------
    rise : minimum mean rise across the outline of an object, 1/m.
    unit : the unit of `LowProfileSettings.levels`, 1/m.
    width : largest width of an object, in cells at a depth of 1 m.
    discontinuity : step that separates two surfaces, 1/m.
    """

    rise: float
    unit: np.float32
    width: float
    discontinuity: float


class Outline(NamedTuple):
    """Counts of the sides of an outline: each lies between a cell of the part and one outside.

    Attributes
    ----------
    sides : all sides.
    facing : sides that face the plane.
    bounded : ``facing`` sides, sides where the surface continues in a cell that is not low, and
        sides in front of a farther surface.
    hidden : sides next to a nearer surface, or to a cell without depth.
    rise : sum of the rises of the ``facing`` sides, each divided by the minimum mean rise, and at
        most `OutlineSettings.max_rise`.
    steep : steep sides among the ``facing`` sides.
    """

    sides: int
    facing: int
    bounded: int
    hidden: int
    rise: float
    steep: int


@kernel(inline=True)
def width_of_part(inv_depth: F4, cells: I4, count: int) -> float:
    """Return the width of a part along the rows, in cells at a depth of 1 m.

    That is its width in cells times the depth of its first cell, metres. ``inv_depth`` is (rows,
    columns), 1/m; the first ``count`` elements of ``cells`` are the flat indices of the part's
    cells.
    """
    columns = inv_depth.shape[1]
    first, last = columns, 0
    for p in cells[:count]:
        _, j = row_and_column(p, columns)
        first, last = min(first, j), max(last, j)
    return float((last - first) / inv_depth[cells[0] // columns, cells[0] % columns])


@kernel(inline=True)
def is_object(outline: Outline, count: int) -> bool:
    """Return whether an outline around ``count`` cells belongs to an object."""
    facing, sides = outline.facing, outline.sides
    if facing < OUTLINES.bounded_share * sides and sides * sides > OUTLINES.ragged * count:
        return False
    visible = sides - (outline.hidden if count > OUTLINES.broad * sides else 0)
    min_facing = max(OUTLINES.min_sides, OUTLINES.facing_share * sides)
    if facing < min_facing or outline.bounded < OUTLINES.bounded_share * visible:
        return False
    min_rise = max(facing * (1 + OUTLINES.chance / sides), OUTLINES.all_around * sides)
    return bool(outline.rise > min_rise and outline.steep > OUTLINES.steep_share * facing)


@kernel(inner=True)
def measure_outline(
    inv_depth: F4,
    residual: F4,
    plane_id: I4,
    part: I4,
    cells: I4,
    count: int,
    number: int,
    limits: Limits,
) -> Outline:
    """Measure the outline of a part, which is a connected set of low cells.

    Parameters
    ----------
    inv_depth : (rows, columns) 1/m.
    residual : (rows, columns) 1/m, from `measure_residual` or `filter_high_pass`; 0 in cells that
        are not low (`LowProfileSettings.low_m`).
    plane_id : (rows, columns) as in `HeightMap`.
    part : (rows, columns) numbers of the parts.
    cells, count : the first ``count`` elements of ``cells`` are the flat indices of this part's
        cells.
    number : number of the plane, from 1, as in ``plane_id``.
    limits : the limits for parts of this plane.
    """
    rows, columns = residual.shape
    parts = part.reshape(-1)
    jump = limits.discontinuity
    sides = facing = bounded = hidden = steep = 0
    rise, outward = 0.0, LOW.rise_cells - OUTLINES.inward
    label = parts[cells[0]]
    for t in range(count):
        p = cells[t]
        beside = (parts[p - 1] == label) & (parts[p + 1] == label)
        if beside & (parts[p - columns] == label) & (parts[p + columns] == label):
            continue
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):  # a different order rounds differently
            if parts[p + di * columns + dj] == label:
                continue
            i, j = row_and_column(p, columns)
            sides += 1
            y, x = i + di, j + dj
            bounded += (
                residual[y, x] == 0
                and inv_depth[y, x] > 0
                and abs(inv_depth[y, x] - inv_depth[i, j]) < jump
            )
            hidden += inv_depth[y, x] <= 0 or inv_depth[y, x] > inv_depth[i, j] + jump
            y, x = i + outward * di, j + outward * dj
            v, u = i - OUTLINES.inward * di, j - OUTLINES.inward * dj
            if min(y, x) < 0 or min(v, u) < 0 or max(y, v) >= rows or max(x, u) >= columns:
                continue
            bounded += 0 < inv_depth[y, x] < inv_depth[i, j] - jump
            if plane_id[y, x] != -number or residual[y, x] == 0 or abs(plane_id[v, u]) != number:
                continue
            facing += 1
            bounded += 1
            step = (residual[v, u] - residual[y, x]) / limits.rise
            if residual[v, u] == 0:  # the inside is not low
                step = OUTLINES.max_rise
            rise += min(step, OUTLINES.max_rise)
            steep += int(step > OUTLINES.steep)
    return Outline(sides, facing, bounded, hidden, rise, steep)
