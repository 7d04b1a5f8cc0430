"""Relief: low things that rise from their plane in a step, told from swells of its surface.

Sensors see a flat table in slow waves, higher than a plate is thick; but only an object has an
edge. So what is low is judged by its outline rather than by its height.
"""

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.detection.cells import JUMP, Cells
from shapecat.detection.heights import Heights
from shapecat.jit import kernel

__all__ = ["raise_low"]

LOW_M = 0.03
"""Higher things are objects anyway."""
LEVELS = np.array([0.009, 0.0065, 0.005, 0.004, 0.0032], np.float32)
"""Inverse depth above the plane at which outlines are looked for, 1/m."""
STEP = 0.0045
"""Mean rise across the outline of an object, 1/m: one and a half steps of a Kinect."""
STEEP, STEEP_SHARE = 0.0027, 0.75
"""A rise that is more than noise, and the share of the outline that has it."""
FRAGMENT, GROWTH, STEEP_GROWTH = 0.4, 1.3, 0.88
"""A known object that is a smaller share of a part is a fragment of it; a part larger than the
object by this factor must have a steeper outline than a new one."""
INWARD, OUTWARD = 2, 3
"""Cells from the outline to where its rise is measured."""
LEAST_CELLS, LEAST_SIDES, SMALL_PART = 120, 30, 12
ALONE, FOOT, BESIDE = 0.65, 0.04, 0.3
"""Shares of an outline: of an object, least along the plane and most in touch with something
that is not low, whose foot it would be; of a swell, least along the plane."""
FLOOR = 0.4
"""Mean of a hole in an outline that belongs to the object, as a share of the level."""


def raise_low(cells: Cells, heights: Heights, planes: F8, raised: U1) -> None:
    """Give low objects the owners of objects, and swells those of the plane, in place.

    Parameters
    ----------
    raised : (rows, columns) set to 1 on low objects.
    """
    for k, plane in enumerate(planes):
        excess = np.zeros(cells.w.shape, np.float32)
        if _excess(cells.w, heights.owner, heights.height, plane, k + 1, excess) >= LEAST_CELLS:
            _raise(cells.w, excess, heights.owner, k + 1, LEVELS, raised)
            _lower(cells.w, excess, heights.owner, k + 1, raised)


@kernel
def _excess(w: F4, owner: I4, height: F4, plane: F8, number: int, out: F4) -> int:
    """Write the smoothed inverse depth above the plane of its low cells; 0 elsewhere."""
    rows, columns = w.shape
    zero, one, low = np.float32(0), np.float32(1), np.float32(LOW_M)
    slope = np.float32(plane[0])
    raw = np.zeros((3, columns), np.float32)
    mark = np.zeros((3, columns), np.float32)
    n = 0
    for i in range(rows + 1):
        now = i % 3
        if i < rows:
            base = np.float32(plane[1] * i + plane[2])
            for j in range(columns):
                mine = ((owner[i, j] == number) | (owner[i, j] == -number)) & (height[i, j] < low)
                mark[now, j] = one if mine else zero
                raw[now, j] = w[i, j] - (slope * np.float32(j) + base) if mine else zero
        if i < 2 or i == rows:
            continue
        middle = (i - 1) % 3
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
def _raise(w: F4, excess: F4, owner: I4, number: int, levels: F4, raised: U1) -> None:
    """Mark the parts above each level, holes included, whose outline is that of an object."""
    flat, marks, owners = excess.reshape(-1), raised.reshape(-1), owner.reshape(-1)
    if np.count_nonzero(flat > levels[-1]) < LEAST_CELLS:
        return
    seeds = np.flatnonzero(flat > levels[-1])
    stack = np.zeros(excess.size, np.int32)
    part = np.zeros(excess.shape, np.int32)
    parts = part.reshape(-1)
    around = np.zeros(excess.shape, np.int32)
    number_of_parts = looks = 0
    for level in levels:
        first = number_of_parts
        for s in seeds:
            if parts[s] > first or not flat[s] > level:
                continue
            number_of_parts += 1
            me = number_of_parts
            count = _flood(excess, level, s, me, part, stack)
            if count < LEAST_CELLS:
                continue
            count, looks = _fill_part(excess, level, me, part, around, looks, stack, count)
            if _is_object(w, excess, owner, part, stack, count, number, raised):
                for t in range(count):
                    marks[stack[t]] = 1
                    owners[stack[t]] = number


@kernel
def _is_object(
    w: F4, excess: F4, owner: I4, part: I4, stack: I4, count: int, number: int, raised: U1
) -> bool:
    """Whether the outline of a part is that of an object.

    A part that is more than a known object, but not by far, is that object and a swell beside it.
    """
    known = 0
    marks = raised.reshape(-1)
    for t in range(count):
        known += marks[stack[t]]
    sides, table, foot, steep, rise = _outline(w, excess, owner, part, stack, count, number)
    share = STEEP_SHARE
    if FRAGMENT * count <= known and GROWTH * known <= count:
        share = STEEP_GROWTH
    enough = table >= max(LEAST_SIDES, ALONE * sides) and foot <= FOOT * sides
    return bool(enough and rise > STEP * table and steep > share * table)


@kernel
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
            q = p + step
            if parts[q] != n and flat[q] > level:
                parts[q] = n
                stack[top] = q
                top += 1
    return top


