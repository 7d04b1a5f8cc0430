"""Relief: low things that rise from their plane in a step, told from swells of its surface.

Sensors see a flat table in slow waves, higher than a plate is thick; but only an object has an
edge. So waves are levelled first, and what is low is judged by its outline rather than by its
height.
"""

import math
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.cells import JUMP, Cells, place_of
from shapecat.detection.heights import Heights
from shapecat.detection.hulls import fill_hull
from shapecat.jit import kernel

__all__ = ["raise_low"]

LOW_M = 0.03
"""Higher things are objects anyway."""
WINDOW = 20
"""Cells to each side over which the mean is taken: more than a rim is wide, less than a wave."""
MOST = 0.006
"""Excess above which a cell counts no more in the mean, 1/m, lest it make a pit around it."""
LEVELS = np.array([3.0, 2.0, 1.3, 0.9, 0.6, 0.4], np.float32)
"""Heights above the mean at which outlines are looked for, as multiples of the least rise."""
FINE = 0.006
"""Most that they are multiples of, 1/m: more is not noise but a plane at a grazing angle."""
STEP, STEADY, SLIP = 0.002, 3.5, 0.7
"""Least mean rise across the outline of an object: 1/m; as a multiple of the median rise between
cells of the plane that are as far apart; and as a share of what the plane itself rises in a cell,
for where it is seen at a grazing angle readings that are a little beside their place seem to
rise."""
BIN, BINS, EVERY = 2e-5, 500, 3
"""How rises are counted: width of a bin, 1/m, their number, and every so many cells."""
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
SLOPE = 0.0016
"""Fall per cell of the side of something, 1/m."""
SIDE = 0.004
"""Rise over two cells of the side of something, 1/m."""
SAME = 0.9
"""Share of the cells of a part from which it is a known object."""
INWARD, OUTWARD = 2, 3
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
BLOCK = 64
"""Cells that are looked at together: most are not above any level."""


def raise_low(
    cells: Cells, heights: Heights, planes: F8, raised: I4, stacks: I4, *, largest_m: float
) -> None:
    """Give low objects the owners of objects, and swells those of the plane, in place.

    Parameters
    ----------
    raised : (rows, columns) set to 1, 2, ... on low objects.
    stacks : (2, cells) int32, room.
    largest_m : wider things are swells or furniture.
    """
    w, (owner, height) = cells.w, heights
    widest = largest_m * cells.lens.fx
    objects = 0
    excess, relief = np.zeros((2, *w.shape), np.float32)
    for number, plane in enumerate(planes, 1):
        if _excess(w, owner, height, plane, number, excess) < LEAST_CELLS:
            continue
        _cut_feet(w, owner, height, number, excess, stacks[0], stacks[1].view(np.float32))
        _level(excess, relief)
        clear = max(STEP, STEADY * _noise(relief, owner, number))
        step = max(clear, SLIP * math.hypot(plane[0], plane[1]))
        levels = np.float32(min(clear, FINE)) * LEVELS
        objects = _raise(w, relief, owner, number, step, levels, raised, widest, objects, stacks)
        _lower(w, excess, owner, number, step, raised, stacks)


@kernel
def _excess(w: F4, owner: I4, height: F4, plane: F8, number: int, out: F4) -> int:
    """Write the smoothed inverse depth above the plane of its low cells; 0 elsewhere."""
    rows, columns = w.shape
    zero, one, low = np.float32(0), np.float32(1), np.float32(LOW_M)
    slope = np.float32(plane[0])
    raw = np.zeros((3, columns), np.float32)
    mark = np.zeros((3, columns), np.float32)
    n = 0
    some = False
    out[0, :] = out[rows - 1, :] = zero
    for i in range(rows + 1):
        now, before, some = i % 3, some, False
        if i < rows:
            base = np.float32(plane[1] * i + plane[2])
            for j in range(columns):
                mine = ((owner[i, j] == number) | (owner[i, j] == -number)) & (height[i, j] < low)
                mark[now, j] = one if mine else zero
                raw[now, j] = w[i, j] - (slope * np.float32(j) + base) if mine else zero
                some |= mine
        if i < 2 or i == rows:
            continue
        middle = (i - 1) % 3
        out[i - 1, 0] = out[i - 1, columns - 1] = zero
        if not before:
            out[i - 1, :] = zero
            continue
        for j in range(1, columns - 1):
            total = count = zero
            for r in range(3):
                total += raw[r, j - 1] + raw[r, j] + raw[r, j + 1]
                count += mark[r, j - 1] + mark[r, j] + mark[r, j + 1]
            mine = mark[middle, j] > zero
            out[i - 1, j] = total / count if mine else zero
            n += mine
    return n


