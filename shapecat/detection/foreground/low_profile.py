"""Low-profile objects: they rise from their plane in a step, unlike low-frequency depth error.

They consist of low cells, which are on the plane or less than `LowProfileSettings.low_m` above it.
Only an object has an edge. So low-frequency depth error is removed first (`depth_error`), and low
parts are classified by their outline rather than by their height.
"""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, I4, Bool, Records
from shapecat.detection.connected_components import SIDES
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.foreground.convex_hull import fill_hull
from shapecat.detection.foreground.depth_error import (
    NOISE_STRIDE,
    clear_contact,
    filter_high_pass,
    measure_noise,
    measure_residual,
)
from shapecat.detection.foreground.outline import Limits, is_object, measure_outline, width_of_part
from shapecat.detection.foreground.settings import LOW
from shapecat.detection.planes.height_map import HeightMap
from shapecat.jit import kernel, unset

__all__ = ["find_low_profile"]

CELLS_PER_BLOCK = 16
"""Number of cells in a block; one test skips a block whose cells are all below the lowest level."""


class Scratch(NamedTuple):
    """Work space for flood fills.

    Attributes
    ----------
    flooded : (rows, columns) int32, the number of the last part that was flooded at each cell.
    part : (rows, columns) int32, the number of the last part whose outline was considered, with its
        filled hull, at each cell.
    seeds, cells : (rows * columns,) int32, lists of flat cell indices.
    """

    flooded: I4
    part: I4
    seeds: I4
    cells: I4


@kernel
def find_low_profile(
    grid: DepthGrid, heights: HeightMap, planes: Records, max_size_m: float
) -> Bool:
    """Find the low-profile objects on each plane; assign cells with mere depth error to the plane.

    Parameters
    ----------
    heights : ``plane_id`` is changed in place: k + 1 for objects on plane k; -(k + 1) for samples
        of plane k that only depth error lifts off it.
    planes : (planes,) records of `PLANE`, from `pack_planes`.
    max_size_m : maximum width of a low-profile object, metres.

    Returns
    -------
    (rows, columns) where the low-profile objects are.
    """
    inv_depth, jump, (plane_id, height) = grid.inverse_depth, grid.discontinuity, heights
    shape, size = inv_depth.shape, inv_depth.size
    widest = max_size_m * grid.intrinsics.fx
    residuals, high_passes = unset(shape, np.float32), unset(shape, np.float32)
    drops, object_ids = unset(size, np.float32), np.zeros(shape, np.int16)
    scratch = Scratch(
        np.zeros(shape, np.int32),
        np.zeros(shape, np.int32),
        unset(size, np.int32),
        unset(size, np.int32),
    )
    objects = parts = 0
    for k in range(len(planes)):
        number, a, b = k + 1, planes[k].a, planes[k].b
        start, end = _rows_of(plane_id, number)
        if start == end:
            continue
        plane = np.array([a, b, planes[k].c + start * b])  # below, row 0 is row ``start``
        values, plane_ids, marks = inv_depth[start:end], plane_id[start:end], object_ids[start:end]
        residual, high_pass = residuals[start:end], high_passes[start:end]
        above = HeightMap(plane_ids, height[start:end])
        if measure_residual(values, above, plane, number, residual) < LOW.min_cells:
            continue
        clear_contact(values, above, number, 2 * jump, residual, scratch.seeds, drops)
        filter_high_pass(residual, high_pass)
        clear = max(LOW.step, LOW.noise_factor * measure_noise(high_pass, plane_ids, number))
        step = max(clear, LOW.slope_share * math.hypot(a, b))
        limits = Limits(step, np.float32(min(clear, LOW.fine)), widest, jump)
        objects, parts = _mark_objects(
            values, high_pass, plane_ids, number, limits, marks, objects, parts, scratch
        )
        parts = _drop_error(values, residual, plane_ids, number, limits, marks, parts, scratch)
    low_profile: Bool = object_ids > 0
    return low_profile


