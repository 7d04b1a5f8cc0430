"""Low-profile objects rise from their plane in a step, which slow errors of depth do not.

Only an object has an edge. So waves of the surface are levelled first (`waves`), and what is low
is judged by its outline rather than by its height.
"""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.depth_grid import DepthGrid, row_and_column
from shapecat.detection.foreground.convex_hull import fill_hull
from shapecat.detection.foreground.depth_error import (
    APART,
    EVERY,
    clear_contact,
    filter_high_pass,
    measure_noise,
    measure_residual,
)
from shapecat.detection.planes.height_map import HeightMap
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel, unset

__all__ = ["find_low_profile"]

LEVELS = np.array([3.0, 2.0, 1.3, 0.9, 0.6, 0.4], np.float32)
"""Heights above the mean at which outlines are looked for, as multiples of the least rise."""
FINE = 0.006
"""Most that they are multiples of, 1/m: more is not noise but a plane at a grazing angle."""
STEP, STEADY, SLIP = 0.002, 3.5, 0.7
"""Least mean rise across the outline of an object: 1/m; as a multiple of the median rise between
cells of the plane that are as far apart; and as a share of what the plane itself rises in a cell,
for where it is seen at a grazing angle readings that are a little beside their place seem to
rise."""
STEEP, STEEP_SHARE = 0.5, 0.7
"""A rise that is more than noise, as a share of the mean, and the share of the outline that has
it."""
MOST_STEPS = 3
"""A place counts for at most so many times the mean rise."""
ALL_AROUND = 0.75
"""Least sum of the rises for each side of the outline, whether it looks at the plane or not."""
CHANCE = 16
"""A short outline must rise more, by this over its sides: few waves rise all around."""
GROWN = 0.95
"""Rise per side of a part that replaces known objects within it, as a share of the greatest of
theirs: an object and a swell beside it rise less."""
SIDE = 0.004
"""Rise over two cells of the side of something, 1/m."""
SAME = 0.9
"""Share of the cells of a part from which it is a known object."""
INWARD = 2
OUTWARD = APART - INWARD
"""Cells from the outline to where its rise is measured."""
LEAST_CELLS, LEAST_SIDES, SMALL_PART = 80, 30, 12
ALONG, KNOWN, BESIDE = 0.4, 0.65, 0.3
"""Shares of an outline: of an object, least along the plane, and, of what nothing hides, least
along the plane, in touch with what is not low, or before something farther; of a swell, least along
the plane."""
BROAD = 1.5
"""Cells for each side of the outline of what may be partly hidden: strips beside something else
are narrower."""
RAGGED = 80
"""Square of the sides by the cells of what only fills a gap: 16 of a square, 50 of a crescent."""
BLOCK = 16
"""Cells that are looked at together: most are not above any level."""


class Scratch(NamedTuple):
    """Room for floods.

    ``seen`` and ``part`` (rows, columns) int32 hold the number of the last part at each cell, as
    flooded and as filled; ``seeds`` and ``stack`` (cells,) int32 are lists of cells.
    """

    seen: I4
    part: I4
    seeds: I4
    stack: I4


