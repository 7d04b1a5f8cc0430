"""Growing boosted trees on binned features: gradient boosting with the cross-entropy loss.

Source: Friedman 2001, algorithm 6 (one tree per category and round, on the residual of the
category's posterior); leaf values and gains from second derivatives: Chen and Guestrin 2016, eqs. 5
and 7.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.jit import kernel
from shapecat.trees import BoostedTrees, Trees

__all__ = ["BINS", "Bins", "Tree", "TreeSettings", "grow_tree", "joined", "make_bins"]

BINS = 64
"""Number of quantile bins of each feature."""
_LEAST_GAIN = 1e-6
"""A leaf is split only if the gain is larger."""


class TreeSettings(NamedTuple):
    """Settings of one tree.

    Attributes
    ----------
    leaves : maximum number of leaves.
    rate : learning rate, which multiplies every leaf value.
    l2 : L2 regularisation, added to the sum of the second derivatives in a leaf.
    min_hessian : minimum sum of the second derivatives in a leaf.
    """

    leaves: int
    rate: float
    l2: float
    min_hessian: float


class Bins(NamedTuple):
    """Binned features of n views.

    Attributes
    ----------
    edges : (f, BINS - 1) upper edges of the bins, ascending.
    binned : (f, n) bin of each value; bin <= k means value <= edges[f, k].
    """

    edges: F4
    binned: U1


class Tree(NamedTuple):
    """The m nodes of a tree, the root first.

    Attributes
    ----------
    feature, threshold : (m,) a view goes to the left child if this feature is <= this threshold;
        meaningless for leaves.
    left : (m,) index of the left child, 0 for a leaf; the right child follows the left one.
    value : (m,) value that a leaf adds to the score.
    """

    feature: I4
    threshold: F4
    left: I4
    value: F4


def make_bins(features: F4) -> Bins:
    """Bin features (n, f) by their quantiles, so that bins hold about equal numbers of views."""
    edges = np.quantile(features, np.linspace(0, 1, BINS + 1)[1:-1], axis=0).T
    edges = np.ascontiguousarray(edges, np.float32)
    binned = np.zeros(features.shape[::-1], np.uint8)
    for row, column, limits in zip(binned, features.T, edges, strict=True):
        row[:] = np.searchsorted(limits, column)
    return Bins(edges, binned)


def grow_tree(
    bins: Bins, columns: I4, rows: I4, gradient: F4, hessian: F4, settings: TreeSettings, score: F4
) -> Tree:
    """Grow one tree, best split first, and add its values to the ``score`` (n,) of all views.

    Parameters
    ----------
    columns : indices of the features to use.
    rows : int32 indices of the views to learn from; they are reordered in place.
    gradient, hessian : (n,) first and second derivative of the loss with respect to the score.
    score : (n,) updated in place.
    """
    room = 2 * settings.leaves - 1
    feature, cut, left = (np.zeros(room, np.int64) for _ in range(3))
    value = np.zeros(room, np.float32)
    count = _grow(
        bins.binned, columns, rows, gradient, hessian, settings.leaves, settings.rate, settings.l2,
        settings.min_hessian, feature, cut, left, value,
    )  # fmt: skip
    feature, cut, left, value = (feature[:count], cut[:count], left[:count], value[:count])
    _add_values(bins.binned, feature, cut, left, value, score)
    return Tree(feature, bins.edges[feature, cut], left, value)


def joined(grown: Sequence[Tree]) -> BoostedTrees:
    """Join trees into one ensemble, whose score is the sum of theirs."""
    roots = np.cumsum([0, *(len(tree.left) for tree in grown)])
    left = [np.where(t.left > 0, t.left + root, 0) for t, root in zip(grown, roots, strict=False)]
    trees = Trees(
        roots[:-1].astype(np.int32),
        np.concatenate([tree.feature for tree in grown]).astype(np.int16),
        np.concatenate([tree.threshold for tree in grown]).astype(np.float32),
        np.concatenate(left).astype(np.int32),
    )
    return BoostedTrees(trees, np.concatenate([tree.value for tree in grown]).astype(np.float32))


@kernel
def _grow(
    binned: U1,
    columns: I4,
    rows: I4,
    gradient: F4,
    hessian: F4,
    leaves: int,
    rate: float,
    l2: float,
    min_hessian: float,
    feature: I4,
    cut: I4,
    left: I4,
    value: F4,
) -> int:
    """Grow a tree into ``feature``, ``cut``, ``left`` and ``value``; return its number of nodes.

    ``cut`` is the last bin that goes left. The other parameters are as in `Bins`, `TreeSettings`
    and `Tree`, or as for `grow_tree`.
    """
    room = feature.size
    first, last = np.zeros(room, np.int64), np.zeros(room, np.int64)
    best = np.zeros((room, 3))  # gain, index into columns, bin
    sums = np.zeros((room, columns.size, BINS, 2), np.float32)
    spare = np.empty_like(rows)
    last[0] = rows.size
    _collect(binned, columns, rows, gradient, hessian, sums[0])
    value[0] = -rate * _best_cut(sums[0], l2, min_hessian, best[0])
    count = 1
    for _ in range(leaves - 1):
        # (1) Choose the leaf whose split gains most.
        node = np.argmax(best[:count, 0])
        if best[node, 0] <= _LEAST_GAIN:
            break
        column = columns[int(best[node, 1])]
        feature[node], cut[node], left[node] = column, int(best[node, 2]), count
        # (2) Divide its views, keeping their order.
        middle = _divide(binned[column], rows, first[node], last[node], cut[node], spare)
        first[count], last[count] = first[node], middle
        first[count + 1], last[count + 1] = middle, last[node]
        # (3) Sum up the smaller child; the larger one is the parent minus this.
        small = count if middle - first[node] <= last[node] - middle else count + 1
        large = 2 * count + 1 - small
        _collect(binned, columns, rows[first[small] : last[small]], gradient, hessian, sums[small])
        for c in range(columns.size):  # a single assignment takes 2 s more to compile
            for k in range(BINS):
                for part in range(2):
                    sums[large, c, k, part] = sums[node, c, k, part] - sums[small, c, k, part]
        # (4) Find the best split of each child.
        for child in (count, count + 1):
            value[child] = -rate * _best_cut(sums[child], l2, min_hessian, best[child])
        best[node, 0] = 0.0
        count += 2
    return count


@kernel(inner=True)
def _collect(binned: U1, columns: I4, rows: I4, gradient: F4, hessian: F4, sums: F4) -> None:
    """Add the derivatives of the views in ``rows`` to ``sums`` (c, BINS, 2), bin by bin.

    The first axis is that of the c features in ``columns``, the last one is gradient, hessian. The
    other parameters are as for `_grow`.
    """
    g, h = gradient[rows], hessian[rows]
    for c in range(columns.size):
        bins, out = binned[columns[c]], sums[c]
        for i in range(rows.size):
            k = bins[rows[i]]
            out[k, 0] += g[i]
            out[k, 1] += h[i]


@kernel(inner=True)
def _best_cut(sums: F4, l2: float, min_hessian: float, best: F8) -> float:
    """Write gain, column and last left bin of a leaf's best split to ``best`` (3,).

    The gain is 0 if there is no split; the column is an index into ``sums``, from `_collect`. The
    other parameters are as in `TreeSettings`. Returns the negative Newton step of the leaf.
    """
    gradient = hessian = 0.0
    for k in range(BINS):
        gradient += sums[0, k, 0]
        hessian += sums[0, k, 1]
    alone = gradient * gradient / (hessian + l2)
    best[0] = 0.0
    for c in range(sums.shape[0]):
        low_gradient = low_hessian = 0.0
        for k in range(BINS - 1):
            low_gradient += sums[c, k, 0]
            low_hessian += sums[c, k, 1]
            if low_hessian < min_hessian:
                continue
            if hessian - low_hessian < min_hessian:
                break
            high_gradient, high_hessian = gradient - low_gradient, hessian - low_hessian
            gain = (
                low_gradient * low_gradient / (low_hessian + l2)
                + high_gradient * high_gradient / (high_hessian + l2)
                - alone
            )
            if gain > best[0]:
                best[0], best[1], best[2] = gain, c, k
    return gradient / (hessian + l2)


@kernel(inline=True)
def _divide(bins: U1, rows: I4, first: int, last: int, cut: int, spare: I4) -> int:
    """Move the views with bins <= ``cut`` to the front of rows[first:last].

    Both these and the other views keep their order. ``bins`` (n,) are the bins of all views in one
    feature. Returns the index in ``rows`` where the other views begin; ``spare`` is work space of
    the size of ``rows``.
    """
    low, high = first, 0
    for i in range(first, last):
        if bins[rows[i]] <= cut:
            rows[low] = rows[i]
            low += 1
        else:
            spare[high] = rows[i]
            high += 1
    for i in range(high):  # a single assignment takes 2 s more to compile
        rows[low + i] = spare[i]
    return low


@kernel
def _add_values(binned: U1, feature: I4, cut: I4, left: I4, value: F4, score: F4) -> None:
    for i in range(score.size):
        node = 0
        while left[node] != 0:
            node = left[node] + (0 if binned[feature[node], i] <= cut[node] else 1)
        score[i] += value[node]
