"""Depth images of arrangements from random viewpoints, by random cameras."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, I4
from shapecat.models.arrangements import Arrangement
from shapecat.simulation.camera.measuring import measure
from shapecat.simulation.camera.presets import PRESETS
from shapecat.simulation.camera.render import Geometry, render
from shapecat.simulation.camera.sensors import Sensor, interpolated, resized
from shapecat.simulation.scenes.paths import looking_at
from shapecat.simulation.shapes.randomness import log_uniform
from shapecat.types import Camera, Frame, Pose

__all__ = ["RenderedView", "render_view"]

_FEWEST_PIXELS = 80
_COARSE = 4
"""Downsampling factor of the images that give the visible fractions."""
_SCALES = (0.5, 1.0, 1.0, 1.0, 1.5)
"""Scale factors of the image sizes; each is drawn with equal probability."""
_WIDTHS = (224, 1280)
"""Minimum and maximum image width, pixels."""
_OFTEN = {"kinect": 3.0, "realsense": 2.0}
"""Weights of the most common sensors; others have weight 1."""
_DISTANCES_M = (0.25, 3.0)
"""Minimum and maximum distance of the camera from its target."""
_CLOSER_M = 0.03
"""Minimum distance by which the target is beyond the sensor's near limit."""


class RenderedView(NamedTuple):
    """One image of an arrangement.

    Attributes
    ----------
    frame : the depth image.
    mesh_ids : (h, w) index of the mesh that each pixel shows, -1 without depth. The objects are
        numbered first, then the furniture.
    visible : (k,) visible fraction of each object.
    table_from_camera : pose of the optical frame.
    sensor : name of the sensor.
    """

    frame: Frame
    mesh_ids: I4
    visible: F8
    table_from_camera: Pose
    sensor: str


def render_view(
    geometry: Geometry, arrangement: Arrangement, rng: np.random.Generator
) -> RenderedView:
    """Take an image of an arrangement with a random sensor from a random viewpoint.

    ``geometry`` holds the meshes of the arrangement, metres, table frame: first its objects,
    then its furniture.
    """
    name, sensor = _draw_sensor(rng)
    camera, pose = sensor.camera, _viewpoint(arrangement, sensor, rng)
    image = render(geometry, camera, pose)
    depth, mesh_ids = measure(image, sensor, rng)
    visible = _visible_fractions(geometry, mesh_ids, camera, pose, len(arrangement.objects))
    frame = Frame("/camera", 0, 0, 0, "camera", depth=depth, camera=camera)
    return RenderedView(frame, mesh_ids, visible, pose, name)


def _draw_sensor(rng: np.random.Generator) -> tuple[str, Sensor]:
    """Draw a preset, half of the time mixed with another; vary its errors and its image size.

    Return the name of the first preset, and the sensor.
    """
    names = list(PRESETS)
    shares = np.array([_OFTEN.get(each, 1.0) for each in names])
    name, other = (str(each) for each in rng.choice(names, 2, p=shares / shares.sum()))
    share = float(rng.uniform(0, 0.6)) if rng.random() < 0.5 else 0.0
    sensor = interpolated(PRESETS[name], PRESETS[other], share)
    least, most = np.log([0.4, 0.4, 0.5, 0.5, 0.7]), np.log([2.0, 2.5, 1.5, 8.0, 2.0])
    noise, fixed_error, edge_jitter, holes, darkness = np.exp(rng.uniform(least, most))
    sensor = replace(
        sensor,
        noise=float(sensor.noise * noise),
        relative_noise=float(sensor.relative_noise * noise),
        fixed_error=float(sensor.fixed_error * fixed_error),
        device=int(rng.integers(1_000_000)),
        edge_jitter_px=float(sensor.edge_jitter_px * edge_jitter),
        holes=float(sensor.holes * holes),
        grazing_cosine=float(sensor.grazing_cosine * darkness),
        log_reflectance_std=float(sensor.log_reflectance_std * darkness),
    )
    scale = np.clip(rng.choice(_SCALES), *(np.array(_WIDTHS) / sensor.camera.width))
    return name, resized(sensor, float(scale))


def _viewpoint(arrangement: Arrangement, sensor: Sensor, rng: np.random.Generator) -> Pose:
    """Draw ``table_from_camera`` within the range of the sensor and the arrangement's angles."""
    points = np.concatenate([item.mesh.vertices for item in arrangement.objects])
    target = points.mean(axis=0) + rng.normal(0, 0.04, 3)
    nearest, farthest = _DISTANCES_M
    nearest = max(nearest, sensor.nearest_m + _CLOSER_M)
    farthest = min(farthest, sensor.farthest_m)
    distance = log_uniform(rng, nearest, farthest)
    azimuth = np.radians(rng.uniform(*arrangement.azimuth))
    elevation = np.radians(rng.uniform(*arrangement.elevation))
    back = np.array(
        [
            np.cos(azimuth) * np.cos(elevation),
            np.sin(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    return looking_at(target + distance * back, target, roll=rng.normal(0, 0.05))


def _visible_fractions(
    geometry: Geometry, mesh_ids: I4, camera: Camera, pose: Pose, count: int
) -> F8:
    """Return the visible fraction of each object, (count,).

    ``mesh_ids`` (h, w) are those of the depth image of ``camera`` at ``pose``, -1 where it has no
    depth. The fraction is the object's number of depth pixels, divided by its number of pixels in
    an image twice as wide and high in which nothing occludes it. It is 0 for an object with fewer
    than `_FEWEST_PIXELS` depth pixels.
    """
    seen_pixels = np.bincount(mesh_ids[mesh_ids >= 0], minlength=count)[:count]
    width, height = camera.width // _COARSE, camera.height // _COARSE
    wide = Camera(
        2 * width,
        2 * height,
        camera.fx / _COARSE,
        camera.fy / _COARSE,
        camera.cx / _COARSE + width // 2,
        camera.cy / _COARSE + height // 2,
    )
    result = np.zeros(count)
    for k in np.flatnonzero(seen_pixels >= _FEWEST_PIXELS):
        of_object = geometry.mesh_ids == k
        alone = Geometry(
            geometry.vertices, geometry.triangles[of_object], geometry.mesh_ids[of_object]
        )
        total = int((render(alone, wide, pose).mesh_ids >= 0).sum()) * _COARSE**2
        result[k] = min(1.0, seen_pixels[k] / max(total, 1))
    return result