@kernel
def _cut_feet(w: F4, owner: I4, height: F4, number: int, excess: F4, stack: I4, drop: F4) -> None:
    """Clear the excess of the feet of what is not low: steep cells below it, down to the plane."""
    rows, columns = excess.shape
    top = 0
    high, edge = np.float32(LOW_M), np.zeros(columns, np.bool_)
    for i in range(1, rows - 1):
        # Few cells are high and beside what is low, and this vectorises.
        here, above, below = excess[i], excess[i - 1], excess[i + 1]
        some = False
        for j in range(1, columns - 1):
            beside = (above[j] != 0) | (below[j] != 0) | (here[j - 1] != 0) | (here[j + 1] != 0)
            edge[j] = beside & (owner[i, j] == number) & (height[i, j] >= high)
            some |= edge[j]
        if not some:
            continue
        for j in range(1, columns - 1):
            if edge[j]:
                for d in range(4):
                    y = i + (1 if d == 0 else -1 if d == 1 else 0)
                    x = j + (1 if d == 2 else -1 if d == 3 else 0)
                    if excess[y, x] != 0 and abs(w[y, x] - w[i, j]) < JUMP:
                        stack[top], drop[top] = y * columns + x, excess[y, x]
                        excess[y, x] = 0
                        top += 1
    done = 0
    while done < top:
        i, j = stack[done] // columns, stack[done] % columns
        here = drop[done]
        done += 1
        for d in range(4):
            y = i + (1 if d == 0 else -1 if d == 1 else 0)
            x = j + (1 if d == 2 else -1 if d == 3 else 0)
            if excess[y, x] != 0 and here - excess[y, x] > SLOPE and abs(w[y, x] - w[i, j]) < JUMP:
                stack[top], drop[top] = y * columns + x, excess[y, x]
                excess[y, x] = 0
                top += 1


@kernel
def _level(excess: F4, relief: F4) -> None:
    """Write the excess over its mean in a window around each low cell; 0 elsewhere.

    The window slides: what enters it is added, what leaves it is taken away. It does so down the
    rows for ``sums`` and ``counts`` of each column, and along a row for those of all its cells.
    """
    rows, columns = excess.shape
    sums, counts = np.zeros(columns, np.float64), np.zeros(columns, np.float64)
    for i in range(-WINDOW, rows):
        for sign, row in ((1, i + WINDOW), (-1, i - WINDOW - 1)):
            if 0 <= row < rows:
                for j in range(columns):
                    sums[j] += sign * min(excess[row, j], MOST)
                    counts[j] += sign * (excess[row, j] != 0)
        if i < 0:
            continue
        total = count = 0.0
        for j in range(-WINDOW, columns):
            if j + WINDOW < columns:
                total += sums[j + WINDOW]
                count += counts[j + WINDOW]
            if j > WINDOW:
                total -= sums[j - WINDOW - 1]
                count -= counts[j - WINDOW - 1]
            if j >= 0:
                here = excess[i, j]
                relief[i, j] = here - np.float32(total / count) if here != 0 else 0


@kernel
def _noise(relief: F4, owner: I4, number: int) -> float:
    """Return the median rise, 1/m, between cells of the plane as far apart as at an outline."""
    rows, columns = relief.shape
    apart = INWARD + OUTWARD
    histogram = np.zeros(BINS, np.int64)
    n = 0
    for i in range(0, rows - apart, EVERY):
        for j in range(0, columns - apart, EVERY):
            here = relief[i, j]
            if owner[i, j] != -number or here == 0:
                continue
            for y, x in ((i + apart, j), (i, j + apart)):
                if owner[y, x] == -number and relief[y, x] != 0:
                    rise = abs(relief[y, x] - here)
                    histogram[min(int(rise / BIN), BINS - 1)] += 1
                    n += 1
    below = bins = 0
    while 2 * below < n:
        below += histogram[bins]
        bins += 1
    return bins * BIN


