"""Data association of detections and tracks: differences between them, and the assignment."""

from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from shapecat.arrays import F4, F8, I4

__all__ = ["assign", "posterior_difference", "size_difference", "size_key", "sorted_sides"]

_SIZE_SLACK_M = 0.01
"""Added to every length before its logarithm is taken: a thin side may vary by a centimetre."""


def sorted_sides(sizes: F4) -> F8:
    """Return sizes (n, 3) as longer side, shorter side, height, in double precision.

    The yaw of a box may change by a quarter turn between frames.
    """
    sides = np.sort(sizes[:, :2].astype(np.float64), axis=1)
    return np.column_stack([sides[:, ::-1], sizes[:, 2]])


def size_key(sizes: F4) -> F8:
    """Return the logarithms (n, 3) of `sorted_sides` plus 1 cm, for sizes (n, 3) in metres."""
    return np.asarray(np.log(np.maximum(sorted_sides(sizes), 0.0) + _SIZE_SLACK_M))


def size_difference(keys_a: F8, keys_b: F8) -> F8:
    """Return the mean absolute differences (m, n) of `size_key` results (m, 3) and (n, 3)."""
    return np.asarray(np.abs(keys_a[:, None] - keys_b[None]).mean(axis=2))


def posterior_difference(a: F8, b: F8) -> F8:
    """Return the total variation distances (m, n), 0 to 1, of posteriors (m, c) and (n, c)."""
    return np.asarray(0.5 * np.abs(a[:, None] - b[None]).sum(axis=2))


def assign(costs: F8, limit: float, method: Literal["hungarian", "greedy"]) -> I4:
    """Choose pairs of rows and columns, each used at most once.

    Parameters
    ----------
    costs : (m, n) cost of each pair; infinite if a pair is impossible.
    limit : only pairs with a lower cost are chosen.
    method : ``hungarian`` minimises the sum of ``cost - limit`` over the chosen pairs, so that no
        costly pair is made only to use up a row (O(n^3) for n rows and columns); ``greedy``
        repeatedly takes the cheapest pair of unused rows and columns (on ties, the first in
        row-major order).

    Returns
    -------
    Row and column of each pair (k, 2), sorted by row.
    """
    gain = np.minimum(costs - limit, 0.0)
    if gain.size == 0 or not gain.any():
        return np.zeros((0, 2), np.int32)
    if method == "hungarian":
        rows, columns = linear_sum_assignment(gain)
        pairs = np.column_stack([rows, columns])[gain[rows, columns] < 0]
    else:
        pairs = _greedy(gain)
    return np.asarray(pairs, np.int32)


def _greedy(gain: F8) -> I4:
    """Pair rows and columns of ``gain`` (m, n), lowest value first; return (p, 2), by row.

    All values are at most 0; those of 0 are not paired.
    """
    rows, columns = np.nonzero(gain)
    free_row, free_column = np.ones(gain.shape[0], bool), np.ones(gain.shape[1], bool)
    pairs = []
    for k in np.argsort(gain[rows, columns], kind="stable"):
        i, j = rows[k], columns[k]
        if free_row[i] and free_column[j]:
            free_row[i] = free_column[j] = False
            pairs.append((i, j))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)
