"""Tests of frames: every layout of a cloud or depth image gives the same, correct coordinates."""

import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from shapecat.errors import NoStreamError
from shapecat.recordings import (
    FrameRange,
    MessageError,
    choose_streams,
    depth_streams,
    frames,
    open_recording,
    read_transforms,
)
from shapecat.recordings.decoding.compressed_depth import depth_of_compressed
from shapecat.recordings.decoding.pointcloud2 import cloud_points
from shapecat.recordings.messages import Message, Needed
from shapecat.recordings.pinhole import fit_pinhole, still_fits
from shapecat.recordings.sources import DepthSource
from shapecat.runs.selection import count_frames
from shapecat.types import Camera, Frame
from tests.depth_encodings import png, rvl
from tests.mcap_files import mcap_writer
from tests.messages import (
    CAMERA,
    CLOUD,
    EPOCH,
    IMAGE,
    INFO,
    SECOND,
    cloud,
    compressed,
    header,
    image,
    info,
    make,
    organized_points,
    wavy_depth,
    write,
)
from tests.scenes import record

DATA = Path(__file__).parents[2] / "shared" / "data"


def read(
    path: Path, *topics: str, needed: Needed = None, **frame_range: Any
) -> tuple[list[Frame], Counter[str], list[str]]:
    skipped: Counter[str] = Counter()
    with open_recording(path) as recording:
        chosen = choose_streams(recording, topics)
        wanted = FrameRange(**frame_range)
        result = list(frames(recording, chosen, wanted, skipped=skipped, needed=needed))
        return result, skipped, recording.warnings


@pytest.mark.parametrize("container", ["mcap", "ros1", "ros2"])
@pytest.mark.parametrize("end_s", [1e12, 1e300])
def test_end_may_be_far_after_the_end(tmp_path: Path, container: str, end_s: float) -> None:
    """In nanoseconds, 1e12 s do not fit into a database, and 1e300 s are infinite."""
    path = record(tmp_path / "lab", 3, container=container)

    assert len(read(path, end_s=end_s)[0]) == 3
    assert not read(path, start_s=end_s)[0]


def test_messages_of_another_type_on_the_topic_are_not_frames(tmp_path: Path) -> None:
    """Two nodes may publish on one topic; other messages must not change the frame numbers."""
    items = []
    for k in range(3):
        stamp = EPOCH + k * SECOND
        items += [
            ("/points", stamp, cloud(stamp, organized_points(wavy_depth()))),
            ("/points", stamp + 1, info(stamp)),
        ]
    found, skipped, _ = read(write(tmp_path / "a.mcap", items), every=2)

    assert [(frame.index, frame.stamp_ns) for frame in found] == [
        (0, EPOCH),
        (2, EPOCH + 2 * SECOND),
    ]
    assert not skipped


@pytest.mark.parametrize("latched", [False, True])
@pytest.mark.parametrize("chunk_size", [1 << 20, 25_000])  # one chunk, or one for each 5 images
def test_needed_frames_equal_those_of_full_read(
    tmp_path: Path, chunk_size: int, *, latched: bool
) -> None:
    """In an indexed file, frames that are not needed are skipped, but still counted.

    The calibration comes with each image or, if latched, only once.
    """
    items = []
    for k in range(12):
        stamp = EPOCH + k * SECOND
        if k == 0 or not latched:
            items.append(("/depth/camera_info", stamp, info(stamp)))
        depth = wavy_depth() + np.float32(0.1 * k)
        items.append(("/depth/image_rect", stamp + 1, image(stamp, depth)))
    path = write(tmp_path / "a.mcap", items, chunk_size=chunk_size)
    all_frames, _, _ = read(path)
    times = {all_frames[k].log_time_ns for k in (0, 5, 6, 11)}

    needed_frames, skipped, warnings = read(
        path, needed=lambda _, log_time_ns: log_time_ns in times
    )

    assert not skipped  # a resumed run would count the frames it leaves out as unreadable
    assert not warnings
    assert len(all_frames) == 12
    assert [frame.index for frame in needed_frames] == [0, 5, 6, 11]
    for frame in needed_frames:
        same = all_frames[frame.index]
        assert (frame.stamp_ns, frame.camera) == (same.stamp_ns, same.camera)
        np.testing.assert_array_equal(frame.depth, same.depth)


