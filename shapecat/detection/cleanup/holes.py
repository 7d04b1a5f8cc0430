"""Hole filling: cells at the level of the table that are of objects: contacts and floors."""

import numpy as np

from shapecat.arrays import F4, I4, U1, Bool
from shapecat.detection.depth_grid import row_and_column
from shapecat.detection.planes.height_map import HEIGHT_NOISE, MIN_HEIGHT_M, HeightMap
from shapecat.geometry import DISCONTINUITY
from shapecat.jit import kernel, unset

__all__ = ["FRINGE", "fill_contact_boundary", "fill_holes"]

FRINGE = 0.6
"""Share of the least height from which a reading next to an object belongs to it."""
MOST_CELLS = 4000
STACK = MOST_CELLS + 4
"""Room for a hole that is found to be too large."""
OPEN = 2
"""Mark of cells seen that are no part of a hole."""
SHARE = 0.6
"""Least share of the boundary of a hole that is of what encloses it."""
RAISED_M, RAISED_NOISE = 0.0012, 0.0008
"""Mean height of a hole from which it is raised, metres, and by the square of its range, 1/m."""
RAISED_SHARE, LABELLED = 0.35, 0.5
"""Instead of `SHARE` where it is raised, and so much of its boundary is of any label."""
LEVEL = 0.15
"""Share of the boundary where the surface goes on: not so through the hole of a handle."""


@kernel
def fill_contact_boundary(inv_depth: F4, heights: HeightMap, labels: I4) -> None:
    """Let the labels grow over the cells beside them that are hardly above their plane.

    The least height of an object cell is safe against the noise of the plane; next to an object
    less is enough. Further away what is so low is as often the plane.
    """
    plane_id, height = heights
    rows, columns = labels.shape
    edge = unset(labels.size, np.int32)
    beside = np.zeros(columns, np.bool_)
    count = 0
    for i in range(rows):
        if not _find_beside(plane_id, labels[i], i, beside):
            continue
        for j in range(columns):
            if beside[j]:
                edge[count] = i * columns + j
                count += 1
    for p in edge[:count]:
        i, j = row_and_column(p, columns)
        for d in range(4):
            y = i + (1 if d == 0 else -1 if d == 1 else 0)
            x = j + (1 if d == 2 else -1 if d == 3 else 0)
            if y < 0 or x < 0 or y >= rows or x >= columns or labels[y, x] != 0:
                continue
            if (
                plane_id[y, x] != -abs(plane_id[i, j])
                or abs(inv_depth[y, x] - inv_depth[i, j]) >= DISCONTINUITY
            ):
                continue
            z = 1 / inv_depth[y, x]
            if height[y, x] > FRINGE * (MIN_HEIGHT_M + HEIGHT_NOISE * z * z):
                labels[y, x] = labels[i, j]


@kernel
def _find_beside(plane_id: I4, labels: I4, i: int, beside: Bool) -> bool:
    """Mark the labelled cells of a row that are beside cells of a plane; whether there are any."""
    rows, columns = plane_id.shape
    # Labelled cells are on no plane, so the row itself may stand for the one beyond the image.
    above, here, below = plane_id[max(i - 1, 0)], plane_id[i], plane_id[min(i + 1, rows - 1)]
    some = False
    for j in range(columns):
        beside[j] = (labels[j] > 0) & ((above[j] < 0) | (below[j] < 0))
    for j in range(columns - 1):
        beside[j] |= (labels[j] > 0) & (here[j + 1] < 0)
    for j in range(columns - 1):
        beside[j + 1] |= (labels[j + 1] > 0) & (here[j] < 0)
    for j in range(columns):
        some |= beside[j]
    return some


@kernel
def _extent_of(labels: I4) -> tuple[int, int, int, int]:
    """Return the first row and column with a label, and those after the last."""
    i0, j0 = labels.shape
    i1 = j1 = 0
    for i in range(labels.shape[0]):
        some = 0
        for j in range(labels.shape[1]):
            some |= labels[i, j]
        if some == 0:
            continue
        i0, i1 = min(i0, i), i + 1
        j = 0
        while j < j0 and labels[i, j] == 0:
            j += 1
        j0, j = j, labels.shape[1]
        while j > j1 and labels[i, j - 1] == 0:
            j -= 1
        j1 = j
    return i0, j0, i1, j1


