"""Find the pinhole camera of an organized cloud or of a CameraInfo."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from shapecat.arrays import F4, F8, Bool
from shapecat.recordings.messages import MessageError
from shapecat.types import Camera

__all__ = [
    "PinholeFit",
    "camera_of_info",
    "distortion_of",
    "fit_pinhole",
    "has_intrinsics",
    "is_rectified",
    "off_center",
    "sample_pixels",
    "still_fits",
]

_LARGEST_ERROR_PX = 0.6
"""A camera fits an organized cloud if 95 % of its points are reprojected within this distance."""
_OFF_CENTER = 0.12
"""Largest plausible distance of the principal point from the image centre, as a fraction of the
width or height. Depth cameras stay below 0.05; intrinsics for 640 x 480 pixels give 0.123 in images
of 848 x 480."""
_UNIT = 1
"""Focal length in an identity matrix, which drivers write if they know no intrinsics."""
_LARGEST_PX = 1e5
"""Largest plausible intrinsic parameter, pixels: a field of view of about half a degree."""
_SAMPLES = 4096
"""Approximate number of points that are sampled from a cloud."""
_FEWEST = 100
"""Minimum number of usable points; with fewer, no camera is fitted."""
_SPREAD = 0.1
"""The samples must span this fraction of the width and height, or the fit is ill-conditioned."""


@dataclass(frozen=True)
class PinholeFit:
    """A camera, and the RMS reprojection error of the points it was fitted to, pixels."""

    camera: Camera
    error_px: float


def fit_pinhole(points: F4) -> PinholeFit | None:
    """Fit a pinhole camera to the points of an organized cloud.

    A point in column u satisfies x / z = (u - cx) / fx, so u is linear in x / z with slope fx and
    offset cx; the same holds for rows. The method fits two least-squares lines to a few thousand
    points in double precision: first to the medians of bins, then to the points without outliers.

    Parameters
    ----------
    points : (h, w, 3) metres; NaN or infinite where depth is missing.

    Returns
    -------
    The fit; None if there are fewer than about a hundred points, or they span less than a tenth of
    the width or height, or fewer than 95 % of them are within 0.6 pixels of the fitted camera.
    """
    height, width = points.shape[:2]
    sample = _sample(points)
    if (
        sample is None
        or np.ptp(sample[0]) < _SPREAD * width
        or np.ptp(sample[1]) < _SPREAD * height
    ):
        return None
    u, v, x, y = sample
    fx, cx = _line(*_medians(x, u))
    fy, cy = _line(*_medians(y, v))
    for _ in range(3):
        error = np.hypot(fx * x + cx - u, fy * y + cy - v)
        keep = error <= max(3.0 * float(np.median(error)), 1e-3)
        fx, cx = _line(x[keep], u[keep])
        fy, cy = _line(y[keep], v[keep])
    camera = Camera(width, height, fx, fy, cx, cy)
    largest, rms = _errors(camera, sample)
    return PinholeFit(camera, rms) if fx > 0 and fy > 0 and largest < _LARGEST_ERROR_PX else None


def still_fits(fit: PinholeFit, points: F4) -> bool:
    """Return whether a fitted camera also fits another organized cloud (h, w, 3).

    The result is True if the cloud has too few points to tell, False if it has another size.
    """
    camera = fit.camera
    if points.shape[:2] != (camera.height, camera.width):
        return False
    sample = _sample(points)
    if sample is None:
        return True  # too few points to contradict it
    largest, rms = _errors(camera, sample)
    return largest < _LARGEST_ERROR_PX and rms < 2 * fit.error_px + 0.02


def _errors(camera: Camera, sample: tuple[F8, F8, F8, F8]) -> tuple[float, float]:
    """Return the 95th percentile of the reprojection error and its RMS without outliers, pixels.

    ``sample`` is from `_sample`.
    """
    u, v, x, y = sample
    error = np.hypot(camera.fx * x + camera.cx - u, camera.fy * y + camera.cy - v)
    keep = error <= max(3.0 * float(np.median(error)), 1e-3)
    return float(np.percentile(error, 95)), float(np.sqrt(np.mean(error[keep] ** 2)))


def _sample(points: F4) -> tuple[F8, F8, F8, F8] | None:
    """Return u, v, x / z and y / z, each (n,), of sampled points; None if there are too few."""
    sampled = sample_pixels(points, lambda flat: flat[:, 2] > 0)
    if sampled is None:
        return None
    u, v, chosen = sampled
    return u, v, chosen[:, 0] / chosen[:, 2], chosen[:, 1] / chosen[:, 2]


def sample_pixels(points: F4, valid: Callable[[F4], Bool]) -> tuple[F8, F8, F8] | None:
    """Return u and v (n,), and points (n, 3), of pixels spread over the image; None if too few.

    Only finite points of ``points`` (h, w, 3) are chosen. ``valid`` returns, for points (k, 3), a
    mask (k,) of those that may be chosen.
    """
    height, width = points.shape[:2]
    # A stride that shares no factor with the width visits all columns.
    stride = max(1, height * width // (4 * _SAMPLES)) | 1
    while np.gcd(stride, width) > 1:
        stride += 2
    flat = points.reshape(-1, 3)[::stride]
    index = np.flatnonzero(np.isfinite(flat).all(1) & valid(flat))
    if index.size < _FEWEST:
        return None
    index = index[:: max(1, index.size // _SAMPLES)]
    v, u = np.divmod(index * stride, width)
    return u.astype(float), v.astype(float), flat[index].astype(np.float64)


def _medians(a: F8, b: F8) -> tuple[F8, F8]:
    """Return the medians (16,) of ``a`` and ``b`` (n,) in 16 bins of ``b``, robust to outliers."""
    groups = np.array_split(np.argsort(b, kind="stable"), 16)
    return (
        np.array([np.median(a[group]) for group in groups]),
        np.array([np.median(b[group]) for group in groups]),
    )


def _line(a: F8, b: F8) -> tuple[float, float]:
    """Fit ``b = slope * a + offset`` by least squares; return slope and offset."""
    mean_a, mean_b = a.mean(), b.mean()
    spread = float(((a - mean_a) ** 2).sum())
    slope = float(((a - mean_a) * (b - mean_b)).sum() / spread) if spread > 0 else 0.0
    return slope, float(mean_b - slope * mean_a)


def camera_of_info(info: Any, *, rectified: bool) -> tuple[Camera, bool]:
    """Read a decoded CameraInfo.

    Parameters
    ----------
    rectified : whether the images are rectified. P describes rectified images, K and D the others.
        If the matrix to use (P or K) is zero or the identity, the other one is used.

    Returns
    -------
    The camera after cropping and binning, without lens distortion; and whether the images have
    lens distortion.

    Raises
    ------
    MessageError : a focal length is at most 1 pixel, or an intrinsic parameter is not finite or
        larger than 100 000 pixels.
    """
    k, p, d = (_field(info, name) for name in "kpd")
    use_p = p.size == 12 and p[0] > _UNIT and (rectified or k.size < 9 or k[0] in {0, _UNIT})
    fx, fy, cx, cy = (p[0], p[5], p[2], p[6]) if use_p else (k[0], k[4], k[2], k[5])
    width, height = int(info.width), int(info.height)
    bin_x, bin_y = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    roi = info.roi
    if roi.width and roi.height:
        width, height = int(roi.width), int(roi.height)
        cx, cy = cx - int(roi.x_offset), cy - int(roi.y_offset)
    values = (fx / bin_x, fy / bin_y, cx / bin_x, cy / bin_y)
    if not (np.isfinite(values).all() and fx > _UNIT and fy > _UNIT):
        msg = f"CameraInfo without intrinsics (focal length {min(fx, fy):g})"
        raise MessageError(msg)
    if np.abs(values).max() > _LARGEST_PX:
        msg = f"CameraInfo with implausible intrinsics (fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g})"
        raise MessageError(msg)
    camera = Camera(width // bin_x, height // bin_y, *(float(value) for value in values))
    # Coefficients that are all zero mean a rectified image, as in image_geometry of ROS, even with
    # a fisheye model: drivers that rectify its images set only the coefficients to zero.
    return camera, bool(not (rectified or use_p) and np.any(d != 0))


def has_intrinsics(info: Any) -> bool:
    """Return whether a decoded CameraInfo has a focal length: some drivers publish zeros first."""
    k, p = _field(info, "k"), _field(info, "p")
    return bool((k.size and k[0] > _UNIT) or (p.size == 12 and p[0] > _UNIT))


def off_center(camera: Camera) -> bool:
    """Return whether the principal point is farther from the centre than in any depth camera."""
    off = abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)
    return max(off) > _OFF_CENTER


def distortion_of(info: Any) -> tuple[float, ...]:
    """Return the distortion coefficients of a decoded CameraInfo."""
    return tuple(_field(info, "d").tolist())


def is_rectified(topic: str) -> bool:
    """Return whether the images of a topic are rectified, as in ``image_rect_raw``."""
    end = "/".join(topic.split("/")[-2:])
    return re.search(r"(?<!un)(?<!di)rect", end) is not None  # not "unrectified" or "direct"


def _field(info: Any, name: str) -> F8:
    """Return an array of a CameraInfo, flat; ``name`` is that of ROS 2, in lower case."""
    value = getattr(info, name, None)
    if value is None:
        value = getattr(info, name.upper())
    return np.asarray(value, np.float64)