@pytest.mark.parametrize("latched", [False, True])
@pytest.mark.parametrize("damage", ["chunk", "message"])
def test_frames_after_damage_have_the_numbers_of_full_read(
    tmp_path: Path, damage: str, *, latched: bool
) -> None:
    """Destroyed messages count in the frame numbers, even if only the index lists them.

    Otherwise a review, a report or a run of every n-th frame would show the wrong frames.
    """
    items: list[tuple[str, int, Any]] = []
    for k in range(20):
        stamp = EPOCH + k * SECOND
        if k == 0 or not latched:
            items.append(("/depth/camera_info", stamp, info(stamp)))
        depth: Any = image(stamp, wavy_depth() + np.float32(0.1 * k))
        if damage == "message" and k in {6, 7}:
            depth = (IMAGE, b"\x28\xb5\x2f\xfd" + bytes(9))  # compressed by rosbag2, and cut
        items.append(("/depth/image_rect", stamp + 1, depth))
    path = write(tmp_path / "a.mcap", items, chunk_size=25_000)
    if damage == "chunk":
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        second = sorted(summary.chunk_indexes, key=lambda chunk: chunk.message_start_time)[1]
        data = bytearray(path.read_bytes())
        data[second.chunk_start_offset + second.chunk_length // 2] ^= 0xFF
        path.write_bytes(data)

    every_2nd, skipped, warnings = read(path, every=2)
    times = {frame.log_time_ns for frame in every_2nd[-4::3]}
    again, *_ = read(path, every=2, needed=lambda _, log_time_ns: log_time_ns in times)

    numbers = [(frame.index, (frame.log_time_ns - EPOCH) // SECOND) for frame in every_2nd]
    assert all(number == second for number, second in numbers)
    lost = set(range(0, 20, 2)) - {number for number, _ in numbers}
    assert lost
    assert max(lost) < every_2nd[-4].index
    assert skipped == {"cannot decode sensor_msgs/msg/Image: it has no data": len(lost)}
    assert ["damaged" in warning for warning in warnings] == [True]
    assert [(frame.index, frame.stamp_ns) for frame in again] == [
        (frame.index, frame.stamp_ns) for frame in every_2nd[-4::3]
    ]


def test_depth_image_and_organized_cloud_give_same_frame(tmp_path: Path) -> None:
    """Objects must not depend on whether depth images or clouds were recorded."""
    depth = wavy_depth()
    items = [
        ("/cam/depth/camera_info", 0, info(EPOCH)),
        ("/cam/depth/image_rect", 1, image(EPOCH, depth)),
        ("/other/points", 2, cloud(EPOCH, organized_points(depth))),
    ]
    path = write(tmp_path / "a.mcap", items)

    (first,), _, _ = read(path, "/cam/depth/image_rect")
    (second,), _, _ = read(path, "/other/points")
    assert first.camera == CAMERA
    assert first.depth is not None
    assert second.depth is not None
    assert second.camera is not None
    np.testing.assert_allclose(first.depth, second.depth, atol=2e-7)
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(getattr(second.camera, name) - getattr(CAMERA, name)) < 0.01


def test_fitted_intrinsics_change_only_with_camera(tmp_path: Path) -> None:
    """Noise must not change the intrinsics; another camera must."""
    rng = np.random.default_rng(0)
    clean = organized_points(wavy_depth())
    noisy = [clean + rng.normal(0, 1e-5, clean.shape) for _ in range(4)]
    other = Camera(64, 48, 62.0, 61.0, 31.2, 23.7)
    noisy.append(organized_points(wavy_depth(), other))
    items = [("/points", k, cloud(EPOCH + k, points)) for k, points in enumerate(noisy)]

    read_frames, _, _ = read(write(tmp_path / "a.mcap", items))

    cameras = [frame.camera for frame in read_frames]
    assert cameras[0] == cameras[1] == cameras[2] == cameras[3]
    assert cameras[4] is not None
    assert abs(cameras[4].fx - 62.0) < 0.01


def test_earlier_camera_is_not_used_for_points_that_do_not_fit(tmp_path: Path) -> None:
    """Converted to depth with another cloud's camera, the points would be wrong."""
    fitting = organized_points(wavy_depth())
    other = np.random.default_rng(0).normal(0, 1, fitting.shape).astype(np.float32)
    items = [("/points", k, cloud(EPOCH + k, p)) for k, p in enumerate((fitting, other, fitting))]

    (first, unfitting, last), _, _ = read(write(tmp_path / "a.mcap", items))

    assert unfitting.points is not None
    np.testing.assert_array_equal(unfitting.points, other.reshape(-1, 3))
    assert first.organized
    assert last.camera == first.camera


@given(
    fx=st.floats(20, 2000),
    ratio=st.floats(0.8, 1.25),
    cx=st.floats(10, 50),
    cy=st.floats(10, 40),
    outliers=st.integers(0, 60),
    seed=st.integers(0, 99),
)
@settings(deadline=None, max_examples=25)
def test_pinhole_fit_recovers_any_camera(
    fx: float, ratio: float, cx: float, cy: float, outliers: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    camera = Camera(64, 48, fx, fx * ratio, cx, cy)
    points = organized_points(rng.integers(0, 3000, (48, 64)).astype(np.uint16), camera)
    flat = points.reshape(-1, 3)
    flat[rng.choice(len(flat), outliers, replace=False)] += 0.3

    fit = fit_pinhole(points)

    assert fit is not None
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(getattr(fit.camera, name) - getattr(camera, name)) < 0.05
    assert still_fits(fit, points)


@pytest.mark.parametrize(
    "points",
    [
        np.full((48, 64, 3), np.nan, np.float32),
        np.random.default_rng(0).normal(0, 1, (48, 64, 3)).astype(np.float32),
        np.ones((48, 64, 3), np.float32),
    ],
    ids=["all invalid", "noise", "one point"],
)
def test_organized_cloud_that_fits_no_camera_stays_points(points: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [("/points", 0, cloud(EPOCH, points))])

    (frame,), _, _ = read(path)

    assert frame.points is not None
    np.testing.assert_array_equal(frame.points, points.reshape(-1, 3))


@pytest.mark.parametrize("kind", ["16UC1", "32FC1"])
def test_padding_behind_the_rows_of_a_depth_image_is_skipped(tmp_path: Path, kind: str) -> None:
    """Drivers that align rows to 64 bytes would give sheared objects."""
    depth = np.arange(500, 500 + 5 * 7, dtype=np.uint16).reshape(5, 7)
    values = depth if kind == "16UC1" else (depth / 1000).astype(np.float32)
    packed = image(EPOCH, values, kind)
    padded = np.full((5, 64), 7, np.uint8)
    padded[:, : values[0].nbytes] = values.view(np.uint8)
    packed.step, packed.data = 64, padded.ravel()
    items = [("/camera/camera_info", EPOCH, info(EPOCH, Camera(7, 5, 9, 9, 3, 2)))]
    items += [("/camera/image_raw", EPOCH, packed)]

    (frame,), _, _ = read(write(tmp_path / "a.mcap", items))

    assert frame.depth is not None
    np.testing.assert_allclose(frame.depth, depth.astype(np.float32) / 1000)


def test_image_with_step_zero_is_read_and_frames_are_counted(tmp_path: Path) -> None:
    """A step of 0 means contiguous rows. Frames cannot be counted in advance in a time window."""
    depth = np.arange(500, 500 + 5 * 7, dtype=np.uint16).reshape(5, 7)
    packed = image(EPOCH, depth)
    packed.step = 0
    items = [("/camera/camera_info", EPOCH, info(EPOCH, Camera(7, 5, 9, 9, 3, 2)))]
    items += [("/camera/image_raw", EPOCH + k, packed) for k in range(5)]
    path = write(tmp_path / "a.mcap", items)

    (first, *_), _, _ = read(path)

    assert first.depth is not None
    np.testing.assert_allclose(first.depth, depth.astype(np.float32) / 1000)
    options: Any = {"topics": ["/camera/image_raw"], "every": 2, "start_s": None, "end_s": None}
    with open_recording(path) as recording:
        streams = choose_streams(recording)
    assert count_frames(streams, options) == 3
    assert count_frames(streams, options | {"start_s": 1.0}) is None
    assert count_frames(streams, options | {"end_s": 1.0}) is None


FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


@given(data=st.data())
@settings(deadline=None, max_examples=60)
def test_cloud_layout_does_not_change_coordinates(data: st.DataObject) -> None:
    """Padding, unaligned fields, byte order and row padding are all legal."""
    h, w = data.draw(st.integers(1, 4)), data.draw(st.integers(1, 5))
    big = data.draw(st.booleans())
    names = data.draw(st.permutations(["x", "y", "z", "intensity", "ring"]))
    offset, fields, layout = 0, [], {}
    for name in names:
        offset += data.draw(st.integers(0, 3))
        code = data.draw(st.sampled_from([7, 8] if name in "xyz" else list(FORMATS)))
        layout[name] = (offset, (">" if big else "<") + FORMATS[code])
        fields.append(make("sensor_msgs/msg/PointField", name, offset, code, 1))
        offset += np.dtype(FORMATS[code]).itemsize
    step = offset + data.draw(st.integers(0, 5))
    row = w * step + data.draw(st.integers(0, 9))
    buffer = np.frombuffer(data.draw(st.randoms()).randbytes(h * row), np.uint8).copy()
    expected = np.random.default_rng(1).normal(size=(h, w, 3)).astype(np.float32)
    for k, name in enumerate("xyz"):
        at, kind = layout[name]
        np.ndarray((h, w), kind, buffer, at, (row, step))[...] = expected[..., k]
    message = make(CLOUD, header(1), h, w, fields, big, step, row, buffer, True)  # wrongly dense

    np.testing.assert_array_equal(cloud_points(message), expected)
    message.data = buffer[: (h - 1) * row]
    with pytest.raises(MessageError, match=f"cloud of {w} x {h} points needs"):
        cloud_points(message)


def test_cloud_with_row_step_zero_is_read() -> None:
    """Some drivers leave out the row step of clouds too; the rows are then contiguous."""
    points = np.random.default_rng(2).normal(size=(2, 3, 3)).astype(np.float32)

    np.testing.assert_array_equal(cloud_points(cloud(0, points, row_step=0)), points)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 2**32 - 1, "height": 2**32 - 1}, "needs"),
        ({"point_step": 4}, "outside"),
        ({"row_step": 1}, "needs"),
        ({"fields": []}, "without fields x, y, z of a known type; fields: none"),
    ],
)
def test_inconsistent_cloud_is_refused_before_allocation(
    changes: dict[str, Any], reason: str
) -> None:
    with pytest.raises(MessageError, match=reason):
        cloud_points(cloud(0, np.zeros((2, 3, 3), np.float32), **changes))


