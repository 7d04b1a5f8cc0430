"""Connected components of cells.

Two passes with a table of equivalent labels (Rosenfeld and Pfaltz 1966).
"""

import numpy as np

from shapecat.arrays import I4, U1, Bool
from shapecat.jit import kernel, unset

__all__ = ["DOWN", "RIGHT", "SIDES", "connected_components", "span_of", "spans_of"]

RIGHT, DOWN = 1, 2
"""Bits of ``links``: a cell is linked to its right neighbour, or to the one below."""
SIDES = ((0, 1), (1, 0), (0, -1), (-1, 0))
"""Row and column offsets of the four neighbours of a cell."""


@kernel
def connected_components(inside: Bool, links: U1, spans: I4, component: I4) -> I4:
    """Label connected components from 1, in the order of their first cells.

    Parameters
    ----------
    inside : (rows, columns) bool, the cells to label; none is outside ``spans``.
    links : (rows, columns) uint8, the bits `RIGHT` and `DOWN`; links to cells that are not inside
        are ignored.
    spans : (rows, 2) for each row, the first column that may be inside, and one past the last.
    component : (rows, columns) int32, written within the spans: the labels, 0 where not inside.

    Returns
    -------
    (n + 1,) the number of cells with each label; 0 for label 0.
    """
    rows, columns = inside.shape
    within, bits, labels = inside.reshape(-1), links.reshape(-1), component.reshape(-1)
    capacity = 1
    for i in range(rows):
        capacity += spans[i, 1] - spans[i, 0]
    parent = unset(capacity, np.int32)
    size = unset(capacity, np.int32)
    count = 0
    # (1) provisional labels, and which of them are connected
    for i in range(rows):
        before = 0
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            label, before = before, 0
            if not within[p]:
                labels[p] = 0
                continue
            label = label if label > 0 and bits[p - 1] & RIGHT else 0
            up = p - columns
            above = labels[up] if up >= 0 and within[up] and bits[up] & DOWN else 0
            if label == 0 and above == 0:
                count += 1
                parent[count] = label = count
                size[count] = 0
            elif label == 0:
                label = above
            elif above > 0 and above != label:
                a, b = _root(parent, label), _root(parent, above)
                parent[max(a, b)] = label = min(a, b)
            labels[p] = before = label
            size[label] += 1
    # (2) final labels
    for k in range(count, 0, -1):
        if parent[k] != k:
            size[parent[k]] += size[k]
    sizes, n = np.zeros(count + 1, np.int32), 0
    for k in range(1, count + 1):
        if parent[k] == k:
            n += 1
            sizes[n] = size[k]
            size[k] = n  # reused for the final label
        else:
            size[k] = size[parent[k]]
    size[0] = 0
    for i in range(rows):
        for p in range(i * columns + spans[i, 0], i * columns + spans[i, 1]):
            labels[p] = size[labels[p]]
    return sizes[: n + 1]


@kernel(inner=True)
def _root(parent: I4, k: int) -> int:
    """Return the root of element ``k`` in a union-find forest, ``parent`` (n,)."""
    while parent[k] != k:
        k = parent[k]
    return k


@kernel
def spans_of(labels: I4) -> I4:
    """Return the spans (rows, 2) of ``labels`` (rows, columns): the result of `span_of` per row."""
    spans = np.zeros((labels.shape[0], 2), np.int32)
    for i in range(len(spans)):
        spans[i, 0], spans[i, 1] = span_of(labels[i])
    return spans


@kernel
def span_of(row: I4) -> tuple[int, int]:
    """Return the first column where a row (n,) is above 0, and one past the last such column.

    Both are 0 if there is none.
    """
    any_inside = False
    for j in range(row.size):
        any_inside |= row[j] > 0  # many rows have none, and this vectorises
    if not any_inside:
        return 0, 0
    start, end = 0, row.size
    while row[start] <= 0:
        start += 1
    while row[end - 1] <= 0:
        end -= 1
    return start, end
