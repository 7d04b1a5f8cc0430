"""Worked examples of calibrations and depth encodings, with distinct numbers."""

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from shapecat.cameras.lenses import distort, undistorted_rays
from shapecat.recordings.decoding.compressed_depth import depth_of_compressed
from shapecat.recordings.decoding.depth_image import depth_of_image
from shapecat.recordings.messages import MessageError
from shapecat.recordings.pinhole import camera_of_info, fit_pinhole
from shapecat.recordings.sources import DepthSource
from shapecat.recordings.streams import IMAGE, Stream
from shapecat.types import Camera, Frame
from tests.depth_encodings import png, rvl
from tests.messages import EPOCH, compressed, image, info, make, organized_points, wavy_depth, write
from tests.test_recordings_frames import read

K = (531.7, 0.0, 322.3, 0.0, 527.1, 243.9, 0.0, 0.0, 1.0)
P = (498.4, 0.0, 317.6, -23.9, 0.0, 503.2, 239.3, 1.7, 0.0, 0.0, 1.0, 0.4)
SIZE = (640, 480)


def calibration(**changes: Any) -> Any:
    """Return a CameraInfo whose K and P describe different cameras."""
    message = info(EPOCH, Camera(*SIZE, 1.0, 1.0, 0.0, 0.0))
    message.k, message.p = np.array(K), np.array(P)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def region(x: int, y: int, width: int, height: int) -> Any:
    return make("sensor_msgs/msg/RegionOfInterest", x, y, height, width, False)


def test_rectified_image_uses_p_and_raw_image_uses_k() -> None:
    """sensor_msgs/CameraInfo: P is the camera of the rectified image, K of the raw one."""
    rectified, distorted = camera_of_info(calibration(), rectified=True)
    assert rectified == Camera(*SIZE, 498.4, 503.2, 317.6, 239.3)
    assert not distorted
    raw, distorted = camera_of_info(calibration(d=np.array([0.1, 0, 0, 0, 0])), rectified=False)
    assert raw == Camera(*SIZE, 531.7, 527.1, 322.3, 243.9)
    assert distorted


@pytest.mark.parametrize("coefficients", [(), (0.0, 0.0, 0.0, 0.0)])
@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_image_without_distortion_coefficients_is_rectified(
    model: str, coefficients: tuple[float, ...]
) -> None:
    """Corrected for a fisheye lens, such an image would be bent; image_geometry leaves it alone."""
    given = calibration(distortion_model=model, d=np.array(coefficients))

    assert camera_of_info(given, rectified=False) == (
        Camera(*SIZE, 531.7, 527.1, 322.3, 243.9),
        False,
    )


@pytest.mark.parametrize(
    ("topic", "rectified"),
    [
        ("/camera/depth/image_rect", True),
        ("/camera/depth/image_rect_raw", True),
        ("/camera/depth/image_rect/compressedDepth", True),
        ("/camera/depth/image_raw", False),
        ("/camera/depth/image_raw/compressedDepth", False),
        ("/rectified_camera/depth/image_raw", False),
        ("/camera/depth/image_unrectified", False),
        ("/camera/direct/image_raw", False),
        ("/camera/depth/rectified", True),
        ("/camera/depth/depth_rect", True),
    ],
)
def test_topic_name_decides_whether_image_is_rectified(topic: str, rectified: bool) -> None:
    """A transport appends to the topic name; the namespace has no meaning."""
    recording: Any = SimpleNamespace(topics=())
    stream = Stream(topic, IMAGE, "depth", "/info", 9, "optical")

    assert DepthSource(recording, stream, Counter()).rectified is rectified


def test_rectified_image_without_p_uses_k() -> None:
    camera, _ = camera_of_info(calibration(p=np.zeros(12)), rectified=True)

    assert (camera.fx, camera.cy) == (531.7, 243.9)


@pytest.mark.parametrize("k", [np.zeros((3, 3)), np.eye(3)])
def test_image_without_k_uses_p(k: Any) -> None:
    """Drivers of rectified depth may fill in P alone; a focal length of 1 px spoils all shapes."""
    given = calibration(k=k.ravel(), d=np.array([0.1, 0, 0, 0, 0]))
    camera, distorted = camera_of_info(given, rectified=False)

    assert camera == Camera(*SIZE, 498.4, 503.2, 317.6, 239.3)
    assert not distorted  # D belongs to K


def test_identity_is_not_a_calibration() -> None:
    """Drivers publish identity matrices for uncalibrated cameras."""
    matrices = {"k": np.eye(3).ravel(), "p": np.eye(3, 4).ravel()}

    with pytest.raises(MessageError, match="CameraInfo without intrinsics"):
        camera_of_info(calibration(**matrices), rectified=True)


def test_error_shows_the_focal_length_that_is_wrong() -> None:
    """Simulators whose y axis points up give a negative fy; the error must not show fx instead."""
    k = np.diag([500.0, -510.0, 1.0]).ravel()

    with pytest.raises(MessageError, match="focal length -510"):
        camera_of_info(calibration(k=k), rectified=False)