@pytest.mark.parametrize(
    ("names", "missing"), [("XYZ", "x, y, z"), (("xyz", "y"), "x, z"), (("x", "y", "Z"), "z")]
)
def test_cloud_without_coordinates_names_missing_fields(
    tmp_path: Path, names: Sequence[str], missing: str
) -> None:
    """If the error listed only the fields present, "X, Y, Z", nothing would look wrong."""
    points = np.random.default_rng(0).normal(1, 0.1, (1, 50, 3)).astype(np.float32)
    message = cloud(EPOCH, points)
    for field, name in zip(message.fields, names, strict=False):
        field.name = name
    message.fields = message.fields[: len(names)]

    _, skipped, _ = read(write(tmp_path / "a.mcap", [("/points", 0, message)]))

    known = ", ".join(names)
    assert skipped == {f"cloud without fields {missing} of a known type; fields: {known}": 1}


def test_invalid_messages_are_skipped_and_counted(tmp_path: Path) -> None:
    good = np.random.default_rng(0).normal(1, 0.1, (1, 50, 3)).astype(np.float32)
    items = [
        ("/points", 0, cloud(EPOCH, good)),
        ("/points", 1, (CLOUD, b"\0\1\0\0rubbish")),
        ("/points", 2, cloud(EPOCH + 2, good, width=2**31)),
        ("/points", 3, cloud(EPOCH + 3, good[:, :0])),
        ("/points", 4, cloud(EPOCH + 4, good)),
    ]

    read_frames, skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert [frame.index for frame in read_frames] == [0, 4]
    assert skipped.total() == 3
    assert skipped["empty cloud"] == 1