@kernel
def _raise(
    w: F4,
    relief: F4,
    owner: I4,
    number: int,
    rise_least: float,
    levels: F4,
    raised: I4,
    widest: float,
    objects: int,
    stacks: I4,
) -> int:
    """Mark the parts above each level, filled, whose outline is that of an object.

    They are numbered from ``objects`` + 1 on. Returns the last number. ``relief`` (rows, columns)
    is from `_level`, ``levels`` falls, both in 1/m.
    """
    flat, marks, owners = relief.reshape(-1), raised.reshape(-1), owner.reshape(-1)
    seeds, stack = stacks[0], stacks[1]
    n = _find_seeds(flat, levels[-1], seeds)
    seen, part = np.zeros(relief.shape, np.int32), np.zeros(relief.shape, np.int32)
    visited, parts = seen.reshape(-1), part.reshape(-1)
    merits = np.zeros(1 + objects + levels.size * (flat.size // LEAST_CELLS), np.float32)
    me = 0
    for level in levels:
        first = me
        for s in seeds[:n]:
            if visited[s] > first or not flat[s] > level:
                continue
            me += 1
            count = _flood(relief, level, s, me, seen, stack)
            if count < LEAST_CELLS:
                continue
            known, best = 0, 0.0
            for p in stack[:count]:
                parts[p] = me
                known += marks[p] > 0
                best = max(best, merits[marks[p]])
            if known > SAME * count or _width(w, stack, count) > widest:
                continue
            filled = fill_hull(relief, part, stack, count)
            outline = _outline(w, relief, owner, part, stack, filled, number, rise_least)
            for p in stack[count:filled]:
                best = max(best, merits[marks[p]])
            merit = outline.rise / outline.sides
            if merit > GROWN * best and _is_object(outline, filled):
                objects += 1
                merits[objects] = merit
                for p in stack[:filled]:
                    marks[p], owners[p] = objects, number
    return objects


@kernel(leaf=True)
def _find_seeds(flat: F4, least: float, seeds: I4) -> int:
    """List the cells above the lowest level that are higher than the one before; return how many.

    The first cell of a part above any level is one. Most cells are lower, and to pass over many of
    them at a time vectorises.
    """
    n = 0
    for start in range(1, flat.size, BLOCK):
        block, before = flat[start : start + BLOCK], flat[start - 1 :]
        some = False
        for k in range(block.size):
            some |= block[k] > least
        if not some:
            continue
        for k in range(block.size):
            seeds[n] = start + k
            n += int((block[k] > least) & (block[k] > before[k]))
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


@kernel(leaf=True)
def _width(w: F4, stack: I4, count: int) -> float:
    """Return the extent of a part along the rows, in cells a metre away."""
    columns = w.shape[1]
    first, last = columns, 0
    for p in stack[:count]:
        _, j = place_of(p, columns)
        first, last = min(first, j), max(last, j)
    return float((last - first) / w[stack[0] // columns, stack[0] % columns])


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


@kernel(leaf=True)
def _flood(excess: F4, level: float, start: int, n: int, part: I4, stack: I4) -> int:
    """Give the connected cells above ``level`` the number ``n``; return how many.

    The cells at the border of the image are 0.
    """
    columns = excess.shape[1]
    flat, parts = excess.reshape(-1), part.reshape(-1)
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


@kernel(leaf=True)
def _outline(
    w: F4,
    excess: F4,
    owner: I4,
    part: I4,
    stack: I4,
    count: int,
    number: int,
    rise_least: float,
) -> Outline:
    """Measure the outline of a part."""
    rows, columns = excess.shape
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
            i, j = place_of(p, columns)
            sides += 1
            y, x = i + di, j + dj
            known += excess[y, x] == 0 and w[y, x] > 0 and abs(w[y, x] - w[i, j]) < JUMP
            hidden += w[y, x] <= 0 or w[y, x] > w[i, j] + JUMP
            y, x = i + OUTWARD * di, j + OUTWARD * dj
            v, u = i - INWARD * di, j - INWARD * dj
            if min(y, x) < 0 or min(v, u) < 0 or max(y, v) >= rows or max(x, u) >= columns:
                continue
            known += 0 < w[y, x] < w[i, j] - JUMP
            if owner[y, x] != -number or excess[y, x] == 0 or abs(owner[v, u]) != number:
                continue
            table += 1
            known += 1
            step = (excess[v, u] - excess[y, x]) / rise_least
            if excess[v, u] == 0:  # the inside is not low
                step = MOST_STEPS
            rise += min(step, MOST_STEPS)
            steep += int(step > STEEP)
    return Outline(sides, table, known, hidden, rise, steep)


@kernel
def _lower(
    w: F4, excess: F4, owner: I4, number: int, rise_least: float, raised: I4, stacks: I4
) -> None:
    """Give level parts of low object cells whose outline is that of a swell back to the plane."""
    rows, columns = excess.shape
    seeds, stack = stacks[0], stacks[1]
    above = np.zeros(excess.shape, np.uint8)
    n = 0
    for i in range(rows):
        some = False
        for j in range(columns):
            some |= (owner[i, j] == number) & (excess[i, j] != 0)
        if not some:
            continue
        for j in range(columns):
            low = (owner[i, j] == number) & (excess[i, j] != 0) & (raised[i, j] == 0)
            if low and _is_flat(excess, i, j):
                above[i, j] = 1
                seeds[n] = i * columns + j
                n += 1
    if n < SMALL_PART:
        return
    part = np.zeros(excess.shape, np.int32)
    parts, owners = part.reshape(-1), owner.reshape(-1)
    number_of_parts = 0
    for s in seeds[:n]:
        if parts[s] > 0:
            continue
        number_of_parts += 1
        count = _flood(above, np.uint8(0), s, number_of_parts, part, stack)
        if count < SMALL_PART:
            continue
        line = _outline(w, excess, owner, part, stack, count, number, rise_least)
        if line.table >= BESIDE * line.sides and line.rise < line.table:
            for t in range(count):
                owners[stack[t]] = -number


@kernel(leaf=True)
def _is_flat(excess: F4, i: int, j: int) -> bool:
    """Whether a low cell is no part of the side of something."""
    rows, columns = excess.shape
    here = excess[i, j]
    for d in range(4):
        y = i + (2 if d == 0 else -2 if d == 1 else 0)
        x = j + (2 if d == 2 else -2 if d == 3 else 0)
        if y < 0 or x < 0 or y >= rows or x >= columns:
            continue
        if excess[y, x] == 0 or abs(excess[y, x] - here) > SIDE:
            return False
    return True
