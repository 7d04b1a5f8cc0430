"""The error model of a depth camera: a record of measurable properties."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from shapecat.types import Camera

__all__ = ["Sensor", "interpolated", "resized"]


@dataclass(frozen=True)
class Sensor:
    """A depth camera and its error model.

    Attributes
    ----------
    camera : intrinsics.
    nearest_m, farthest_m : limits of the measured depth.
    step : quantization of the inverse depth, 1/m; 0 for none.
    noise : standard deviation of the inverse depth, 1/m, for cameras that triangulate.
    relative_noise : standard deviation of the depth, relative to the depth, for time-of-flight
        cameras.
    noise_window : (across, down) correlation window of the noise, pixels.
    smoothings : number of times that ``noise`` and the edge jitter are averaged over their windows.
    fixed_error : standard deviation of the device's low-frequency error of the inverse depth, 1/m;
        the error is the same in all images.
    fixed_error_px : distance over which this error varies, pixels.
    device : seed of the fixed error and of the objects' reflectance.
    edge_jitter_px : standard deviation of the displacement of depth edges, pixels.
    edge_jitter_window : (across, down) correlation window of this displacement, pixels.
    matching_window_px : width of the stereo matching window, pixels; 0 for none. Matching rounds
        the corners of outlines, and the edges and small steps within a surface.
    shadow_m : x positions of the light source and of other cameras, relative to this one, metres;
        depth is missing at points that are hidden from one of them.
    shadow_fill_px : mean width by which these shadows are narrower than geometry predicts, pixels.
    grazing_cosine : cosine of the angle of incidence at which half of the pixels lack depth.
    log_reflectance_std : standard deviation of the logarithm of the objects' reflectance; on dark
        objects, depth is missing at smaller angles of incidence.
    stereo_margin_px : width of the margins around nearer surfaces in which stereo matching fails,
        pixels.
    holes : approximate fraction of the pixels in random holes.
    hole_px : approximate width of the largest holes, including those on oblique surfaces, pixels.
    blend_px : width of the window that mixes near and far at depth edges (flying pixels), pixels; 0
        for none.
    smoothing_px : width of the window that rounds edges and corners within a surface (multipath,
        smoothing filters), pixels; 0 for none.
    border_px : (left, right, top, bottom) margins of the image without depth, pixels.
    """

    camera: Camera
    nearest_m: float = 0.4
    farthest_m: float = 4.0
    step: float = 0.0
    noise: float = 0.0
    relative_noise: float = 0.0
    noise_window: tuple[int, int] = (1, 1)
    smoothings: int = 1
    fixed_error: float = 0.0
    fixed_error_px: int = 80
    device: int = 1
    edge_jitter_px: float = 0.0
    edge_jitter_window: tuple[int, int] = (1, 1)
    matching_window_px: int = 0
    shadow_m: tuple[float, ...] = ()
    shadow_fill_px: float = 0.0
    grazing_cosine: float = 0.0
    log_reflectance_std: float = 0.0
    stereo_margin_px: int = 0
    holes: float = 0.0
    hole_px: int = 3
    blend_px: int = 0
    smoothing_px: int = 0
    border_px: tuple[int, int, int, int] = (0, 0, 0, 0)


def interpolated(first: Sensor, second: Sensor, share: float) -> Sensor:
    """Interpolate the error models of two sensors.

    ``share`` is 0 for the first model and 1 for the second. Intrinsics, device, shadows and borders
    come from the first sensor.
    """
    mixed = {
        field.name: _mixed(getattr(first, field.name), getattr(second, field.name), share)
        for field in fields(Sensor)
        if field.name not in {"camera", "device", "shadow_m", "border_px"}
    }
    return replace(first, **mixed)


def _mixed(first: Any, second: Any, share: float) -> Any:
    """Return a value between two, of the same type; ``share`` is the fraction of the second."""
    mean = (1 - share) * np.asarray(first, float) + share * np.asarray(second, float)
    if isinstance(first, tuple):
        return tuple(np.rint(mean).astype(int).tolist())
    return type(first)(round(float(mean)) if isinstance(first, int) else float(mean))


def resized(sensor: Sensor, scale: float) -> Sensor:
    """Return a sensor with ``scale`` times the width and height, and the same field of view.

    ``border_px`` stays: another border would change the scenes that the default model and the
    rejection trees were trained on.
    """
    camera = sensor.camera
    middle = [(c + 0.5) * scale - 0.5 for c in (camera.cx, camera.cy)]
    focal = camera.fx * scale, camera.fy * scale
    return replace(
        sensor,
        camera=Camera(round(camera.width * scale), round(camera.height * scale), *focal, *middle),
        noise_window=_scaled(sensor.noise_window, scale),
        edge_jitter_window=_scaled(sensor.edge_jitter_window, scale),
        edge_jitter_px=sensor.edge_jitter_px * scale,
        matching_window_px=round(sensor.matching_window_px * scale),
        fixed_error_px=max(round(sensor.fixed_error_px * scale), 2),
        shadow_fill_px=sensor.shadow_fill_px * scale,
        stereo_margin_px=round(sensor.stereo_margin_px * scale),
        hole_px=max(round(sensor.hole_px * scale), 3),
        blend_px=round(sensor.blend_px * scale),
        smoothing_px=round(sensor.smoothing_px * scale),
    )


def _scaled(window: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return a window with ``scale`` times the width and height, of at least one pixel."""
    return max(round(window[0] * scale), 1), max(round(window[1] * scale), 1)
