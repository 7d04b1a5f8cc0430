"""Fill: cells near the level of the table that belong to objects: their feet and their floors."""

import numpy as np

from shapecat.arrays import F4, I4, U1
from shapecat.detection.cells import JUMP
from shapecat.detection.heights import LEAST_M, NOISE
from shapecat.jit import kernel

__all__ = ["FRINGE", "fill_enclosed", "grow_feet"]

FRINGE = 0.6
"""Share of the least height from which a reading next to an object belongs to it."""
FEET_CELLS = 4
MOST_CELLS = 4000
SHARE = 0.6
LEVEL = 0.15
"""Share of the boundary where the surface goes on: not so through the hole of a handle."""


def fill_enclosed(w: F4, labels: I4, count: int, *, active: bool) -> U1:
    """Give enclosed unlabelled cells to what encloses them; return (rows, columns) what was filled.

    Cells are enclosed when 60 % of their boundary is one label and every other label on it is in
    front of them.
    """
    filled = np.zeros(labels.shape, np.uint8)
    rows, columns = np.flatnonzero(labels.any(axis=1)), np.flatnonzero(labels.any(axis=0))
    if active and rows.size:
        i0, i1, j0, j1 = rows[0], rows[-1] + 1, columns[0], columns[-1] + 1
        _fill(w[i0:i1, j0:j1], labels[i0:i1, j0:j1], count, filled[i0:i1, j0:j1])
    return filled


@kernel
def grow_feet(w: F4, owner: I4, height: F4, labels: I4) -> None:
    """Let the labels grow over up to four cells that are hardly above their plane.

    The least height of an object cell is safe against the noise of the plane; next to an object
    less is enough.
    """
    rows, columns = labels.shape
    queue = np.zeros(labels.size, np.int32)
    top = 0
    for i in range(rows):
        for j in range(columns):
            if labels[i, j] > 0 and (
                (i > 0 and owner[i - 1, j] < 0)
                or (j > 0 and owner[i, j - 1] < 0)
                or (i + 1 < rows and owner[i + 1, j] < 0)
                or (j + 1 < columns and owner[i, j + 1] < 0)
            ):
                queue[top] = i * columns + j
                top += 1
    done = 0
    for _ in range(FEET_CELLS):
        end = top
        while done < end:
            i, j = queue[done] // columns, queue[done] % columns
            done += 1
            for d in range(4):
                y = i + (1 if d == 0 else -1 if d == 1 else 0)
                x = j + (1 if d == 2 else -1 if d == 3 else 0)
                if y < 0 or x < 0 or y >= rows or x >= columns or labels[y, x] != 0:
                    continue
                if owner[y, x] != -abs(owner[i, j]) or abs(w[y, x] - w[i, j]) >= JUMP:
                    continue
                z = 1 / w[y, x]
                if height[y, x] > FRINGE * (LEAST_M + NOISE * z * z):
                    labels[y, x] = labels[i, j]
                    queue[top] = y * columns + x
                    top += 1


@kernel
def _fill(w: F4, labels: I4, count: int, filled: U1) -> None:
    rows, columns = labels.shape
    seen = np.zeros(labels.shape, np.uint8)
    stack = np.zeros((labels.size, 2), np.int16)
    sides = np.zeros(count + 1, np.int32)
    ahead = np.zeros(count + 1, np.int32)
    level = np.zeros(count + 1, np.int32)
    for si in range(rows):
        for sj in range(columns):
            if labels[si, sj] != 0 or seen[si, sj] or w[si, sj] <= 0:
                continue
            sides[:] = 0
            ahead[:] = 0
            level[:] = 0
            outside = False
            total = 0
            stack[0, 0], stack[0, 1] = si, sj
            seen[si, sj] = 1
            done, top = 0, 1
            while done < top:
                i, j = stack[done, 0], stack[done, 1]
                done += 1
                for d in range(4):
                    y = i + (1 if d == 0 else -1 if d == 1 else 0)
                    x = j + (1 if d == 2 else -1 if d == 3 else 0)
                    if y < 0 or x < 0 or y >= rows or x >= columns:
                        outside = True
                        continue
                    label = labels[y, x]
                    if label > 0:
                        total += 1
                        sides[label] += 1
                        ahead[label] += w[y, x] > w[i, j] + JUMP
                        level[label] += abs(w[y, x] - w[i, j]) < JUMP
                    elif w[y, x] <= 0:
                        total += 1
                    elif not seen[y, x]:
                        seen[y, x] = 1
                        stack[top, 0], stack[top, 1] = y, x
                        top += 1
            if outside or top >= MOST_CELLS:
                continue
            best = np.argmax(sides)
            fits = sides[best] > max(0, SHARE * total) and level[best] > LEVEL * total
            for k in range(1, count + 1):
                if k != best and ahead[k] < sides[k]:
                    fits = False
            if fits:
                for t in range(top):
                    labels[stack[t, 0], stack[t, 1]] = best
                    filled[stack[t, 0], stack[t, 1]] = 1
