"""Tests of reading transforms and accelerations near the frames instead of all at once."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from shapecat.errors import ConfigError
from shapecat.recordings import Message, Recording, open_recording, read_transforms
from shapecat.recordings.look_ahead import AROUND_NS
from shapecat.recordings.transforms.buffer import TransformError, fixed_frame
from shapecat.recordings.transforms.gravity import PoseFinder
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Frame, Pose
from tests import messages as ros
from tests.messages import EPOCH, SECOND
from tests.odd_recordings import write_all
from tests.scenes import serialized
from tests.test_gravity import imu

TURN = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
SECONDS = 90
Items = list[tuple[str, int, Any]]


def moving(make: MessageFactory, *, every: int = 1, late: int = 30) -> Items:
    """Return the transforms of a robot that is localised only after ``late`` seconds."""
    items: Items = []
    for k in range(0, SECONDS, every):
        stamp = EPOCH + k * SECOND
        links = [("odom", "base", Pose(np.eye(3), np.array([0.1 * k, 0.0, 0.02 * k * k])))]
        if k >= late:
            links.append(("map", "odom", Pose(TURN, np.array([3.0, 0.0, 0.5 * k]))))
        items.append(("/tf", stamp, make.transforms(links, stamp)))
    fixed = [("base", "camera", Pose(TURN, np.array([0.0, 0.3, 1.2])))]
    items.append(("/tf_static", EPOCH + 70 * SECOND, make.transforms(fixed, EPOCH)))
    return sorted(items, key=lambda item: item[1])


def in_mcap(path: Path, *, late: int = 30) -> Path:
    return ros.write(path / "a.mcap", moving(MessageFactory(2), late=late), chunk_size=300)


def in_bag(path: Path) -> Path:
    make = MessageFactory(1)
    writer = BagWriter(path / "a.bag")
    writer.chunk_threshold = 300
    write_all(writer, serialized(moving(make), make), make.typestore)
    return path / "a.bag"


def in_database(path: Path) -> Path:
    make = MessageFactory(2)
    writer = FolderWriter(path / "a", version=9, storage_plugin=StoragePlugin.SQLITE3)
    write_all(writer, serialized(moving(make), make), make.typestore)
    return path / "a"


def lookup_at(window: TransformWindow, second: float) -> Any:
    stamp = EPOCH + int(second * SECOND)
    try:
        return window.around(stamp, stamp).lookup("map", "camera", stamp)
    except TransformError:
        return None


@pytest.mark.parametrize("write", [in_mcap, in_bag, in_database])
def test_windowed_transforms_equal_those_of_full_read(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    """Frames are read from the same file in between, which must not disturb the transforms."""
    with open_recording(write(tmp_path)) as recording:
        whole = TransformWindow(read_transforms(recording))
        window = TransformWindow.of(recording)
        others = recording.messages()
        for second in np.arange(0, SECONDS, 1.1):
            expected, found = lookup_at(whole, second), lookup_at(window, second)
            next(others, None)
            assert (expected is None) == (found is None)
            if expected is not None:
                np.testing.assert_array_equal(found.translation, expected.translation)
                np.testing.assert_array_equal(found.rotation, expected.rotation)
        assert next(others, None) is not None


@pytest.mark.parametrize("late", [30, SECONDS - 2])
def test_fixed_frame_may_appear_late(tmp_path: Path, late: int) -> None:
    """Localisation may start long after the recording does, and yet all tracks are in the map."""
    with open_recording(in_mcap(tmp_path, late=late)) as recording:
        window = TransformWindow.of(recording)

        assert fixed_frame(window.tree, "camera") == "map"
        assert "map" not in window.around(EPOCH, EPOCH).frames


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """Count the messages that are decoded, by topic."""
    counts: Counter[str] = Counter()
    original = Recording.decode

    def decode(recording: Recording, message: Message) -> Any:
        counts[message.topic] += 1
        return original(recording, message)

    monkeypatch.setattr(Recording, "decode", decode)
    return counts


def test_first_frame_reads_only_seconds_of_transforms(
    tmp_path: Path, decoded: Counter[str]
) -> None:
    """Reading all transforms would delay the first frame, also with --start."""
    around = AROUND_NS // SECOND
    with open_recording(in_mcap(tmp_path)) as recording:
        window = TransformWindow.of(recording)
        lookup_at(window, 0)
        assert decoded["/tf"] <= 2 * around + 4
        decoded.clear()
        assert lookup_at(window, 60) is not None
        assert decoded["/tf"] <= 2 * around + 4


def test_kept_transforms_do_not_grow_with_recording(tmp_path: Path) -> None:
    """Thirty joints at 50 Hz are 400 MB an hour."""
    with open_recording(in_mcap(tmp_path)) as recording:
        window = TransformWindow.of(recording)
        kept = []
        for second in range(SECONDS):
            lookup_at(window, second)
            kept.append(len(window.known._tracks["base"].stamps))

    assert max(kept) <= 5 * AROUND_NS // SECOND
    assert kept[-1] < SECONDS // 2


def test_wrong_frame_stamp_discards_no_transforms(tmp_path: Path) -> None:
    """A driver may send one stamp far in the future."""
    with open_recording(in_mcap(tmp_path)) as recording:
        window = TransformWindow.of(recording)
        assert lookup_at(window, 50) is not None
        stamp = EPOCH + 51 * SECOND
        window.around(stamp, stamp + 10**6 * SECOND)
        assert lookup_at(window, 51.5) is not None


def test_frames_of_two_sensors_may_be_out_of_order(tmp_path: Path) -> None:
    """One driver may send its images later than the other."""
    with open_recording(in_mcap(tmp_path)) as recording:
        window = TransformWindow.of(recording)
        assert all(lookup_at(window, second) is not None for second in (40, 55, 60, 46, 61, 48))


def test_transforms_logged_far_from_their_stamps_are_read(tmp_path: Path) -> None:
    """A converter may write all transforms first, even those that only the last frame needs."""
    items = [(topic, EPOCH + k, message) for k, (topic, _, message) in enumerate(moving_items())]
    items.append(("/end", EPOCH + SECONDS * SECOND, ros.make("std_msgs/msg/String", "")))
    with open_recording(ros.write(tmp_path / "a.mcap", items)) as recording:
        window = TransformWindow.of(recording)
        assert all(lookup_at(window, second) is not None for second in (40, 60, 80, 41))


def moving_items() -> Iterator[tuple[str, int, Any]]:
    yield from moving(MessageFactory(2))


def frame(second: int) -> Frame:
    stamp = EPOCH + second * SECOND
    return Frame("/points", 0, stamp, stamp, "camera", points=np.zeros((1, 3)))


@pytest.mark.parametrize("first", [0, 40])
def test_imu_is_read_only_as_far_as_frames_need(
    tmp_path: Path, decoded: Counter[str], first: int
) -> None:
    """The IMU may be switched on late; at 400 Hz, hours of it would delay the first frame."""
    ups = {k: (np.sin(0.1 * k), -np.cos(0.1 * k), 0.0) for k in range(first, SECONDS)}
    items = [
        ("/imu", EPOCH + k * SECOND, imu(EPOCH + k * SECOND, up, "camera")) for k, up in ups.items()
    ]
    items.append(("/begin", EPOCH, ros.make("std_msgs/msg/String", "")))
    path = ros.write(tmp_path / "a.mcap", sorted(items, key=lambda item: item[1]), chunk_size=600)
    with open_recording(path) as recording:
        poses = PoseFinder.of(recording, up="auto", fixed_frame=None)
        assert decoded["/imu"] == 0  # not before a frame needs it
        for second in range(SECONDS):
            up = poses.orient(frame(second)).up
            assert decoded["/imu"] <= second + 2 * AROUND_NS // SECOND + 2
            if second >= first:
                assert up is not None
                assert np.allclose(up, ups[second], atol=1e-6)
            else:
                assert up is None
        assert poses.accelerometers is not None
        (accelerometer,) = poses.accelerometers.around(*2 * [EPOCH + (SECONDS - 1) * SECOND])
        assert len(accelerometer._sums) < SECONDS // 2
        assert PoseFinder.of(recording, up="imu", fixed_frame=None).orient(frame(60)).up is not None


def test_imu_without_accelerations_is_refused(tmp_path: Path) -> None:
    """A gyroscope alone gives no up direction."""
    items = [
        ("/imu", EPOCH + k * SECOND, imu(EPOCH + k * SECOND, [0, 0, 0])) for k in range(SECONDS)
    ]
    with (
        open_recording(ros.write(tmp_path / "a.mcap", items)) as recording,
        pytest.raises(ConfigError, match="no sensor_msgs/Imu with accelerations"),
    ):
        PoseFinder.of(recording, up="imu", fixed_frame=None)
