"""Removal of low-frequency depth error: slow waves that sensors measure on a flat surface.

The waves are higher than a plate is thick. Without them, only steps and noise remain, and the noise
is measured.
"""

import numpy as np

from shapecat.arrays import F4, F8, I4
from shapecat.detection.connected_components import SIDES
from shapecat.detection.foreground.settings import LOW
from shapecat.detection.planes.height_map import HeightMap
from shapecat.jit import kernel

__all__ = ["NOISE_STRIDE", "clear_contact", "filter_high_pass", "measure_noise", "measure_residual"]

STEPS = 2**20
"""Number of integer steps per 1/m in the sums of `filter_high_pass`. A sum fits in 32 bits even if
all samples of a window are 1/m off."""
BIN = 2e-5
"""Width of a bin in the histogram of rises, 1/m."""
BINS = 500
"""Number of bins in the histogram of rises."""
NOISE_STRIDE = 3
"""Step between the rows and columns of the cells from which rises are measured."""


@kernel
def measure_residual(inv_depth: F4, heights: HeightMap, plane: F8, number: int, out: F4) -> int:
    """Write the smoothed inverse depth of a plane's low cells, relative to the plane; 0 elsewhere.

    Low cells are on the plane, or less than `LowProfileSettings.low_m` above it. Returns the number
    of low cells, without those on the border of the image.

    Parameters
    ----------
    inv_depth : (rows, columns) 1/m.
    plane : (3,) a, b, c of the plane's inverse depth.
    number : number of the plane, from 1, as in `HeightMap.plane_id`.
    out : (rows, columns) 1/m, written in place.
    """
    rows, columns = inv_depth.shape
    zero = np.float32(0)
    raw, mark = np.zeros((3, columns), np.float32), np.zeros((3, columns), np.float32)
    total, count = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    n = 0
    any_low = False
    one, last = np.uint64(1), np.uint64(columns - 1)
    for j in range(np.uint64(columns)):
        out[0, j] = out[rows - 1, j] = zero
    for i in range(rows):
        any_low_before = any_low
        any_low = _find_low(inv_depth, heights, plane, number, i, raw, mark)
        if i < 2:
            continue
        for j in range(np.uint64(columns)):
            out[i - 1, j] = zero
        if not any_low_before:
            continue
        row, row_above, row_below = (i - 1) % 3, (i - 2) % 3, i % 3
        for j in range(np.uint64(columns)):
            total[j] = raw[row, j] + raw[row_above, j] + raw[row_below, j]
        for j in range(np.uint64(columns)):
            count[j] = mark[row, j] + mark[row_above, j] + mark[row_below, j]
        for j in range(one, last):
            sums = total[j - one] + total[j] + total[j + one]
            mean = sums / (count[j - one] + count[j] + count[j + one])
            out[i - 1, j] = mean if mark[row, j] > zero else zero
        for j in range(one, last):
            n += int(mark[row, j])
    return n


@kernel(inline=True)
def _find_low(
    inv_depth: F4, heights: HeightMap, plane: F8, number: int, i: int, raw: F4, mark: F4
) -> bool:
    """Find the low cells of row ``i``; return whether there are any.

    Their inverse depth relative to the plane is written to ``raw``, and 1 to ``mark``; both are 0
    in the other cells. These arrays (3, columns) hold the last three rows, row ``i`` at the index
    ``i % 3``. The other parameters are as in `measure_residual`.
    """
    plane_id, height = heights
    zero, one, low = np.float32(0), np.float32(1), np.float32(LOW.low_m)
    slope, base = np.float32(plane[0]), np.float32(plane[1] * i + plane[2])
    above, on = np.int8(number), np.int8(-number)
    any_low, row, columns = False, i % 3, np.uint64(inv_depth.shape[1])
    for j in range(columns):
        is_low = ((plane_id[i, j] == above) | (plane_id[i, j] == on)) & (height[i, j] < low)
        mark[row, j] = one if is_low else zero
        any_low |= is_low
    for j in range(columns):
        level = slope * np.float32(np.int32(j)) + base
        raw[row, j] = mark[row, j] * (inv_depth[i, j] - level) if any_low else zero
    return any_low


@kernel
def clear_contact(
    inv_depth: F4, heights: HeightMap, number: int, jump: float, residual: F4, queue: I4, drop: F4
) -> None:
    """Set the residual to 0 where the low cells at the foot of a higher object are steep.

    So the foot is not taken for a low-profile object. From the cells of the higher object, the
    search follows low cells downwards as long as they fall steeply.

    Parameters
    ----------
    inv_depth : (rows, columns) 1/m.
    number : number of the plane, from 1, as in `HeightMap.plane_id`.
    jump : largest change from cell to cell on the side of an object, 1/m.
    residual : (rows, columns) 1/m, changed in place.
    queue, drop : (rows * columns,) work space.
    """
    (rows, columns), (plane_id, height) = residual.shape, heights
    tail = 0
    high, edge = np.float32(LOW.low_m), np.zeros(columns, np.bool_)
    one, above = np.uint64(1), np.int8(number)
    for i in range(1, rows - 1):
        # Few rows have high cells, and few of these are next to low ones; the tests vectorise.
        any_high = False
        for j in range(np.uint64(columns)):
            any_high |= (plane_id[i, j] == above) & (height[i, j] >= high)
        if not any_high:
            continue
        any_edge = False
        for j in range(one, np.uint64(columns - 1)):
            beside = (residual[i - 1, j] != 0) | (residual[i + 1, j] != 0)
            beside |= (residual[i, j - one] != 0) | (residual[i, j + one] != 0)
            edge[j] = beside & (plane_id[i, j] == above) & (height[i, j] >= high)
            any_edge |= edge[j]
        if not any_edge:
            continue
        for j in range(1, columns - 1):
            if edge[j]:
                queue[tail], drop[tail] = i * columns + j, np.inf
                tail += 1
    head = 0
    while head < tail:
        i, j = queue[head] // columns, queue[head] % columns
        level = drop[head]
        head += 1
        for di, dj in SIDES:
            y, x = i + di, j + dj
            falls = residual[y, x] != 0 and level - residual[y, x] > LOW.slope
            if falls and abs(inv_depth[y, x] - inv_depth[i, j]) < jump:
                queue[tail], drop[tail] = y * columns + x, residual[y, x]
                residual[y, x] = 0
                tail += 1