def test_definition_without_fields_of_its_type_is_skipped(tmp_path: Path) -> None:
    """Any program may name its own type sensor_msgs/msg/Image."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path) as writer:
        for kind in (CLOUD, IMAGE, INFO, "tf2_msgs/msg/TFMessage"):
            schema = writer.register_schema(kind, "ros2msg", b"uint8 header")
            channel = writer.register_channel(f"/{kind}", "cdr", schema)
            writer.add_message(channel, 0, b"\0\1\0\0\0", 0)

    with open_recording(path) as recording:
        assert depth_streams(recording) == ()
        assert read_transforms(recording).frames == ()
        assert recording.warnings == [
            "skipped transforms: /tf2_msgs/msg/TFMessage: message does not match its type"
        ]


def test_impossible_stamps_and_log_times_are_counted(tmp_path: Path) -> None:
    """Tables hold times from 0 to 2**63 - 1 ns; other times must not end the run."""
    points = np.ones((1, 3, 3), np.float32)
    late, negative = cloud(EPOCH, points), cloud(EPOCH, points)
    negative.header.stamp.sec = -5
    items = [
        ("/points", 0, cloud(EPOCH, points)),
        ("/points", 1, negative),
        ("/points", 2**63, late),
    ]

    read_frames, skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert len(read_frames) == 1
    assert skipped.total() == 2


def test_calibration_without_size_is_that_of_the_image(tmp_path: Path) -> None:
    """Some drivers fill in K and leave width and height at 0."""
    calibration = info(EPOCH)
    calibration.width = calibration.height = 0
    items = [
        ("/depth/camera_info", 0, calibration),
        ("/depth/image", 1, image(EPOCH, wavy_depth())),
    ]

    (frame,), skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert frame.camera == CAMERA
    assert not skipped


def test_step_shorter_than_a_row_is_named(tmp_path: Path) -> None:
    """The error said that the image needs fewer bytes than it has."""
    message = image(EPOCH, wavy_depth())
    message.step = message.width
    items = [("/depth/camera_info", 0, info(EPOCH)), ("/depth/image", 1, message)]

    _, skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert dict(skipped) == {"image of 64 pixels in 16UC1 per row with a step of 64 bytes": 1}


def test_camera_of_distorted_images_is_fitted_to_their_rays(tmp_path: Path) -> None:
    """K alone, without the distortion, would be off by pixels at the border."""
    calibration = ("/depth/camera_info", 0, info(EPOCH, d=(0.12, 0, 0, 0, 0)))
    items = [calibration, ("/depth/image", 1, image(EPOCH, wavy_depth()))]

    (frame,), _, _ = read(write(tmp_path / "a.mcap", items))

    own = frame.camera
    assert own is not None
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    x, y = (u - own.cx) / own.fx, (v - own.cy) / own.fy
    radial = 1 + 0.12 * (x * x + y * y)  # distorting a ray again must lead back to its pixel
    off_u = x * radial * CAMERA.fx + CAMERA.cx - u
    off_v = y * radial * CAMERA.fy + CAMERA.cy - v
    assert np.percentile(np.hypot(off_u, off_v), 95) < 0.6


@pytest.mark.parametrize(
    ("height", "kept", "reason"),
    [
        (48, 6143, "image of 64 x 48 pixels needs 6144 bytes and has 6143"),
        (0, 6144, "image of 64 x 0 pixels needs 0 bytes and has 6144"),
    ],
)
def test_truncated_or_empty_depth_image_is_counted_with_its_size(
    tmp_path: Path, height: int, kept: int, reason: str
) -> None:
    """The size in the error tells a driver's mistake from a truncated message."""
    message = image(EPOCH, wavy_depth())
    message.height, message.data = height, message.data[:kept]
    items = [("/depth/camera_info", 0, info(EPOCH)), ("/depth/image", 1, message)]

    found, skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert not found
    assert dict(skipped) == {reason: 1}


