"""Tests of organized clouds that were transformed before they were recorded."""

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from shapecat.arrays import F4
from shapecat.geometry import (
    LINK_FROM_OPTICAL,
    compose,
    inverse,
    rotation_from_quaternion,
    transform,
)
from shapecat.pipeline import process
from shapecat.recordings import choose_streams, frames, open_recording
from shapecat.recordings.colour_frames import frames_with_colour
from shapecat.recordings.colour_streams import pair_colours
from shapecat.recordings.decoding.pointcloud2 import unorganized
from shapecat.recordings.pinhole import fit_pinhole
from shapecat.recordings.viewpoint import find_viewpoint
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.runs.labelled_tracks import LabelledTracks, read_annotation_frames
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Frame, Pose
from tests.colour_messages import gradient, raw
from tests.messages import CAMERA, EPOCH, cloud, info, organized_points, wavy_depth, write
from tests.scenes import OPTICAL, views

MAKE = MessageFactory(2)
MOUNTS = {
    "base_link": Pose(rotation_from_quaternion((0.1, -0.05, 0.3, 0.9)), np.array([0.4, -1.2, 0.3])),
    "world": Pose(rotation_from_quaternion((0.0, 0.0, 0.7, 0.7)), np.array([-20.0, 31.0, 2.0])),
}
"""Poses of frames in the map."""
LINK = "camera_link"
"""The frame of the camera with x forward, in which ZED cameras publish their clouds."""


def posed(points: F4, quaternion: Any = (0.3, -0.6, 0.4, 0.5), place: Any = (0.3, -1.2, 0.8)) -> F4:
    """Transform points of a camera to a frame in which the camera has the given pose."""
    pose = Pose(rotation_from_quaternion(quaternion), np.array(place))
    return transform(pose, points).astype(np.float32)


def depth_noise(points: F4, rng: np.random.Generator) -> F4:
    """Move points along their rays, and remove 30 % of them."""
    noisy = points * (1 + rng.normal(0, 0.01, points.shape[:2]))[..., None]
    noisy[rng.random(points.shape[:2]) < 0.3] = np.nan
    return np.asarray(noisy)


@pytest.mark.parametrize("invalid", [np.nan, 0.0], ids=["nan", "zero"])
def test_camera_of_transformed_cloud_is_found(invalid: float) -> None:
    """Some drivers mark missing points by zeros, which a transform moves to the camera's centre."""
    rng = np.random.default_rng(0)
    points = depth_noise(organized_points(wavy_depth()), rng)
    points[np.isnan(points)] = invalid
    points[rng.random(points.shape[:2]) < 0.01] += 0.2  # outliers

    found = find_viewpoint(posed(points), None)

    assert found is not None
    fit, pose, _ = found
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(getattr(fit.camera, name) - getattr(CAMERA, name)) < 0.01
    np.testing.assert_allclose(pose.translation, [0.3, -1.2, 0.8], atol=1e-4)
    rotation = rotation_from_quaternion((0.3, -0.6, 0.4, 0.5))
    np.testing.assert_allclose(pose.rotation, rotation, atol=1e-4)


def test_clouds_with_damaged_numbers_are_read_without_warnings() -> None:
    """NumPy would print its own warnings between the messages of shapecat."""
    points = posed(organized_points(wavy_depth()))
    points.view(np.uint32)[::7, ::5] = 0x7F800001  # a signaling NaN
    points[3::7, ::5] = 3e38

    flat = unorganized(points)["points"]

    find_viewpoint(points, None)
    valid = np.isfinite(points).all(axis=2).reshape(-1)
    assert np.isnan(flat[~valid]).all()
    np.testing.assert_array_equal(flat[valid], points.reshape(-1, 3)[valid])


def test_missing_points_at_the_origin_of_another_frame_have_no_depth(tmp_path: Path) -> None:
    """A camera that looks at the base of its robot would see a wall of such points."""
    depth, quaternion = wavy_depth(), (0.3, -0.6, 0.4, 0.5)
    place = rotation_from_quaternion(quaternion) @ [0.05, -0.02, -0.7]
    points = posed(organized_points(depth), quaternion, place)
    points[depth == 0] = 0
    (frame,) = read(write(tmp_path / "a.mcap", [("/points", EPOCH, cloud(EPOCH, points))]))

    assert frame.depth is not None
    np.testing.assert_allclose(frame.depth, depth / 1000, atol=1e-4)