@kernel
def find_low_profile(
    grid: DepthGrid, heights: HeightMap, planes: F8, low_profile: I4, largest_m: float
) -> None:
    """Give low objects the owners of objects, and swells those of the plane, in place.

    Parameters
    ----------
    low_profile : (rows, columns) set to 1, 2, ... on low objects.
    largest_m : wider things are swells or furniture.
    """
    inv_depth, plane_id, height = grid.inverse_depth, heights.plane_id, heights.height
    widest = largest_m * grid.intrinsics.fx
    images = unset((2, *inv_depth.shape), np.float32)
    scratch = Scratch(
        np.zeros(inv_depth.shape, np.int32),
        np.zeros(inv_depth.shape, np.int32),
        unset(inv_depth.size, np.int32),
        unset(inv_depth.size, np.int32),
    )
    objects = parts = np.int64(0)  # a literal would be compiled apart
    for k in range(len(planes)):
        number, plane = k + 1, planes[k].copy()
        start, end = _rows_of(plane_id, number)
        if start == end:
            continue
        plane[2] += start * plane[1]  # rows count from ``start`` from here on
        rows = slice(start, end)
        values, plane_ids, above, marks = (
            inv_depth[rows],
            plane_id[rows],
            height[rows],
            low_profile[rows],
        )
        residual, high_pass = images[0, rows], images[1, rows]
        if measure_residual(values, plane_ids, above, plane, number, residual) < LEAST_CELLS:
            continue
        clear_contact(
            values,
            plane_ids,
            above,
            number,
            residual,
            scratch.seeds,
            scratch.stack.view(np.float32),
        )
        filter_high_pass(residual, high_pass)
        clear = max(STEP, STEADY * measure_noise(high_pass, plane_ids, number))
        step = max(clear, SLIP * math.hypot(plane[0], plane[1]))
        least = np.float32(min(clear, FINE))
        objects, parts = _raise(
            values,
            high_pass,
            plane_ids,
            number,
            step,
            least,
            marks,
            widest,
            objects,
            parts,
            scratch,
        )
        parts = _lower(values, residual, plane_ids, number, step, marks, parts, scratch)


@kernel
def _rows_of(plane_id: I4, number: int) -> tuple[int, int]:
    """Return the rows from which on and before which the cells of a plane are, with a margin.

    They are the same if there is none. What is looked at around a cell lies within the margin.
    """
    rows = plane_id.shape[0]
    above, on = np.int8(number), np.int8(-number)
    start, end = rows, 0
    for i in range(rows):
        some = False
        for j in range(plane_id.shape[1]):
            some |= (plane_id[i, j] == above) | (plane_id[i, j] == on)
        if some:
            start, end = min(start, i), i + 1
    if end == 0:
        return 0, 0
    start = max(start - APART, 0)
    return start - start % EVERY, min(end + APART, rows)  # noise is measured on the same rows