def test_invalid_points_of_cloud_are_nan(tmp_path: Path) -> None:
    rows = [[1, 2, 3], [np.nan, 1, 1], [np.inf, 0, 1], [0, 0, 0], [0, 0, 1]]
    points = np.array([rows], np.float32)

    (frame,), _, _ = read(write(tmp_path / "a.mcap", [("/points", 0, cloud(EPOCH, points))]))

    assert frame.points is not None
    np.testing.assert_array_equal(np.isnan(frame.points).all(1), [False, True, True, True, False])
    assert np.isfinite(frame.points[[0, 4]]).all()


def test_invalid_depth_is_zero(tmp_path: Path) -> None:
    depth = np.full((48, 64), 1.5, np.float32)
    depth[0, :5] = [np.nan, np.inf, -np.inf, -1, 0]
    items = [
        ("/depth/camera_info", 0, info(EPOCH)),
        ("/depth/image", 1, image(EPOCH, depth, "32FC1")),
    ]

    (frame,), _, _ = read(write(tmp_path / "a.mcap", items))

    assert frame.depth is not None
    np.testing.assert_array_equal(frame.depth[0, :6], [0, 0, 0, 0, 0, 1.5])


def test_each_image_uses_calibration_of_its_time(tmp_path: Path) -> None:
    """Zoom and reconfiguration change the calibration; it may be recorded after its image."""
    other, last = (Camera(64, 48, f, f, 30.0, 20.0) for f in (99.0, 77.0))
    depth = wavy_depth()
    items = [
        ("/depth/image", 0, image(EPOCH, depth)),
        ("/depth/camera_info", 1, info(EPOCH)),
        ("/depth/camera_info", 2, info(EPOCH + 9, other)),
        ("/depth/image", 3, image(EPOCH + 9, depth)),
        ("/depth/image", 4, image(EPOCH + 20, depth)),
        ("/depth/image", 5, image(EPOCH + 30, depth)),
        ("/depth/camera_info", 6, info(EPOCH + 30, last)),
    ]

    read_frames, _, _ = read(write(tmp_path / "a.mcap", items))

    assert [frame.camera for frame in read_frames] == [CAMERA, other, other, last]
    assert [frame.index for frame in read_frames] == [0, 1, 2, 3]


def test_calibration_recorded_once_is_used_for_all_images(tmp_path: Path) -> None:
    depth = wavy_depth()
    items: list[tuple[str, int, Any]] = [("/depth/camera_info", 0, info(EPOCH))]
    items += [("/depth/image", k, image(EPOCH + k, depth)) for k in range(1, 4)]

    read_frames, skipped, _ = read(write(tmp_path / "a.mcap", items), start_s=1e-9)

    assert len(read_frames) == 3
    assert not skipped


def test_unreadable_calibration_is_searched_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading the topic again for each image would take hours for a recording of minutes."""
    items: list[tuple[str, int, Any]] = []
    for k in range(30):
        items.append(("/depth/camera_info", EPOCH + k, (INFO, b"\0\1\0\0rubbish")))
        items.append(("/depth/image", EPOCH + k, image(EPOCH + k, wavy_depth())))
    decoded: Counter[str] = Counter()
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        streams, skipped = choose_streams(recording), Counter[str]()
        original = recording.decode

        def decode(message: Message) -> Any:
            decoded[message.topic] += 1
            return original(message)

        monkeypatch.setattr(recording, "decode", decode)
        found = list(frames(recording, streams, skipped=skipped))

    assert not found
    assert skipped == {"depth image without CameraInfo": 30}
    assert decoded["/depth/camera_info"] <= 30 + 30  # as they come, and in one search


def test_mismatched_calibration_is_counted_with_its_topic(tmp_path: Path) -> None:
    """Without the topic, nobody would guess that the calibration is another camera's."""
    items = [
        ("/depth/camera_info", 0, info(EPOCH)),
        ("/depth/image", 1, image(EPOCH, np.ones((24, 32), np.uint16))),
    ]

    _, skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert skipped == {"with depth of 32 x 24 but CameraInfo for 64 x 48 on /depth/camera_info": 1}


@pytest.mark.parametrize(
    ("center", "cropped", "warned"),
    [((16.0, 12.0), False, True), ((31.2, 31.0), False, True), ((34.0, 21.0), False, False),
     ((40.0, 12.0), True, False)],
)  # fmt: skip
def test_intrinsics_of_another_resolution_cause_warning(
    tmp_path: Path, center: tuple[float, float], cropped: bool, warned: bool
) -> None:
    """Objects would be sheared and of the wrong size; a crop may have any principal point."""
    calibration = info(EPOCH, replace(CAMERA, cx=center[0], cy=center[1]))
    if cropped:
        calibration.roi.width, calibration.roi.height = 64, 48
    items = [
        ("/depth/camera_info", 0, calibration),
        ("/depth/image", 1, image(EPOCH, np.full((48, 64), 1000, np.uint16))),
    ]

    found, _, warnings = read(write(tmp_path / "a.mcap", items))

    assert len(found) == 1
    assert any("intrinsics for a different resolution?" in text for text in warnings) == warned