def lidar_rings() -> F4:
    """Return the organized cloud of a rotating lidar that stands beside the origin."""
    elevation, azimuth = np.radians(np.mgrid[-15:15:16j, 0:360:400j])
    far = 2 + np.sin(3 * azimuth) + 0.5 * np.cos(9 * elevation)
    x, y = far * np.cos(elevation) * np.cos(azimuth), far * np.cos(elevation) * np.sin(azimuth)
    return np.stack([x + 1, y, far * np.sin(elevation) + 0.5], axis=-1).astype(np.float32)


def height_map() -> F4:
    """Return an organized cloud of points above a regular grid, like those of a fused map."""
    v, u = np.mgrid[1:49, 1:65] / 50.0
    return np.stack([u, v, 0.1 * np.sin(9 * u) * np.cos(7 * v)], axis=-1).astype(np.float32)


@pytest.mark.parametrize(
    "points",
    [
        lidar_rings(),
        height_map(),
        posed(organized_points(np.full((48, 64), 800, np.uint16))),
        posed(organized_points(wavy_depth()) * np.array([-1, 1, 1], np.float32)),
        posed(np.random.default_rng(0).normal(0, 1, (48, 64, 3))),
        np.ones((48, 64, 3), np.float32),
    ],
    ids=["lidar", "height map", "plane", "mirrored", "noise", "one point"],
)
def test_cloud_without_one_viewpoint_stays_points(points: F4, tmp_path: Path) -> None:
    """A camera that was not there would give wrong objects."""
    (frame,) = read(write(tmp_path / "a.mcap", [("/points", EPOCH, cloud(EPOCH, points))]))

    assert fit_pinhole(points) is None
    assert frame.frame_from_sensor is None
    assert frame.points is not None
    np.testing.assert_array_equal(frame.points, points.reshape(-1, 3))


def test_viewpoint_is_found_again_after_it_moved(tmp_path: Path) -> None:
    """A camera on an arm keeps its intrinsics, but not its pose in the base."""
    points = organized_points(wavy_depth())
    places = [(0.3, -1.2, 0.8), (0.3, -1.2, 0.8), (0.35, -1.1, 0.9)]
    items = [
        ("/points", EPOCH + k, cloud(EPOCH + k, posed(points, place=place)))
        for k, place in enumerate(places)
    ]
    found = read(write(tmp_path / "a.mcap", items))

    poses = [frame.frame_from_sensor for frame in found]
    assert poses[0] is poses[1]
    for pose, place in zip(poses, places, strict=True):
        assert pose is not None
        np.testing.assert_allclose(pose.translation, place, atol=1e-4)
    assert len({frame.camera for frame in found}) == 1


