"""Detection: from one frame to planes and object candidates (thesis ch. 4)."""

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8
from shapecat.config import DetectionSettings
from shapecat.detection.depth_grid import cells_of
from shapecat.detection.pixels import pixels_of, points_of
from shapecat.detection.scenes import scene_of
from shapecat.detection.segmentation import Segmentation, segment
from shapecat.detection.virtual_camera import View, overview_of, view_of
from shapecat.geometry import IDENTITY, inverse
from shapecat.types import Camera, Frame, Scene

__all__ = ["detect"]

DEFAULT_UP = (0.0, -1.0, 0.0)
"""Up in an upright optical frame, where nothing else is known."""
CROWDED = 0.08
"""Share of points behind others from which a cloud is taken for fused from several views."""


def detect(
    frame: Frame,
    *,
    up: ArrayLike | None = None,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Scene:
    """Find the supporting planes of a frame and the objects on them.

    Parameters
    ----------
    frame : a depth image or a cloud. The sensor is at the origin of its frame.
    up : (3,) direction away from gravity, sensor frame, of any length but zero. With it only
        planes within 15 degrees of level count; without, it is estimated from the dominant plane.
    settings : see `DetectionSettings`.
    rng : source of what RANSAC tries; the same state gives the same scene.

    Returns
    -------
    The planes, lowest first, and the objects in the order of their first point; both empty if no
    supporting plane is seen.

    Raises
    ------
    ValueError : ``up`` is not a direction.
    ConfigError : ``settings.rules`` names an unknown rule.

    Notes
    -----
    Depth images are worked on in image space. A cloud is looked at through a virtual camera at
    its origin and goes the same way, so both give the same answer on the same scene. A cloud that
    was not taken from its origin is looked at from above its dominant plane; the points of a
    fused cloud that are hidden in the view join what they touch.
    """
    hint = None if up is None else _unit(up)
    if frame.depth is not None and frame.camera is not None:
        scene = _in_image(frame.depth, frame.camera, hint, settings, rng)
    else:
        scene = _in_cloud(frame.xyz(), hint, settings, rng)
    return scene or Scene(np.array(DEFAULT_UP) if hint is None else hint, (), ())


def _unit(up: ArrayLike) -> F8:
    vector = np.asarray(up, np.float64)
    norm = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not (np.isfinite(norm) and norm > 1e-9):
        msg = f"up must be a direction (3,), got {vector.tolist()}"
        raise ValueError(msg)
    return vector / norm


def _in_image(
    depth: F4,
    camera: Camera,
    hint: F8 | None,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Scene | None:
    cells = cells_of(depth, camera, range_m=settings.max_range_m)
    found = None if cells is None else segment(cells, hint, settings=settings, rng=rng)
    if cells is None or found is None:
        return None
    indices = pixels_of(depth, cells, found, range_m=settings.max_range_m)
    return scene_of(cells, found, indices, IDENTITY, settings=settings)


def _in_cloud(
    points: F4, hint: F8 | None, settings: DetectionSettings, rng: np.random.Generator
) -> Scene | None:
    view = view_of(points, range_m=settings.max_range_m)
    found = None if view is None else _seen(view, hint, settings, rng)
    if found is None:
        view = overview_of(points, hint, range_m=settings.max_range_m, rng=rng)
        found = None if view is None else _seen(view, hint, settings, rng)
    if view is None or found is None:
        return None
    indices = points_of(view, found, fused=view.crowded > CROWDED)
    return scene_of(
        view.cells, found, indices, inverse(view.view_from_sensor), settings=settings,
        points=view.points,
    )  # fmt: skip


def _seen(
    view: View, hint: F8 | None, settings: DetectionSettings, rng: np.random.Generator
) -> Segmentation | None:
    turned = None if hint is None else view.view_from_sensor.rotation @ hint
    return segment(view.cells, turned, settings=settings, rng=rng)
