"""Tests of the up direction: its sources and their reliability."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

from shapecat.config import Settings
from shapecat.errors import ConfigError
from shapecat.geometry import IDENTITY, LINK_FROM_OPTICAL, transform
from shapecat.pipeline import process
from shapecat.recordings import open_recording
from shapecat.recordings.decoding.pointcloud2 import cloud_points
from shapecat.recordings.streams import Stream
from shapecat.recordings.transforms.buffer import TransformBuffer
from shapecat.recordings.transforms.gravity import Orientation, PoseFinder
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.runs.perceive import up_check
from shapecat.runs.perceive.up_report import explain_up, report_up
from shapecat.runs.tables.schemas import DETECTIONS, FRAMES, PLANES
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Frame, Pose
from tests.mcap_files import mcap_writer
from tests.messages import CAMERA, EPOCH, SECOND, header, make, write
from tests.scenes import OPTICAL, stream, views

MAKE = MessageFactory(2)
TURN = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def imu(stamp: int, acceleration: Any, frame_id: str = "imu", *, absent: bool = False) -> Any:
    """Return an IMU message; ``absent`` marks the acceleration as not measured."""
    covariance = np.zeros(9)
    covariance[0] = -1.0 if absent else 0.0
    vector = make("geometry_msgs/msg/Vector3", *map(float, acceleration))
    angular_velocity = make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
    return make(
        "sensor_msgs/msg/Imu",
        header(stamp, frame_id),
        make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
        *(np.zeros(9), angular_velocity, np.zeros(9), vector, covariance),
    )


def frame(stamp: int) -> Frame:
    depth = np.ones((CAMERA.height, CAMERA.width), np.float32)
    return Frame("/d", 0, stamp, stamp, "camera", depth=depth, camera=CAMERA)


def test_imu_up_is_smoothed_and_rotated_into_sensor_frame(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    mounting = [("imu", "camera", Pose(TURN, np.zeros(3)))]
    items: list[tuple[str, int, Any]] = [("/tf_static", EPOCH, MAKE.transforms(mounting, EPOCH))]
    for k in range(400):
        stamp = EPOCH + k * SECOND // 200
        items.append(("/imu", stamp, imu(stamp, rng.normal((0, 0, 9.8), 2))))
        items.append(("/gyro", stamp, imu(stamp, [0, 0, 0])))
        items.append(("/fake", stamp, imu(stamp, [9, 9, 9], absent=True)))
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        poses = PoseFinder.of(recording, up="imu", fixed_frame=None)
        up = poses.orient(frame(EPOCH + SECOND)).up
        late = poses.orient(frame(EPOCH + 60 * SECOND)).up

    assert up is not None
    assert np.degrees(np.arccos(up @ (TURN.T @ [0, 0, 1]))) < 3
    assert late is None


def test_imu_without_stamps_uses_log_times(tmp_path: Path) -> None:
    """Depth images without stamps use their log times, so both need the same clock."""
    items = [
        ("/imu", EPOCH + k * SECOND, imu(0, a, "camera"))
        for k, a in ((0, [0, -9.8, 0]), (7, [9.8, 0, 0]))
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        poses = PoseFinder.of(recording, up="imu", fixed_frame=None)
        found = [poses.orient(frame(EPOCH + k * SECOND)).up for k in (0, 3, 7)]

    assert [None if up is None else up.tolist() for up in found] == [[0, -1, 0], None, [1, 0, 0]]


def test_missing_stamps_of_an_imu_are_in_the_clock_of_the_others(tmp_path: Path) -> None:
    """In simulated time, 0 is a valid stamp: replaced by log time, it left frames without up."""
    items = [
        ("/imu", EPOCH + stamp, imu(stamp, a, "camera"))
        for stamp, a in ((0, [0, -9.8, 0]), (7 * SECOND, [9.8, 0, 0]))
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        up = PoseFinder.of(recording, up="imu", fixed_frame=None).orient(frame(0)).up

    assert up is not None
    assert up.tolist() == [0, -1, 0]


def test_imu_in_the_sensor_frame_needs_no_transform_whatever_the_slash(tmp_path: Path) -> None:
    """Some ROS 1 drivers write ``/camera``, others ``camera``: the accelerations were lost."""
    items = [("/imu", EPOCH, imu(EPOCH, [0, -9.8, 0], "/camera"))]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        up = PoseFinder.of(recording, up="imu", fixed_frame=None).orient(frame(EPOCH)).up

    assert up is not None
    assert up.tolist() == [0, -1, 0]


def test_imu_logged_late_uses_its_stamps(tmp_path: Path) -> None:
    """Drivers send measurements in packets; the robot may have turned before they are logged."""
    items = [
        ("/imu", EPOCH + (k + 7) * SECOND, imu(EPOCH + k * SECOND, a, "camera"))
        for k, a in ((1, [0, -9.8, 0]), (8, [9.8, 0, 0]))
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        poses = PoseFinder.of(recording, up="imu", fixed_frame=None)
        found = [poses.orient(frame(EPOCH + k * SECOND)).up for k in (1, 8, 15)]

    assert [None if up is None else up.tolist() for up in found] == [[0, -1, 0], [1, 0, 0], None]


@pytest.mark.parametrize(("up", "error"), [("imu", "no sensor_msgs/Imu"), ("tf", "no transforms")])
def test_missing_up_source_is_an_error(tmp_path: Path, up: str, error: str) -> None:
    path = write(tmp_path / "a.mcap", [("/x", 1, make("std_msgs/msg/String", "x"))])
    with open_recording(path) as recording, pytest.raises(ConfigError, match=error):
        PoseFinder.of(recording, up=up, fixed_frame=None)


@pytest.mark.parametrize(("tilt_deg", "warns"), [(0.0, False), (13.0, True), (50.0, True)])
def test_run_reports_angle_between_given_up_and_planes(
    tmp_path: Path, tilt_deg: float, warns: bool
) -> None:
    """A wrong mounting angle in the transforms would silently spoil every height."""
    angle = np.radians(tilt_deg)
    c, s = np.cos(angle), np.sin(angle)
    tilt = Pose(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.zeros(3))
    items = []
    for topic, time, message in stream(MAKE, 3):
        if topic == "/tf_static":
            message.transforms[0].child_frame_id = "mount"
            items.append((topic, time, message))
            bad = MAKE.transforms([("mount", OPTICAL, tilt)], time)
            items.append((topic, time, bad))
        else:
            items.append((topic, time, message))
    process(Job(write(tmp_path / "a.mcap", items), tmp_path / "out", mcap=False, rrd=False))
    run = read_run(tmp_path / "out")

    assert any("up" in text for text in run["warnings"]) is warns
    if tilt_deg < 15:
        assert run["up"]["source"] == "transforms, z of map"
        assert run["up"]["planes_differ_deg"] == pytest.approx(tilt_deg, abs=2)
    else:
        dropped = {"/camera/depth/image_raw": "transforms, z of map"}
        assert run["up"] == {"source": "planes", "dropped": dropped}


@pytest.mark.parametrize(
    ("off_deg", "dropped"),
    [
        ((40, 30, 50), True),
        ((40, 3), False),  # one frame confirms it; the other shows a wall
        ((3, 40), False),
        ((None, 40), False),  # too few frames have planes
        ((40, None, None, 35, None, None, 45), True),
        ((40, None, 2), False),
    ],
)
def test_given_up_is_dropped_only_if_no_plane_confirms_it(
    monkeypatch: pytest.MonkeyPatch, off_deg: tuple[float | None, ...], *, dropped: bool
) -> None:
    """A cupboard in view at the start must not override a correct up direction."""
    poses = PoseFinder(TransformWindow(TransformBuffer()), None, None, ("tf", "imu"))
    given = Orientation("tf", np.array([0.0, -1.0, 0.0]), None)
    angles = [None if off is None else np.radians(off) for off in off_deg]
    found = [None if a is None else np.array([0, -np.cos(a), -np.sin(a)]) for a in angles]
    planes = iter(found)
    monkeypatch.setattr(up_check, "find_up", lambda *_: next(planes))
    frames = [frame(EPOCH + k) for k in range(len(off_deg))]

    oriented = ((item, None, given) for item in frames)
    returned = list(up_check.UpCheck(poses, Settings()).before(oriented))

    assert [item for item, *_ in returned] == frames
    assert poses.dropped == ({"/d": "tf"} if dropped else {})


@pytest.mark.parametrize(("up", "most"), [(None, 1), (np.array([0.0, -1.0, 0.0]), 65)])
def test_topic_that_ends_early_does_not_hold_frames_back(
    monkeypatch: pytest.MonkeyPatch, up: Any, most: int
) -> None:
    """All other frames of a long recording would be kept in memory, and none saved."""
    monkeypatch.setattr(up_check, "find_up", lambda *_: None)
    poses = PoseFinder(TransformWindow(TransformBuffer()), None, None, ("tf", "imu"))
    frames = [frame(EPOCH + k) for k in range(300)]
    frames[1] = replace(frames[1], topic="/short")
    held: set[int] = set()

    def read() -> Iterator[Any]:
        for item in frames:
            held.add(item.stamp_ns)
            assert len(held) <= most
            yield item, None, Orientation("tf" if up is not None else "", up, None)

    for item, *_ in up_check.UpCheck(poses, Settings()).before(read()):
        held.remove(item.stamp_ns)
    assert not held


def test_up_that_is_given_later_is_tested(monkeypatch: pytest.MonkeyPatch) -> None:
    """Transforms often begin after the first frames: up must be tested when it first appears."""
    poses = PoseFinder(TransformWindow(TransformBuffer()), None, None, ("tf", "imu"))
    given, plane = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0])
    monkeypatch.setattr(up_check, "find_up", lambda *_: plane)
    ups = [Orientation("", None, None)] * 4 + [Orientation("tf", given, None)] * 4
    oriented = ((frame(EPOCH + k), None, up) for k, up in enumerate(ups))

    returned = list(up_check.UpCheck(poses, Settings()).before(oriented))

    assert [item.stamp_ns - EPOCH for item, *_ in returned] == list(range(8))
    assert poses.dropped == {"/d": "tf"}


@pytest.mark.parametrize("clouds", [False, True])
def test_transforms_of_optical_data_in_another_frame_are_corrected(
    tmp_path: Path, *, clouds: bool
) -> None:
    """Gazebo gives images the frame id of the link: a moving camera gave objects many tracks."""
    poses = []
    for name, frame_id in (("right", OPTICAL), ("wrong", "camera_link")):
        items = list(stream(MAKE, 4, clouds=clouds))
        for topic, _, message in items:
            if "depth" in topic:
                message.header.frame_id = frame_id
        path = write(tmp_path / f"{name}.mcap", items)
        process(Job(path, tmp_path / name, mcap=False, rrd=False))
        table = pq.read_table(tmp_path / name / "frames.parquet")
        names = ("fixed_rotation", "fixed_translation", "up", "up_given")
        poses.append([np.array(table[column].to_pylist()) for column in names])
    run = read_run(tmp_path / "wrong")

    for right, wrong in zip(*poses, strict=True):
        np.testing.assert_allclose(wrong, right, atol=1e-6)
    assert run["up"]["source"] == "transforms, z of map"
    (warning,) = run["warnings"]
    assert "optical frame" in warning


@pytest.mark.parametrize(("pitch_deg", "corrected"), [(2, True), (12, False)])
def test_map_with_z_forward_does_not_correct_transforms(
    monkeypatch: pytest.MonkeyPatch, pitch_deg: float, *, corrected: bool
) -> None:
    """In visual SLAM, the map is the camera's first pose; a wrong correction made tracks drift."""
    pitch = np.radians(pitch_deg)
    poses = PoseFinder(TransformWindow(TransformBuffer()), None, None, ("tf", "imu"))
    planes = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
    monkeypatch.setattr(up_check, "find_up", lambda *_: planes)
    given = Orientation("transforms, z of map", np.array([0.0, 0.0, 1.0]), None)
    oriented = ((frame(EPOCH + k), None, given) for k in range(4))

    list(up_check.UpCheck(poses, Settings()).before(oriented))

    assert bool(poses.misnamed) is corrected
    assert bool(poses.dropped) is not corrected