@pytest.mark.parametrize(
    "mount", ["base_link", pytest.param("world", marks=pytest.mark.many), LINK]
)
def test_cloud_in_other_frame_gives_the_results_of_its_camera(mount: str, tmp_path: Path) -> None:
    """Objects in transformed clouds were split: the origin was mistaken for the camera."""
    map_from_mounts = [
        MOUNTS.get(mount) or compose(view.pose, inverse(LINK_FROM_OPTICAL)) for view in views(2)
    ]
    runs = []
    for name in (OPTICAL, mount):
        items: list[tuple[str, int, Any]] = []
        for k, (view, map_from_mount) in enumerate(zip(views(2), map_from_mounts, strict=True)):
            map_from_camera = view.pose
            stamp = EPOCH + k
            links = [("map", OPTICAL, map_from_camera), ("map", mount, map_from_mount)]
            items.append(("/tf", stamp, MAKE.transforms(links, stamp)))
            pose = compose(inverse(map_from_mount), map_from_camera)
            points = depth_noise(view.points(), np.random.default_rng(k))
            points = points if name == OPTICAL else transform(pose, points)
            items.append(("/points", stamp, MAKE.cloud(points.astype(np.float32), stamp, name)))
        out = tmp_path / name
        process(Job(write(tmp_path / f"{name}.mcap", items), out, mcap=False, rrd=False))
        assert read_run(out)["warnings"] == []
        runs.append({t: pq.read_table(out / f"{t}.parquet") for t in ("detections", "tracks")})

    own, other = runs
    assert len(own["detections"]) > 4
    assert own["tracks"]["track"].to_pylist() == other["tracks"]["track"].to_pylist()
    # Rounding may move one of these small objects across the novelty threshold.
    names = zip(*(run["detections"]["category"].to_pylist() for run in runs), strict=True)
    assert sum(name != of_mount for name, of_mount in names) <= 1
    places = [np.array(run["detections"]["center_fixed"].to_pylist()) for run in runs]
    np.testing.assert_allclose(places[1], places[0], atol=2e-4)
    # What viewers draw is in the frame that the messages name.
    labels = {n: TrackLabel(n, "cup", 1.0) for n in own["tracks"]["track"].to_pylist()}
    shown = list(read_annotation_frames(out, LabelledTracks.read(out, labels), visible=True))
    boxes = [
        (box, pose) for f, pose in zip(shown, map_from_mounts, strict=True) for box in f.objects
    ]
    drawn = np.array([transform(pose, np.array(box.center)) for box, pose in boxes])
    tracked = np.array(other["tracks"]["center_fixed"].to_pylist())
    assert len(drawn) == len(tracked) > 4
    assert np.linalg.norm(drawn[:, None] - places[1], axis=2).min(axis=1).max() < 1e-5
    turns = [pose.rotation @ rotation_from_quaternion(box.orientation) for box, pose in boxes]
    np.testing.assert_allclose([turn[2, 2] for turn in turns], 1, atol=1e-2)


def test_cloud_in_the_map_needs_no_transforms(tmp_path: Path) -> None:
    """The frame of the cloud is the fixed one, and its z axis is up."""
    items = [
        ("/points", EPOCH + k, MAKE.cloud(transform(v.pose, v.points()), EPOCH + k, "map"))
        for k, v in enumerate(views(2))
    ]
    process(Job(write(tmp_path / "a.mcap", items), tmp_path / "out", mcap=False, rrd=False))
    run = read_run(tmp_path / "out")
    table = pq.read_table(tmp_path / "out" / "frames.parquet")

    assert (run["fixed_frame"], run["up"]["source"]) == ("map", "transforms, z of map")
    for view, place in zip(views(2), table["fixed_translation"].to_pylist(), strict=True):
        np.testing.assert_allclose(place, view.pose.translation, atol=1e-4)
    assert table["frame_translation"].to_pylist() == table["fixed_translation"].to_pylist()


def test_colour_camera_is_placed_beside_the_camera_of_a_moved_cloud(tmp_path: Path) -> None:
    """Masks would be off: transforms relate it to the frame of the cloud, not the depth camera."""
    pose = Pose(rotation_from_quaternion((0.3, -0.6, 0.4, 0.5)), np.array([0.3, -1.2, 0.8]))
    beside = Pose(rotation_from_quaternion((0.1, 0.2, -0.1, 0.9)), np.array([0.05, -0.02, 0.01]))
    links = [("base_link", "color", compose(pose, beside))]
    points = posed(organized_points(wavy_depth()))
    items = [
        ("/tf_static", EPOCH, MAKE.transforms(links, EPOCH)),
        ("/cam/points", EPOCH, MAKE.cloud(points, EPOCH, "base_link")),
        ("/cam/color/camera_info", EPOCH, info(EPOCH)),
        ("/cam/color/image", EPOCH, raw(EPOCH, gradient(), "rgb8", "color")),
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        streams = choose_streams(recording)
        colours = pair_colours(recording, streams, None)
        ((_, view),) = frames_with_colour(recording, streams, colours)

    assert view is not None
    assert view.colour_from_depth is not None
    expected = inverse(beside)
    np.testing.assert_allclose(view.colour_from_depth.rotation, expected.rotation, atol=1e-4)
    np.testing.assert_allclose(view.colour_from_depth.translation, expected.translation, atol=1e-4)


def read(path: Path) -> list[Frame]:
    with open_recording(path) as recording:
        return list(frames(recording, choose_streams(recording)))
