"""Which detection continues which track: costs of the pairs, and the choice among them."""

from typing import Literal

import numpy as np
from scipy.optimize import linear_sum_assignment

from shapecat.arrays import F4, F8, I4

__all__ = ["assign", "posterior_difference", "size_difference", "size_key"]

_SIZE_SLACK_M = 0.01
"""Added to every length before its logarithm: a centimetre on a flat side is noise."""


def size_key(sizes: F4) -> F8:
    """Return (n, 3) logarithms of sizes (n, 3): longer side, shorter side, height.

    The sides are sorted because the yaw of a box may flip by a quarter turn between frames.
    """
    sizes = np.asarray(sizes, np.float64)
    sides = np.sort(sizes[:, :2], axis=1)[:, ::-1]
    lengths = np.maximum(np.column_stack([sides, sizes[:, 2]]), 0.0)
    return np.asarray(np.log(lengths + _SIZE_SLACK_M))


def size_difference(keys_a: F8, keys_b: F8) -> F8:
    """Return (m, n) mean absolute logarithms of the ratios of sizes, from their `size_key`."""
    return np.asarray(np.abs(keys_a[:, None] - keys_b[None]).mean(axis=2))


def posterior_difference(a: F8, b: F8) -> F8:
    """Return (m, n) total variation distances, 0 to 1, between posteriors (m, c) and (n, c)."""
    return np.asarray(0.5 * np.abs(a[:, None] - b[None]).sum(axis=2))


def assign(costs: F8, limit: float, method: Literal["hungarian", "greedy"]) -> I4:
    """Choose pairs of rows and columns, each used at most once.

    Parameters
    ----------
    costs : (m, n) cost of each pair; infinite where a pair is impossible.
    limit : no pair costs this much or more.
    method : ``hungarian`` takes the pairs whose sum of ``cost - limit`` is least, so that a
        far-fetched pair is not made only to use up a row (O(n^3) for n rows and columns);
        ``greedy`` takes the cheapest pair, strikes out its row and column, and so on (the
        first in row-major order on ties).

    Returns
    -------
    (k, 2) row and column of each pair, by row.
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
    rows, columns = np.nonzero(gain)
    free_row, free_column = np.ones(gain.shape[0], bool), np.ones(gain.shape[1], bool)
    pairs = []
    for k in np.argsort(gain[rows, columns], kind="stable"):
        i, j = rows[k], columns[k]
        if free_row[i] and free_column[j]:
            free_row[i] = free_column[j] = False
            pairs.append((i, j))
    return np.array(sorted(pairs), np.int64).reshape(-1, 2)
