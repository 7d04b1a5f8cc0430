"""Worked examples of streams, clocks, records and time windows, each at its exact limit."""

import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from numpy.testing import assert_allclose
from rosbags.rosbag1 import Reader as BagReader
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation, Slerp

from shapecat.cameras.colour import ColourImage
from shapecat.errors import NoStreamError
from shapecat.geometry import IDENTITY
from shapecat.recordings import choose_streams, open_recording
from shapecat.recordings.colour_streams import pair_colours
from shapecat.recordings.containers import chunked
from shapecat.recordings.containers.chunked import Chunk, RawMessage, in_time_order
from shapecat.recordings.containers.mcap_records import Opcode, TruncatedError, walk
from shapecat.recordings.containers.ros1_records import BagError, split
from shapecat.recordings.decoding.colour_image import cloud_colours, compressed_size, pixels_of
from shapecat.recordings.messages import MessageError, Topic
from shapecat.recordings.overview import describe_recording
from shapecat.recordings.pinhole import PinholeFit, still_fits
from shapecat.recordings.stamps import Clock
from shapecat.recordings.streams import info_topic_of
from shapecat.recordings.transforms.buffer import ExtrapolationError, TransformBuffer
from shapecat.recordings.transforms.extrinsics import Extrinsics
from shapecat.recordings.transforms.imu import Accelerometer
from shapecat.recordings.transforms.samples import _slerp
from shapecat.types import Camera
from tests.colour_messages import gradient, jpeg, packed, png, raw
from tests.mcap_files import mcap_writer
from tests.messages import EPOCH, SECOND, cloud, image, info, make, organized_points, wavy_depth
from tests.messages import write as record
from tests.test_recordings_colour import MS, WIDE, depth_items, in_order, read, static
from tests.test_recordings_frames import read as read_depth

OTHER = Camera(80, 60, 69.5, 73.5, 39.1, 30.3)


@pytest.mark.parametrize("kind", ["64FC1", "16UC1; jpeg compressed "])
def test_error_lists_encodings(tmp_path: Path, kind: str) -> None:
    """Depth in an unsupported encoding was refused as if its topic held no image."""
    topic, message = "/cam/depth/image", packed(EPOCH, jpeg(gradient()), kind)
    if kind == "64FC1":
        message = image(EPOCH, np.ones((3, 4)), kind)
    path = record(tmp_path / "a.mcap", [(topic, EPOCH, message)])

    errors = []
    for wanted in ([], [topic]):
        with open_recording(path) as recording, pytest.raises(NoStreamError) as found:
            choose_streams(recording, wanted)
        errors.append(str(found.value))

    name = "Image" if kind == "64FC1" else "CompressedImage"
    assert errors == [
        (
            f"{path}: no point clouds or depth images (16UC1, mono16, 32FC1); "
            f"topics found: {topic} (sensor_msgs/msg/{name}, {kind.strip()})"
        ),
        (
            f"{path}: topic {topic} holds no clouds or depth images ({kind.strip()}); "
            "usable topics: none"
        ),
    ]


def test_error_says_why_images_cannot_be_decoded(tmp_path: Path) -> None:
    """Some converters store incomplete definitions; users did not learn why nothing is readable."""
    path, topic = tmp_path / "a.mcap", "/cam/depth/image"
    with mcap_writer(path) as writer:
        schema = writer.register_schema(
            "sensor_msgs/msg/Image", "ros2msg", b"std_msgs/Header header\n"
        )
        channel = writer.register_channel(topic, "cdr", schema)
        writer.add_message(channel, EPOCH, bytes(40), EPOCH)

    for wanted in ([], [topic]):
        with open_recording(path) as recording, pytest.raises(NoStreamError) as found:
            choose_streams(recording, wanted)
        assert "no readable messages: cannot decode sensor_msgs/msg/Image: " in str(found.value)
        assert "std_msgs/msg/Header" in str(found.value)


def test_error_about_a_truncated_recording_says_so(tmp_path: Path) -> None:
    """The error listed a depth topic, yet said that there is no depth, and gave no reason."""
    topic = "/cam/depth/image_raw"
    empty = [(topic, "sensor_msgs/msg/Image")]
    path = record(tmp_path / "a.mcap", depth_items(EPOCH), chunk_size=1, empty=empty)
    path.write_bytes(path.read_bytes()[:3000])

    errors = []
    for wanted in ([], [topic]):
        with open_recording(path) as recording, pytest.raises(NoStreamError) as found:
            choose_streams(recording, wanted)
        errors.append(str(found.value))

    warning = "the recording was not finished; messages recovered: 1; the last "
    assert errors[0].startswith(
        f"{path}: no point clouds or depth images (16UC1, mono16, 32FC1); topics found: "
        "/cam/depth/camera_info (sensor_msgs/msg/CameraInfo), /cam/depth/image_raw "
        f"(sensor_msgs/msg/Image, no readable messages); warnings: {warning}"
    )
    assert errors[1].startswith(
        f"{path}: topic {topic} has no readable messages; usable topics: none; warnings: {warning}"
    )


