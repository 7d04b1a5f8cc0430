"""Occluded points: the points of a fused cloud that the virtual camera does not see.

Objects are found on the surface that the virtual camera sees. Points behind it join the object
whose points they touch; the others are clustered by distance alone (thesis Alg. 2).
"""

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.detection.output.settings import OUTPUT
from shapecat.jit import kernel

__all__ = ["label_occluded_points"]


def label_occluded_points(points: F4, labels: I4, first_new: int) -> I4:
    """Label all points: labels spread to unlabelled points that touch labelled ones.

    Points touch if their voxels of 1 cm share at least a corner. Labels spread one voxel
    at a time, so that the nearest object wins.

    Parameters
    ----------
    points : (n, 3) metres, any frame.
    labels : (n,) labels from 1; 0 where there is none.
    first_new : the label of the first cluster that touches no labelled object; further clusters get
        the numbers after it.

    Returns
    -------
    (n,) labels, none of them 0.
    """
    cell = np.floor((points - points.min(axis=0)) / OUTPUT.voxel_m).astype(np.int64) + 1
    _, ny, nz = cell.max(axis=0) + 2
    keys, voxel = np.unique((cell[:, 0] * ny + cell[:, 1]) * nz + cell[:, 2], return_inverse=True)
    voxel_labels = np.zeros(keys.size, np.int64)
    np.maximum.at(voxel_labels, voxel, labels)
    _spread(keys, int(ny), int(nz), voxel_labels, first_new)
    return np.where(labels > 0, labels, voxel_labels[voxel])


@kernel
def _spread(keys: I4, ny: int, nz: int, labels: I4, new_label: int) -> None:
    """Spread labels of voxels to touching voxels, in place; clusters without one get new labels.

    ``keys`` (n,), ascending, are ``(x * ny + y) * nz + z`` of each voxel; ``labels`` (n,) are 0
    where there is none. New labels count from ``new_label``.
    """
    queue = np.zeros(keys.size, np.int64)
    head = tail = 0
    for k in range(keys.size):
        if labels[k] > 0:
            queue[tail] = k
            tail += 1
    seed = 0
    while True:
        while head < tail:
            k = queue[head]
            head += 1
            for dx in range(-1, 2):
                for dy in range(-1, 2):
                    # The three voxels of a column are neighbours in the sorted keys.
                    key = keys[k] + (dx * ny + dy) * nz - 1
                    q = np.searchsorted(keys, key)
                    while q < keys.size and keys[q] <= key + 2:
                        if labels[q] == 0:
                            labels[q] = labels[k]
                            queue[tail] = q
                            tail += 1
                        q += 1
        while seed < keys.size and labels[seed] > 0:
            seed += 1
        if seed == keys.size:
            return
        labels[seed] = new_label
        new_label += 1
        queue[tail] = seed
        tail += 1
