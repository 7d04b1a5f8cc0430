"""Label upsampling: the labels of cells transferred to pixels at full resolution."""

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, U4, Records
from shapecat.detection.connected_components import span_of
from shapecat.detection.depth_grid import DepthGrid, row_and_column
from shapecat.detection.output.pixel_runs import append_run, pixels_by_label, split_by_label
from shapecat.detection.planes.height_map import (
    FRINGE,
    HEIGHT_NOISE,
    MIN_HEIGHT_M,
    height_above,
    min_height_at,
)
from shapecat.detection.records import Segmentation
from shapecat.geometry import NEAREST_M
from shapecat.jit import kernel, unset

__all__ = [
    "assign_labels",
    "dilate_row",
    "label_pixels",
]

UNSURE, BARE = -1, -2
"""Codes in place of a label. `UNSURE`: a closer test is needed. `BARE`: an unlabelled cell is next
to a labelled one."""
PIXELS_PER_BLOCK = 16
"""Number of pixels that one vectorised test covers; most have the mark of the pixel before."""


def label_pixels(
    depth: F4, grid: DepthGrid, segmentation: Segmentation, *, range_m: float
) -> list[U4]:
    """Return the pixels of each label 1, 2, ...: ascending flat indices (k,) uint32.

    A pixel takes the label of its cell if their depths agree, else the label of the neighbouring
    cell whose depth agrees best, if any does. The pixel keeps that label only if it is above the
    plane or in a cell of `Segmentation.filled`.

    Parameters
    ----------
    depth : (height, width) metres, 0 where depth is missing.
    range_m : pixels farther away get no label, metres.
    """
    return split_by_label(*_list_pixels(depth, grid, segmentation, range_m))


@kernel(inner=True)
def dilate_row(labels: I4, i: int, scratch: I4, dilated: I4) -> None:
    """Mark in ``dilated`` the cells of row ``i`` that have a label or a neighbour with one.

    ``labels`` and ``dilated`` are (rows, columns); ``scratch`` (columns + 2,) is 0 at both ends.
    """
    rows, columns = labels.shape
    row_above, row_below, one = max(i - 1, 0), min(i + 1, rows - 1), np.uint64(1)
    for j in range(np.uint64(columns)):
        scratch[j + one] = labels[row_above, j] | labels[i, j] | labels[row_below, j]
    for j in range(np.uint64(columns)):
        dilated[i, j] = (scratch[j] | scratch[j + one] | scratch[j + one + one]) != 0


@kernel
def _list_pixels(
    depth: F4, grid: DepthGrid, segmentation: Segmentation, range_m: float
) -> tuple[U4, I4]:
    """Return the pixels of each label, in the form that `pixels_by_label` returns.

    ``depth`` and ``range_m`` are as in `label_pixels`.
    """
    inv_depth, factor = grid.inverse_depth, grid.factor
    rows, columns = inv_depth.shape
    height, width = depth.shape
    # The cells of a row at full resolution, and the marks of its pixels.
    wide_code, wide_w = np.zeros(width, np.int16), np.zeros(width, np.float32)
    line, marks = np.zeros(width, np.int16), np.zeros(width, np.int16)
    cells, positions = np.zeros((2, width), np.int64), np.zeros((3, width))
    runs, n = np.zeros((4 * width, 3), np.int32), 0
    code, spans = _code_cells(grid, segmentation)
    max_depth, shift, scale = np.float32(range_m), (factor - 1) * 0.5, 1.0 / factor
    jump = np.float32(grid.discontinuity)
    for i in range(rows):
        if spans[i, 0] == spans[i, 1]:
            continue
        _widen(code, inv_depth, i, factor, spans[i], wide_code, wide_w)
        x0, x1 = spans[i, 0] * factor, spans[i, 1] * factor if spans[i, 1] < columns else width
        for y in range(i * factor, (i + 1) * factor if i + 1 < rows else height):
            if n + width > len(runs):
                runs = np.concatenate((runs, np.zeros_like(runs)))
            _mark(depth, wide_w, wide_code, (y, x0, x1), max_depth, jump, line)
            unsure = _find_unsure(line, x0, x1, cells)
            for m in range(unsure):
                x = cells[1, m]
                cells[0, m], cells[1, m] = i, min(row_and_column(x, factor)[0], columns - 1)
                positions[0, m], positions[1, m] = (x - shift) * scale, (y - shift) * scale
                positions[2, m] = depth[y, x]
            assign_labels(grid, segmentation, cells, positions, unsure, marks)
            unsure, label, x, start, first = 0, 0, x0, x0, y * width
            while x < x1:
                mark = line[x]
                if mark == UNSURE:
                    mark = marks[unsure]
                    unsure += 1
                if mark != label:
                    n = append_run(label, first + start, first + x, runs, n)
                    label, start = mark, x
                x = _end_of(line, x + 1, x1, label)
            n = append_run(label, first + start, first + x1, runs, n)
    pixels: tuple[U4, I4] = pixels_by_label(runs[:n], segmentation.plane_ids.size)
    return pixels