# ---- which of several colour cameras


def colour(topic: str, frame_id: str = "far", count: int = 1) -> list[tuple[str, int, Any]]:
    """Return images of a topic, compressed if the topic name says so."""
    stamps = [EPOCH + k * MS for k in range(count)]
    if topic.endswith("compressed"):
        return [(topic, s, packed(s, jpeg(gradient()), frame_id=frame_id)) for s in stamps]
    return [(topic, s, raw(s, gradient(), "rgb8", frame_id)) for s in stamps]


@pytest.mark.parametrize(
    ("better", "worse"),
    [
        # In the frame of the depth camera, though the other one shares more of the name.
        (colour("/z/view", "camera"), colour("/cam/depth/color/compressed", count=2)),
        # Shares two parts of the name, not one.
        (colour("/cam/depth/view/image"), colour("/cam/color/x/compressed", count=2)),
        # Named after colour.
        (colour("/cam/zcolour/image"), colour("/cam/aview/x/compressed", count=2)),
        # Rectified.
        (colour("/cam/zrgb/image_rect"), colour("/cam/acolor/x/compressed", count=2)),
        # More messages.
        (colour("/cam/zrgb/image", count=2), colour("/cam/acolor/x/compressed")),
        # Compressed.
        (colour("/cam/zcolor/x/compressed"), colour("/cam/acolor/image")),
        # By name.
        (colour("/cam/acolor/image"), colour("/cam/bcolor/image")),
    ],
)
def test_criteria_for_colour_stream_apply_in_order(tmp_path: Path, better: Any, worse: Any) -> None:
    path = record(tmp_path / "a.mcap", in_order([*depth_items(EPOCH), *worse, *better]))
    with open_recording(path) as recording:
        (stream,) = choose_streams(recording)
        chosen = pair_colours(recording, [stream]).get(stream.topic)

    assert chosen is not None
    assert chosen.topic == better[0][0]


def test_unrelated_colour_camera_is_used_only_if_single(tmp_path: Path) -> None:
    compressed = "/one/image/compressed"
    cases: dict[str, str | None] = {
        "/one/image": "/one/image",
        compressed: compressed,  # the same images
        "/two/image": None,
    }
    for k, (second, wanted) in enumerate(cases.items()):
        items = [*depth_items(EPOCH), *colour("/one/image")]
        items += colour(second) if second != "/one/image" else []
        file = record(tmp_path / f"{k}.mcap", in_order(items))
        with open_recording(file) as recording:
            (stream,) = choose_streams(recording)
            chosen = pair_colours(recording, [stream]).get(stream.topic)
        assert (None if chosen is None else chosen.topic) == wanted


@pytest.mark.parametrize(
    ("topic", "frame_id", "found"),
    [
        ("/right/depth/image_raw", "right", None),  # another sensor
        ("/cam/aligned_depth/image_raw", "right", "/one/image"),  # the same, by its namespace
        ("/right/depth/image_raw", "camera", "/one/image"),  # the same, by its frame
    ],
)
def test_single_colour_camera_is_not_used_for_two_sensors(
    tmp_path: Path, topic: str, frame_id: str, found: str | None
) -> None:
    """The camera may belong to either sensor; masks of the other one would be on the wrong view."""
    second = (topic, EPOCH, image(EPOCH, wavy_depth(), frame_id=frame_id))
    items = [*depth_items(EPOCH), second, *colour("/one/image")]
    with open_recording(record(tmp_path / "a.mcap", in_order(items))) as recording:
        streams = choose_streams(recording, ["/cam/depth/image_raw", topic])
        pairs = pair_colours(recording, streams, None)
        wanted = pair_colours(recording, streams, "/one/image")

    assert {stream.topic: pairs.get(stream.topic) for stream in streams} == {
        stream.topic: None if found is None else wanted[stream.topic] for stream in streams
    }
    assert {colour.topic for colour in wanted.values()} == {"/one/image"}


@pytest.mark.parametrize(
    ("topic", "users"),
    [
        ("/robot/left/color/image", ["left"]),
        ("/robot/right/color/image", ["right"]),
        ("/robot/rgb/image", ["left", "right"]),  # as near to one as to the other
        ("/robot/image", ["left", "right"]),
        ("/lab/left/image", []),
    ],
)
def test_colour_camera_of_another_sensor_is_not_used(
    tmp_path: Path, topic: str, users: list[str]
) -> None:
    """Each object would have two masks on its images, one from each depth camera."""
    items = []
    for side in ("left", "right"):
        items += [
            (f"/robot/{side}/depth/camera_info", EPOCH, info(EPOCH)),
            (f"/robot/{side}/depth/image", EPOCH, image(EPOCH, wavy_depth(), frame_id=side)),
        ]
    items += colour(topic)
    with open_recording(record(tmp_path / "a.mcap", in_order(items))) as recording:
        streams = choose_streams(recording, [f"/robot/{s}/depth/image" for s in ("left", "right")])
        pairs = pair_colours(recording, streams, None)

    assert {depth: colour.topic for depth, colour in pairs.items()} == {
        f"/robot/{side}/depth/image": topic for side in users
    }