def test_slight_distortion_is_ignored_and_strong_is_corrected(
    tmp_path: Path,
) -> None:
    """No pinhole camera fits a strongly distorted image; its points must still be right."""
    depth = np.full((48, 64), 1000, np.uint16)
    slight = [("/depth/camera_info", 0, info(EPOCH, d=(1e-4, 0, 0, 0, 0)))]
    strong = [("/depth/camera_info", 0, info(EPOCH, d=(-0.3, 0.1, 0.001, -0.002, 0)))]
    images = [("/depth/image", 1, image(EPOCH, depth))]

    (first,), _, _ = read(write(tmp_path / "a.mcap", slight + images))
    (second,), _, warnings = read(write(tmp_path / "b.mcap", strong + images))

    assert first.organized
    assert second.points is not None
    assert "undistorted" in warnings[0]
    # Distorting the ray of a pixel again must lead back to the pixel.
    x, y, _ = second.points[5 * 64 + 7]
    r = x * x + y * y
    k1, k2, p1, p2 = -0.3, 0.1, 0.001, -0.002
    radial = 1 + r * (k1 + r * k2)
    u = (x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x)) * CAMERA.fx + CAMERA.cx
    v = (y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y) * CAMERA.fy + CAMERA.cy
    assert (u, v) == pytest.approx((7, 5), abs=0.01)


@pytest.mark.parametrize(
    ("model", "coefficients", "problem"),
    [
        ("plumb_bob", (np.nan, 0, 0, 0, 0), "lens distortion that is not finite is ignored"),
        (
            "plumb_bob",
            (-3.0, 0, 0, 0, 0),
            "distortion 'plumb_bob' that cannot be inverted is ignored",
        ),
        ("mirror", (0.1, 0, 0, 0, 0), "unknown lens distortion 'mirror' is ignored"),
    ],
)
def test_ignored_distortion_is_explained(
    tmp_path: Path, model: str, coefficients: tuple[float, ...], problem: str
) -> None:
    calibration = info(EPOCH, d=coefficients)
    calibration.distortion_model = model
    depth = image(EPOCH, np.full((48, 64), 1000, np.uint16))
    items = [("/depth/camera_info", 0, calibration), ("/depth/image", 1, depth)]

    _, _, warnings = read(write(tmp_path / "a.mcap", items))

    assert [problem in text for text in warnings] == [True]


def test_pixels_that_see_no_ray_have_no_points(tmp_path: Path) -> None:
    """The corners outside the round image of a wide lens must not spoil the rest."""
    calibration = info(EPOCH, d=(-0.9, 0, 0, 0, 0))
    items = [
        ("/depth/camera_info", 0, calibration),
        ("/depth/image", 1, image(EPOCH, np.full((48, 64), 1000, np.uint16))),
    ]

    (frame,), _, warnings = read(write(tmp_path / "a.mcap", items))

    assert frame.points is not None
    assert np.isnan(frame.points[0]).all()
    assert np.isfinite(frame.points[24 * 64 + 32]).all()
    assert any("pixels" in text for text in warnings)


def test_new_distortion_changes_rays(tmp_path: Path) -> None:
    """Otherwise the rays of the first calibration would be used for the whole recording."""
    depth = np.full((48, 64), 1000, np.uint16)
    old, new = [
        [
            ("/depth/camera_info", k, info(EPOCH + k, d=(k1, 0.1, 0.0, 0.0, 0.0))),
            ("/depth/image", k, image(EPOCH + k, depth)),
        ]
        for k, k1 in enumerate((-0.3, -0.4))
    ]

    (_, second), _, _ = read(write(tmp_path / "a.mcap", old + new))
    (alone,), _, _ = read(write(tmp_path / "b.mcap", new))

    np.testing.assert_array_equal(second.points, alone.points)


