"""Depth cameras: their intrinsics and error models.

The parameters of the Kinect and the RealSense D435 are fitted to real images of tables with
objects. The other cameras follow their data sheets and the cited measurements, the waves, margins
and rounding of the D4xx and the SR300 also real images.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from shapecat.types import Camera

__all__ = ["IDEAL", "KINECT", "PRESETS", "REALSENSE", "SENSORS", "Sensor", "between", "resized"]


@dataclass(frozen=True)
class Sensor:
    """A depth camera and its error model.

    Attributes
    ----------
    camera : intrinsics.
    nearest_m, farthest_m : range of depth that is reported.
    step : quantization of the inverse depth, 1/m; 0 is none.
    noise : standard deviation of the inverse depth, 1/m, for cameras that triangulate.
    noise_m : standard deviation of the depth of time-of-flight cameras, metres per metre.
    grain : (across, down) correlation window of the noise, pixels.
    smoothings : how often the noise, and the displacement of outlines, is averaged over its window.
    wave : standard deviation of a fixed error of the device in inverse depth, 1/m.
    wave_px : distance over which this error varies, pixels.
    device : seed of the fixed error and of the objects' reflectance.
    ragged_px : standard deviation by which the outlines of objects are displaced, pixels.
    ragged_window : (across, down) correlation window of this displacement, pixels.
    shadow_m : x positions of the light source and the other cameras, metres; a surface that one of
        them does not see has no reading.
    filled_px : mean width by which shadows are narrower than geometry predicts, pixels.
    grazing : cosine of the angle of incidence at which half of the readings fail.
    dark : standard deviation of the logarithm of the objects' reflectance; a dark object loses
        readings at smaller angles of incidence.
    edge_px : width of the margins around nearer surfaces in which stereo matching fails, pixels.
    holes : approximate fraction of the pixels lost in random holes.
    hole_px : approximate width of the largest holes, also of those at grazing incidence, pixels.
    blend_px : window that mixes near and far at outlines (flying pixels), pixels; 0 is none.
    rounded_px : window that rounds edges and corners within a surface (multipath, smoothing
        windows), pixels; 0 is none.
    border_px : (left, right, top, bottom) margins without readings, pixels.
    """

    camera: Camera
    nearest_m: float = 0.4
    farthest_m: float = 4.0
    step: float = 0.0
    noise: float = 0.0
    noise_m: float = 0.0
    grain: tuple[int, int] = (1, 1)
    smoothings: int = 1
    wave: float = 0.0
    wave_px: int = 80
    device: int = 1
    ragged_px: float = 0.0
    ragged_window: tuple[int, int] = (1, 1)
    shadow_m: tuple[float, ...] = ()
    filled_px: float = 0.0
    grazing: float = 0.0
    dark: float = 0.0
    edge_px: int = 0
    holes: float = 0.0
    hole_px: int = 3
    blend_px: int = 0
    rounded_px: int = 0
    border_px: tuple[int, int, int, int] = (0, 0, 0, 0)


def _camera(width: int, height: int, focal: float) -> Camera:
    return Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)


IDEAL = Sensor(_camera(640, 480, 525.0), nearest_m=0.05, farthest_m=10.0)
"""A camera without errors."""

KINECT = Sensor(
    _camera(640, 480, 525.0),
    nearest_m=0.45,
    step=0.0029,  # 1/8 px of a 580 px infrared camera, 7.5 cm from its projector
    noise=0.0018,
    grain=(8, 4),
    wave=0.0024,
    ragged_px=0.55,
    ragged_window=(5, 4),
    shadow_m=(0.05, -0.025),  # projector and infrared camera, seen from the colour camera
    filled_px=2.0,
    grazing=0.06,
    holes=0.0003,
    border_px=(4, 40, 4, 6),
)
"""Kinect v1, Xtion or Carmine (structured light), with depth registered to the colour camera."""

REALSENSE = Sensor(
    _camera(640, 480, 610.0),
    nearest_m=0.2,
    step=0.0005,
    noise=0.0023,
    grain=(17, 7),
    wave=0.0024,
    ragged_px=0.7,
    ragged_window=(7, 5),
    shadow_m=(0.05,),
    filled_px=1.0,
    grazing=0.12,
    holes=0.0006,
    blend_px=3,
    border_px=(8, 0, 0, 0),
)
"""Intel D435 (active stereo, left infrared camera) with its spatial filter switched on."""

_KINECT_V2 = Sensor(
    _camera(512, 424, 365.0),
    nearest_m=0.5,
    farthest_m=4.5,
    noise_m=0.0018,
    grain=(3, 3),
    wave=0.002,
    wave_px=100,
    ragged_px=0.5,
    ragged_window=(2, 2),
    grazing=0.1,
    dark=0.3,
    holes=0.001,
    blend_px=3,
    rounded_px=7,
)
"""Kinect v2 (time of flight): Wasenmüller and Stricker, Comparison of Kinect v1 and v2, 2016."""

_AZURE_KINECT = Sensor(
    _camera(640, 576, 504.0),
    nearest_m=0.45,
    noise_m=0.0011,
    grain=(3, 3),
    wave=0.0015,
    wave_px=120,
    ragged_px=0.5,
    ragged_window=(2, 2),
    grazing=0.12,
    dark=0.35,
    holes=0.001,
    blend_px=3,
    rounded_px=5,
    border_px=(24, 24, 8, 8),
)
"""Azure Kinect (time of flight, narrow field of view): Tölgyessy et al., Evaluation of the Azure
Kinect and its comparison to Kinect v1 and v2, 2021."""

_D435 = Sensor(
    _camera(848, 480, 425.0),
    nearest_m=0.2,
    step=0.0015,
    noise=0.0032,
    grain=(11, 9),
    smoothings=2,
    wave=0.006,
    wave_px=90,
    ragged_px=2.0,
    ragged_window=(11, 11),
    shadow_m=(0.05,),
    filled_px=2.0,
    grazing=0.15,
    dark=0.2,
    edge_px=6,
    holes=0.004,
    hole_px=8,
    blend_px=3,
    rounded_px=11,
    border_px=(12, 0, 0, 0),
)
"""Intel D435 without filters: noise of 0.07 px of disparity at a focal length of 425 px and a
baseline of 50 mm, in waves as wide as the matching windows; Grunnet-Jepsen et al., Best-known
methods for tuning D400 depth cameras, 2018."""

_D415 = replace(
    _D435,
    camera=_camera(848, 480, 615.0),
    nearest_m=0.3,
    step=0.0009,
    noise=0.0023,
    grain=(13, 11),
    wave=0.004,
    wave_px=110,
    shadow_m=(0.055,),
    border_px=(14, 0, 0, 0),
)
"""Intel D415: disparity noise of 0.08 px at 615 px and 55 mm; source as for the D435."""

_D455 = replace(
    _D435,
    camera=_camera(1280, 720, 640.0),
    nearest_m=0.4,
    step=0.0005,
    noise=0.0024,
    grain=(17, 13),
    wave=0.003,
    wave_px=130,
    ragged_px=2.6,
    ragged_window=(15, 15),
    shadow_m=(0.095,),
    filled_px=3.0,
    edge_px=8,
    hole_px=12,
    blend_px=5,
    rounded_px=17,
    border_px=(30, 0, 0, 0),
)
"""Intel D455: disparity noise of 0.15 px at 640 px and 95 mm; source as for the D435."""

_SR300 = Sensor(
    _camera(640, 480, 475.0),
    nearest_m=0.2,
    farthest_m=1.5,
    step=0.0005,
    noise=0.0018,
    grain=(9, 9),
    smoothings=2,
    wave=0.005,
    wave_px=100,
    ragged_px=0.6,
    ragged_window=(2, 2),
    shadow_m=(0.026,),
    filled_px=1.0,
    grazing=0.3,
    dark=0.6,
    edge_px=3,
    holes=0.002,
    blend_px=3,
    border_px=(4, 4, 0, 0),
)
"""Intel F200 or SR300 (coded light): Carfagni et al., On the performance of the Intel SR300 depth
camera, 2017."""

_L515 = Sensor(
    _camera(640, 480, 460.0),
    nearest_m=0.25,
    noise_m=0.0025,
    grain=(2, 2),
    wave=0.001,
    wave_px=140,
    ragged_px=0.4,
    ragged_window=(2, 2),
    grazing=0.12,
    dark=0.5,
    holes=0.001,
    blend_px=3,
    rounded_px=3,
)
"""Intel L515 (scanned laser, time of flight): Servi et al., Metrological characterization and
comparison of D415, D455, L515, 2021."""

_PHONE = Sensor(
    _camera(256, 192, 212.0),
    nearest_m=0.25,
    noise_m=0.0025,
    grain=(5, 5),
    wave=0.004,
    wave_px=50,
    ragged_px=0.8,
    ragged_window=(3, 3),
    blend_px=3,
    rounded_px=5,
)
"""Lidar of a phone, which the phone densifies with its colour image to 256 x 192, without holes:
Luetzenburg et al., Evaluation of the Apple iPhone 12 Pro LiDAR, 2021."""

PRESETS = {
    "kinect": KINECT,
    "realsense": REALSENSE,
    "kinect-v2": _KINECT_V2,
    "azure-kinect": _AZURE_KINECT,
    "d415": _D415,
    "d435": _D435,
    "d455": _D455,
    "sr300": _SR300,
    "l515": _L515,
    "phone": _PHONE,
}
"""Real depth cameras by name."""

SENSORS = {"ideal": IDEAL, **PRESETS}
"""All sensors by name."""


def between(first: Sensor, second: Sensor, share: float) -> Sensor:
    """Return the first sensor with an error model interpolated towards the second sensor's.

    ``share`` is 0 for the first model and 1 for the second. The first sensor keeps its intrinsics,
    device, shadows and borders.
    """
    mixed = {
        field.name: _mixed(getattr(first, field.name), getattr(second, field.name), share)
        for field in fields(Sensor)
        if field.name not in {"camera", "device", "shadow_m", "border_px"}
    }
    return replace(first, **mixed)


def _mixed(first: Any, second: Any, share: float) -> Any:
    mean = (1 - share) * np.asarray(first, float) + share * np.asarray(second, float)
    if isinstance(first, tuple):
        return tuple(np.rint(mean).astype(int).tolist())
    return type(first)(round(float(mean)) if isinstance(first, int) else float(mean))


def resized(sensor: Sensor, scale: float) -> Sensor:
    """Return a sensor with ``scale`` times the width and height, and the same field of view."""
    camera = sensor.camera
    middle = [(c + 0.5) * scale - 0.5 for c in (camera.cx, camera.cy)]
    focal = camera.fx * scale, camera.fy * scale
    return replace(
        sensor,
        camera=Camera(round(camera.width * scale), round(camera.height * scale), *focal, *middle),
        grain=_scaled(sensor.grain, scale),
        ragged_window=_scaled(sensor.ragged_window, scale),
        ragged_px=sensor.ragged_px * scale,
        wave_px=max(round(sensor.wave_px * scale), 2),
        filled_px=sensor.filled_px * scale,
        edge_px=round(sensor.edge_px * scale),
        hole_px=max(round(sensor.hole_px * scale), 3),
        blend_px=round(sensor.blend_px * scale),
        rounded_px=round(sensor.rounded_px * scale),
    )


def _scaled(window: tuple[int, int], scale: float) -> tuple[int, int]:
    return max(round(window[0] * scale), 1), max(round(window[1] * scale), 1)