def test_new_colour_calibration_changes_lens(tmp_path: Path) -> None:
    """Each image uses the last calibration before it; a repeated one changes nothing.

    If only the bottom of the image is cut off, only its height differs.
    """
    cut = replace(OTHER, height=OTHER.height - 8)
    items = depth_items(*(EPOCH + 100 * k * MS for k in range(4)))
    items.append(("/tf_static", EPOCH, static("camera", "color", (0.05, 0, 0), (0, 0, 0, 1))))
    for k, camera in enumerate((WIDE, WIDE, OTHER, cut)):
        stamp = EPOCH + 100 * k * MS
        pixels = gradient(camera.height, camera.width)
        items.append(("/cam/color/camera_info", stamp, info(stamp, camera)))
        items.append(("/cam/color/image_raw", stamp, raw(stamp, pixels, "rgb8", "color")))
    pairs, _ = read(record(tmp_path / "a.mcap", in_order(items)))

    lenses = [view and view.lens and view.lens.pinhole for _, view in pairs]
    assert lenses == [WIDE, WIDE, OTHER, cut]


def test_new_colour_distortion_alone_changes_lens(tmp_path: Path) -> None:
    """The focal lengths of a new calibration may be those of the old one."""
    distortions = ((0.11, -0.07, 0.002, 0.001, 0.03), (0.05, 0.02, -0.001, 0.003, -0.04), ())
    stamps = [EPOCH + 100 * k * MS for k in range(len(distortions))]
    items = [*depth_items(*stamps)]
    items.append(("/tf_static", EPOCH, static("camera", "color", (0.05, 0, 0), (0, 0, 0, 1))))
    for stamp, numbers in zip(stamps, distortions, strict=True):
        items.append(("/cam/color/camera_info", stamp, info(stamp, WIDE, numbers)))
        items.append(("/cam/color/image_raw", stamp, raw(stamp, gradient(60, 80), "rgb8", "color")))
    pairs, _ = read(record(tmp_path / "a.mcap", in_order(items)))

    lenses = [view.lens for _, view in pairs if view is not None and view.lens is not None]
    assert [lens.coefficients for lens in lenses] == list(distortions)
    assert [lens.pinhole for lens in lenses] == [WIDE] * 3


DEPTH = Camera(64, 48, 60.0, 61.0, 31.2, 23.7)


@pytest.mark.parametrize(
    ("camera", "frame_id", "registered"),
    [
        # One frame: nearly the same calibration is the same camera.
        (Camera(64, 48, 60.6, 61.0, 31.2, 23.7), "camera", True),
        (Camera(64, 48, 60.6, 61.0, 31.2, 23.7), "/camera", True),  # as in ROS 1
        (WIDE, "/camera", False),
        (Camera(64, 48, 60.0, 61.0, 31.2, 24.4), "camera", False),
        (Camera(64, 48, 60.0, 61.0, 30.5, 23.7), "camera", False),
        # Another frame without a transform: only equal numbers are the same camera.
        (DEPTH, "color", True),
        (Camera(64, 48, 60.001, 61.0, 31.2, 23.7), "color", None),
        (Camera(64, 48, 60.0, 60.999, 31.2, 23.7), "color", None),
    ],
)
def test_colour_is_registered_only_if_cameras_are_equal(
    tmp_path: Path, camera: Camera, frame_id: str, registered: bool | None
) -> None:
    """``registered`` is None if there is no colour at all."""
    items = depth_items(EPOCH)
    items.append(("/cam/color/camera_info", EPOCH, info(EPOCH, camera)))
    colours = gradient(camera.height, camera.width)
    items.append(("/cam/color/image_raw", EPOCH + 1, raw(EPOCH, colours, "rgb8", frame_id)))
    ((_, view),), _ = read(record(tmp_path / "a.mcap", in_order(items)))

    assert (None if view is None else view.registered) == registered
    if view is not None:
        assert view.lens is not None
        assert view.lens.pinhole == camera


@pytest.mark.parametrize("frame_id", ["camera", "color"])
@pytest.mark.parametrize(("k1", "registered"), [(0.4, False), (0.01, True)])
def test_distorted_colour_is_not_registered_to_rectified_depth(
    tmp_path: Path, k1: float, frame_id: str, *, registered: bool
) -> None:
    """OAK cameras rectify depth aligned to colour, but not the colour images: masks were off."""
    items = depth_items(EPOCH)
    calibration = info(EPOCH, DEPTH, (k1, 0, 0, 0, 0))
    items.append(("/cam/color/camera_info", EPOCH, calibration))
    items.append(("/cam/color/image_raw", EPOCH + 1, raw(EPOCH, gradient(), "rgb8", frame_id)))
    ((_, view),), _ = read(record(tmp_path / "a.mcap", in_order(items)))

    assert view is not None
    assert view.lens is not None
    assert view.lens.coefficients[0] == k1
    assert view.registered == registered
    if not registered:
        assert view.colour_from_depth is IDENTITY


