"""Lens distortion: the pixel that a ray hits, and the ray that a pixel sees.

A ray is given by its slopes x / z and y / z in the optical frame of the camera.
"""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F8
from shapecat.types import Camera

__all__ = ["FISHEYE_MODELS", "LENS_MODELS", "distort", "undistorted_rays"]

FISHEYE_MODELS = ("equidistant", "fisheye", "kannala_brandt")
"""Names of Kannala and Brandt's model; Foxglove's messages use the last one."""
LENS_MODELS = ("plumb_bob", "rational_polynomial", *FISHEYE_MODELS)
"""The supported lens models of OpenCV's calibration."""

_ROUNDS = 30
"""Maximum number of iterations; lenses of 120 degrees need this many near their edge."""
_ENOUGH_PX = 1e-4
"""Error at which the iterations end."""
_WRONG_PX = 0.1
"""Pixels with a larger error see no ray: they are outside the round image of a wide lens."""
_LEAST_SHARE = 0.3
"""If fewer pixels than this fraction see a ray, the coefficients are not those of a lens."""


def distort(rays: F8, model: str, coefficients: Sequence[float]) -> F8:
    """Distort rays, which are given and returned as slopes (..., 2).

    Source: the lens models of OpenCV's calibration (Brown 1966; Kannala & Brandt 2006).

    Parameters
    ----------
    model : one of `LENS_MODELS`, or empty for a lens without distortion.
    coefficients : in OpenCV's order; missing ones are 0, and only the first 8, or 4 of a fisheye
        lens, are used.

    Raises
    ------
    ValueError : the model is not known.

    Examples
    --------
    >>> distort(np.array([0.5, 0.0]), "plumb_bob", (0.1, 0, 0, 0, 0)).round(4)
    array([0.5125, 0.    ])
    """
    if not model:
        return np.asarray(rays, np.float64)
    if model not in LENS_MODELS:
        msg = f"lens distortion {model!r} is not known; known: {', '.join(LENS_MODELS)}"
        raise ValueError(msg)
    d = np.zeros(8)
    d[: min(8, len(coefficients))] = coefficients[:8]
    bend = _fisheye if model in FISHEYE_MODELS else _polynomial
    return bend(np.asarray(rays, np.float64), d)


def undistorted_rays(camera: Camera, model: str, coefficients: Sequence[float]) -> F8 | None:
    """Return the slopes x / z and y / z of the ray that each pixel sees.

    Source: `distort`, inverted by fixed-point iteration as in OpenCV's undistortPoints.

    Returns
    -------
    (h, w, 2) slopes, NaN at pixels where the iteration does not converge; None if it converges
    at fewer than 30 % of the pixels, ``model`` is not one of `LENS_MODELS` (also if it is empty),
    or a coefficient is not finite.
    """
    if model not in LENS_MODELS or not np.isfinite(coefficients).all():
        return None
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    distorted = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy], axis=-1)
    targets = distorted.reshape(-1, 2)
    rays, error, active = targets.copy(), np.full(len(targets), np.inf), np.arange(len(targets))
    with np.errstate(all="ignore"):  # diverges outside the image of the lens: rejected below
        for _ in range(_ROUNDS):
            bent = distort(rays[active], model, coefficients)
            off = targets[active] - bent
            # A step by the error alone is slow where the lens compresses the image.
            stretch = np.linalg.norm(rays[active], axis=1) / np.linalg.norm(bent, axis=1)
            rays[active] += off * np.where(stretch > 0, stretch, 1)[:, None]
            error[active] = np.abs(off * (camera.fx, camera.fy)).max(axis=1)
            active = active[error[active] > _ENOUGH_PX]
    converged = error < _WRONG_PX  # False for NaN
    rays[~converged] = np.nan
    return rays.reshape(distorted.shape) if converged.mean() >= _LEAST_SHARE else None


def _polynomial(rays: F8, d: F8) -> F8:
    """Distort rays (..., 2) by Brown's model in its rational form, with coefficients ``d`` (8,)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = d
    x, y = rays[..., 0], rays[..., 1]
    r = x * x + y * y
    radial = (1 + r * (k1 + r * (k2 + r * k3))) / (1 + r * (k4 + r * (k5 + r * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
            y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def _fisheye(rays: F8, d: F8) -> F8:
    """Distort rays (..., 2) by Kannala and Brandt's model, with the first four of ``d`` (8,)."""
    radius = np.maximum(np.hypot(rays[..., 0], rays[..., 1]), 1e-12)
    angle = np.arctan(radius)
    s = angle * angle
    bent = angle * (1 + s * (d[0] + s * (d[1] + s * (d[2] + s * d[3]))))
    return np.asarray(rays * (bent / radius)[..., None])