@kernel(inline=True)
def _rows_of(plane_id: I4, number: int) -> tuple[int, int]:
    """Return the first row of the cells of a plane, and one past the last, with a margin.

    Both are 0 if there is no cell. ``plane_id`` and ``number``, from 1, are as in `HeightMap`. The
    margin holds all neighbours that the search for low-profile objects reads.
    """
    rows = plane_id.shape[0]
    above, on = np.int8(number), np.int8(-number)
    start, end = rows, 0
    for i in range(rows):
        occupied = False
        for j in range(plane_id.shape[1]):
            occupied |= (plane_id[i, j] == above) | (plane_id[i, j] == on)
        if occupied:
            start, end = min(start, i), i + 1
    if end == 0:
        return 0, 0
    start = max(start - LOW.rise_cells, 0)
    # Noise is measured on the same rows as in the whole image.
    return start - start % NOISE_STRIDE, min(end + LOW.rise_cells, rows)


@kernel(inner=True)
def _mark_objects(
    inv_depth: F4,
    high_pass: F4,
    plane_id: I4,
    number: int,
    limits: Limits,
    object_ids: I4,
    objects: int,
    parts: int,
    scratch: Scratch,
) -> tuple[int, int]:
    """Mark the parts above each level that have the outline of an object.

    The objects are numbered from ``objects`` + 1, the parts from ``parts`` + 1; the last
    numbers are returned. ``object_ids`` (rows, columns) holds the number of the object at each
    cell, 0 elsewhere; ``high_pass`` (rows, columns) is from `filter_high_pass`. The cells of
    objects become cells above the plane in ``plane_id``. The other parameters are as in
    `measure_outline`.
    """
    flat, marks, plane_ids = high_pass.reshape(-1), object_ids.reshape(-1), plane_id.reshape(-1)
    flooded, part, seeds, cells = scratch
    visited, part_of = flooded.reshape(-1), part.reshape(-1)
    n = _find_seeds(high_pass, limits.unit * LOW.levels[-1], seeds)
    merits = np.zeros(1 + objects + len(LOW.levels) * (flat.size // LOW.min_cells), np.float32)
    for multiple in LOW.levels:
        level = np.float32(limits.unit * multiple)
        first = parts
        for s in seeds[:n]:
            if visited[s] > first or not flat[s] > level:
                continue
            parts += 1
            count = _flood(high_pass, level, s, parts, flooded, cells)
            if count < LOW.min_cells:
                continue
            overlap, best_merit = 0, 0.0
            for p in cells[:count]:
                part_of[p] = parts
                overlap += marks[p] > 0
                best_merit = max(best_merit, merits[marks[p]])
            if (
                overlap > LOW.max_overlap * count
                or width_of_part(inv_depth, cells, count) > limits.width
            ):
                continue
            filled = fill_hull(high_pass, part, cells, count)
            outline = measure_outline(
                inv_depth, high_pass, plane_id, part, cells, filled, number, limits
            )
            for p in cells[count:filled]:
                best_merit = max(best_merit, merits[marks[p]])
            merit = outline.rise / outline.sides
            if merit > LOW.grown * best_merit and is_object(outline, filled):
                objects += 1
                merits[objects] = merit
                for p in cells[:filled]:
                    marks[p], plane_ids[p] = objects, number
    return objects, parts


@kernel(inline=True)
def _find_seeds(high_pass: F4, threshold: float, seeds: I4) -> int:
    """List the cells above ``threshold`` that are higher than their left and upper neighbours.

    At ``threshold`` and every higher level, the first cell of each part above the level is listed.
    Writes flat indices to ``seeds``; returns their number. ``high_pass`` (rows, columns) is from
    `filter_high_pass`. Most cells are below ``threshold``, so a vectorised test skips whole blocks.
    """
    rows, columns = high_pass.shape
    flat = high_pass.reshape(-1)
    n = 0
    for i in range(1, rows):
        for start in range(1, columns, CELLS_PER_BLOCK):
            # Unsigned indices instead of slices: numba counts the references to each slice.
            cell = np.uint64(i * columns + start)
            before, above = cell - np.uint64(1), np.uint64((i - 1) * columns + start)
            cells = np.uint64(min(CELLS_PER_BLOCK, columns - start))
            any_above = False
            for k in range(cells):
                value = flat[cell + k]
                any_above |= (
                    (value > threshold) & (value > flat[before + k]) & (value > flat[above + k])
                )
            if not any_above:
                continue
            for k in range(cells):
                value = flat[cell + k]
                seeds[n] = cell + k
                higher = (value > flat[before + k]) & (value > flat[above + k])
                n += int((value > threshold) & higher)
    return n


@kernel(inner=True)
def _flood(residual: F4, level: float, start: int, n: int, part: I4, cells: I4) -> int:
    """Set ``part`` to ``n`` in the cells above ``level`` that are connected with ``start``.

    Lists these cells in ``cells`` and returns their number. ``start`` is a flat index; ``residual``
    (rows, columns), 1/m, must be 0 at the border of the image; ``part`` is (rows, columns),
    ``cells`` (rows * columns,).
    """
    columns = residual.shape[1]
    flat, parts = residual.reshape(-1), part.reshape(-1)
    cells[0] = start
    parts[start] = n
    head, tail = 0, 1
    while head < tail:
        p = cells[head]
        head += 1
        for step in (1, -1, columns, -columns):
            q = np.uint64(p + step)  # unsigned: no check for negative indices
            new = (parts[q] != n) & (flat[q] > level)
            parts[q] = n if new else parts[q]  # a branch would be unpredictable
            cells[tail] = q
            tail += int(new)
    return tail


@kernel(inner=True)
def _drop_error(
    inv_depth: F4,
    residual: F4,
    plane_id: I4,
    number: int,
    limits: Limits,
    object_ids: I4,
    parts: int,
    scratch: Scratch,
) -> int:
    """Assign the parts of the remaining low cells to the plane if their outline shows depth error.

    Cells on the side of an object and small parts are left out. The parts are numbered from
    ``parts`` + 1; the last number is returned. ``object_ids`` is from `_mark_objects`; the other
    parameters are as in `measure_outline`.
    """
    rows, columns = residual.shape
    _, part, seeds, cells = scratch
    above = np.zeros(residual.shape, np.float32)
    n = 0
    for i in range(rows):
        any_low = False
        for j in range(columns):
            any_low |= (plane_id[i, j] == number) & (residual[i, j] != 0)
        if not any_low:
            continue
        for j in range(columns):
            low = (plane_id[i, j] == number) & (residual[i, j] != 0) & (object_ids[i, j] == 0)
            if low and _is_flat(residual, i, j):
                above[i, j] = 1
                seeds[n] = i * columns + j
                n += 1
    part_of, plane_ids = part.reshape(-1), plane_id.reshape(-1)
    first = parts
    for s in seeds[:n]:
        if part_of[s] > first:
            continue
        parts += 1
        count = _flood(above, np.float32(0), s, parts, part, cells)
        if count < LOW.small_part:
            continue
        line = measure_outline(inv_depth, residual, plane_id, part, cells, count, number, limits)
        if line.facing >= LOW.facing_share * line.sides and line.rise < line.facing:
            for t in range(count):
                plane_ids[cells[t]] = -number
    return parts


@kernel(inline=True)
def _is_flat(residual: F4, i: int, j: int) -> bool:
    """Return whether the surface is flat around the low cell in row ``i`` and column ``j``.

    On flat surface, unlike on the side of an object, the four cells two rows or columns away are
    low too, and their residuals differ from its own by at most `LOW.side`; those outside the image
    do not count. ``residual`` (rows, columns), 1/m, is from `measure_residual`, 0 if not low.
    """
    rows, columns = residual.shape
    value = residual[i, j]
    for di, dj in SIDES:
        y, x = i + 2 * di, j + 2 * dj
        if y < 0 or x < 0 or y >= rows or x >= columns:
            continue
        if residual[y, x] == 0 or abs(residual[y, x] - value) > LOW.side:
            return False
    return True
