"""Tests of transforms: the correct pose, or an error that names the missing link."""

import tracemalloc
from bisect import bisect_right
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pytransform3d.rotations import quaternion_slerp
from pytransform3d.transform_manager import TransformManager
from pytransform3d.transformations import transform_from_pq
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shapecat.geometry import quaternion_from_rotation
from shapecat.recordings import TransformBuffer, fixed_frame, open_recording, read_transforms
from shapecat.recordings.transforms.buffer import (
    ExtrapolationError,
    GapError,
    TransformError,
    TransformLoopError,
)
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Pose
from tests.mcap_files import mcap_writer
from tests.messages import write

IDENTITY = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
SECOND = 10**9
EPOCH = 1_700_000_000 * SECOND


def moved(x: float, turn: float = 0.0) -> Any:
    return (x, 0.0, 0.0), (0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))


@given(seed=st.integers(0, 1000), share=st.floats(0, 1))
@settings(deadline=None, max_examples=20)
def test_chain_over_time_agrees_with_pytransform3d(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    buffer, oracle = TransformBuffer(), TransformManager()
    stamps = [0, 10, 25, 40]
    time = round(share * 40)
    at = min(bisect_right(stamps, time), 3)
    part = (time - stamps[at - 1]) / (stamps[at] - stamps[at - 1])
    for parent, child in (("map", "odom"), ("odom", "base"), ("base", "camera"), ("base", "arm")):
        quaternions = rng.normal(size=(4, 4))
        quaternions /= np.linalg.norm(quaternions, axis=1)[:, None]
        translations = rng.normal(size=(4, 3))
        for stamp, t, q in zip(stamps, translations, quaternions, strict=True):
            buffer.add(parent, child, stamp, (t, q), static=False)
        wxyz = quaternions[:, [3, 0, 1, 2]]
        turn = quaternion_slerp(wxyz[at - 1], wxyz[at], part, shortest_path=True)
        move = (1 - part) * translations[at - 1] + part * translations[at]
        oracle.add_transform(child, parent, transform_from_pq(np.hstack([move, turn])))

    pose = buffer.lookup("arm", "camera", time)

    expected = oracle.get_transform("camera", "arm")
    np.testing.assert_allclose(pose.rotation, expected[:3, :3], atol=1e-6)
    np.testing.assert_allclose(pose.translation, expected[:3, 3], atol=1e-6)


def test_order_of_arrival_and_repeated_poses_do_not_matter() -> None:
    """Bags hold transforms out of order, and a robot at rest repeats them for hours."""
    buffer = TransformBuffer()
    for stamp, x in ((40, 4.0), (0, 1.0), (10, 1.0), (20, 1.0), (30, 1.0), (50, 4.0), (60, 4.0)):
        buffer.add("map", "base", stamp, moved(x), static=False)

    read = [buffer.lookup("map", "base", t).translation[0] for t in (0, 15, 30, 35, 40, 45, 60)]

    assert read == pytest.approx([1, 1, 1, 2.5, 4, 4, 4])


def test_lookup_resolves_nanoseconds() -> None:
    """Seconds since 1970 in a double resolve only 238 ns."""
    buffer = TransformBuffer()
    buffer.add("map", "base", EPOCH, moved(0.0), static=False)
    buffer.add("map", "base", EPOCH + 100, moved(1.0), static=False)

    assert buffer.lookup("map", "base", EPOCH + 25).translation[0] == pytest.approx(0.25)


def test_interpolation_takes_shorter_rotation() -> None:
    buffer = TransformBuffer()
    buffer.add("map", "base", 0, ((0, 0, 0), (0, 0, 0, 1)), static=False)
    buffer.add("map", "base", 10, ((0, 0, 0), (0, 0, -np.sin(0.2), -np.cos(0.2))), static=False)

    half = quaternion_from_rotation(buffer.lookup("map", "base", 5).rotation)

    np.testing.assert_allclose(half, [0, 0, np.sin(0.1), np.cos(0.1)], atol=1e-9)


def test_static_transform_is_valid_at_all_times() -> None:
    buffer = TransformBuffer()
    buffer.add("base", "camera", EPOCH, moved(2.0), static=True)

    assert buffer.lookup("/base", "/camera", 0).translation[0] == 2.0


@pytest.mark.parametrize("first", ["static", "moving"])
def test_static_transform_does_not_hide_a_moving_one(first: str) -> None:
    """Localization replaces the placeholder of a launch file, as in tf2."""
    buffer = TransformBuffer()
    for kind in (first, "static", "moving"):
        if kind == "static":
            buffer.add("map", "odom", 0, moved(9.0), static=True)
        else:
            for k in (1, 2):
                buffer.add("world", "odom", k * SECOND, moved(float(k)), static=False)
    buffer.add("odom", "camera", 0, IDENTITY, static=True)

    assert buffer.root_of("camera") == "world"
    assert buffer.lookup("world", "camera", SECOND * 3 // 2).translation[0] == 1.5
    assert buffer.lookup("map", "camera", 0).translation[0] == 9.0
    assert buffer.lookup("map", "camera", 9 * SECOND).translation[0] == 9.0


def test_extrapolation_beyond_tolerance_is_an_error() -> None:
    buffer = TransformBuffer()
    buffer.add("map", "base", 1_000_000_000, moved(1.0), static=False)
    buffer.add("map", "base", 2_000_000_000, moved(2.0), static=False)

    assert buffer.lookup("map", "base", 900_000_000).translation[0] == 1.0
    assert buffer.lookup("map", "base", 2_100_000_000).translation[0] == 2.0
    with pytest.raises(ExtrapolationError, match=r"base at 899999999 ns.* before the first"):
        buffer.lookup("map", "base", 899_999_999)
    with pytest.raises(ExtrapolationError, match="after the last"):
        buffer.lookup("map", "base", 2_100_000_001)


def published(
    times_ms: Iterable[int], pose: Callable[[int], Any], *, static: bool = False
) -> TransformBuffer:
    """Return the transforms of ``base`` in ``map`` at some times after ``EPOCH``."""
    buffer = TransformBuffer()
    if static:
        buffer.add("map", "base", 0, moved(9.0), static=True)
    for time in times_ms:
        buffer.add("map", "base", EPOCH + time * 10**6, pose(time), static=False)
    return buffer


@pytest.mark.parametrize("static", [False, True])
def test_transform_is_unknown_within_a_gap(static: bool) -> None:
    """Poses interpolated over 3 s were wrong by 10 cm; a static placeholder is wrong as well."""
    buffer = published(
        [*range(0, 301, 100), *range(1700, 2200, 100)], lambda t: moved(t * 1e-4), static=static
    )
    known = buffer.lookup("map", "base", EPOCH + 1600 * 10**6)

    assert known.translation[0] == pytest.approx(0.16)
    assert buffer.lookup("map", "base", EPOCH + 400 * 10**6).translation[0] == pytest.approx(0.04)
    for time_ms in (401, 1000, 1599):
        with pytest.raises(GapError, match=r"base at 17\d+ ns: that is within a gap of 1.400 s"):
            buffer.lookup("map", "base", EPOCH + time_ms * 10**6)


@pytest.mark.parametrize("missing", [1, 2, 3])
@pytest.mark.parametrize("interval_ms", [20, 400, 1000])
def test_gap_is_longer_than_the_usual_interval(interval_ms: int, missing: int) -> None:
    """Localization may publish once per second: then a second without it is no gap."""
    times = [k * interval_ms for k in range(20) if not 10 <= k < 10 + missing]
    buffer = published(times, lambda t: moved(t * 1e-3))
    gap_ms = (missing + 1) * interval_ms
    within = EPOCH + (9 * interval_ms + gap_ms // 2) * 10**6

    if missing == 3 and gap_ms > 500:
        with pytest.raises(GapError):
            buffer.lookup("map", "base", within)
    else:
        x = buffer.lookup("map", "base", within).translation[0]
        assert x == pytest.approx((9 * interval_ms + gap_ms / 2) * 1e-3)


@pytest.mark.parametrize(
    ("pose", "known"),
    [
        (moved(1.0), True),
        (moved(1.018), True),
        (moved(1.022), False),
        (moved(1.0, 0.015), True),
        (moved(1.0, 0.019), False),
    ],
)
def test_gap_without_motion_is_bridged(pose: Any, known: bool) -> None:
    """A robot at rest loses nothing, though its encoders are noisy."""
    times = [*range(0, 1000, 100), *range(3000, 4000, 100)]
    buffer = published(times, lambda t: pose if t >= 3000 else moved(1.0))

    if known:
        x = buffer.lookup("map", "base", EPOCH + 2 * SECOND).translation[0]
        assert x == pytest.approx(1.0, abs=0.02)
    else:
        with pytest.raises(GapError):
            buffer.lookup("map", "base", EPOCH + 2 * SECOND)


def test_equal_transforms_count_in_the_usual_interval() -> None:
    """Otherwise a robot at rest, whose equal samples are dropped, would seem to publish rarely."""
    times = [*range(0, 3000, 100), *range(5000, 8000, 100)]
    buffer = published(times, lambda t: moved(float(t >= 5000)))

    with pytest.raises(GapError):
        buffer.lookup("map", "base", EPOCH + 4 * SECOND)


def test_frame_that_changes_its_parent_in_a_gap_is_unknown_there() -> None:
    buffer = published(range(0, 1000, 100), lambda _: moved(1.0))
    for time in range(3000, 4000, 100):
        buffer.add("odom", "base", EPOCH + time * 10**6, moved(1.0), static=False)

    with pytest.raises(GapError):
        buffer.lookup("map", "base", EPOCH + 2 * SECOND)


def test_lookup_errors_name_missing_link() -> None:
    buffer = TransformBuffer()
    buffer.add("a", "b", 0, IDENTITY, static=True)
    buffer.add("c", "d", 0, IDENTITY, static=True)
    buffer.add("b", "g", 0, IDENTITY, static=True)
    buffer.add("d", "h", 0, IDENTITY, static=True)
    buffer.add("f", "e", 0, IDENTITY, static=True)
    buffer.add("e", "f", 0, IDENTITY, static=True)

    with pytest.raises(TransformError, match="'x'; known frames: a, b, c, d"):
        buffer.lookup("a", "x", 0)
    with pytest.raises(TransformError, match="between b and d: their roots are a and c"):
        buffer.lookup("b", "d", 0)
    with pytest.raises(TransformError, match="between g and h: their roots are a and c"):
        buffer.lookup("g", "h", 0)
    with pytest.raises(TransformLoopError, match="loop"):
        buffer.lookup("e", "a", 0)
    assert fixed_frame(buffer, "e") is None
    assert buffer.root_of("b") == "a"


def test_frame_may_change_its_parent() -> None:
    """An object that a robot picks up moves from the table to the gripper."""
    buffer = TransformBuffer()
    buffer.add("world", "gripper", 0, moved(5.0), static=True)
    buffer.add("world", "cup", 0, moved(1.0), static=False)
    buffer.add("gripper", "cup", 100, moved(0.5), static=False)

    assert buffer.lookup("world", "cup", 50).translation[0] == 1.0
    assert buffer.lookup("world", "cup", 100).translation[0] == 5.5


def test_each_transform_takes_little_memory() -> None:
    """A hundred per second, for ten joints and ten hours, are 36 million transforms."""
    buffer = TransformBuffer()
    tracemalloc.start()
    try:
        for k in range(6_000):
            parent = f"body{k // 3_000}"  # another string each time
            assert buffer.add(parent, "arm", EPOCH + k * SECOND, moved(k * 1e-3), static=False)
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 100 * 6_000
    middle = buffer.lookup("body1", "arm", EPOCH + 4_500 * SECOND + SECOND // 2)
    assert middle.translation == pytest.approx([4.5005, 0, 0])


@pytest.mark.parametrize(
    "bad",
    [
        ((np.nan, 0, 0), (0, 0, 0, 1)),
        ((0, -1e30, 0), (0, 0, 0, 1)),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (np.inf, 0, 0, 1)),
    ],
)
def test_invalid_transform_is_refused(bad: Any) -> None:
    buffer = TransformBuffer()

    assert not buffer.add("a", "b", 0, bad, static=False)
    assert not buffer.add("a", "a", 0, IDENTITY, static=False)
    assert not buffer.add("", "a", 0, IDENTITY, static=False)
    assert buffer.frames == ()


@pytest.mark.parametrize(
    ("chain", "expected"),
    [
        (["earth", "map", "odom", "base", "camera"], "map"),
        (["odom", "base", "camera"], "odom"),
        (["world", "odom", "camera"], "odom"),
        (["robot/map", "base", "camera"], "robot/map"),
        (["earth", "robot/odom", "base", "camera"], "robot/odom"),
        (["base", "camera"], "base"),
        (["camera", "lens"], None),
    ],
)
def test_fixed_frame_follows_naming_convention(chain: list[str], expected: str | None) -> None:
    buffer = TransformBuffer()
    for parent, child in pairwise(chain):
        buffer.add(parent, child, 0, IDENTITY, static=True)

    assert fixed_frame(buffer, "camera") == expected
    assert fixed_frame(buffer, "stranger") is None


@pytest.mark.parametrize(
    ("root", "sensor", "expected"),
    [
        ("world", "r1/camera", "r1/odom"),
        ("world", "r2/camera", "r2/odom"),
        ("world", "r3/camera", "world"),
        ("map", "r2/camera", "map"),
    ],
)
def test_fixed_frame_is_not_that_of_another_robot(root: str, sensor: str, expected: str) -> None:
    """The corrections of the other robot's pose would move the tracks of this one."""
    buffer = TransformBuffer()
    for robot, odom in (("r1", "odom"), ("r2", "odom"), ("r3", "base_link")):
        buffer.add(root, f"{robot}/{odom}", 0, IDENTITY, static=True)
        buffer.add(f"{robot}/{odom}", f"{robot}/camera", 0, IDENTITY, static=True)

    assert fixed_frame(buffer, sensor) == expected


def transform(store: Any, parent: str, child: str, stamp: int, x: float) -> Any:
    types = store.types
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp, SECOND))
    values = (
        (0, time, parent)
        if "seq" in types["std_msgs/msg/Header"].__annotations__
        else (time, parent)
    )
    return types["geometry_msgs/msg/TransformStamped"](
        types["std_msgs/msg/Header"](*values),
        child,
        types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](x, 0, 0),
            types["geometry_msgs/msg/Quaternion"](0, 0, 0, 1),
        ),
    )