@pytest.mark.parametrize(
    ("turn", "how"),
    [(LINK_FROM_OPTICAL.rotation, "x forward"), (np.diag([1.0, -1.0, -1.0]), "OpenGL")],
)
def test_transforms_of_clouds_in_other_axes_are_corrected(
    turn: Any, how: str, tmp_path: Path
) -> None:
    """Gazebo's clouds have x forward, even in an optical frame: positions in the map were wrong."""
    items = list(stream(MAKE, 4, clouds=True))
    for k, (topic, time, message) in enumerate(items):
        if topic.endswith("points"):
            points = cloud_points(message) @ turn.T
            items[k] = (topic, time, MAKE.cloud(points, time, OPTICAL))
    path = write(tmp_path / "a.mcap", items)
    process(Job(path, tmp_path / "out", mcap=False, rrd=False))
    run, table = read_run(tmp_path / "out"), pq.read_table(tmp_path / "out" / "frames.parquet")

    (warning,) = run["warnings"]
    assert how in warning
    assert run["up"]["source"] == "transforms, z of map"
    for view, rotation in zip(views(), table["fixed_rotation"].to_pylist(), strict=True):
        np.testing.assert_allclose(np.reshape(rotation, (3, 3)), view.pose.rotation, atol=1e-6)


def test_table_above_the_origin_of_a_cloud_does_not_contradict_up(tmp_path: Path) -> None:
    """In a robot's base frame, a table above the origin looks like one seen from below."""
    links = [("map", "base_link", Pose(np.eye(3), np.array([0.1, -1.2, -0.8])))]
    items: list[tuple[str, int, Any]] = [("/tf_static", EPOCH, MAKE.transforms(links, EPOCH))]
    for k, view in enumerate(views()):
        points = transform(view.pose, view.points().reshape(1, -1, 3)) - links[0][2].translation
        cloud = MAKE.cloud(points.astype(np.float32), EPOCH + k, "base_link")
        items.append(("/points", EPOCH + k, cloud))
    process(Job(write(tmp_path / "a.mcap", items), tmp_path / "out", mcap=False, rrd=False))
    run = read_run(tmp_path / "out")

    assert run["up"]["source"] == "transforms, z of map"
    (warning,) = run["warnings"]
    assert "base_link, which is not the frame of a camera" in warning