@kernel(inline=True)
def _find_unsure(line: I4, start: int, end: int, cells: I4) -> int:
    """Write the columns of `UNSURE` pixels to ``cells[1]``; return their number.

    ``line`` (width,) are the marks of a row, searched from ``start`` to ``end``; ``cells`` is (2,
    width).
    """
    n = 0
    for x in range(start, end, PIXELS_PER_BLOCK):
        last, any_unsure = min(x + PIXELS_PER_BLOCK, end), False
        for k in range(np.uint64(x), np.uint64(last)):
            any_unsure |= line[k] == UNSURE  # few blocks have any, and this vectorises
        for k in range(x, last if any_unsure else x):
            cells[1, n] = k
            n += line[k] == UNSURE
    return n


@kernel(inline=True)
def _end_of(line: I4, x: int, end: int, mark: int) -> int:
    """Return the first column from ``x`` on whose mark is not ``mark``, but at most ``end``.

    ``line`` (width,) are the marks of a row.
    """
    while x + PIXELS_PER_BLOCK <= end:
        all_equal = True
        for k in range(np.uint64(x), np.uint64(x + PIXELS_PER_BLOCK)):
            all_equal &= line[k] == mark  # this vectorises
        if not all_equal:
            break
        x += PIXELS_PER_BLOCK
    while x < end and line[x] == mark:
        x += 1
    return x


@kernel(inline=True)
def _code_cells(grid: DepthGrid, segmentation: Segmentation) -> tuple[I4, I4]:
    """Return a code for the pixels that fit each cell, (rows, columns), and the spans of the codes.

    The code is the label of the cell if all these pixels have it, `UNSURE` if they may have it,
    `BARE` if the cell has none but a neighbour does, and 0 away from all labels.
    """
    inv_depth, jump, planes = grid.inverse_depth, grid.discontinuity, segmentation.model.planes
    labels, filled, plane_ids = segmentation.labels, segmentation.filled, segmentation.plane_ids
    code, spans = unset(labels.shape, np.int16), np.zeros((len(labels), 2), np.int32)
    scratch = np.zeros(labels.shape[1] + 2, np.int16)
    high = np.zeros((len(planes), labels.shape[1]), np.uint8)
    for i in range(len(labels)):
        dilate_row(labels, i, scratch, code)
        spans[i, 0], spans[i, 1] = span_of(code[i])
        _find_high(planes, inv_depth, np.float32(jump), i, spans[i], high)
        for j in range(np.uint64(spans[i, 0]), np.uint64(spans[i, 1])):
            label = labels[i, j]
            sure = filled[i, j] | high[np.uint32(plane_ids[np.uint16(label)]), j]
            cell_code = label if sure else np.int16(UNSURE)
            cell_code = cell_code if label > 0 else np.int16(BARE)
            code[i, j] = cell_code if code[i, j] != 0 else np.int16(0)
    return code, spans


@kernel(inline=True)
def _find_high(planes: Records, inv_depth: F4, jump: float, i: int, span: I4, high: U1) -> None:
    """Write whether all pixels that fit a cell are above each plane, for a span of row i.

    A pixel fits a cell if their inverse depths differ by less than ``jump``, 1/m. ``planes`` are
    records of `PLANE`, ``inv_depth`` (rows, columns) is in 1/m, ``span`` is the first column and
    one past the last; ``high`` (planes, columns) is written.
    """
    zero, floor = np.float32(0), np.float32(1e-3)
    base = np.float32(FRINGE * HEIGHT_NOISE)
    slope = np.float32(FRINGE * MIN_HEIGHT_M)
    for k in range(len(planes)):
        plane = planes[k]
        a, below = np.float32(plane.a), np.float32(-plane.offset)
        # The farthest pixel of a cell is 1.5 cells away.
        margin = 1.5 * (abs(plane.a) + abs(plane.b))
        level = np.float32(plane.b * i + plane.c + margin)
        for j in range(np.uint64(span[0]), np.uint64(span[1])):
            min_w = inv_depth[i, j] - jump if inv_depth[i, j] - jump > floor else floor
            ground = level + a * np.float32(np.int32(j))
            ground = ground if ground > zero else zero
            # Heights at the depth 1 / min_w, times the square of min_w.
            high[k, j] = (min_w - ground) * min_w * below > slope * min_w * min_w + base


