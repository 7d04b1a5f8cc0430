"""Label upsampling: labels of cells brought back to full resolution."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, U4
from shapecat.detection.cleanup.settings import CLEANUP
from shapecat.detection.connected_components import span_of
from shapecat.detection.depth_grid import DepthGrid, row_and_column
from shapecat.detection.planes.height_map import HEIGHT_NOISE, MIN_HEIGHT_M
from shapecat.detection.records import Segmentation
from shapecat.geometry import DISCONTINUITY, NEAREST_M
from shapecat.jit import kernel

__all__ = [
    "GridLabels",
    "find_near",
    "grid_labels_of",
    "label_pixels",
    "list_runs",
    "settle_labels",
    "split_lists",
]

UNSURE, BARE = -1, -2
"""Instead of a label: what takes more to tell, and cells without a label next to one that has."""


class GridLabels(NamedTuple):
    """What is known of the cells, as in `DepthGrid` and `Segmentation`; ``plane_ids`` by label."""

    inverse_depth: F4
    labels: I4
    filled: U1
    planes: F8
    plane_ids: I4


def label_pixels(depth: F4, grid: DepthGrid, found: Segmentation, *, range_m: float) -> list[U4]:
    """Return the ascending pixel indices of the labels 1, 2, ...

    A pixel takes the label of its cell, or else of the neighbour whose depth fits best; it keeps
    it only where it is above the plane itself, except in filled cells.
    """
    grid_labels = grid_labels_of(grid, found)
    return split_lists(
        *_list_pixels(depth, grid_labels, grid.factor, range_m, found.plane_ids.size)
    )


def grid_labels_of(grid: DepthGrid, found: Segmentation) -> GridLabels:
    """Gather what the kernels here read."""
    return GridLabels(grid.inverse_depth, found.labels, found.filled, found.planes, found.plane_ids)


def split_lists(order: U4, ends: I4) -> list[U4]:
    """Split what `list_runs` returns into the lists of the labels."""
    return [order[a:b] for a, b in pairwise(ends.tolist())]


@kernel
def find_near(labels: I4, i: int, scratch: I4, near: I4) -> None:
    """Mark the cells of a row that have a label or are next to one that has.

    ``scratch`` is (columns + 2,) with 0 at both ends.
    """
    rows, columns = labels.shape
    above, here, below = labels[max(i - 1, 0)], labels[i], labels[min(i + 1, rows - 1)]
    for j in range(columns):
        scratch[j + 1] = above[j] | here[j] | below[j]
    for j in range(columns):
        near[j] = (scratch[j] | scratch[j + 1] | scratch[j + 2]) != 0


@kernel
def _list_pixels(
    depth: F4, grid_labels: GridLabels, factor: int, range_m: float, labels: int
) -> tuple[U4, I4]:
    """Return the pixels of the labels below ``labels`` as `list_runs`."""
    rows, columns = grid_labels.inverse_depth.shape
    height, width = depth.shape
    # The cells of a row, and the same at full resolution.
    code, wide_code = np.zeros(columns, np.int16), np.zeros(width, np.int16)
    wide_w, line = np.zeros(width, np.float32), np.zeros(width, np.int16)
    scratch, high = (
        np.zeros(columns + 2, np.int16),
        np.zeros((len(grid_labels.planes), columns), np.uint8),
    )
    runs = np.zeros((4 * width, 3), np.int32)
    cells, places = np.zeros((2, width), np.int64), np.zeros((3, width), np.float64)
    marks = np.zeros(width, np.int16)
    far, shift, scale = np.float32(range_m), (factor - 1) * 0.5, 1.0 / factor
    n = 0
    for i in range(rows):
        span = _code_cells(grid_labels, i, scratch, high, code)
        if span[0] == span[1]:
            continue
        x0, x1 = span[0] * factor, span[1] * factor if span[1] < columns else width
        _widen(code, factor, span, wide_code)
        _widen(grid_labels.inverse_depth[i], factor, span, wide_w)
        for y in range(i * factor, (i + 1) * factor if i + 1 < rows else height):
            if n + width > len(runs):
                runs = np.concatenate((runs, np.zeros_like(runs)))
            part = line[x0:x1]
            _mark(depth[y, x0:x1], wide_w[x0:x1], wide_code[x0:x1], far, part)
            unsure = 0
            for k in range(part.size):
                if part[k] == UNSURE:
                    cells[0, unsure] = i
                    cells[1, unsure] = min(row_and_column(x0 + k, factor)[0], columns - 1)
                    places[0, unsure], places[1, unsure] = (
                        (x0 + k - shift) * scale,
                        (y - shift) * scale,
                    )
                    places[2, unsure] = depth[y, x0 + k]
                    unsure += 1
            settle_labels(grid_labels, cells, places, unsure, marks)
            unsure, label, start, first = 0, 0, 0, y * width + x0
            for k in range(part.size):
                mark = part[k]
                if mark == UNSURE:
                    mark = marks[unsure]
                    unsure += 1
                if mark != label:
                    n = _end_run(label, first + start, first + k, runs, n)
                    label, start = mark, k
            n = _end_run(label, first + start, first + part.size, runs, n)
    listed: tuple[U4, I4] = list_runs(runs[:n], labels)
    return listed


@kernel
def _end_run(label: int, first: int, end: int, runs: I4, n: int) -> int:
    """Append the indices of a label to n runs, if it is one; return how many there are then."""
    if label > 0:
        runs[n, 0], runs[n, 1], runs[n, 2] = label, first, end
        n += 1
    return n


@kernel
def list_runs(runs: I4, labels: int) -> tuple[U4, I4]:
    """Return the indices in the runs by label, ascending, and where those of each label end.

    The first end is that of label 0, which has none.
    """
    ends = np.zeros(labels, np.int64)
    for r in range(len(runs)):
        ends[runs[r, 0]] += runs[r, 2] - runs[r, 1]
    ends = np.cumsum(ends)
    place = np.zeros(labels, np.int64)
    place[1:] = ends[:-1]
    order = np.zeros(ends[-1], np.uint32)
    for r in range(len(runs)):
        label, first, size = runs[r, 0], runs[r, 1], runs[r, 2] - runs[r, 1]
        start = np.uint64(place[label])
        for k in range(np.uint64(size)):
            order[start + k] = first + k
        place[label] += size
    return order, ends


@kernel
def _code_cells(
    grid_labels: GridLabels, i: int, scratch: I4, high: U1, code: I4
) -> tuple[int, int]:
    """Write what the pixels that fit each cell of a row are.

    That is its label if all of them have it, `UNSURE` if they may have it, `BARE` if it has none,
    and 0 away from all labels. Returns the first column that is not 0 and the one after the last.
    """
    find_near(grid_labels.labels, i, scratch, code)
    span: tuple[int, int] = span_of(code)
    part = slice(span[0], span[1])
    for k in range(len(high)):
        _find_high(
            grid_labels.planes[k], i, span[0], grid_labels.inverse_depth[i, part], high[k, part]
        )
    labels, filled = grid_labels.labels[i], grid_labels.filled[i]
    for j in range(span[0], span[1]):
        label = labels[j]
        sure = filled[j] | high[np.uint32(grid_labels.plane_ids[np.uint16(label)]), j]
        what = label if sure else np.int16(UNSURE)
        what = what if label > 0 else np.int16(BARE)
        code[j] = what if code[j] != 0 else np.int16(0)
    return span


@kernel
def _find_high(plane: F8, i: int, first: int, inv_depth: F4, high: U1) -> None:
    """Write whether every pixel that fits a cell rises above a plane.

    The cells are those of row i from column ``first`` on.
    """
    jump, zero, nowhere = np.float32(DISCONTINUITY), np.float32(0), np.float32(1e-3)
    a, above = np.float32(plane[0]), np.float32(plane[3])
    # The farthest pixel of a cell is 1.5 cells away.
    level = np.float32(plane[1] * i + plane[2] + 1.5 * (abs(plane[0]) + abs(plane[1])))
    base, slope = (
        np.float32(CLEANUP.fringe * HEIGHT_NOISE),
        np.float32(CLEANUP.fringe * MIN_HEIGHT_M),
    )
    for j in range(inv_depth.size):
        least = inv_depth[j] - jump if inv_depth[j] - jump > nowhere else nowhere
        ground = level + a * np.float32(first + j)
        ground = ground if ground > zero else zero
        # Heights at the depth 1 / least, times the square of least.
        high[j] = (least - ground) * least * above > slope * least * least + base


@kernel
def _widen(row: F4, factor: int, span: tuple[int, int], wide: F4) -> None:
    """Write the cells of a part of a row to their pixels; those beyond the last cell are its."""
    here, part = row[span[0] : span[1]], wide[span[0] * factor : span[1] * factor]
    if factor == 2:  # the usual case, in a form that vectorises
        for j in range(here.size):
            part[2 * j] = part[2 * j + 1] = here[j]
    else:
        for j in range(here.size):
            for k in range(factor):
                part[j * factor + k] = here[j]
    if span[1] == row.size:
        wide[row.size * factor :] = row[-1]


@kernel
def _mark(depth: F4, inv_depth: F4, code: I4, range_m: float, marks: I4) -> None:
    """Write the labels of pixels (n,), `UNSURE` where it takes more to tell."""
    least, zero, unsure, bare = np.float32(NEAREST_M), np.int16(0), np.int16(UNSURE), np.int16(BARE)
    for x in range(depth.size):
        z = depth[x]
        fitting = code[x] if code[x] != bare else zero
        other = unsure if code[x] != zero else zero
        mark = fitting if _fits(inv_depth[x], z) else other
        marks[x] = mark if (z >= least) & (z <= range_m) else zero


@kernel
def settle_labels(grid_labels: GridLabels, cells: I4, places: F8, n: int, marks: I4) -> None:
    """Write the labels of the first ``n`` of some depths, 0 where there is none.

    Parameters
    ----------
    cells : (2, m) row and column of the cell of each.
    places : (3, m) its column, row, in cells, and depth.
    marks : (m,) to write to.
    """
    inv_depth, labels, filled = grid_labels.inverse_depth, grid_labels.labels, grid_labels.filled
    planes, plane_ids = grid_labels.planes, grid_labels.plane_ids
    rows, columns = inv_depth.shape
    jump = np.float32(DISCONTINUITY)
    for m in range(n):
        i, j, u, v, z = (
            cells[0, m],
            cells[1, m],
            places[0, m],
            places[1, m],
            np.float32(places[2, m]),
        )
        marks[m] = 0
        if not abs(inv_depth[i, j] * z - np.float32(1)) < jump * z:
            # The neighbour whose depth fits best, if any is within two jumps.
            row, column, nearest = -1, -1, np.float32(2 * DISCONTINUITY) * z
            for y in range(max(i - 1, 0), min(i + 2, rows)):
                for x in range(max(j - 1, 0), min(j + 2, columns)):
                    gap = abs(inv_depth[y, x] * z - np.float32(1))
                    better = gap < nearest  # a choice, for no branch could be foretold
                    nearest = gap if better else nearest
                    row, column = y if better else row, x if better else column
            if row < 0:
                continue
            i, j = row, column
        label = labels[i, j]
        if label <= 0:
            continue
        k = plane_ids[label]
        h = (1 - (planes[k, 0] * u + planes[k, 1] * v + planes[k, 2]) * z) * planes[k, 3]
        if filled[i, j] or h > CLEANUP.fringe * (MIN_HEIGHT_M + HEIGHT_NOISE * z * z):
            marks[m] = label


@kernel
def _fits(inv_depth: float, z: float) -> bool:
    """Whether a depth is within one jump of a cell; both sides are multiplied by the depth."""
    return bool(abs(inv_depth * z - np.float32(1)) < np.float32(DISCONTINUITY) * z)
