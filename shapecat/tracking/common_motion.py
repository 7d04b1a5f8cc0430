"""The common motion of all objects, on a turntable or relative to a sensor of unknown pose."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from shapecat.arrays import F8, I4
from shapecat.tracking.detection_table import DetectionTable

__all__ = ["CommonMotion", "find_common_motion"]

_LONG = 5  # fewest detections of a track that is used
_MOVED_M = 0.06  # a track's centres spread less than this while its object stands still
_MOST = 0.7  # fraction of the detections that must be of moving objects, and fit the motion
_TOGETHER_M = 0.03  # largest distance of a detection that fits the common motion
_NOISE_M = 0.01  # residual at which the weight of a detection is one half
_ROUNDS = 10

C16 = NDArray[np.complexfloating[Any, Any]]


@dataclass(frozen=True)
class CommonMotion:
    """For each frame, the transform into a coordinate frame in which the objects stand still.

    Attributes
    ----------
    rotations : (f, 3, 3) about the up direction.
    translations : (f, 3) metres.
    """

    rotations: F8
    translations: F8

    def stabilised(self, table: DetectionTable) -> DetectionTable:
        """Return the detections transformed into the coordinate frame of the still objects."""
        centers = np.zeros(table.centers.shape)
        orientations = np.zeros_like(table.orientations)
        for block in table.blocks():
            turns = self.rotations[table.rows[block]]
            shifts = self.translations[table.rows[block]]
            centers[block] = np.einsum("nij,nj->ni", turns, table.centers[block]) + shifts
            orientations[block] = Rotation.from_matrix(turns @ table.axes(block)).as_quat()
        return replace(table, centers=centers, orientations=orientations)

    def unstabilised(self, rows: I4, places: F8) -> F8:
        """Transform ``places`` (k, 3), metres, from the frame of the still objects back.

        The result (k, 3) is in the coordinate frame of the detections. ``rows`` (k,) is the index
        of the frame to which each place belongs.
        """
        return np.asarray(
            np.einsum("kji,kj->ki", self.rotations[rows], places - self.translations[rows])
        )


def find_common_motion(table: DetectionTable, tracks: Sequence[I4]) -> CommonMotion | None:
    """Find the motion that all objects have in common, if there is one.

    In each frame it is a rotation about the up direction and a horizontal translation, in the
    coordinate frame of the detections.

    Parameters
    ----------
    table : all detections of a stream.
    tracks : for each track, the indices of its detections in ``table``, ascending; several tracks
        may belong to one object.

    Returns
    -------
    The motion; None if fewer than three tracks have at least five detections, if less than 70 % of
    their detections belong to moving objects, or if less than 70 % fit a common motion.

    Notes
    -----
    The position of each object in the still scene and the transform of each frame are estimated
    alternately (generalized Procrustes analysis, Gower 1975), starting from the motion between
    neighbouring frames. Outliers get less weight (Cauchy).
    """
    long = [track for track in tracks if len(track) >= _LONG]
    if len(long) < 3:
        return None
    lengths = [len(track) for track in long]
    moved = [_extent(table.centers[track]) > _MOVED_M for track in long]
    if np.average(moved, weights=lengths) < _MOST:
        return None
    which, owner = np.concatenate(long), np.repeat(np.arange(len(long)), lengths)
    level = _level(table)
    local = table.centers[which] @ level.T
    plane = local[:, 0] + 1j * local[:, 1]
    rows, count = table.rows[which], len(table.stamps_ns)
    turn, shift = _between_neighbours(plane, rows, owner, count)
    weights = np.ones(len(which))
    for _ in range(_ROUNDS):
        still = turn[rows] * plane + shift[rows]
        place = _means(still, owner, weights, len(long))[owner]
        weights = 1 / (1 + (np.abs(still - place) / _NOISE_M) ** 2)
        turn, shift = _fit(plane, place, rows, weights, turn, shift)
    still = turn[rows] * plane + shift[rows]
    place = _means(still, owner, weights, len(long))[owner]
    if np.mean(np.abs(still - place) <= _TOGETHER_M) < _MOST:
        return None
    return _in_space(level, turn, shift)


def _extent(centers: F8) -> float:
    """Return the diagonal between the 10th and the 90th percentiles of centres (k, 3), metres."""
    low, high = np.quantile(centers, [0.1, 0.9], axis=0)
    return float(np.linalg.norm(high - low))


def _level(table: DetectionTable) -> F8:
    """Return the rotation (3, 3) into a frame whose z axis is the boxes' mean up direction."""
    up = np.sum([table.axes(block)[:, :, 2].sum(axis=0) for block in table.blocks()], axis=0)
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    up /= np.linalg.norm(up)
    return np.array([first, np.cross(up, first), up])


