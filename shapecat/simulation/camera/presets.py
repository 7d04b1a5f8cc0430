"""Presets of depth cameras: their intrinsics and error models.

The parameters of the Kinect and the RealSense D435 are fitted to real images of tables with
objects, and so are the low-frequency error, margins and smoothing of the D4xx and the SR300, and
the matching windows of the D4xx. All other parameters follow data sheets and the cited
measurements.
"""

from dataclasses import replace

from shapecat.simulation.camera.sensors import Sensor
from shapecat.types import Camera

__all__ = ["IDEAL", "KINECT", "PRESETS", "REALSENSE", "SENSORS"]


def _camera(width: int, height: int, focal: float) -> Camera:
    return Camera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)


IDEAL = Sensor(_camera(640, 480, 525.0), nearest_m=0.05, farthest_m=10.0)
"""A camera without errors."""

KINECT = Sensor(
    _camera(640, 480, 525.0),
    nearest_m=0.45,
    step=0.0029,  # 1/8 px of a 580 px infrared camera, 7.5 cm from its projector
    noise=0.0018,
    noise_window=(8, 4),
    fixed_error=0.0024,
    edge_jitter_px=0.55,
    edge_jitter_window=(5, 4),
    shadow_m=(0.05, -0.025),  # projector and infrared camera, seen from the colour camera
    shadow_fill_px=2.0,
    grazing_cosine=0.06,
    holes=0.0003,
    border_px=(4, 40, 4, 6),
)
"""Kinect v1, Xtion or Carmine (structured light), with depth registered to the colour camera."""

REALSENSE = Sensor(
    _camera(640, 480, 610.0),
    nearest_m=0.2,
    step=0.0005,
    noise=0.0023,
    noise_window=(17, 7),
    fixed_error=0.0024,
    edge_jitter_px=0.7,
    edge_jitter_window=(7, 5),
    shadow_m=(0.05,),
    shadow_fill_px=1.0,
    grazing_cosine=0.12,
    holes=0.0006,
    blend_px=3,
    border_px=(8, 0, 0, 0),
)
"""Intel D435 (active stereo, left infrared camera) with its spatial filter switched on."""

_KINECT_V2 = Sensor(
    _camera(512, 424, 365.0),
    nearest_m=0.5,
    farthest_m=4.5,
    relative_noise=0.0018,
    noise_window=(3, 3),
    fixed_error=0.002,
    fixed_error_px=100,
    edge_jitter_px=0.5,
    edge_jitter_window=(2, 2),
    grazing_cosine=0.1,
    log_reflectance_std=0.3,
    holes=0.001,
    blend_px=3,
    smoothing_px=7,
)
"""Kinect v2 (time of flight): Wasenmüller and Stricker, Comparison of Kinect v1 and v2, 2016."""

_AZURE_KINECT = Sensor(
    _camera(640, 576, 504.0),
    nearest_m=0.45,
    relative_noise=0.0011,
    noise_window=(3, 3),
    fixed_error=0.0015,
    fixed_error_px=120,
    edge_jitter_px=0.5,
    edge_jitter_window=(2, 2),
    grazing_cosine=0.12,
    log_reflectance_std=0.35,
    holes=0.001,
    blend_px=3,
    smoothing_px=5,
    border_px=(24, 24, 8, 8),
)
"""Azure Kinect (time of flight, narrow field of view): Tölgyessy et al., Evaluation of the Azure
Kinect and its comparison to Kinect v1 and v2, 2021."""

_D435 = Sensor(
    _camera(848, 480, 425.0),
    nearest_m=0.2,
    step=0.0015,
    noise=0.0032,
    noise_window=(11, 9),
    smoothings=2,
    fixed_error=0.006,
    fixed_error_px=90,
    edge_jitter_px=2.0,
    edge_jitter_window=(11, 11),
    matching_window_px=11,
    shadow_m=(0.05,),
    shadow_fill_px=2.0,
    grazing_cosine=0.15,
    log_reflectance_std=0.2,
    stereo_margin_px=6,
    holes=0.004,
    hole_px=8,
    blend_px=3,
    border_px=(12, 0, 0, 0),
)
"""Intel D435 without filters: noise of 0.07 px of disparity at a focal length of 425 px and a
baseline of 50 mm, correlated over the matching windows; Grunnet-Jepsen et al., Best-known
methods for tuning D400 depth cameras, 2018."""

_D415 = replace(
    _D435,
    camera=_camera(848, 480, 615.0),
    nearest_m=0.3,
    step=0.0009,
    noise=0.0023,
    noise_window=(13, 11),
    fixed_error=0.004,
    fixed_error_px=110,
    shadow_m=(0.055,),
    border_px=(14, 0, 0, 0),
)
"""Intel D415: disparity noise of 0.08 px, focal length of 615 px, baseline of 55 mm; source as for
the D435."""

_D455 = replace(
    _D435,
    camera=_camera(1280, 720, 640.0),
    nearest_m=0.4,
    step=0.0005,
    noise=0.0024,
    noise_window=(17, 13),
    fixed_error=0.003,
    fixed_error_px=130,
    edge_jitter_px=2.6,
    edge_jitter_window=(15, 15),
    matching_window_px=17,
    shadow_m=(0.095,),
    shadow_fill_px=3.0,
    stereo_margin_px=8,
    hole_px=12,
    blend_px=5,
    border_px=(30, 0, 0, 0),
)
"""Intel D455: disparity noise of 0.15 px, focal length of 640 px, baseline of 95 mm; source as for
the D435."""

_SR300 = Sensor(
    _camera(640, 480, 475.0),
    nearest_m=0.2,
    farthest_m=1.5,
    step=0.0005,
    noise=0.0018,
    noise_window=(9, 9),
    smoothings=2,
    fixed_error=0.005,
    fixed_error_px=100,
    edge_jitter_px=0.6,
    edge_jitter_window=(2, 2),
    shadow_m=(0.026,),
    shadow_fill_px=1.0,
    grazing_cosine=0.3,
    log_reflectance_std=0.6,
    stereo_margin_px=3,
    holes=0.002,
    blend_px=3,
    border_px=(4, 4, 0, 0),
)
"""Intel F200 or SR300 (coded light): Carfagni et al., On the performance of the Intel SR300 depth
camera, 2017."""

_L515 = Sensor(
    _camera(640, 480, 460.0),
    nearest_m=0.25,
    relative_noise=0.0025,
    noise_window=(2, 2),
    fixed_error=0.001,
    fixed_error_px=140,
    edge_jitter_px=0.4,
    edge_jitter_window=(2, 2),
    grazing_cosine=0.12,
    log_reflectance_std=0.5,
    holes=0.001,
    blend_px=3,
    smoothing_px=3,
)
"""Intel L515 (scanned laser, time of flight): Servi et al., Metrological characterization and
comparison of D415, D455, L515, 2021."""

_PHONE = Sensor(
    _camera(256, 192, 212.0),
    nearest_m=0.25,
    relative_noise=0.0025,
    noise_window=(5, 5),
    fixed_error=0.004,
    fixed_error_px=50,
    edge_jitter_px=0.8,
    edge_jitter_window=(3, 3),
    blend_px=3,
    smoothing_px=5,
)
"""Lidar of a phone, densified to 256 x 192 pixels without holes by means of the colour image:
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
"""Real depth cameras by name. Append new ones at the end: training picks by position."""

SENSORS = {"ideal": IDEAL, **PRESETS}
"""All sensors by name."""