def test_time_window_and_every_select_frames(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(1, 0.1, (1, 9, 3)).astype(np.float32)
    items = [("/points", k * SECOND, cloud(EPOCH + k, points)) for k in range(10)]
    path = write(tmp_path / "a.mcap", items)

    read_frames, _, _ = read(path, start_s=2, end_s=9, every=3)

    assert [(f.index, f.stamp_ns - EPOCH) for f in read_frames] == [(0, 2), (3, 5), (6, 8)]


def test_untrustworthy_stamps_are_reported(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(1, 0.1, (1, 9, 3)).astype(np.float32)
    stamps = [0, 5 * SECOND, EPOCH, EPOCH - SECOND]
    items = [("/points", EPOCH + k, cloud(stamp, points)) for k, stamp in enumerate(stamps)]

    read_frames, _, warnings = read(write(tmp_path / "a.mcap", items))

    # Without a stamp: as long before the next one as in the log.
    assert [f.stamp_ns for f in read_frames] == [5 * SECOND - 1, *stamps[1:]]
    assert len(warnings) == 4
    for word in ("is 0 (1×)", "Unix", "backwards (1×)", "jumps", "all objects get new tracks"):
        assert any(word in warning for warning in warnings)


def test_one_stream_of_a_sensor_is_chosen(tmp_path: Path) -> None:
    depth = wavy_depth()
    colour = np.zeros((48, 64), np.uint8)
    items = [
        ("/cam/aligned_depth_to_color/camera_info", 0, info(EPOCH)),
        ("/cam/aligned_depth_to_color/image_raw", 0, image(EPOCH, depth, frame_id="colour")),
        ("/cam/color/camera_info", 0, info(EPOCH)),
        ("/cam/color/image_raw", 0, image(EPOCH, colour, "mono8")),
        ("/cam/depth/camera_info", 0, info(EPOCH)),
        ("/cam/depth/image_rect_raw", 0, image(EPOCH, depth)),
        ("/cam/depth/points", 0, cloud(EPOCH, organized_points(depth))),
        ("/cam/infra1/image_rect_raw", 0, image(EPOCH, depth, "mono16")),
    ]
    path = write(tmp_path / "a.mcap", items)

    with open_recording(path) as recording:
        found = {s.topic: (s.kind, s.info_topic) for s in depth_streams(recording)}
        (chosen,) = choose_streams(recording)
        wanted = choose_streams(recording, ["cam/depth/points", "/cam/depth/points"])

    assert found == {
        "/cam/aligned_depth_to_color/image_raw": (
            "depth",
            "/cam/aligned_depth_to_color/camera_info",
        ),
        "/cam/depth/image_rect_raw": ("depth", "/cam/depth/camera_info"),
        "/cam/depth/points": ("points", None),
    }
    assert chosen.topic == "/cam/depth/image_rect_raw"
    assert {stream.topic for stream in wanted} == {"/cam/depth/points"}


def test_stream_with_more_messages_is_chosen(tmp_path: Path) -> None:
    """A driver may publish one image on a topic before another topic takes over."""
    items = [("/cam/depth/camera_info", 0, info(EPOCH))]
    for number, topic in enumerate(["/cam/depth/a", "/cam/depth/b", "/cam/depth/b"]):
        items.append((topic, number, image(EPOCH + number, wavy_depth())))
    path = write(tmp_path / "a.mcap", items)

    with open_recording(path) as recording:
        (chosen,) = choose_streams(recording)

    assert chosen.topic == "/cam/depth/b"


def test_several_sensors_require_a_topic(tmp_path: Path) -> None:
    points = np.ones((1, 3, 3), np.float32)
    left, right = cloud(EPOCH, points), cloud(EPOCH, points)
    left.header.frame_id, right.header.frame_id = "left", "right"
    path = write(tmp_path / "a.mcap", [("/left/points", 0, left), ("/right/points", 0, right)])

    with open_recording(path) as recording:
        with pytest.raises(NoStreamError, match=r"/left/points.*/right/points.*--topic"):
            choose_streams(recording)
        assert len(choose_streams(recording, ["/right/points", "/left/points"])) == 2
        with pytest.raises(NoStreamError, match="/front does not exist; usable topics: /left"):
            choose_streams(recording, ["/front"])


def test_error_names_why_no_stream_is_usable(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [("/depth/image", 0, image(EPOCH, wavy_depth()))])
    bare = write(tmp_path / "b.mcap", [("/depth/camera_info", 0, info(EPOCH))])

    with open_recording(path) as recording, pytest.raises(NoStreamError, match="without a sensor"):
        choose_streams(recording)
    with (
        open_recording(bare) as recording,
        pytest.raises(NoStreamError, match="/depth/camera_info"),
    ):
        choose_streams(recording)


def test_clouds_of_changing_size_keep_their_sizes(tmp_path: Path) -> None:
    """A camera fitted to a whole cloud also fits a crop of it, but has another image size."""
    points = organized_points(wavy_depth())
    sizes = [(48, 64), (36, 64), (36, 50)]
    items = [("/points", k, cloud(EPOCH + k, points[:h, :w])) for k, (h, w) in enumerate(sizes)]

    found, skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert not skipped
    assert [frame.depth is not None and frame.depth.shape for frame in found] == sizes
    cameras = [frame.camera for frame in found if frame.camera is not None]
    assert [(camera.height, camera.width) for camera in cameras] == sizes


@pytest.mark.parametrize("pack", [png, rvl])
def test_compressed_depth_is_decoded(tmp_path: Path, pack: Any) -> None:
    depth = wavy_depth()
    inverse = np.where(depth > 0, 4000, 0).astype(np.uint16)
    items = [
        ("/depth/camera_info", 0, info(EPOCH)),
        ("/depth/image/compressedDepth", 0, compressed(EPOCH, pack(depth))),
        (
            "/depth/image/compressedDepth",
            1,
            compressed(EPOCH, pack(inverse), "32FC1", (8000, -4000)),
        ),
    ]

    (first, second), skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert not skipped
    assert first.depth is not None
    assert second.depth is not None
    np.testing.assert_array_equal(first.depth, depth / np.float32(1000))
    np.testing.assert_allclose(second.depth, np.where(depth > 0, 1.0, 0.0))


@given(data=st.binary(max_size=200), pack=st.sampled_from([png, rvl]), at=st.integers(0, 2000))
@settings(deadline=None, max_examples=60)
def test_damaged_compressed_depth_is_error_or_finite(data: bytes, pack: Any, at: int) -> None:
    body = bytearray(pack(wavy_depth()))
    body[at : at + len(data)] = data
    for damaged in (bytes(body), data):
        try:
            depth = depth_of_compressed(compressed(0, damaged))
        except MessageError:
            continue
        assert np.isfinite(depth).all()


def test_realsense_viewer_recording_uses_its_depth_unit(tmp_path: Path) -> None:
    """The viewer writes other topic names, mono16 depth, and a depth unit for each sensor."""
    depth = wavy_depth()
    sensor = "/device_0/sensor_1"
    unit, other = (make("std_msgs/msg/Float32", metres) for metres in (0.00025, 0.001))
    items = [
        ("/device_0/sensor_0/option/Depth_Units/value", 0, other),
        (f"{sensor}/option/Depth_Units/value", 0, unit),
        (f"{sensor}/Depth_0/info/camera_info", 0, info(0)),
        (f"{sensor}/Infrared_1/info/camera_info", 0, info(0)),
        (f"{sensor}/Depth_0/image/data", 1, image(EPOCH, depth, "mono16")),
        (f"{sensor}/Infrared_1/image/data", 1, image(EPOCH, depth, "mono16")),
    ]

    (frame,), _, _ = read(write(tmp_path / "a.mcap", items))

    assert frame.depth is not None
    assert frame.topic == f"{sensor}/Depth_0/image/data"
    np.testing.assert_allclose(frame.depth, depth * 0.00025, rtol=1e-6)


@pytest.mark.skipif(not DATA.exists(), reason="needs the recorded tabletop scenes")
@pytest.mark.parametrize("name", ["clouds.mcap", "clouds.bag", "clouds_ros2"])
def test_recorded_clouds_match_depth_images(name: str) -> None:
    images, _, _ = read(DATA / "osd_learn" / "depth.mcap")
    clouds, skipped, _ = read(DATA / "osd_learn" / name)
    by_stamp = {frame.stamp_ns: frame for frame in images}

    assert clouds
    assert not skipped
    for frame in clouds:
        same = by_stamp[frame.stamp_ns]
        assert frame.depth is not None
        assert same.depth is not None
        assert frame.camera is not None
        assert same.camera is not None
        np.testing.assert_allclose(frame.depth, same.depth, atol=2e-7)
        for field in ("fx", "fy", "cx", "cy"):
            assert abs(getattr(frame.camera, field) - getattr(same.camera, field)) < 0.05


def test_image_is_returned_as_soon_as_its_calibration_arrives(tmp_path: Path) -> None:
    """With several streams, an image that is a frame late would be out of order."""
    items = [
        ("/depth/image", 0, image(EPOCH, wavy_depth())),
        ("/depth/camera_info", 1, info(EPOCH)),
        ("/depth/image", 2, image(EPOCH + 5, wavy_depth())),
        ("/depth/camera_info", 3, info(EPOCH + 5)),
    ]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        (stream,) = choose_streams(recording)
        source = DepthSource(recording, stream, Counter())
        returned = []
        for k, message in enumerate(recording.messages()):
            is_info = message.topic.endswith("info")
            found = source.calibrate(message) if is_info else source.read(message, k)
            returned.append([(frame.index, frame.stamp_ns) for frame in found])

    assert returned == [[], [(0, EPOCH)], [], [(2, EPOCH + 5)]]


@pytest.mark.parametrize(
    ("body", "kind", "reason"),
    [
        (b"", "32FC1", "compressed depth in 32FC1 without its parameters"),
        (struct.pack(">II", 0, 7), "16UC1", "png image without a size, or of too many pixels"),
        (struct.pack(">II", 3, 6), "16UC1", "png image without a size, or of too many pixels"),
    ],
)
def test_compressed_depth_that_cannot_be_right_is_refused(
    body: bytes, kind: str, reason: str
) -> None:
    """Decoded anyway, it would give wrong distances, or rows that are not in the image."""
    whole = png(np.arange(500, 515, dtype=np.uint16).reshape(5, 3))
    at = whole.index(b"IHDR") + 4
    message = compressed(0, b"", kind)
    message.data = np.frombuffer(whole[:at] + body + whole[at + len(body) :], np.uint8)

    with pytest.raises(MessageError, match=f"^{reason}$"):
        depth_of_compressed(message)


def test_damaged_pixels_of_compressed_depth_are_refused() -> None:
    """The pixels after the damage would have arbitrary depths."""
    body = bytearray(png(wavy_depth()))
    body[body.index(b"IDAT") + 100] ^= 16

    with pytest.raises(MessageError, match="compressed depth is damaged"):
        depth_of_compressed(compressed(0, bytes(body)))


def test_image_that_turns_into_colour_is_not_read_as_depth(tmp_path: Path) -> None:
    """A driver restarted with another profile publishes infrared images on the topic of depth."""
    depth = np.arange(500, 500 + 48 * 64, dtype=np.uint16).reshape(48, 64)
    items = [("/camera/camera_info", EPOCH, info(EPOCH))]
    for k, kind in enumerate(("16UC1", "mono8", "16UC1")):
        values = depth if kind == "16UC1" else depth.astype(np.uint8)
        items.append(("/camera/image_raw", EPOCH + k, image(EPOCH + k, values, kind)))

    frames, skipped, _ = read(write(tmp_path / "a.mcap", items))

    assert [frame.stamp_ns for frame in frames] == [EPOCH, EPOCH + 2]
    assert dict(skipped) == {"image encoding 'mono8' is not depth": 1}