@kernel
def filter_high_pass(residual: F4, high_pass: F4) -> None:
    """For each low cell, write its residual minus the mean of the low cells in a window around it.

    In the mean, a value counts as at least -1 and at most `LOW.max_value`. ``residual`` (rows,
    columns), 1/m, is 0 where a cell is not low; ``high_pass`` (rows, columns), 1/m, is written in
    place, and is 0 there too. The sums are integers, in steps of 1 / `STEPS`, updated as the window
    slides: they are exact, and take a quarter of the time of floating-point sums.
    """
    rows, columns = residual.shape
    sums = np.zeros(columns + 2 * LOW.window + 1, np.int32)
    counts = np.zeros(sums.size, np.int32)
    total, count = np.zeros(columns, np.int32), np.zeros(columns, np.int32)
    unit, zero = np.float32(1 / STEPS), np.float32(0)
    for i in range(-LOW.window, rows):
        entering, leaving = i + LOW.window, i - LOW.window - 1
        if entering < rows:
            _slide(residual, entering, np.int32(1), sums, counts)
        if leaving >= 0:
            _slide(residual, leaving, np.int32(-1), sums, counts)
        if i < 0:
            continue
        any_low = False
        for j in range(np.uint64(columns)):
            any_low |= residual[i, j] != zero
        if any_low:
            _add_windows(sums, counts, total, count)
        for j in range(np.uint64(columns)):
            level = residual[i, j] - unit * np.float32(total[j]) / np.float32(count[j])
            high_pass[i, j] = level if residual[i, j] != zero else zero


@kernel(inner=True)
def _slide(residual: F4, i: int, sign: int, sums: I4, counts: I4) -> None:
    """Add a row of ``residual`` to the sums of the columns, or subtract it (``sign`` -1).

    ``sums`` and ``counts`` (columns + 2 * LOW.window + 1,) are the sum over the window's rows in
    each column, in steps of 1 / `STEPS`, and the number of low cells; the margins stay 0.
    """
    steps, maximum, minimum = np.float32(STEPS), np.float32(LOW.max_value), np.float32(-1)
    margin = np.uint64(LOW.window + 1)
    for j in range(np.uint64(residual.shape[1])):
        value = residual[i, j] if residual[i, j] < maximum else maximum
        sums[j + margin] += sign * np.int32(steps * (value if value > minimum else minimum))
        counts[j + margin] += sign * np.int32(residual[i, j] != 0)


@kernel(inline=True)
def _add_windows(sums: I4, counts: I4, total: I4, count: I4) -> None:
    """Write the sum over the window around each column, and the number of low cells, at least 1.

    ``sums`` and ``counts`` are as in `_slide`; ``total`` and ``count`` (columns,) are written.
    """
    width = 2 * LOW.window + 1
    window = number = np.int32(0)
    for j in range(width):
        window += sums[j]
        number += counts[j]
    for j in range(total.size):
        window += sums[j + width] - sums[j]
        number += counts[j + width] - counts[j]
        total[j], count[j] = window, max(number, 1)


@kernel
def measure_noise(high_pass: F4, plane_id: I4, number: int) -> float:
    """Return the median rise on a plane, 1/m; 0 if no rise can be measured.

    A rise is the absolute change of ``high_pass`` over `LOW.rise_cells` cells to the right or down.
    ``high_pass`` (rows, columns), 1/m, is from `filter_high_pass`; ``number``, from 1, is the
    plane's number in ``plane_id`` (rows, columns), as in `HeightMap`.
    """
    rows, columns = high_pass.shape
    histogram = np.zeros(BINS, np.int64)
    n = 0
    for i in range(0, rows - LOW.rise_cells, NOISE_STRIDE):
        for j in range(0, columns - LOW.rise_cells, NOISE_STRIDE):
            value = high_pass[i, j]
            if plane_id[i, j] != -number or value == 0:
                continue
            for y, x in ((i + LOW.rise_cells, j), (i, j + LOW.rise_cells)):
                if plane_id[y, x] == -number and high_pass[y, x] != 0:
                    rise = abs(high_pass[y, x] - value)
                    histogram[min(int(rise / BIN), BINS - 1)] += 1
                    n += 1
    below = bins = 0
    while 2 * below < n:
        below += histogram[bins]
        bins += 1
    return bins * BIN