def test_transforms_of_ros2_recording_are_read(tmp_path: Path) -> None:
    store, kind = get_typestore(Stores.ROS2_HUMBLE), "tf2_msgs/msg/TFMessage"
    path = tmp_path / "a.mcap"
    with mcap_writer(path) as writer:
        text = store.generate_msgdef(kind, ros_version=2)[0].encode()
        schema = writer.register_schema(kind, "ros2msg", text)
        fixed, moving = (writer.register_channel(t, "cdr", schema) for t in ("/tf_static", "/tf"))
        for k in range(3):
            item = transform(store, "odom", "base", EPOCH + k * SECOND, float(k))
            data = store.serialize_cdr(store.types[kind]([item]), kind)
            writer.add_message(moving, k, bytes(data), k)
        item = transform(store, "base", "camera", 0, 10.0)
        data = store.serialize_cdr(store.types[kind]([item]), kind)
        writer.add_message(moving, 3, b"\0\1\0\0rubbish", 3)
        writer.add_message(fixed, 4, bytes(data), 4)

    with open_recording(path) as recording:
        buffer = read_transforms(recording)
        assert recording.warnings[0].startswith("skipped transforms: /tf: cannot decode")

    assert buffer.lookup("odom", "camera", EPOCH + SECOND // 2).translation[0] == 10.5


def test_transforms_of_old_ros1_recording_are_read(tmp_path: Path) -> None:
    """ROS 1 recorded tf/tfMessage before tf2."""
    store, kind = get_typestore(Stores.ROS1_NOETIC), "tf/msg/tfMessage"
    store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    path = tmp_path / "a.bag"
    with BagWriter(path) as writer:
        connection = writer.add_connection("/tf", kind, typestore=store)
        item = transform(store, "/map", "/camera", EPOCH, 3.0)
        writer.write(connection, EPOCH, store.serialize_ros1(store.types[kind]([item]), kind))

    with open_recording(path) as recording:
        buffer = read_transforms(recording)

    assert buffer.lookup("map", "camera", EPOCH).translation[0] == 3.0


def stamped(parent: str, child: str, x: float, stamp: int) -> Any:
    pose = Pose(np.eye(3), np.array([x, 0.0, 0.0]))
    return MessageFactory(2).transforms([(parent, child, pose)], stamp)


def test_static_transforms_of_a_namespace_hold_at_all_times(tmp_path: Path) -> None:
    """Read as moving transforms, they were valid only near their stamps: frames had no pose."""
    items = [("/robot1/tf_static", EPOCH, stamped("base", "camera", 0.3, EPOCH))]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        buffer = read_transforms(recording)

    assert buffer.lookup("base", "camera", EPOCH + 60 * SECOND).translation[0] == 0.3


@pytest.mark.parametrize(
    ("moving", "near", "expected", "warned"),
    [
        ({"/r1": 1.0, "/r2": 2.0}, "/r1/camera/image", 1.0, "/r2/tf are ignored"),
        ({"/r1": 1.0, "/r2": 2.0}, "r2/camera/image", 2.0, "/r1/tf are ignored"),
        ({"/r1": 1.0, "/r11": 2.0}, "/r11/camera/image", 2.0, "/r1/tf are ignored"),
        ({"/r1": 1.0, "/r2": 1.0}, "/camera/image", 1.0, "on /r1/tf and /r2/tf have frames of"),
        ({"/r1": 1.0, "/r2": 1.0}, "/r11/camera/image", 1.0, "on /r1/tf and /r2/tf have frames of"),
        ({"": 1.0, "/r2": 1.0}, "/r2/camera/image", 1.0, ""),
    ],
)
def test_transforms_of_other_robots_are_left_out(
    tmp_path: Path, moving: dict[str, float], near: str, expected: float, warned: str
) -> None:
    """Robots with their own namespaces use the same names of frames, in different places."""
    items = [
        (f"{space}/tf", EPOCH + k, stamped("odom", "base", x, EPOCH))
        for k, (space, x) in enumerate(moving.items())
    ]
    items.append(("/mocap/tf", EPOCH, stamped("map", "odom", 10.0, EPOCH)))
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        buffer = read_transforms(recording, sensor_topics=[near])

        assert buffer.lookup("map", "base", EPOCH).translation[0] == 10 + expected
        assert warned in "".join(recording.warnings)
        assert len(recording.warnings) == (warned != "")


def test_mixed_up_poses_of_two_robots_are_reported(tmp_path: Path) -> None:
    """Objects of both robots were placed by the poses of one; the warning did not say so."""
    items = [(f"/r{k}/tf", EPOCH + k, stamped("odom", "base", k, EPOCH)) for k in (1, 2)]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        read_transforms(recording, sensor_topics=["/r1/camera/image", "/r2/camera/image"])
        (warning,) = recording.warnings

    assert "of one robot are used for the other: process one at a time" in warning


def test_transforms_without_stamps_use_log_times(tmp_path: Path) -> None:
    """Images without stamps use log times, too; otherwise they would find no transform.

    The poses of other images are late, which nothing said.
    """
    items = [("/tf", EPOCH + k * SECOND, stamped("odom", "base", float(k), 0)) for k in range(3)]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        buffer = read_transforms(recording)
        (warning,) = recording.warnings

    assert buffer.lookup("odom", "base", EPOCH + SECOND // 2).translation[0] == 0.5
    assert warning == (
        "/tf: transforms have no stamps: their log times, which are later, replace them"
    )


@pytest.mark.parametrize("clock", [0, 3 * SECOND])
def test_missing_stamps_of_transforms_are_in_the_clock_of_the_others(
    clock: int, tmp_path: Path
) -> None:
    """A simulation begins at 0, and its first pose was taken for one at the log time.

    That may be the time of the simulation (``clock`` is 0), or not.
    """
    items = [
        ("/tf", clock + stamp, stamped("odom", "base", x, stamp))
        for x, stamp in ((1.0, 0), (2.0, SECOND // 10))
    ]
    items.insert(0, ("/tf", clock, stamped("odom", "lidar", 7.0, 0)))
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        buffer = read_transforms(recording)
        assert not recording.warnings

    assert buffer.lookup("odom", "base", SECOND // 20).translation[0] == 1.5
    assert buffer.lookup("odom", "lidar", 0).translation[0] == 7.0


def test_invalid_transforms_are_skipped_and_reported(tmp_path: Path) -> None:
    """A driver without a fix publishes NaN; the pose before it stays valid."""
    items = [
        ("/tf", EPOCH, stamped("odom", "base", 1.5, EPOCH)),
        ("/tf", EPOCH + 1, stamped("odom", "base", np.nan, EPOCH + 1)),
        ("/tf", EPOCH + 2, stamped("odom", "", 2.5, EPOCH + 2)),
    ]
    with open_recording(write(tmp_path / "valid.mcap", items[:1])) as recording:
        read_transforms(recording)

        assert recording.warnings == []
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        buffer = read_transforms(recording)

        assert recording.warnings == ["skipped invalid transforms (NaN, no name)"]
    assert buffer.lookup("odom", "base", EPOCH).translation[0] == 1.5