@pytest.mark.parametrize(
    ("place", "number"), [(0, 1e30), (2, 1e30), (4, 1e30), (5, 1e30), (2, -1e30), (5, -1e30)]
)
def test_intrinsics_that_fit_no_camera_are_refused(place: int, number: float) -> None:
    """A damaged calibration of the colour camera ended the run with a traceback."""
    k = calibration().k.copy()
    k[place] = number

    with pytest.raises(MessageError, match="implausible intrinsics"):
        camera_of_info(calibration(k=k), rectified=False)


def test_region_of_interest_shifts_principal_point() -> None:
    """Cutting 80 columns and 30 rows moves the point from (322.3, 243.9) to (242.3, 213.9)."""
    camera, _ = camera_of_info(calibration(roi=region(80, 30, 400, 300)), rectified=False)

    assert (camera.width, camera.height) == (400, 300)
    assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [531.7, 527.1, 242.3, 213.9])


def test_binning_divides_focal_length_and_principal_point() -> None:
    camera, _ = camera_of_info(calibration(binning_x=2, binning_y=4), rectified=False)

    assert (camera.width, camera.height) == (320, 120)
    assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [265.85, 131.775, 161.15, 60.975])


def test_region_of_interest_applies_before_binning() -> None:
    """sensor_msgs/CameraInfo: the ROI is in full resolution, binning comes after."""
    changes = {"roi": region(80, 30, 400, 300), "binning_x": 2, "binning_y": 3}
    camera, _ = camera_of_info(calibration(**changes), rectified=False)

    assert (camera.width, camera.height) == (200, 100)
    assert_allclose([camera.cx, camera.cy], [121.15, 71.3])


@pytest.mark.parametrize(("width", "height"), [(0, 0), (400, 0), (0, 300)])
def test_empty_region_of_interest_means_whole_image(width: int, height: int) -> None:
    """Some drivers fill in only some fields of the region."""
    plain, _ = camera_of_info(calibration(), rectified=False)

    assert (
        camera_of_info(calibration(roi=region(80, 30, width, height)), rectified=False)[0] == plain
    )


def fisheye_of_opencv(ray: Any, k: Any) -> Any:
    """Distort slopes (x / z, y / z) by the formula in the documentation of cv::fisheye."""
    a, b = ray
    r = np.sqrt(a**2 + b**2)
    theta = np.arctan(r)
    theta_d = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    return np.array([theta_d / r * a, theta_d / r * b])


FISHEYE = (-0.021, 0.0043, -0.0117, 0.0029)


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "kannala_brandt"])
@pytest.mark.parametrize("ray", [(0.31, -0.52), (1.2, 0.4), (-0.05, 0.02)])
def test_fisheye_matches_published_formula(model: str, ray: tuple[float, float]) -> None:
    assert_allclose(distort(np.array(ray), model, FISHEYE), fisheye_of_opencv(ray, FISHEYE))


def rational_of_opencv(ray: Any, d: Any) -> Any:
    """Distort slopes (x / z, y / z) by the formula in the documentation of cv::projectPoints."""
    x, y = ray
    k1, k2, p1, p2, k3, k4, k5, k6 = d
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.array(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ]
    )


@pytest.mark.parametrize("ray", [(0.31, -0.52), (-0.4, 0.17)])
def test_rational_polynomial_matches_published_formula(ray: tuple[float, float]) -> None:
    d = (0.21, -0.13, 0.0031, -0.0017, 0.047, 0.19, -0.08, 0.023)

    assert_allclose(distort(np.array(ray), "rational_polynomial", d), rational_of_opencv(ray, d))


@pytest.mark.parametrize(
    ("model", "d", "project"),
    [
        ("fisheye", FISHEYE, fisheye_of_opencv),
        ("plumb_bob", (-0.28, 0.11, 0.0012, -0.0021, -0.02), None),
    ],
)
def test_undistorted_rays_match_numerical_inverse(model: str, d: Any, project: Any) -> None:
    """SciPy's least squares inverts the published formula at some pixels."""
    forward = project or (lambda ray, k: rational_of_opencv(ray, (*k, 0, 0, 0)))
    camera = Camera(80, 60, 61.3, 57.9, 37.2, 31.4)
    rays = undistorted_rays(camera, model, d)
    assert rays is not None

    for u, v in [(3, 5), (70, 11), (41, 52)]:
        distorted = np.array([(u - 37.2) / 61.3, (v - 31.4) / 57.9])
        found = least_squares(lambda ray, s=distorted: forward(ray, d) - s, distorted, xtol=1e-14)
        assert_allclose(rays[v, u], found.x, atol=1e-4)


WIDE = (4.7247, 3.2092, 0.0, 0.0001, 0.1706, 5.0559, 4.7758, 0.8865)
"""A depth camera of 120 degrees (Azure Kinect, wide field of view)."""


def test_wide_lens_is_inverted_up_to_its_edge() -> None:
    """At the edge, the solver converges so slowly that the lens might seem to have no inverse."""
    camera = Camera(64, 64, 31.5, 31.5, 32.1, 31.8)
    rays = undistorted_rays(camera, "rational_polynomial", WIDE)
    assert rays is not None

    pixels = distort(rays, "rational_polynomial", WIDE) * 31.5 + (32.1, 31.8)
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    assert_allclose(pixels, np.stack([u, v], axis=-1), atol=0.01)
    assert np.linalg.norm(rays[32, 0]) > 1.7