@kernel
def _flood_hole(
    inv_depth: F4,
    labels: I4,
    extent: tuple[int, int, int, int],
    seen: U1,
    stack: I4,
    sides: I4,
    ahead: I4,
    level: I4,
) -> tuple[int, int]:
    """Collect the unlabelled cells connected to the first of ``stack``, not known to be open.

    Counts, for each label, the sides of cells where it bounds the hole, where it is in front of
    it, and where the surface goes on. Returns how many cells the hole has, 0 if it is large or
    reaches the border of the extent, and how many sides, those to cells without a reading included.
    """
    sides[:] = 0
    ahead[:] = 0
    level[:] = 0
    i0, j0, i1, j1 = extent
    total = 0
    done, top = 0, 1
    seen[stack[0, 0], stack[0, 1]] = 1
    while done < top:
        i, j = stack[done, 0], stack[done, 1]
        done += 1
        open_ = i == i0 or j == j0 or i == i1 - 1 or j == j1 - 1
        if not open_:
            open_ = (seen[i - 1, j] == OPEN) | (seen[i + 1, j] == OPEN)
            open_ |= (seen[i, j - 1] == OPEN) | (seen[i, j + 1] == OPEN)
        if top >= MOST_CELLS or open_:
            for t in range(top):
                seen[stack[t, 0], stack[t, 1]] = OPEN
            return 0, 0
        for d in range(4):
            y = i + (1 if d == 0 else -1 if d == 1 else 0)
            x = j + (1 if d == 2 else -1 if d == 3 else 0)
            label = labels[y, x]
            if label > 0:
                total += 1
                sides[label] += 1
                ahead[label] += inv_depth[y, x] > inv_depth[i, j] + DISCONTINUITY
                level[label] += abs(inv_depth[y, x] - inv_depth[i, j]) < DISCONTINUITY
            elif inv_depth[y, x] <= 0:
                total += 1
            elif not seen[y, x]:
                seen[y, x] = 1
                stack[top, 0], stack[top, 1] = y, x
                top += 1
    return top, total


@kernel
def _mark_open(inv_depth: F4, labels: I4, extent: tuple[int, int, int, int], seen: U1) -> None:
    """Mark unlabelled cells from which others lead right and down to the border of the extent.

    What leads left and up is found as the holes are looked for; the rest takes a flood.
    """
    i0, j0, i1, j1 = extent
    for i in range(i1 - 1, i0 - 1, -1):
        here, label, value = seen[i, j0:j1], labels[i, j0:j1], inv_depth[i, j0:j1]
        for j in range(here.size):
            here[j] = OPEN if (label[j] == 0) & (value[j] > 0) else 0
        if i == i1 - 1:
            continue
        below, right = seen[i + 1, j0:j1], np.uint8(OPEN)
        for j in range(here.size - 1, -1, -1):
            right = (right | below[j]) & here[j]
            here[j] = right


@kernel
def _is_raised(inv_depth: F4, height: F4, stack: I4, size: int) -> bool:
    """Whether a hole lies a little above the plane, as the floor of a plate does."""
    height_sum = far = 0.0
    for t in range(size):
        i, j = stack[t, 0], stack[t, 1]
        height_sum += height[i, j]
        far += 1 / inv_depth[i, j]
    far /= size
    return height_sum > size * (RAISED_M + RAISED_NOISE * far * far)


@kernel
def fill_holes(inv_depth: F4, height: F4, labels: I4, count: int, filled: U1) -> None:
    """Give enclosed unlabelled cells to what encloses them, and mark them in ``filled``.

    Cells are enclosed when 60 % of their boundary is one label and every other label on it is in
    front of them.
    """
    seen = np.zeros(labels.shape, np.uint8)
    stack = np.zeros((STACK, 2), np.int16)
    sides, ahead = np.zeros(count + 1, np.int32), np.zeros(count + 1, np.int32)
    level = np.zeros(count + 1, np.int32)
    extent = _extent_of(labels)
    _mark_open(inv_depth, labels, extent, seen)
    i0, j0, i1, j1 = extent
    for si in range(i0, i1):
        for sj in range(j0, j1):
            if labels[si, sj] != 0 or seen[si, sj] or inv_depth[si, sj] <= 0:
                continue
            open_ = si == i0 or sj == j0 or si == i1 - 1 or sj == j1 - 1
            if not open_:
                open_ = (seen[si - 1, sj] == OPEN) | (seen[si + 1, sj] == OPEN)
                open_ |= (seen[si, sj - 1] == OPEN) | (seen[si, sj + 1] == OPEN)
            if open_:
                seen[si, sj] = OPEN
                continue
            stack[0, 0], stack[0, 1] = si, sj
            size, total = _flood_hole(inv_depth, labels, extent, seen, stack, sides, ahead, level)
            if size == 0:
                continue
            best, labelled, share = 0, 0, SHARE
            for k in range(1, count + 1):
                labelled += sides[k]
                best = k if sides[k] > sides[best] else best
            if labelled > LABELLED * total and _is_raised(inv_depth, height, stack, size):
                share = RAISED_SHARE
            fits = sides[best] > max(0, share * total) and level[best] > LEVEL * total
            for k in range(1, count + 1):
                if k != best and ahead[k] < sides[k]:
                    fits = False
            if fits:
                for t in range(size):
                    labels[stack[t, 0], stack[t, 1]] = best
                    filled[stack[t, 0], stack[t, 1]] = 1
