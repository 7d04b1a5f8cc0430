"""Find the camera pose of a transformed organized cloud, for example in a robot's base frame."""

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.geometry import NEAREST_M
from shapecat.recordings.pinhole import PinholeFit, fit_pinhole, sample_pixels, still_fits
from shapecat.types import Pose

__all__ = ["find_viewpoint", "seen_from"]

_LONGEST = 10
"""Maximum focal length in image widths. A larger one fits a height map, which no camera took."""
_CLEAR = 1e-4
"""Maximum squared ratio of the two smallest singular values of the equations. It is near 1 for the
points of a single plane, which many cameras fit."""
_ROUNDS = 3
"""Number of fits, each but the first without the outliers of the one before."""


def find_viewpoint(points: F4, previous: PinholeFit | None) -> tuple[PinholeFit, Pose, F4] | None:
    """Find the pinhole camera that took an organized cloud, and its pose in the cloud's frame.

    The method is the direct linear transform (Hartley and Zisserman 2004, 7.1) with normalized
    coordinates, repeated without outliers.

    Parameters
    ----------
    points : (h, w, 3) metres; NaN, infinite or zero where depth is missing.
    previous : the camera of an earlier cloud, which is kept if it fits; None if there is none.

    Returns
    -------
    The camera, ``frame_from_camera``, and the points (h, w, 3) in the frame of the camera; None if
    no plausible camera fits, or if the points do not determine one, as on a single plane.
    """
    sample = sample_pixels(points, lambda flat: np.asarray((flat != 0).any(axis=1)))
    if sample is None:
        return None
    width = points.shape[1]
    u, v, chosen = sample
    pixels = np.column_stack([u / width - 0.5, v / width - 0.5])
    middle, scale = chosen.mean(axis=0), float(chosen.std()) or 1.0
    places = np.column_stack([(chosen - middle) / scale, np.ones(len(chosen))])
    keep = np.ones(len(places), bool)
    for _ in range(_ROUNDS):
        matrix, unclear = _projection_matrix(places[keep], pixels[keep])
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            projected = places @ matrix.T
            error = np.linalg.norm(projected[:, :2] / projected[:, 2:] - pixels, axis=1)
        error[np.isnan(error)] = np.inf
        keep = error <= max(3 * float(np.median(error)), 1e-3 / width)
    linear = matrix[:, :3] * np.sign(np.linalg.det(matrix[:, :3]))
    if unclear > _CLEAR or not linear.any():
        return None
    center = middle - scale * np.linalg.solve(matrix[:, :3], matrix[:, 3])
    pose = Pose(_rq_rotation(linear).T, center)
    image = seen_from(pose, points)
    fit = previous if previous is not None and still_fits(previous, image) else fit_pinhole(image)
    return None if fit is None or fit.camera.fx > _LONGEST * width else (fit, pose, image)


def seen_from(pose: Pose, points: F4) -> F4:
    """Transform a cloud (h, w, 3) to the frame of its camera, whose pose is ``frame_from_camera``.

    Its z is NaN where depth is missing: at points that are NaN, behind or very near the camera, or
    at the origin of either frame, since drivers mark missing points by the origin.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        image = (points - pose.translation.astype(np.float32)) @ pose.rotation.astype(np.float32)
        has_point = np.einsum("ijk,ijk->ij", points, points) > 0
    depth = image[..., 2]
    depth[~(has_point & (depth > NEAREST_M))] = np.nan
    return np.asarray(image)


def _projection_matrix(places: F8, pixels: F8) -> tuple[F8, float]:
    """Fit the projection of homogeneous points (n, 4) to pixels (n, 2).

    Returns
    -------
    The matrix (3, 4), and the squared ratio of the two smallest singular values of the equations,
    which is small if the points determine the matrix.
    """
    zero = np.zeros_like(places)
    rows = np.vstack(
        [
            np.hstack([places, zero, -pixels[:, :1] * places]),
            np.hstack([zero, places, -pixels[:, 1:] * places]),
        ]
    )
    values, vectors = np.linalg.eigh(rows.T @ rows)
    return vectors[:, 0].reshape(3, 4), float(max(values[0], 0) / max(values[1], 1e-300))


def _rq_rotation(linear: F8) -> F8:
    """Return the rotation Q of the RQ decomposition of a matrix (3, 3), with R upper triangular."""
    rows, triangle = np.linalg.qr(linear[::-1].T)
    return np.asarray(rows.T[::-1] * np.sign(np.diag(triangle)[::-1, None]))