@kernel(inline=True)
def _widen(
    code: I4, inv_depth: F4, i: int, factor: int, span: I4, wide_code: I4, wide_w: F4
) -> None:
    """Copy a span of row i to full resolution; pixels beyond the last cell get its values.

    ``code`` and ``span`` are from `_code_cells`; a cell is ``factor`` pixels wide. The codes and
    the inverse depths go to ``wide_code`` and ``wide_w`` (width,).
    """
    start, end, two, one = np.uint64(span[0]), np.uint64(span[1]), np.uint64(2), np.uint64(1)
    if factor == 2:  # the usual case, in a form that vectorises
        for j in range(start, end):
            wide_code[two * j] = wide_code[two * j + one] = code[i, j]
        for j in range(start, end):
            wide_w[two * j] = wide_w[two * j + one] = inv_depth[i, j]
    else:
        for j in range(span[0], span[1]):
            for x in range(j * factor, (j + 1) * factor):
                wide_code[x], wide_w[x] = code[i, j], inv_depth[i, j]
    for x in range(span[1] * factor, wide_w.size if span[1] == code.shape[1] else 0):
        wide_code[x], wide_w[x] = code[i, -1], inv_depth[i, -1]


@kernel(inline=True)
def _mark(
    depth: F4,
    inv_depth: F4,
    code: I4,
    run: tuple[int, int, int],
    range_m: float,
    jump: float,
    marks: I4,
) -> None:
    """Write the labels of a run of pixels, `UNSURE` where a closer test is needed.

    ``run`` is the row, the first column, and one past the last. ``inv_depth`` and ``code`` (width,)
    hold the values of the cells for each pixel column, from `_widen`; ``marks`` (width,) is
    written. ``depth`` and ``range_m`` are as in `label_pixels`. A pixel fits a cell if their
    inverse depths differ by less than ``jump``, 1/m. The loop vectorises.
    """
    min_depth, zero = np.float32(NEAREST_M), np.int16(0)
    unsure, bare = np.int16(UNSURE), np.int16(BARE)
    y, start, end = run
    for x in range(np.uint64(start), np.uint64(end)):
        z = depth[y, x]
        fitting = code[x] if code[x] != bare else zero
        fallback = unsure if code[x] != zero else zero
        mark = fitting if _fits(inv_depth[x], z, jump) else fallback
        marks[x] = mark if (z >= min_depth) & (z <= range_m) else zero


@kernel(inner=True)
def assign_labels(
    grid: DepthGrid, segmentation: Segmentation, cells: I4, positions: F8, n: int, marks: I4
) -> None:
    """Write the labels of the first ``n`` of m depths to ``marks``.

    Parameters
    ----------
    cells : (2, m) row and column of the cell of each depth.
    positions : (3, m) column and row of each depth in units of cells, and the depth, metres.
    marks : (m,) the labels are written here, 0 where there is none.
    """
    inv_depth, labels, filled = grid.inverse_depth, segmentation.labels, segmentation.filled
    planes, plane_ids = segmentation.model.planes, segmentation.plane_ids
    rows, columns = inv_depth.shape
    jump = np.float32(grid.discontinuity)
    for m in range(n):
        i, j = cells[0, m], cells[1, m]
        u, v, z = positions[0, m], positions[1, m], np.float32(positions[2, m])
        marks[m] = 0
        if not abs(inv_depth[i, j] * z - np.float32(1)) < jump * z:
            # The neighbour whose depth fits best, if any is within two discontinuities.
            row, column, nearest = -1, -1, np.float32(2) * jump * z
            for y in range(max(i - 1, 0), min(i + 2, rows)):
                for x in range(max(j - 1, 0), min(j + 2, columns)):
                    gap = abs(inv_depth[y, x] * z - np.float32(1))
                    closer = gap < nearest  # a selection: a branch would be unpredictable
                    nearest = gap if closer else nearest
                    row, column = y if closer else row, x if closer else column
            if row < 0:
                continue
            i, j = row, column
        label = labels[i, j]
        if label <= 0:
            continue
        height = height_above(planes[plane_ids[label]], v, u, z)
        if filled[i, j] or height > FRINGE * min_height_at(z):
            marks[m] = label


@kernel(inline=True)
def _fits(inv_depth: float, z: float, jump: float) -> bool:
    """Return whether 1 / ``z`` and a cell's ``inv_depth`` differ by less than ``jump``, 1/m."""
    return bool(abs(inv_depth * z - np.float32(1)) < jump * z)  # faster than a division