def _between_neighbours(plane: C16, rows: I4, owner: I4, count: int) -> tuple[C16, C16]:
    """Return the motions of all frames, chained from the fits of neighbouring frames.

    Returns the rotation and the translation (count,) that map each frame to the first one, as
    complex numbers (see `_fit`).

    Parameters
    ----------
    plane : (n,) horizontal positions of detections, metres, complex.
    rows, owner : (n,) frame and track of each.
    count : number of frames.
    """
    order = np.lexsort([rows, owner])
    a, b = order[:-1], order[1:]
    pair = (owner[a] == owner[b]) & (rows[b] - rows[a] == 1)
    a, b = a[pair], b[pair]
    weights = np.ones(len(a))
    turn, shift = np.ones(count, complex), np.zeros(count, complex)
    for _ in range(3):
        turn, shift = _fit(plane[b], plane[a], rows[b], weights, turn, shift)
        gap = np.abs(turn[rows[b]] * plane[b] + shift[rows[b]] - plane[a])
        weights = 1 / (1 + (gap / _NOISE_M) ** 2)
    total = np.cumprod(turn, dtype=complex)
    before = np.concatenate([[1.0], total[:-1]])
    return total / np.abs(total), np.cumsum(before * shift)


def _fit(
    observed: C16, reference: C16, rows: I4, weights: F8, turn: C16, shift: C16
) -> tuple[C16, C16]:
    """Fit the rotation and the translation of each frame that map ``observed`` to ``reference``.

    ``observed`` and ``reference`` (n,) are points, ``rows`` and ``weights`` (n,) their frames and
    weights. A frame with fewer than two points keeps its ``turn`` and ``shift`` (f,). Points and
    translations in the plane are complex numbers; a rotation is a complex number of modulus 1.
    """
    count = len(turn)
    mean_observed = _means(observed, rows, weights, count)
    mean_reference = _means(reference, rows, weights, count)
    cross = (reference - mean_reference[rows]) * np.conj(observed - mean_observed[rows]) * weights
    total = _sums(cross, rows, count)
    enough = (np.bincount(rows, minlength=count) >= 2) & (np.abs(total) > 0)
    turn = np.where(enough, total / np.maximum(np.abs(total), 1e-300), turn)
    shift = np.where(enough, mean_reference - turn * mean_observed, shift)
    return turn, shift


def _sums(values: C16, groups: I4, count: int) -> C16:
    """Return the sum of the values in each group, (count,).

    ``groups`` (n,) is the group of each of the ``values`` (n,), from 0.
    """
    real = np.bincount(groups, values.real, count)
    return np.asarray(real + 1j * np.bincount(groups, values.imag, count))


def _means(values: C16, groups: I4, weights: F8, count: int) -> C16:
    """Return the weighted mean of the values in each group, as in `_sums`; 0 for an empty group."""
    total = np.bincount(groups, weights, count)
    return _sums(values * weights, groups, count) / np.maximum(total, 1e-300)


def _in_space(level: F8, turn: C16, shift: C16) -> CommonMotion:
    """Convert rotations and translations in the horizontal plane to 3D.

    ``turn`` and ``shift`` are from `_fit`, in the x-y plane of the frame ``level`` from `_level`.
    """
    zero, one = np.zeros(len(turn)), np.ones(len(turn))
    flat = np.array(
        [[turn.real, -turn.imag, zero], [turn.imag, turn.real, zero], [zero, zero, one]]
    )
    rotations = np.einsum("ji,jkf,kl->fil", level, flat, level)
    return CommonMotion(rotations, np.column_stack([shift.real, shift.imag, zero]) @ level)