@kernel
def _fill_part(
    excess: F4, level: float, me: int, part: I4, around: I4, looks: int, stack: I4, count: int
) -> tuple[int, int]:
    """Add the holes in a part that are raised; return its cells, and the number of looks so far."""
    columns = excess.shape[1]
    flat, parts, seen = excess.reshape(-1), part.reshape(-1), around.reshape(-1)
    i0, i1, j0, j1 = excess.shape[0], 0, columns, 0
    for t in range(count):
        i = stack[t] // columns
        j = stack[t] - i * columns
        i0, i1, j0, j1 = min(i0, i), max(i1, i), min(j0, j), max(j1, j)
    since = looks
    for t in range(count):
        for step in (1, -1, columns, -columns):
            q = stack[t] + step
            if flat[q] == 0 or parts[q] == me or seen[q] > since:
                continue
            looks += 1
            top, total = _hole(
                flat, q, columns, parts, me, seen, looks, since, stack, count, (i0, i1, j0, j1)
            )
            if total > FLOOR * level * (top - count):
                for k in range(count, top):
                    parts[stack[k]] = me
                count = top
    return count, looks


@kernel
def _hole(
    excess: F4,
    start: int,
    columns: int,
    part: I4,
    me: int,
    around: I4,
    n: int,
    since: int,
    stack: I4,
    first: int,
    box: tuple[int, int, int, int],
) -> tuple[int, float]:
    """Put the hole around a cell on the stack: where it ends, and its sum; none if it is open.

    The cells of look ``n`` get that number in ``around``; looks after ``since`` are of this part.
    """
    around[start] = n
    stack[first] = start
    # Both ends of the stack are used: visited cells gather at the front, last in first.
    done, top = first, first + 1
    total = 0.0
    while done < top:
        p = stack[top - 1]
        stack[top - 1] = stack[done]
        stack[done] = p
        done += 1
        total += excess[p]
        i = p // columns
        j = p - i * columns
        if i < box[0] or i > box[1] or j < box[2] or j > box[3]:
            return first, 0.0
        for step in (1, -1, columns, -columns):
            q = p + step
            if part[q] == me or excess[q] == 0 or around[q] == n:
                continue
            if around[q] > since:  # known to be open
                return first, 0.0
            around[q] = n
            stack[top] = q
            top += 1
    return top, total


@kernel
def _outline(
    w: F4, excess: F4, owner: I4, part: I4, stack: I4, count: int, number: int
) -> tuple[int, int, int, int, float]:
    """Measure an outline.

    Returns
    -------
    How many sides of cells it has; how many of these look at the plane, how many touch what is
    not low; how many of the former are steep, and the sum of their rises.
    """
    rows, columns = excess.shape
    parts = part.reshape(-1)
    sides = table = foot = steep = 0
    rise = 0.0
    me = parts[stack[0]]
    for t in range(count):
        p = stack[t]
        for d in range(4):
            di = 1 if d == 0 else -1 if d == 1 else 0
            dj = 1 if d == 2 else -1 if d == 3 else 0
            if parts[p + di * columns + dj] == me:
                continue
            i = p // columns
            j = p - i * columns
            sides += 1
            y, x = i + di, j + dj
            foot += excess[y, x] == 0 and owner[y, x] == number and abs(w[y, x] - w[i, j]) < JUMP
            y, x = i + OUTWARD * di, j + OUTWARD * dj
            v, u = i - INWARD * di, j - INWARD * dj
            if min(y, x) < 0 or min(v, u) < 0 or max(y, v) >= rows or max(x, u) >= columns:
                continue
            if owner[y, x] != -number or excess[y, x] == 0 or abs(owner[v, u]) != number:
                continue
            table += 1
            most = np.float32(3 * STEP)  # also where the inside is not low
            step = min(excess[v, u] - excess[y, x], most) if excess[v, u] != 0 else most
            rise += float(step)
            steep += int(step > STEEP)
    return sides, table, foot, steep, rise


@kernel
def _lower(w: F4, excess: F4, owner: I4, number: int, raised: U1) -> None:
    """Give level parts of low object cells whose outline is that of a swell back to the plane."""
    rows, columns = excess.shape
    seeds = np.zeros(excess.size, np.int32)
    above = np.zeros(excess.shape, np.float32)
    n = 0
    for i in range(rows):
        for j in range(columns):
            low = (owner[i, j] == number) & (excess[i, j] != 0) & (raised[i, j] == 0)
            if low and _is_flat(excess, i, j):
                above[i, j] = 1
                seeds[n] = i * columns + j
                n += 1
    if n < SMALL_PART:
        return
    stack = np.zeros(n, np.int32)
    part = np.zeros(excess.shape, np.int32)
    parts, owners = part.reshape(-1), owner.reshape(-1)
    number_of_parts = 0
    for s in seeds[:n]:
        if parts[s] > 0:
            continue
        number_of_parts += 1
        count = _flood(above, np.float32(0.5), s, number_of_parts, part, stack)
        if count < SMALL_PART:
            continue
        sides, table, _, _, rise = _outline(w, excess, owner, part, stack, count, number)
        if table >= BESIDE * sides and rise < STEP * table:
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
        if excess[y, x] == 0 or abs(excess[y, x] - here) > STEP:
            return False
    return True
