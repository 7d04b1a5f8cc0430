"""Runs of consecutive pixels with one label, and the list of each label's pixels."""

from itertools import pairwise

import numpy as np

from shapecat.arrays import I4, U4
from shapecat.jit import kernel

__all__ = ["append_run", "pixels_by_label", "split_by_label"]


@kernel(inner=True)
def append_run(label: int, first: int, end: int, runs: I4, n: int) -> int:
    """Append a run of pixels after the first ``n`` rows of ``runs``; return the new number of rows.

    ``runs`` is as in `pixels_by_label`; a run whose label is 0 is left out. The run is from pixel
    ``first`` to before ``end``.
    """
    if label > 0:
        runs[n, 0], runs[n, 1], runs[n, 2] = label, first, end
        n += 1
    return n


@kernel
def pixels_by_label(runs: I4, labels: int) -> tuple[U4, I4]:
    """Return the pixel indices (n,) of runs, sorted by label, and where each label ends (labels,).

    ``runs`` is (r, 3): label, first pixel, and one past the last. ``labels`` is the number of
    labels, including label 0, which has no pixels: its end is 0.
    """
    offset, total = np.zeros(labels, np.int64), 0  # where the next pixel of each label goes
    for r in range(len(runs)):
        offset[runs[r, 0]] += runs[r, 2] - runs[r, 1]
    for label in range(labels):
        offset[label], total = total, total + offset[label]
    order = np.zeros(total, np.uint32)
    for r in range(len(runs)):
        label, first, size = runs[r, 0], runs[r, 1], runs[r, 2] - runs[r, 1]
        start = np.uint64(offset[label])
        for k in range(np.uint64(size)):
            order[start + k] = first + k
        offset[label] += size
    return order, offset


def split_by_label(order: U4, ends: I4) -> list[U4]:
    """Split the result of `pixels_by_label` into a list (k,) of pixels for each label from 1.

    ``order`` (n,) are the pixel indices, ``ends`` (labels,) where each label ends.
    """
    return [order[a:b] for a, b in pairwise(ends.tolist())]