def test_pixels_outside_the_image_of_a_lens_see_no_ray() -> None:
    """Pixels that no ray reaches must not make the lens count as one that cannot be inverted."""
    camera, d = Camera(64, 64, 40.0, 40.0, 32.0, 32.0), (-0.3, 0, 0, 0, 0)  # at most a slope of 0.7
    rays = undistorted_rays(camera, "plumb_bob", d)
    assert rays is not None

    pixels = distort(rays, "plumb_bob", d) * 40.0 + 32.0
    assert np.isnan(rays[0, 0]).all()
    assert_allclose(pixels[32, 10], [10, 32], atol=0.01)


def test_fisheye_depth_image_gives_points_along_true_rays(tmp_path: Path) -> None:
    message = info(EPOCH, d=FISHEYE)
    message.distortion_model = "equidistant"
    items = [
        ("/depth/camera_info", 0, message),
        ("/depth/image_raw", 1, image(EPOCH, np.full((48, 64), 1500, np.uint16))),
    ]
    (frame,), _, _ = read(write(tmp_path / "a.mcap", items))

    for u, v in [(2, 40), (60, 3)]:
        x, y, z = frame.xyz(np.array([v * 64 + u], np.uint32))[0]
        a, b = fisheye_of_opencv((x / z, y / z), FISHEYE)
        assert_allclose([60.0 * a + 31.2, 61.0 * b + 23.7], [u, v], atol=0.2)
        assert z == pytest.approx(1.5)


@pytest.mark.parametrize("kind", ["16UC1", "32FC1"])
def test_big_endian_depth_equals_little_endian_depth(kind: str) -> None:
    """In the wrong byte order, 1 m becomes 59 m."""
    depth = wavy_depth()
    values = depth if kind == "16UC1" else (depth / 1000).astype(np.float32)
    little = image(EPOCH, values, kind)
    big = image(EPOCH, values.astype(values.dtype.newbyteorder(">")), kind)
    big.is_bigendian = 1

    assert_allclose(depth_of_image(big), depth / 1000, rtol=1e-6)
    np.testing.assert_array_equal(depth_of_image(big), depth_of_image(little))


@pytest.mark.parametrize("pack", [png, rvl])
def test_inverse_depth_follows_its_formula(pack: Any) -> None:
    """compressed_depth_image_transport: depth = A / (value - B), here A 9100 and B -350."""
    stored = np.array([[650, 4200, 0], [1470, 0, 12_650]], np.uint16)
    message = compressed(EPOCH, pack(stored), "32FC1", (9100.0, -350.0))
    expected = [[9.1, 2.0, 0], [5.0, 0, 0.7]]

    assert_allclose(depth_of_compressed(message), expected, rtol=1e-5)


def test_rays_agree_with_pixels_to_a_thousandth_of_a_pixel() -> None:
    """A shift by half a pixel moves a point on a table by a millimetre."""
    camera = Camera(64, 48, 60.0, 61.0, 31.2, 23.7)
    depth = np.full((48, 64), 2.0, np.float32)
    points = Frame("", 0, 0, 0, "", depth=depth, camera=camera).xyz()
    u, v = 50, 7
    assert_allclose(
        points[v * 64 + u], [2 * (50 - 31.2) / 60.0, 2 * (7 - 23.7) / 61.0, 2.0], rtol=1e-6
    )

    fit = fit_pinhole(organized_points(wavy_depth()))
    assert fit is not None
    found = (fit.camera.fx, fit.camera.fy, fit.camera.cx, fit.camera.cy)
    assert_allclose(found, [60.0, 61.0, 31.2, 23.7], atol=1e-3)


def test_up_is_rotated_from_fixed_frame_into_sensor_frame() -> None:
    """Z of the fixed frame, seen by the sensor, is the last row of fixed_from_sensor."""
    from shapecat.recordings.transforms.buffer import TransformBuffer  # noqa: PLC0415  used only here
    from shapecat.recordings.transforms.gravity import PoseFinder  # noqa: PLC0415  the same
    from shapecat.recordings.transforms.window import TransformWindow  # noqa: PLC0415  the same

    turn = Rotation.from_euler("xyz", [-2.1, 0.3, 0.8])
    transforms = TransformBuffer()
    transforms.add("map", "camera", 0, ((1.0, 2.0, 3.0), tuple(turn.as_quat())), static=True)
    poses = PoseFinder(TransformWindow(transforms), "map", None, ("tf",))
    frame = Frame("/depth", 0, 5, 5, "camera", points=np.zeros((1, 3)))

    up = poses.orient(frame).up
    assert up is not None
    assert_allclose(up, turn.inv().apply([0, 0, 1]), atol=1e-6)
    pose = poses.fixed_from_sensor(frame)
    assert pose is not None
    assert_allclose(pose.rotation, turn.as_matrix(), atol=1e-9)
    assert_allclose(pose.translation, [1, 2, 3])