@kernel
def _raise(
    inv_depth: F4,
    high_pass: F4,
    plane_id: I4,
    number: int,
    rise_least: float,
    level_least: float,
    low_profile: I4,
    widest: float,
    objects: int,
    me: int,
    scratch: Scratch,
) -> tuple[int, int]:
    """Mark the parts above each level, filled, whose outline is that of an object.

    They are numbered from ``objects`` + 1 on, the parts that are looked at from ``me`` + 1 on.
    Returns the last numbers. ``high_pass`` (rows, columns) is from `filter_high_pass`;
    ``level_least`` is what `LEVELS` are multiples of, 1/m.
    """
    flat, marks, plane_ids = high_pass.reshape(-1), low_profile.reshape(-1), plane_id.reshape(-1)
    seen, part, seeds, stack = scratch
    visited, parts = seen.reshape(-1), part.reshape(-1)
    n = _find_seeds(high_pass, level_least * LEVELS[-1], seeds)
    merits = np.zeros(1 + objects + LEVELS.size * (flat.size // LEAST_CELLS), np.float32)
    for multiple in LEVELS:
        level = level_least * multiple
        first = me
        for s in seeds[:n]:
            if visited[s] > first or not flat[s] > level:
                continue
            me += 1
            count = _flood(high_pass, level, s, me, seen, stack)
            if count < LEAST_CELLS:
                continue
            known, best = 0, 0.0
            for p in stack[:count]:
                parts[p] = me
                known += marks[p] > 0
                best = max(best, merits[marks[p]])
            if known > SAME * count or _width(inv_depth, stack, count) > widest:
                continue
            filled = fill_hull(high_pass, part, stack, count)
            outline = _outline(
                inv_depth, high_pass, plane_id, part, stack, filled, number, rise_least
            )
            for p in stack[count:filled]:
                best = max(best, merits[marks[p]])
            merit = outline.rise / outline.sides
            if merit > GROWN * best and _is_object(outline, filled):
                objects += 1
                merits[objects] = merit
                for p in stack[:filled]:
                    marks[p], plane_ids[p] = objects, number
    return objects, me


@kernel
def _find_seeds(high_pass: F4, least: float, seeds: I4) -> int:
    """List cells above the lowest level that are higher than the ones before and above them.

    The first cell of a part above any level is one. Returns how many there are. Most cells are
    lower, and to pass over many of them at a time vectorises.
    """
    rows, columns = high_pass.shape
    flat = high_pass.reshape(-1)
    n = 0
    for i in range(1, rows):
        for start in range(1, columns, BLOCK):
            # Unsigned indices instead of slices, each of which counts references.
            here = np.uint64(i * columns + start)
            before, above = here - np.uint64(1), np.uint64((i - 1) * columns + start)
            cells = np.uint64(min(BLOCK, columns - start))
            some = False
            for k in range(cells):
                value = flat[here + k]
                some |= (value > least) & (value > flat[before + k]) & (value > flat[above + k])
            if not some:
                continue
            for k in range(cells):
                value = flat[here + k]
                seeds[n] = here + k
                higher = (value > flat[before + k]) & (value > flat[above + k])
                n += int((value > least) & higher)
    return n


class Outline(NamedTuple):
    """What is known of an outline.

    Attributes
    ----------
    sides : sides of cells; ``table`` of them look at the plane; ``known`` are these, those that
        touch what is not low, and those before something farther; ``hidden`` end at something
        nearer or where nothing is seen.
    rise : sum of the rises of the ``table`` sides, as multiples of the least mean rise.
    steep : how many of them are steep.
    """

    sides: int
    table: int
    known: int
    hidden: int
    rise: float
    steep: int


@kernel
def _width(inv_depth: F4, stack: I4, count: int) -> float:
    """Return the extent of a part along the rows, in cells a metre away."""
    columns = inv_depth.shape[1]
    first, last = columns, 0
    for p in stack[:count]:
        _, j = row_and_column(p, columns)
        first, last = min(first, j), max(last, j)
    return float((last - first) / inv_depth[stack[0] // columns, stack[0] % columns])


@kernel
def _is_object(outline: Outline, count: int) -> bool:
    """Whether an outline around so many cells is that of an object."""
    table, sides = outline.table, outline.sides
    if table < KNOWN * sides and sides * sides > RAGGED * count:
        return False
    seen = sides - (outline.hidden if count > BROAD * sides else 0)
    if table < max(LEAST_SIDES, ALONG * sides) or outline.known < KNOWN * seen:
        return False
    least = max(table * (1 + CHANCE / sides), ALL_AROUND * sides)
    return bool(outline.rise > least and outline.steep > STEEP_SHARE * table)


@kernel
def _flood(residual: F4, level: float, start: int, n: int, part: I4, stack: I4) -> int:
    """Give the connected cells above ``level`` the number ``n``; return how many.

    The cells at the border of the image are 0.
    """
    columns = residual.shape[1]
    flat, parts = residual.reshape(-1), part.reshape(-1)
    stack[0] = start
    parts[start] = n
    done, top = 0, 1
    while done < top:
        p = stack[done]
        done += 1
        for step in (1, -1, columns, -columns):
            q = np.uint64(p + step)  # saves to look whether an index counts from the end
            new = (parts[q] != n) & (flat[q] > level)
            parts[q] = n if new else parts[q]  # branches here are hard to foresee
            stack[top] = q
            top += int(new)
    return top


@kernel
def _outline(
    inv_depth: F4,
    residual: F4,
    plane_id: I4,
    part: I4,
    stack: I4,
    count: int,
    number: int,
    rise_least: float,
) -> Outline:
    """Measure the outline of a part."""
    rows, columns = residual.shape
    parts = part.reshape(-1)
    sides = table = known = hidden = steep = 0
    rise = 0.0
    me = parts[stack[0]]
    for t in range(count):
        p = stack[t]
        beside = (parts[p - 1] == me) & (parts[p + 1] == me)
        if beside & (parts[p - columns] == me) & (parts[p + columns] == me):
            continue
        for d in range(4):
            di = 1 if d == 0 else -1 if d == 1 else 0
            dj = 1 if d == 2 else -1 if d == 3 else 0
            if parts[p + di * columns + dj] == me:
                continue
            i, j = row_and_column(p, columns)
            sides += 1
            y, x = i + di, j + dj
            known += (
                residual[y, x] == 0
                and inv_depth[y, x] > 0
                and abs(inv_depth[y, x] - inv_depth[i, j]) < DISCONTINUITY
            )
            hidden += inv_depth[y, x] <= 0 or inv_depth[y, x] > inv_depth[i, j] + DISCONTINUITY
            y, x = i + OUTWARD * di, j + OUTWARD * dj
            v, u = i - INWARD * di, j - INWARD * dj
            if min(y, x) < 0 or min(v, u) < 0 or max(y, v) >= rows or max(x, u) >= columns:
                continue
            known += 0 < inv_depth[y, x] < inv_depth[i, j] - DISCONTINUITY
            if plane_id[y, x] != -number or residual[y, x] == 0 or abs(plane_id[v, u]) != number:
                continue
            table += 1
            known += 1
            step = (residual[v, u] - residual[y, x]) / rise_least
            if residual[v, u] == 0:  # the inside is not low
                step = MOST_STEPS
            rise += min(step, MOST_STEPS)
            steep += int(step > STEEP)
    return Outline(sides, table, known, hidden, rise, steep)


@kernel
def _lower(
    inv_depth: F4,
    residual: F4,
    plane_id: I4,
    number: int,
    rise_least: float,
    low_profile: I4,
    me: int,
    scratch: Scratch,
) -> int:
    """Give level parts of low object cells whose outline is that of a swell back to the plane.

    The parts are numbered from ``me`` + 1 on; returns the last number.
    """
    rows, columns = residual.shape
    _, part, seeds, stack = scratch
    above = np.zeros(residual.shape, np.uint8)
    n = 0
    for i in range(rows):
        some = False
        for j in range(columns):
            some |= (plane_id[i, j] == number) & (residual[i, j] != 0)
        if not some:
            continue
        for j in range(columns):
            low = (plane_id[i, j] == number) & (residual[i, j] != 0) & (low_profile[i, j] == 0)
            if low and _is_flat(residual, i, j):
                above[i, j] = 1
                seeds[n] = i * columns + j
                n += 1
    parts, plane_ids = part.reshape(-1), plane_id.reshape(-1)
    first = me
    for s in seeds[:n]:
        if parts[s] > first:
            continue
        me += 1
        count = _flood(above, np.uint8(0), s, me, part, stack)
        if count < SMALL_PART:
            continue
        line = _outline(inv_depth, residual, plane_id, part, stack, count, number, rise_least)
        if line.table >= BESIDE * line.sides and line.rise < line.table:
            for t in range(count):
                plane_ids[stack[t]] = -number
    return me


@kernel
def _is_flat(residual: F4, i: int, j: int) -> bool:
    """Whether a low cell is no part of the side of something."""
    rows, columns = residual.shape
    here = residual[i, j]
    for d in range(4):
        y = i + (2 if d == 0 else -2 if d == 1 else 0)
        x = j + (2 if d == 2 else -2 if d == 3 else 0)
        if y < 0 or x < 0 or y >= rows or x >= columns:
            continue
        if residual[y, x] == 0 or abs(residual[y, x] - here) > SIDE:
            return False
    return True