@pytest.mark.parametrize("same", [True, False])
def test_images_without_frame_ids_need_equal_calibrations(tmp_path: Path, *, same: bool) -> None:
    """Masks would be off by the distance between the two cameras."""
    items = depth_items(EPOCH, frame_id="")
    items.append(("/cam/color/camera_info", EPOCH, info(EPOCH, DEPTH if same else WIDE)))
    colours = gradient() if same else gradient(60, 80)
    items.append(("/cam/color/image_raw", EPOCH + 1, raw(EPOCH, colours, "rgb8", "")))
    ((_, view),), warnings = read(record(tmp_path / "a.mcap", in_order(items)))

    assert (view is not None and view.registered) == same
    assert any("between a frame without a name and" in text for text in warnings) != same


@pytest.mark.parametrize("k1", [0.0, 0.4])
def test_warning_says_why_points_have_no_masks(tmp_path: Path, k1: float) -> None:
    """Strongly distorted depth, as from an Azure Kinect, becomes points without pixels."""
    items = depth_items(EPOCH)
    items[0][2].d = np.array([k1, 0, 0, 0, 0])
    items.append(("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE)))
    items.append(("/cam/color/image_raw", EPOCH + 1, raw(EPOCH, gradient(60, 80), "rgb8")))
    ((frame, view),), warnings = read(record(tmp_path / "a.mcap", in_order(items)))

    assert view is not None
    assert frame.organized == (k1 == 0)
    assert any("no masks on colour images" in text for text in warnings) == (k1 != 0)


def test_colour_image_of_other_size_than_calibration_is_unused(tmp_path: Path) -> None:
    items = depth_items(EPOCH)
    items.append(("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE)))
    items.append(("/cam/color/image_raw", EPOCH, raw(EPOCH, gradient(61, 80), "rgb8")))
    ((_, view),), warnings = read(record(tmp_path / "a.mcap", in_order(items)))

    assert view is None
    assert any("image of 80 x 61 pixels with CameraInfo for 80 x 60" in w for w in warnings)


@pytest.mark.parametrize(("gap_ms", "found"), [(59, True), (61, False)])
def test_single_image_pairs_with_frames_within_60_ms(
    tmp_path: Path, gap_ms: int, found: bool
) -> None:
    items = [*depth_items(EPOCH + gap_ms * MS), *colour("/cam/color/image", "camera")]
    ((_, view),), _ = read(record(tmp_path / "a.mcap", in_order(items)))

    assert (view is not None) == found


def test_librealsense_recording_gives_colour_pose(tmp_path: Path) -> None:
    """Each stream has its own transform from the reference; both are needed."""
    turns = {"Depth_0": (0.02, 0.3, -0.1, 0.94), "Color_0": (-0.1, 0.05, 0.2, 0.97)}
    moves = {"Depth_0": (0.01, -0.02, 0.03), "Color_0": (0.05, 0.07, -0.04)}
    items: list[tuple[str, int, Any]] = []
    for name, data in (("Depth_0", wavy_depth()), ("Color_0", gradient())):
        sensor = f"/device_0/sensor_{int(name == 'Color_0')}/{name}"
        move = make("geometry_msgs/msg/Vector3", *moves[name])
        turn = make("geometry_msgs/msg/Quaternion", *turns[name])
        items.append((f"{sensor}/tf/0", 0, make("geometry_msgs/msg/Transform", move, turn)))
        items.append((f"{sensor}/info/camera_info", 1, info(EPOCH)))
        message = image(EPOCH, data, "mono16") if name == "Depth_0" else raw(EPOCH, data, "rgb8")
        items.append((f"{sensor}/image/data", 2, message))
    path = record(tmp_path / "a.mcap", in_order(items))
    with open_recording(path) as recording:
        (stream,) = choose_streams(recording)
        found = pair_colours(recording, [stream]).get(stream.topic)
        assert found is not None
        pose = Extrinsics(recording, stream, found).colour_from_depth("0", "0", EPOCH, EPOCH)
    ((_, view),), _ = read(path)  # here the frame ids are equal

    depth_turn, colour_turn = (Rotation.from_quat(turns[name]) for name in ("Depth_0", "Color_0"))
    assert pose is not None
    point = np.array([0.3, -0.2, 0.9])  # in the reference
    in_depth = depth_turn.apply(point) + moves["Depth_0"]
    in_colour = colour_turn.apply(point) + moves["Color_0"]
    assert_allclose(pose.rotation @ in_depth + pose.translation, in_colour, atol=1e-12)
    assert view is not None
    assert view.colour_from_depth is not None
    assert_allclose(view.colour_from_depth.rotation, pose.rotation)


# ---- calibrations of depth images


def test_late_calibration_is_used_only_without_an_earlier_one(
    tmp_path: Path,
) -> None:
    depth = wavy_depth()
    late = Camera(64, 48, 99.0, 98.0, 30.0, 20.0)
    first = [("/d/image", 0, image(EPOCH, depth)), ("/d/camera_info", 1, info(EPOCH + 9, late))]
    later = [
        ("/d/camera_info", 0, info(EPOCH)),
        ("/d/image", 1, image(EPOCH + 5, depth)),
        ("/d/camera_info", 2, info(EPOCH + 9, late)),
        ("/d/image", 3, image(EPOCH + 20, depth)),
    ]
    (only,), _, _ = read_depth(record(tmp_path / "a.mcap", first))
    (before, after), _, _ = read_depth(record(tmp_path / "b.mcap", later))

    assert only.camera == late
    assert before.camera == DEPTH
    assert after.camera == late


def with_topics(infos: list[str]) -> Any:
    """Return a stub of a recording with these calibration topics, and one without messages."""
    kind = "sensor_msgs/msg/CameraInfo"
    counts = {**dict.fromkeys(infos, 3), "/cam/infra/camera_info": 0}
    return SimpleNamespace(topics=[Topic(n, kind, "cdr", count) for n, count in counts.items()])


@pytest.mark.parametrize(
    ("image_topic", "expected"),
    [
        ("/cam/depth/image_raw", "/cam/depth/camera_info"),
        ("/cam/depth/image/compressedDepth", "/cam/depth/camera_info"),
        ("/cam/infra/image_raw", "/cam/camera_info"),
        ("/device_0/sensor_0/Depth_0/image/data", "/device_0/sensor_0/Depth_0/info/camera_info"),
        ("/other/image", None),  # several, of which none is near
        ("/image", "/camera_info"),  # beside it
    ],
)
def test_calibration_sharing_most_of_path_is_chosen(image_topic: str, expected: str | None) -> None:
    infos = ["/cam/camera_info", "/cam/depth/camera_info", "/cam/color/camera_info",
             "/device_0/sensor_0/Depth_0/info/camera_info", "/camera_info"]  # fmt: skip
    assert info_topic_of(image_topic, with_topics(infos), "") == expected
    single = with_topics(["/far/camera_info"])
    assert info_topic_of(image_topic, single, "camera") == "/far/camera_info"


def test_camera_still_fits_points_within_its_fit_error() -> None:
    points = organized_points(wavy_depth())
    assert still_fits(PinholeFit(DEPTH, 0.0), points)
    for shift, error_px, fits in ((0.1, 0.0, False), (0.1, 0.05, True), (0.7, 9.0, False)):
        moved = Camera(64, 48, 60.0, 61.0, 31.2 + shift, 23.7)
        assert still_fits(PinholeFit(moved, error_px), points) == fits
    few = np.full_like(points, np.nan)
    assert still_fits(PinholeFit(DEPTH, 0.0), few)
    assert not still_fits(PinholeFit(DEPTH, 0.0), few[:, :60])
    assert not still_fits(PinholeFit(DEPTH, 0.0), few[:40])


# ---- pixels


def test_compressed_image_may_have_short_padding_at_end() -> None:
    """An end marker far before the end is that of an embedded preview, not of the image."""
    for body in (jpeg(gradient()), png(gradient())):
        assert compressed_size(body + bytes(4000))[1:] == (64, 48)
        with pytest.raises(MessageError, match="truncated"):
            compressed_size(body + bytes(5000))
    with pytest.raises(MessageError, match="truncated"):
        compressed_size(png(gradient())[:23])


def test_incomplete_blocks_of_pixels_are_black() -> None:
    """Pixels left over at the border of the blocks must not shift the other pixels."""
    mosaic = np.full((5, 7), 90, np.uint8)
    found = pixels_of(ColourImage("", 0, 0, "", "bayer_rggb8", 7, 5, 7, mosaic.tobytes()))
    assert (found[:4, :6] == 90).all()
    assert not found[4:].any()
    assert not found[:, 6:].any()
    rows = np.tile(np.array([128, 77], np.uint8), (2, 3))
    found = pixels_of(ColourImage("", 0, 0, "", "uyvy", 3, 2, 6, rows.tobytes()))
    assert (found[:, :2] == 77).all()
    assert not found[:, 2:].any()


def test_raw_image_must_reach_its_last_pixel() -> None:
    """Rows may be padded, but the padding of the last row may be missing."""
    data = np.arange(60, dtype=np.uint8).tobytes()
    for step, size in ((8, 8 * 2 + 6), (6, 18), (0, 18)):
        found = ColourImage("", 0, 0, "", "bgr8", 2, 3, step, data[:size])
        first = (step or 6) * 2 + 3
        assert pixels_of(found)[2, 1].tolist() == [first + 2, first + 1, first]
        with pytest.raises(MessageError, match=f"needs {size} bytes and has {size - 1}"):
            pixels_of(ColourImage("", 0, 0, "", "bgr8", 2, 3, step, data[: size - 1]))
    with pytest.raises(MessageError, match="needs"):
        pixels_of(ColourImage("", 0, 0, "", "bgr8", 2, 3, 5, data))
    for width, height in ((0, 3), (2, 0)):
        with pytest.raises(MessageError, match=f"image of {width} x {height} pixels"):
            pixels_of(ColourImage("", 0, 0, "", "bgr8", width, height, 6, data))


def test_packed_colours_must_reach_last_point() -> None:
    points = np.zeros((3, 2, 3), np.float32)
    field = [make("sensor_msgs/msg/PointField", "rgba", 5, 6, 1)]
    data = np.arange(80, dtype=np.uint8)
    for row, big in ((20, False), (24, True)):
        need = 2 * row + 10 + 9
        layout = {"fields": field, "point_step": 10, "row_step": row, "is_bigendian": big}
        at = 2 * row + 10 + 5
        expected = [at + 1, at + 2, at + 3] if big else [at + 2, at + 1, at]
        found = cloud_colours(cloud(EPOCH, points, data=data[:need], **layout))
        assert found[2, 1].tolist() == expected
        with pytest.raises(MessageError, match="do not fit"):
            cloud_colours(cloud(EPOCH, points, data=data[: need - 1], **layout))
    for change in ({"point_step": 8}, {"row_step": 19}):
        with pytest.raises(MessageError, match="do not fit"):
            cloud_colours(cloud(EPOCH, points, data=data, **({**layout, "row_step": 20} | change)))


# ---- time


def test_clock_counts_each_kind_of_fault() -> None:
    year2000 = 946_684_800 * SECOND
    nothing: Any = SimpleNamespace(messages=lambda _topics: iter(()))
    clock = Clock(nothing, "/t")
    jump = 10 * SECOND
    times = [
        (EPOCH, EPOCH + 5),
        (EPOCH + 1, EPOCH + 6 + jump),  # the delay changes by just ten seconds
        (EPOCH + 2, EPOCH + 8 + 2 * jump),  # and by one nanosecond more
        (EPOCH + 2, EPOCH + 8 + 2 * jump),  # twice the same time is not backwards
        (EPOCH, EPOCH + 6 + 2 * jump),  # backwards
        (EPOCH + 1, EPOCH + 7 + 2 * jump),  # continues from there
        (0, 77),  # no stamp
        (year2000 - 1, year2000),
        (year2000 - 2, year2000 - 1),  # neither clock knows the year
    ]
    found = [clock.check(stamp, log_time) for stamp, log_time in times]

    assert found == [stamp or 77 for stamp, _ in times]
    assert clock.counts == {"zero": 1, "epoch": 1, "same": 1, "back": 3, "jump": 2}


@pytest.mark.parametrize("simulated", [False, True])
def test_simulated_time_is_not_suspicious(simulated: bool) -> None:
    """Every recording of a simulation, in which all is well, had a warning."""
    topics = (Topic("/clock", "rosgraph_msgs/msg/Clock", "cdr", 1),) if simulated else ()
    warnings: list[str] = []
    recording: Any = SimpleNamespace(topics=topics, warn=warnings.append)
    clock = Clock(recording, "/t")
    clock.check(7 * SECOND, EPOCH)
    clock.report()

    assert len(warnings) == (not simulated)


def test_overlapping_chunks_are_merged_in_bounded_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ties keep the order of the file; a chunk is opened when it is due and there is room."""
    chunks = {0: [50, 60], 1: [20, 30, 40], 2: [10, 30, 50], 3: [15, 70]}
    opened: list[int] = []

    def open_chunk(chunk: Chunk) -> Any:
        opened.append(chunk.entry)
        data = memoryview(bytes(100))
        return (RawMessage(chunk.entry, 0, t, t, data) for t in chunks[chunk.entry])

    def merged() -> list[tuple[int, int]]:
        opened.clear()
        due = [Chunk(times[0], 0, 7 * number, (), number) for number, times in chunks.items()]
        return [(m.log_time, m.channel_id) for m in in_time_order(due, open_chunk)]

    everything = sorted((t, n) for n, times in chunks.items() for t in times)
    assert merged() == everything
    assert opened == [2, 3, 1, 0]
    monkeypatch.setattr(chunked, "_PENDING", 100)  # bytes: the next chunk waits for room
    assert [n for _, n in merged()] == [2, 2, 2, 3, 3, 1, 1, 1, 0, 0]
    monkeypatch.setattr(chunked, "_PENDING", 350)  # each message that is handed out makes room
    assert merged() == everything


def test_slerp_agrees_with_scipy() -> None:
    rng = np.random.default_rng(8)
    for spread in (1.0, 0.02, 1e-4):
        a = rng.normal(size=4)
        b = a + spread * rng.normal(size=4)
        a, b = a / np.linalg.norm(a), -b / np.linalg.norm(b)
        for share in (0.13, 0.77):
            expected = Slerp([0, 1], Rotation.from_quat([a, b]))([share])
            found = Rotation.from_quat(_slerp(a, b, share))
            assert (found.inv() * expected).magnitude()[0] < 1e-7


def test_transform_is_extrapolated_only_within_tolerance() -> None:
    """Of equal samples, those in the middle are dropped, which must not change results."""
    buffer = TransformBuffer()
    for ms, x in ((1000, 1.0), (2000, 2.0), (3000, 2.0), (4000, 2.0), (5000, 5.0)):
        assert buffer.add("map", "cup", ms * MS, ((x, 0, 0), (0, 0, 0, 1)), static=False)
    expected = {900: 1.0, 1000: 1.0, 1300: 1.3, 2500: 2.0, 4000: 2.0, 4400: 3.2, 5100: 5.0}
    for ms, x in expected.items():
        assert buffer.lookup("map", "cup", ms * MS).translation[0] == pytest.approx(x)
    for stamp, message in ((900 * MS - 1, "before the first"), (5100 * MS + 1, "after the last")):
        with pytest.raises(Exception, match=message):
            buffer.lookup("map", "cup", stamp)


def test_last_transform_before_the_limit_is_not_forgotten() -> None:
    """A frame between two distant transforms needs the one long before it."""
    buffer = TransformBuffer()
    for ms in (1000, 4000, 9000):
        buffer.add("map", "cup", ms * MS, ((ms, 0, 0), (0, 0, 0, 1)), static=False)
    buffer.forget(5000 * MS)

    assert buffer.lookup("map", "cup", 5500 * MS).translation[0] == pytest.approx(5500)
    with pytest.raises(ExtrapolationError, match="before the first"):
        buffer.lookup("map", "cup", 1500 * MS)


def test_accelerations_are_averaged_over_half_a_second_each_way() -> None:
    bin_ns = 50_000_000
    sensor = Accelerometer("/imu", "imu")
    for number, value in ((20, (3.0, 0, 0)), (30, (0, 4.0, 0)), (41, (0, 0, 9.0))):
        sensor.add(number * bin_ns + 7, np.array(value))

    def up(number: int) -> list[float] | None:
        found = sensor.up(number * bin_ns + 49)
        return None if found is None else [round(float(x), 3) for x in found]

    assert up(9) is None
    assert up(10) == [1, 0, 0]
    assert up(20) == [0.6, 0.8, 0]
    assert up(30) == [0.6, 0.8, 0]
    assert up(31) == pytest.approx([0, 0.406, 0.914])
    assert up(41) == [0, 0, 1]
    assert up(52) is None


# ---- records and windows


def test_bag_record_must_end_within_its_chunk() -> None:
    """A record that claims more than the chunk holds must be an error, not be read past its end."""
    header = struct.pack("<I", 4) + b"op=\x02"

    def entry(data: bytes) -> bytes:
        return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data

    first, second = entry(b"hello"), entry(b"world of bags")
    found = [(fields["op"], bytes(data)) for fields, data in split(memoryview(first + second))]
    assert found == [(b"\x02", b"hello"), (b"\x02", b"world of bags")]
    for cut in range(1, len(second)):
        with pytest.raises(BagError):
            list(split(memoryview((first + second)[:-cut])))


def test_mcap_record_must_end_within_the_file(tmp_path: Path) -> None:
    content = struct.pack("<BQ", Opcode.HEADER, 5) + b"hello"
    more = struct.pack("<BQ", Opcode.METADATA, 3) + b"abc"
    path = tmp_path / "records"
    path.write_bytes(b"12" + content + more)
    with path.open("rb") as file:
        end = 2 + len(content + more)
        assert list(walk(file, 2, end)) == [
            (Opcode.HEADER, 11, 5, True),
            (Opcode.METADATA, 2 + 14 + 9, 3, True),
        ]
        with pytest.raises(TruncatedError, match="byte 16") as cut:
            list(walk(file, 2, end - 1))
        assert cut.value.record == (Opcode.METADATA, 25, 2, False)


TIMES = (5, 9, 9, 12, 30, 31, 31, 40, 52, 53, 53, 60)
TEXTS = {"/a": 0, "/b": 1}


def mcap_of(path: Path) -> Path:
    """Write one message per chunk, not in order of time."""
    with mcap_writer(path, chunk_size=1, compression=CompressionType.NONE) as writer:
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channels = [writer.register_channel(topic, "cdr", schema) for topic in TEXTS]
        for k, time in enumerate([*TIMES[6:], *TIMES[:6]]):
            writer.add_message(channels[k % 2], time, b"\0\1\0\0" + bytes([k]), time)
    return path


def bag_of(path: Path) -> Path:
    """Write the messages of `mcap_of` to a bag, two in most chunks."""
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = BagWriter(path)
    writer.chunk_threshold = 60
    with writer as bag:
        kind = "std_msgs/msg/UInt8"
        links = [bag.add_connection(topic, kind, typestore=store) for topic in TEXTS]
        for k, time in enumerate([*TIMES[6:], *TIMES[:6]]):
            message = store.types[kind](k)
            bag.write(links[k % 2], time, store.serialize_ros1(message, kind))
    return path


def test_bag_without_index_has_times_of_its_messages(tmp_path: Path) -> None:
    """The first message in the file need not be the earliest."""
    path = bag_of(tmp_path / "a.bag")
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)  # as while it was being recorded
    path.write_bytes(data)

    with open_recording(path) as recording:
        assert (recording.start_ns, recording.end_ns) == (5, 60)
        assert [(t.name, t.count) for t in recording.topics] == [("/a", 6), ("/b", 6)]
        assert recording.warnings == ["no index, or a damaged one; messages recovered: 12"]


@pytest.mark.parametrize("container", ["mcap", "bag"])
def test_time_windows_agree_with_official_readers(tmp_path: Path, container: str) -> None:
    """A window includes its start and excludes its stop."""
    if container == "mcap":
        path = mcap_of(tmp_path / "a.mcap")
        with path.open("rb") as file:
            read_all = list(make_reader(file).iter_messages())
        known = [(c.topic, m.log_time, bytes(m.data)) for _, c, m in read_all]
    else:
        path = bag_of(tmp_path / "a.bag")
        with BagReader(path) as bag:
            known = [(c.topic, time, bytes(data)) for c, time, data in bag.messages()]
    limits = [None, *sorted({t + d for t in TIMES for d in (-1, 0, 1)})]
    with open_recording(path) as recording:
        assert (recording.start_ns, recording.end_ns) == (5, 60)
        assert [(t.name, t.count) for t in recording.topics] == [("/a", 6), ("/b", 6)]
        assert not recording.warnings
        for topics in (None, ["/a"], ["/b"]):
            for start in limits:
                for stop in limits:
                    found = recording.messages(topics, start, stop)
                    expected = Counter(
                        (topic, time, data)
                        for topic, time, data in known
                        if (topics is None or topic in topics)
                        and (start is None or time >= start)
                        and (stop is None or time < stop)
                    )
                    got = [(m.topic, m.log_time_ns, bytes(m.data)) for m in found]
                    assert Counter(got) == expected
                    assert [time for _, time, _ in got] == sorted(time for _, time, _ in got)


def test_description_has_times_sizes_and_uses_of_topics(tmp_path: Path) -> None:
    """The description is what `shapecat info` prints."""
    items = depth_items(EPOCH, EPOCH + 250 * MS)
    items.append(("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE)))
    items.append(("/cam/color/image_raw", EPOCH, raw(EPOCH, gradient(60, 80), "rgb8", "color")))
    items.append(("/tf_static", EPOCH, static("camera", "color", (0.05, 0, 0), (0, 0, 0, 1))))
    path = record(tmp_path / "a.mcap", in_order(items))
    points = organized_points(wavy_depth())
    description = describe_recording(path)

    uses = {topic["name"]: (topic["use"], topic["count"]) for topic in description.pop("topics")}
    assert uses == {
        "/cam/color/camera_info": ("CameraInfo", 1),
        "/cam/color/image_raw": ("colour of /cam/depth/image_raw", 1),
        "/cam/depth/camera_info": ("CameraInfo", 2),
        "/cam/depth/image_raw": ("depth stream", 2),
        "/tf_static": ("", 1),
    }
    assert description == {
        "path": str(path),
        "kind": "mcap",
        "bytes": path.stat().st_size,
        "start_ns": EPOCH,
        "seconds": 0.25,
        "warnings": [],
    }
    alone = record(tmp_path / "b.mcap", [("/points", 1, cloud(EPOCH, points))])
    assert describe_recording(alone)["topics"][0]["use"] == "points stream"
    page = (Path(__file__).parents[1] / "docs/howto-bag.md").read_text("utf-8")
    assert "Look for *depth stream* or *points stream* in the column `use`" in page


def test_description_names_all_depth_streams_of_a_colour_camera(tmp_path: Path) -> None:
    """All depth streams but one seemed to have no colour."""
    aligned = "/cam/aligned_depth_to_color/image_raw"
    items = [*depth_items(EPOCH), (aligned, EPOCH, image(EPOCH, wavy_depth(), frame_id="color"))]
    items.append(("/cam/color/image_raw", EPOCH, raw(EPOCH, gradient(), "rgb8", "color")))
    path = record(tmp_path / "a.mcap", in_order(items))

    uses = {topic["name"]: topic["use"] for topic in describe_recording(path)["topics"]}
    assert uses["/cam/color/image_raw"] == f"colour of {aligned}, /cam/depth/image_raw"


def test_description_marks_depth_stream_without_calibration(tmp_path: Path) -> None:
    """`process` refuses such a stream, so `info` must say it beforehand."""
    images = [item for item in depth_items(EPOCH) if not item[0].endswith("camera_info")]
    path = record(tmp_path / "a.mcap", images)

    (topic,) = describe_recording(path)["topics"]
    assert topic["use"] == "depth stream without CameraInfo"