def test_up_without_other_source_comes_from_planes(tmp_path: Path) -> None:
    items = [item for item in stream(MAKE, 1) if "tf" not in item[0]]
    process(Job(write(tmp_path / "a.mcap", items), tmp_path / "out", mcap=False, rrd=False))

    assert read_run(tmp_path / "out")["up"] == {"source": "planes"}


def test_imu_up_is_rotated_into_sensor_of_transformed_cloud(tmp_path: Path) -> None:
    """The cloud is in the IMU's frame, but up is needed in the frame of the cloud's sensor."""
    items = [("/imu", EPOCH, imu(EPOCH, [1.2, -3.1, 9.0], "base"))]
    turn = Rotation.from_euler("xyz", [-1.9, 0.2, 0.6]).as_matrix()
    seen = replace(
        frame(EPOCH), frame_id="base", frame_from_sensor=Pose(turn, np.array([0.1, 0.3, 1.2]))
    )
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        up = PoseFinder.of(recording, up="imu", fixed_frame=None).orient(seen).up

    assert up is not None
    np.testing.assert_allclose(
        turn @ up * np.linalg.norm([1.2, -3.1, 9.0]), [1.2, -3.1, 9.0], atol=1e-5
    )


def test_imu_is_used_if_transforms_lack_the_sensor(tmp_path: Path) -> None:
    items: list[tuple[str, int, Any]] = [
        ("/tf", EPOCH, MAKE.transforms([("map", "elsewhere", IDENTITY)], EPOCH)),
        ("/imu", EPOCH, imu(EPOCH, [0, -9.8, 0], "camera")),
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        up = PoseFinder.of(recording, up="auto", fixed_frame=None).orient(frame(EPOCH)).up

    assert up is not None
    np.testing.assert_allclose(up, [0, -1, 0], atol=1e-6)


def in_frames(path: Path, *links: tuple[str, str]) -> Path:
    """Write a recording of static transforms of (parent, child) frames, each turned by `TURN`."""
    poses = [(parent, child, Pose(TURN, np.zeros(3))) for parent, child in links]
    return write(path, [("/tf_static", EPOCH, MAKE.transforms(poses, EPOCH))])


def test_frames_of_a_robot_may_have_its_name_in_front(tmp_path: Path) -> None:
    """With several robots, r1/map is the map of one robot; each has its own up direction."""
    links = ("r1/map", "r1/camera"), ("r2/map", "r2/base"), ("r2/base", "r2/camera")
    with open_recording(in_frames(tmp_path / "a.mcap", *links)) as recording:
        poses = PoseFinder.of(recording, up="tf", fixed_frame=None)
        found = [poses.orient(replace(frame(EPOCH), frame_id=f"/r{k}/camera")) for k in (1, 2)]

    assert [one.source for one in found] == [f"transforms, z of r{k}/map" for k in (1, 2)]
    assert found[1].up is not None
    np.testing.assert_allclose(found[1].up, (TURN @ TURN)[2])
    assert poses.fixed_frame == "r1/map"
    assert poses.failed == 1  # the second robot is not in the map of the first


@pytest.mark.parametrize("robot", ["r1", "r10"])
def test_up_is_that_of_the_robot_of_the_sensor(tmp_path: Path, robot: str) -> None:
    """Robots may share a tree of transforms, and a name may begin with that of another robot."""
    links = [("hall", f"{name}/map") for name in ("r1", "r10")]
    links += [(f"{name}/map", f"{name}/camera") for name in ("r1", "r10")]
    with open_recording(in_frames(tmp_path / "a.mcap", *links)) as recording:
        poses = PoseFinder.of(recording, up="tf", fixed_frame=None)
        found = poses.orient(replace(frame(EPOCH), frame_id=f"{robot}/camera"))

    assert found.source == f"transforms, z of {robot}/map"


def test_map_of_all_robots_comes_before_that_of_one(tmp_path: Path) -> None:
    """Robots that share a map must all get its up direction."""
    links = ("map", "r1/map"), ("r1/map", "r1/camera")
    with open_recording(in_frames(tmp_path / "a.mcap", *links)) as recording:
        poses = PoseFinder.of(recording, up="tf", fixed_frame=None)
        found = poses.orient(replace(frame(EPOCH), frame_id="r1/camera"))

    assert found.source == "transforms, z of map"
    assert found.up is not None
    np.testing.assert_allclose(found.up, (TURN @ TURN)[2])


def test_wanted_fixed_frame_may_begin_with_a_slash(tmp_path: Path) -> None:
    """ROS 1 wrote frame ids with a slash; transforms are stored without it."""
    with open_recording(in_frames(tmp_path / "a.mcap", ("/map", "/camera"))) as recording:
        poses = PoseFinder.of(recording, up="tf", fixed_frame="/map")

        assert poses.orient(frame(EPOCH)).fixed_from_sensor is not None
        assert poses.fixed_frame == "map"


def test_fixed_frame_is_chosen_for_all_sensors(tmp_path: Path) -> None:
    """The first frame may be of a sensor on a tripod, which is in no map."""
    links = ("mount", "tripod"), ("robot", "camera"), ("map", "robot")
    streams = [Stream(f"/{f}", "", "depth", None, 1, f) for f in ("tripod", "camera")]
    with open_recording(in_frames(tmp_path / "a.mcap", *links)) as recording:
        chosen = []
        for order in (streams, streams[::-1], streams[:1]):
            poses = PoseFinder.of(recording, up="tf", fixed_frame=None, streams=order)
            poses.orient(replace(frame(EPOCH), frame_id="tripod"))
            chosen.append(poses.fixed_frame)

    assert chosen == ["map", "map", "mount"]


@pytest.mark.parametrize("period", [1, 6])  # transforms of the longer recording are read in parts
@pytest.mark.parametrize(("begins", "chosen"), [(4, "map"), (6, "odom")])
def test_map_that_is_known_too_late_is_not_the_fixed_frame(
    begins: int, chosen: str, period: int, tmp_path: Path
) -> None:
    """Until someone sets the initial pose, there is only odometry: earlier frames had no pose."""
    items = []
    for k in range(11):
        links = [("odom", "camera", IDENTITY)] + [("map", "odom", IDENTITY)] * (k >= begins)
        stamp = EPOCH + k * period * SECOND
        items.append(("/tf", stamp, MAKE.transforms(links, stamp)))
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        poses = PoseFinder.of(recording, up="auto", fixed_frame=None)
        poses.orient(frame(EPOCH))

    assert poses.fixed_frame == chosen


def test_fixed_frame_is_chosen_by_stamps_of_another_clock(tmp_path: Path) -> None:
    """In simulated time, no transform has the log time of the middle of the recording."""
    items = []
    for k in range(11):
        links = [("odom", "camera", IDENTITY)] + [("map", "odom", IDENTITY)] * (k >= 6)
        items.append(("/tf", EPOCH + k * SECOND, MAKE.transforms(links, (3 + k) * SECOND)))
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        poses = PoseFinder.of(recording, up="auto", fixed_frame=None)
        poses.orient(replace(frame(EPOCH), stamp_ns=3 * SECOND))

    assert poses.fixed_frame == "odom"


def test_loop_of_other_frames_is_reported_and_ignored(tmp_path: Path) -> None:
    """Two drivers that name each other's frames must not cost the whole run its fixed frame."""
    links = ("map", "camera"), ("u", "v"), ("v", "u")
    with open_recording(in_frames(tmp_path / "a.mcap", *links)) as recording:
        poses = PoseFinder.of(recording, up="tf", fixed_frame=None)

        assert poses.orient(frame(EPOCH)).fixed_from_sensor is not None
        assert poses.fixed_frame == "map"
    (warning,) = poses.warnings
    assert warning.startswith("transforms: the frames u < v < u form a loop")


@pytest.mark.parametrize(
    ("second", "warned"),
    [
        (("base", 0.305), False),
        (("base", 0.5), True),
        (("arm", 0.3), True),
    ],
)
def test_static_transforms_that_differ_are_reported(
    tmp_path: Path, second: tuple[str, float], *, warned: bool
) -> None:
    """A driver and the robot model may disagree: all positions were 20 cm off without a word."""
    items = [
        (
            "/tf_static",
            EPOCH + k,
            MAKE.transforms([(parent, "camera", Pose(np.eye(3), np.array([x, 0, 0])))], EPOCH),
        )
        for k, (parent, x) in enumerate((("base", 0.3), ("base", 0.3), second))
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        warnings = PoseFinder.of(recording, up="auto", fixed_frame=None).warnings

    text = "transforms: static ones of camera differ: the last is used for the whole recording"
    assert warnings == [text] * warned


@pytest.mark.parametrize(
    ("back_s", "moved_m", "warned"),
    [
        (20, 0.5, True),
        (20, 0.0, False),  # a looped playback repeats its transforms
        (40, 0.5, False),  # no stamp is used twice
        (1.5, 0.5, False),  # messages of two nodes may come in another order
    ],
)
def test_transforms_with_the_stamps_of_others_are_reported(
    tmp_path: Path, back_s: float, moved_m: float, *, warned: bool
) -> None:
    """After a simulation was reset, poses of both sessions were mixed without a word."""
    times = [(k * SECOND, 0.1 * k) for k in range(30)]
    again = 30 - back_s, 31 - back_s
    times += [(round(s * SECOND), 0.1 * s + moved_m) for s in again]
    items = [
        (
            "/tf",
            EPOCH + k * SECOND,
            MAKE.transforms(
                [("map", "camera", Pose(np.eye(3), np.array([x, 0, 0])))], EPOCH + stamp
            ),
        )
        for k, (stamp, x) in enumerate(times)
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        poses = PoseFinder.of(recording, up="auto", fixed_frame=None)
        for k in range(len(items)):
            poses.orient(replace(frame(EPOCH + times[k][0]), log_time_ns=EPOCH + k * SECOND))
    warnings = explain_up(poses, tmp_path, {})

    found = [text for text in warnings if "a clock was set back, and those of camera" in text]
    assert len(found) == warned


def test_failed_transform_look_ups_are_counted(tmp_path: Path) -> None:
    items = [("/tf", EPOCH, MAKE.transforms([("map", "elsewhere", IDENTITY)], EPOCH))]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        poses = PoseFinder.of(recording, up="auto", fixed_frame=None)
    for stamp in (EPOCH, EPOCH + 1):
        assert poses.orient(frame(stamp)).up is None

    (warning,) = explain_up(poses, tmp_path, {})
    assert warning.startswith("failed transform look-ups: 2, the first: ")


@pytest.mark.parametrize(
    ("begins", "loss"),
    [
        (1, "unknown in 1 of 4 frames, whose objects are not tracked"),
        (2, "unknown in 2 of 4 frames: its tracks are in the frame of the sensor"),
        (3, "unknown in 3 of 4 frames: its tracks are in the frame of the sensor"),
    ],
)
def test_frames_without_pose_are_reported_with_what_they_cost(
    begins: int, loss: str, tmp_path: Path
) -> None:
    """Transforms that begin late cost detections silently, or put tracks in another frame."""
    rows = [dict.fromkeys(FRAMES.names) | {"topic": "/d", "frame": k} for k in range(4)]
    for row in rows[begins:]:
        row["fixed_translation"] = [0.0, 0.0, 1.0]
    pq.write_table(pa.Table.from_pylist(rows, FRAMES), tmp_path / "frames.parquet")
    poses = PoseFinder(TransformWindow(TransformBuffer()), "map", None, ("tf",))
    poses.failed = begins

    warnings = list(explain_up(poses, tmp_path, {}))

    assert warnings[1:] == [f"/d: the pose of its sensor in map is {loss}"]


@pytest.mark.parametrize(
    ("link", "frame_id", "moves", "reported"),
    [
        (("odom", "base"), "", True, True),
        (("odom", "base"), "cam_unknown", True, True),
        ((OPTICAL, "imu"), OPTICAL, True, True),  # the sensor is the root of its tree
        (("odom", "base"), "cam_unknown", False, False),  # a camera at rest needs no pose
        (("odom", OPTICAL), OPTICAL, True, False),
    ],
)
def test_sensor_without_fixed_frame_is_reported_if_something_moves(
    link: tuple[str, str], frame_id: str, moves: bool, reported: bool, tmp_path: Path
) -> None:
    """A warning named failed look-ups, but not that tracks moved with the camera."""
    items = []
    for topic, stamp, message in stream(MAKE, 4):
        if not topic.startswith("/tf"):
            message.header.frame_id = frame_id
            items.append((topic, stamp, message))
        elif topic == "/tf":
            x = (stamp - EPOCH) / SECOND * moves
            pose = Pose(LINK_FROM_OPTICAL.rotation, np.array([x, 0, 1]))
            items.append((topic, stamp, MAKE.transforms([(*link, pose)], stamp)))
    path = write(tmp_path / "a.mcap", items)
    process(Job(path, tmp_path / "out", mcap=False, rrd=False))
    run = read_run(tmp_path / "out")

    warning = (
        "/camera/depth/image_raw: no transforms lead from the frame of its sensor to a fixed "
        "frame: its tracks are in the frame of the sensor, which may move"
    )
    assert run["fixed_frame"] == ("odom" if link == ("odom", OPTICAL) else None)
    assert run["warnings"].count(warning) == reported


def test_frame_with_objects_does_not_count_as_without_plane(tmp_path: Path) -> None:
    """The plane under objects may be assumed, and thus in no table: the count would be wrong."""
    for name, schema, frames, of_other in (
        ("frames", FRAMES, (0, 1, 2, 3, 4), (0, 1, 3)),
        ("planes", PLANES, (0, 3), (1,)),
        ("detections", DETECTIONS, (1,), (3,)),
    ):
        keys = [("/d", k) for k in frames] + [("/e", k) for k in of_other]
        rows = [dict.fromkeys(schema.names) | {"topic": t, "frame": k} for t, k in keys]
        for row in rows if name == "frames" else ():
            given = None if (row["topic"], row["frame"]) == ("/d", 3) else [0.0, -1.0, 0.0]
            row |= {"up": [0.0, -np.cos(0.1), np.sin(0.1)], "up_given": given}
        pq.write_table(pa.Table.from_pylist(rows, schema), tmp_path / f"{name}.parquet")
    poses = PoseFinder(TransformWindow(TransformBuffer()), None, None, ("tf",))
    poses.given = {"transforms, z of map": 3, "planes": 1}

    report = report_up(poses, tmp_path)
    assert (report["planes_differ_deg"], report["frames_without_plane"]) == (5.7, 3)


@pytest.mark.parametrize(
    ("links", "listed"),
    [((("map", "base"),), "base, map"), ((), "none, it has no transforms")],
)
def test_unknown_fixed_frame_is_an_error_that_lists_the_known_ones(
    tmp_path: Path, links: Any, listed: str
) -> None:
    """A misspelled name would silently leave all objects without tracks in a fixed frame."""
    path = in_frames(tmp_path / "a.mcap", *links)
    with open_recording(path) as recording, pytest.raises(ConfigError) as error:
        PoseFinder.of(recording, up="auto", fixed_frame="/mpa")

    assert str(error.value) == f"--fixed-frame /mpa: not in {path}; its frames: {listed}"


@pytest.mark.parametrize("up", ["gravity", "0,-1", "0,0,0", "0,nan,1", "0,-1,0,"])
def test_malformed_up_is_an_error(tmp_path: Path, up: str) -> None:
    """A malformed --up ended in a traceback after the recording was opened."""
    with (
        open_recording(in_frames(tmp_path / "a.mcap", ("map", "camera"))) as recording,
        pytest.raises(ConfigError, match=f"--up {up}: expected auto, tf, imu, or a vector"),
    ):
        PoseFinder.of(recording, up=up, fixed_frame=None)


def test_damaged_imu_message_is_skipped_and_reported(tmp_path: Path) -> None:
    """One damaged message must not end the run; other types on the topic are ignored."""
    kind = "sensor_msgs/msg/Imu"
    items = [
        ("/imu", EPOCH, imu(EPOCH, (0, -9.7, 0), "camera")),
        ("/imu", EPOCH + 1, (kind, b"\0\1\0\0" + bytes(7))),
        ("/imu", EPOCH + 2, make("std_msgs/msg/String", "reset")),
        ("/imu", EPOCH + 3, imu(EPOCH + 3, (0, np.nan, 0), "camera")),
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        found = PoseFinder.of(recording, up="imu", fixed_frame=None).orient(frame(EPOCH))
        warnings = recording.warnings

    assert found.up is not None
    assert found.up.tolist() == [0, -1, 0]
    assert len(warnings) == 1
    assert warnings[0].startswith(f"skipped an IMU message: /imu: cannot decode {kind}")


@pytest.mark.parametrize(
    "changes",
    [
        {"header": {"stamp": {"sec": 10**400, "nanosec": 0}, "frame_id": "camera"}},
        {"header": {"stamp": {"sec": 1, "nanosec": 0}}},
        {"linear_acceleration": {"x": 10**400, "y": 0, "z": 0}},
    ],
)
def test_absurd_imu_message_is_skipped_and_reported(tmp_path: Path, changes: Any) -> None:
    """JSON has no types: an integer may have any size, and a field may be missing."""
    name, good = (
        "sensor_msgs/msg/Imu",
        {
            "header": {"stamp": {"sec": EPOCH // SECOND, "nanosec": 0}, "frame_id": "camera"},
            "linear_acceleration": {"x": 0.0, "y": -9.7, "z": 0.0},
            "linear_acceleration_covariance": [0.0] * 9,
        },
    )
    path = tmp_path / "a.mcap"
    with mcap_writer(path) as writer:
        schema = writer.register_schema(name, "jsonschema", b"{}")
        channel = writer.register_channel("/imu", "json", schema)
        for k, content in enumerate((good, good | changes)):
            writer.add_message(channel, EPOCH + k, json.dumps(content).encode(), EPOCH + k)

    with open_recording(path) as recording:
        found = PoseFinder.of(recording, up="imu", fixed_frame=None).orient(frame(EPOCH))

        assert recording.warnings == [
            "skipped an IMU message: /imu: message does not match its type"
        ]
    assert found.up is not None
    assert found.up.tolist() == [0, -1, 0]
