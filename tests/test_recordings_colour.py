"""Tests of colour streams: choice, decoding, pairing in time, and registration to the depth."""

import io
import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rosbags.rosbag1 import Writer as Bag
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shapecat.cameras.colour import ColourImage, ColourView
from shapecat.errors import NoStreamError
from shapecat.geometry import rotation_from_quaternion
from shapecat.recordings import FrameRange, choose_streams, colour_frames, open_recording
from shapecat.recordings.colour_frames import frames_with_colour
from shapecat.recordings.colour_streams import ColourStream, pair_colours
from shapecat.recordings.decoding.colour_image import cloud_colours, encoded, pixels_of
from shapecat.recordings.messages import MessageError, Topic
from shapecat.recordings.overview import describe_recording
from shapecat.recordings.streams import Stream
from shapecat.recordings.transforms import extrinsics
from shapecat.recordings.transforms.extrinsics import Extrinsics
from shapecat.types import Camera, Frame
from tests.colour_messages import gradient, jpeg, packed, png, raw
from tests.mcap_files import McapChannels, mcap_writer
from tests.messages import (
    EPOCH,
    IMAGE,
    SECOND,
    STORE,
    cloud,
    header,
    image,
    info,
    make,
    organized_points,
    wavy_depth,
    write,
)

MS = 10**6
WIDE = Camera(80, 60, 71.0, 72.0, 40.2, 29.1)
Pairs = list[tuple[Frame, ColourView | None]]


def read(
    path: Path, wanted: str | None = None, topics: Sequence[str] = (), **frame_range: Any
) -> tuple[Pairs, list[str]]:
    """Return frames and their colour, and the warnings; ``wanted`` is the colour topic."""
    with open_recording(path) as recording:
        streams = choose_streams(recording, topics)
        colours = pair_colours(recording, streams, wanted)
        chosen = FrameRange(**frame_range)
        pairs = frames_with_colour(recording, streams, colours, chosen)
        return list(pairs), recording.warnings


def depth_items(*stamps: int, frame_id: str = "camera") -> list[tuple[str, int, Any]]:
    items: list[tuple[str, int, Any]] = []
    for stamp in stamps:
        items.append(("/cam/depth/camera_info", stamp, info(stamp)))
        items.append(("/cam/depth/image_raw", stamp, image(stamp, wavy_depth(), frame_id=frame_id)))
    return items


def in_order(items: list[tuple[str, int, Any]]) -> list[tuple[str, int, Any]]:
    return sorted(items, key=lambda item: item[1])


def static(parent: str, child: str, translation: Any, quaternion: Any, stamp: int = EPOCH) -> Any:
    transform = make(
        "geometry_msgs/msg/Transform",
        make("geometry_msgs/msg/Vector3", *translation),
        make("geometry_msgs/msg/Quaternion", *quaternion),
    )
    stamped = make("geometry_msgs/msg/TransformStamped", header(stamp, parent), child, transform)
    return make("tf2_msgs/msg/TFMessage", [stamped])


def paired(
    path: Path,
    *more: tuple[str, int, Any],
    frame_id: str = "color_optical",
    distortion: Sequence[float] = (0.1, -0.2, 0.001, 0.002, 0.0),
    **options: Any,
) -> Path:
    """Write a depth image, a colour image of another camera, and ``more`` messages."""
    items = depth_items(EPOCH)
    items += [("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE, distortion))]
    colours = raw(EPOCH, gradient(60, 80), "rgb8", frame_id)
    items += [*more, ("/cam/color/image_raw", EPOCH + 1, colours)]
    return write(path, in_order(items), **options)


@pytest.mark.parametrize(
    ("encoding", "data"),
    [
        ("rgb8", gradient()),
        ("bgr8", gradient()[..., ::-1]),
        ("rgba8", np.concatenate([gradient(), np.full((48, 64, 1), 7, np.uint8)], axis=-1)),
        ("bgra8", np.concatenate([gradient()[..., ::-1], np.zeros((48, 64, 1), "u1")], axis=-1)),
        ("8UC3", gradient()[..., ::-1]),  # OpenCV's order
        ("8UC4", np.concatenate([gradient()[..., ::-1], np.zeros((48, 64, 1), "u1")], axis=-1)),
        ("rgb16", gradient().astype("<u2") * 256 + 99),
        ("bgr16", gradient()[..., ::-1].astype("<u2") * 256 + 99),
    ],
)
def test_raw_encodings_give_same_pixels(encoding: str, data: Any) -> None:
    """A swapped channel makes a red cup blue in every exported data set."""
    message = raw(EPOCH, data, encoding)
    found = ColourImage("", 0, 0, "", encoding, 64, 48, message.step, bytes(message.data))

    np.testing.assert_array_equal(pixels_of(found), gradient())


def test_bayer_and_yuv_images_are_decoded() -> None:
    red, green, blue = 200, 120, 40
    mosaic = np.zeros((6, 8), np.uint8)
    mosaic[::2, 1::2], mosaic[1::2, ::2] = red, blue  # grbg
    mosaic[::2, ::2] = mosaic[1::2, 1::2] = green
    y = 0.299 * red + 0.587 * green + 0.114 * blue
    u, v = 128 + 0.564 * (blue - y), 128 + 0.713 * (red - y)
    uyvy = np.tile(np.round([u, y, v, y]), (6, 4)).astype(np.uint8)
    for encoding, data in (("bayer_grbg8", mosaic), ("yuv422", uyvy)):
        width = data.shape[1] // (1 if data is mosaic else 2)
        found = ColourImage("", 0, 0, "", encoding, width, 6, data.shape[1], data.tobytes())
        pixels = pixels_of(found).astype(int)
        assert np.abs(pixels - [red, green, blue]).max() <= 2


@pytest.mark.parametrize(
    ("encoding", "red_at", "blue_at"),
    [
        ("bayer_rggb8", (0, 0), (1, 1)),
        ("bayer_grbg8", (0, 1), (1, 0)),
        ("bayer_gbrg8", (1, 0), (0, 1)),
        ("bayer_bggr8", (1, 1), (0, 0)),
    ],
)
def test_bayer_patterns_place_red_and_blue_correctly(
    encoding: str, red_at: tuple[int, int], blue_at: tuple[int, int]
) -> None:
    mosaic = np.full((6, 8), 120, np.uint8)
    mosaic[red_at[0] :: 2, red_at[1] :: 2] = 200
    mosaic[blue_at[0] :: 2, blue_at[1] :: 2] = 40
    found = ColourImage("", 0, 0, "", encoding, 8, 6, 8, mosaic.tobytes())

    assert np.abs(pixels_of(found).astype(int) - [200, 120, 40]).max() <= 2


@pytest.mark.parametrize("encoding", ["yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_yuv_encodings_order_luma_and_chroma_correctly(encoding: str) -> None:
    """UYVY is the order of yuv422, YUYV that of yuv422_yuy2."""
    red, green, blue = 200, 120, 40
    y = 0.299 * red + 0.587 * green + 0.114 * blue
    u, v = 128 + 0.564 * (blue - y), 128 + 0.713 * (red - y)
    pair = [y, u, y, v] if encoding in {"yuyv", "yuv422_yuy2"} else [u, y, v, y]
    data = np.tile(np.round(pair), (6, 4)).astype(np.uint8)
    found = ColourImage("", 0, 0, "", encoding, 8, 6, 16, data.tobytes())

    assert np.abs(pixels_of(found).astype(int) - [red, green, blue]).max() <= 2


def test_packed_point_colours_are_read_at_their_offset() -> None:
    """PCL packs 0x00RRGGBB into a float; read as a number, it would make all objects black."""
    points = organized_points(wavy_depth())
    data = np.zeros((48, 64), np.dtype([("xyz", "<f4", 3), ("pad", "<f4"), ("rgb", "<u4")]))
    data["xyz"] = points
    colours = gradient().astype(np.uint32)
    data["rgb"] = (colours[..., 0] << 16) | (colours[..., 1] << 8) | colours[..., 2]
    fields = [make("sensor_msgs/msg/PointField", n, 4 * k, 7, 1) for k, n in enumerate("xyz")]
    fields.append(make("sensor_msgs/msg/PointField", "rgb", 16, 7, 1))
    raw_bytes = np.frombuffer(data.tobytes(), np.uint8)
    step = {"fields": fields, "point_step": 20, "row_step": 20 * 64, "data": raw_bytes}
    message = cloud(EPOCH, points, **step)

    np.testing.assert_array_equal(cloud_colours(message), gradient())
    message.data = raw_bytes[:-40]
    with pytest.raises(MessageError, match="do not fit"):
        cloud_colours(message)


def test_cloud_colours_are_registered_to_its_points(tmp_path: Path) -> None:
    """A cloud may hold its colours; without an image topic, they would be lost."""
    points = organized_points(wavy_depth())
    data = np.zeros((48, 64), np.dtype([("xyz", "<f4", 3), ("rgb", "<u4")]))
    data["xyz"], data["rgb"] = points, 0x0A141E
    fields = [make("sensor_msgs/msg/PointField", n, 4 * k, 7, 1) for k, n in enumerate("xyz")]
    fields.append(make("sensor_msgs/msg/PointField", "rgb", 12, 7, 1))
    step = {"point_step": 16, "row_step": 1024, "data": np.frombuffer(data.tobytes(), "u1")}
    path = write(tmp_path / "a.mcap", [("/p", 1, cloud(EPOCH, points, fields=fields, **step))])

    ((frame, view),), _ = read(path)
    assert view is not None
    assert view.registered
    assert frame.organized
    np.testing.assert_array_equal(
        np.unique(pixels_of(view.image).reshape(-1, 3), axis=0), [[10, 20, 30]]
    )


@pytest.mark.parametrize(("encode", "close"), [(jpeg, 4), (png, 0)])
def test_compressed_images_are_kept_unchanged(tmp_path: Path, encode: Any, close: int) -> None:
    """A second compression would cost quality and time."""
    body = encode(gradient())
    items = [*depth_items(EPOCH), ("/cam/color/image_raw/compressed", EPOCH, packed(EPOCH, body))]
    ((_, view),), warnings = read(write(tmp_path / "a.mcap", in_order(items)))

    assert view is not None
    assert bytes(view.image.data) == body
    assert (view.image.width, view.image.height) == (64, 48)
    assert np.abs(pixels_of(view.image).astype(int) - gradient()).max() <= close
    assert not warnings


@pytest.mark.parametrize(("shrink", "size"), [(1, (48, 64)), (2, (24, 32)), (4, (12, 16))])
def test_jpeg_is_decoded_at_a_fraction_of_its_size(shrink: int, size: tuple[int, int]) -> None:
    """The review needs few pixels; decoding all of them takes several times as long."""
    image = ColourImage("/c", 1, 2, "c", "jpeg", 64, 48, 0, jpeg(gradient()))

    assert pixels_of(image, shrink=shrink).shape == (*size, 3)


def test_compressed_colour_stream_is_preferred(tmp_path: Path) -> None:
    """Infrared images, or those of another camera, must not be taken for the colour."""
    items = depth_items(EPOCH)
    for topic in ("/cam/infra1/image", "/cam/color/image_raw", "/other/color/image_raw"):
        encoding = "mono8" if "infra" in topic else "rgb8"
        data = gradient() if encoding == "rgb8" else gradient()[..., 0]
        items.append(
            (topic, EPOCH, raw(EPOCH, data, encoding, "far" if "other" in topic else "camera"))
        )
    body = jpeg(gradient())
    items.append(("/cam/color/image_raw/compressed", EPOCH, packed(EPOCH, body)))
    path = write(tmp_path / "a.mcap", in_order(items))

    with open_recording(path) as recording:
        (stream,) = choose_streams(recording)
        chosen = pair_colours(recording, [stream]).get(stream.topic)
        assert chosen is not None
        assert chosen.topic == "/cam/color/image_raw/compressed"
        other = pair_colours(recording, [stream], "other/color/image_raw").get(stream.topic)
        assert other is not None
        assert other.topic == "/other/color/image_raw"
        with pytest.raises(
            NoStreamError, match="/nowhere does not exist; colour images: /cam/color"
        ):
            pair_colours(recording, [stream], "/nowhere")
        with pytest.raises(NoStreamError, match="holds no colour images"):
            pair_colours(recording, [stream], "/cam/depth/image_raw")
    uses = {t["name"]: t["use"] for t in describe_recording(path)["topics"]}
    assert uses["/cam/color/image_raw/compressed"] == "colour of /cam/depth/image_raw"


def test_grey_images_are_used_only_on_request(tmp_path: Path) -> None:
    """A grey camera is not a colour camera, but masks can be drawn on its images."""
    grey = raw(EPOCH, gradient()[..., 0], "mono8", "camera")
    path = write(tmp_path / "a.mcap", [*depth_items(EPOCH), ("/cam/left/image_raw", EPOCH, grey)])

    with open_recording(path) as recording:
        (stream,) = choose_streams(recording)
        assert not pair_colours(recording, [stream])
    ((_, view),), _ = read(path, "/cam/left/image_raw")
    assert view is not None
    assert (pixels_of(view.image) == gradient()[..., :1]).all()


def test_frames_pair_with_nearest_image_within_a_period(tmp_path: Path) -> None:
    """An image from another time would paint the table onto a moved object."""
    shades = {k: gradient(seed=k) for k in range(4)}
    colours = [
        ("/cam/color/image_raw", EPOCH + t * MS, raw(EPOCH + t * MS, shades[k], "rgb8"))
        for k, t in enumerate((0, 40, 80, 120))
    ]
    stamps = [EPOCH + t * MS for t in (19, 21, 100, 145)]
    pairs, warnings = read(write(tmp_path / "a.mcap", in_order([*depth_items(*stamps), *colours])))

    nearest = [None if v is None else (v.image.stamp_ns - EPOCH) // MS for _, v in pairs]
    assert nearest == [0, 40, 80, None]
    assert [frame.index for frame, _ in pairs] == [0, 1, 2, 3]
    assert any("(1×): no colour image near the time of the frame" in w for w in warnings)


def test_frames_midway_between_images_have_colour(tmp_path: Path) -> None:
    """At half the rate of depth, every second frame is half a period of the images from two.

    The periods vary by some microseconds, so some of these frames got no colour.
    """
    items = depth_items(*(EPOCH + 33 * k * MS for k in range(20)))
    for k in range(0, 21, 2):
        stamp = EPOCH + 33 * k * MS + (-1) ** (k // 2) * 400_000
        items.append(("/cam/color/image_raw", stamp, raw(stamp, gradient(), "rgb8")))
    pairs, warnings = read(write(tmp_path / "a.mcap", in_order(items)))

    assert all(view is not None for _, view in pairs)
    assert not warnings


def test_frame_pairs_with_the_image_of_its_time_not_of_its_arrival(tmp_path: Path) -> None:
    """Delays vary, so the image that arrives with a frame need not be the nearest in time."""
    colours = [
        ("/cam/color/image_raw", EPOCH + arrival * MS, raw(EPOCH + t * MS, gradient(), "rgb8"))
        for t, arrival in ((0, 10), (100, 110), (200, 210), (300, 345), (340, 350), (440, 450))
    ]
    items = [(topic, EPOCH + 352 * MS, one) for topic, _, one in depth_items(EPOCH + 310 * MS)]
    ((_, view),), _ = read(write(tmp_path / "a.mcap", in_order([*items, *colours])))

    assert view is not None
    assert view.image.stamp_ns == EPOCH + 300 * MS


@pytest.mark.parametrize("early", [False, True])
def test_pairing_keeps_to_its_side_of_a_clock_step(tmp_path: Path, early: bool) -> None:
    """After a clock is set back, stamps repeat: a frame could get an image from before the step."""
    stamps = [EPOCH + (33 * k - 198 * (k > 9)) * MS for k in range(20)]
    logged = [EPOCH + 33 * k * MS for k in range(20)]
    items: list[tuple[str, int, Any]] = []
    for time, at in zip(logged, stamps, strict=True):
        items += [(topic, time + 2 * MS, message) for topic, _, message in depth_items(at)]
        colour = raw(at + MS, gradient(), "rgb8")
        items.append(("/cam/color/image_raw", time + (1 if early else 5) * MS, colour))
    pairs, _ = read(write(tmp_path / "a.mcap", in_order(items)))

    delay = -MS if early else 3 * MS
    found = [view and view.image.log_time_ns - frame.log_time_ns for frame, view in pairs]
    assert found == [delay] * 20


def test_pairing_waits_for_image_logged_late(tmp_path: Path) -> None:
    """Compression takes time: the right image is often logged after the next frame."""
    stamps = [EPOCH + t * MS for t in (0, 33, 66)]
    colours = [
        ("/cam/color/image_raw", s + 50 * MS, raw(s, gradient(seed=k), "rgb8"))
        for k, s in enumerate(stamps)
    ]
    pairs, _ = read(write(tmp_path / "a.mcap", in_order([*depth_items(*stamps), *colours])))

    assert [v and v.image.stamp_ns for _, v in pairs] == stamps


def test_image_is_kept_for_depth_logged_late(tmp_path: Path) -> None:
    """Depth may arrive dozens of images late; if these were dropped, no frame would have colour."""
    stamps = [EPOCH + 100 * k * MS for k in range(3)]
    items = [(t, time + 600 * MS, message) for t, time, message in depth_items(*stamps)]
    times = [EPOCH + round(k * 1000 / 60 * MS) for k in range(50)]
    items += [("/cam/color/image_raw", t, raw(t, gradient(), "rgb8")) for t in times]
    pairs, _ = read(write(tmp_path / "a.mcap", in_order(items)))

    assert [v and v.image.stamp_ns for _, v in pairs] == [times[k] for k in (0, 6, 12)]


def test_images_kept_for_late_depth_are_limited_in_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """64 raw images of 12 megapixels that wait for depth would take 2 GB."""
    monkeypatch.setattr(colour_frames, "_BUFFERED_BYTES", 3 * gradient().nbytes)
    times = [EPOCH + 20 * k * MS for k in range(10)]
    items = [(t, times[-1] + MS, message) for t, _, message in depth_items(times[5], times[8])]
    items += [("/cam/color/image_raw", t, raw(t, gradient(), "rgb8")) for t in times]
    pairs, _ = read(write(tmp_path / "a.mcap", in_order(items)))

    assert [v and v.image.stamp_ns for _, v in pairs] == [None, times[8]]


def late_images(path: Path, ahead_ms: int, late_ms: int) -> Path:
    """Write depth and colour images at 30 Hz with the same times, but another clock or log time."""
    items = []
    for time in (EPOCH + 33 * k * MS for k in range(40)):
        items += depth_items(time)
        colours = raw(time + ahead_ms * MS, gradient(), "rgb8")
        items.append(("/cam/color/image_raw", time + late_ms * MS, colours))
    return write(path, in_order(items))


def test_frames_wait_half_a_second_for_late_colour(tmp_path: Path) -> None:
    """Colour over a slow network was missing in all frames but the last few.

    Only eight frames waited, which is a quarter of a second at 30 Hz.
    """
    pairs, warnings = read(late_images(tmp_path / "a.mcap", 0, 450))

    assert [view and view.image.stamp_ns for _, view in pairs] == [f.stamp_ns for f, _ in pairs]
    assert not warnings


@pytest.mark.parametrize(
    ("ahead_ms", "late_ms", "difference"),
    [(500, 0, "0.50 s ahead of"), (-500, 0, "0.50 s behind"), (0, 700, "0.70 s behind")],
)
def test_colour_of_another_clock_is_reported(
    ahead_ms: int, late_ms: int, difference: str, tmp_path: Path
) -> None:
    """Users saw images in the recording, but only heard that there is none near the frames."""
    _, warnings = read(late_images(tmp_path / "a.mcap", ahead_ms, late_ms))

    (warning,) = (text for text in warnings if "at the same log time" in text)
    assert warning.startswith(
        f"/cam/color/image_raw: its stamps are {difference} those of /cam/depth/image_raw "
    )


def test_end_of_colour_is_no_other_clock(tmp_path: Path) -> None:
    """In a slow simulation, delays grow, and later frames have others than the last image."""
    items = depth_items(*(EPOCH + 33 * k * MS for k in range(40)))
    colours = [raw(EPOCH + 33 * k * MS, gradient(), "rgb8") for k in range(10)]
    items += [("/cam/color/image_raw", EPOCH + 33 * k * MS, c) for k, c in enumerate(colours)]
    slow = [(topic, EPOCH + 10 * (time - EPOCH), message) for topic, time, message in items]
    _, (warning,) = read(write(tmp_path / "a.mcap", in_order(slow)))

    assert "frames without colour (30×)" in warning


@pytest.mark.parametrize("bare", [0, 2])
def test_missing_stamps_are_estimated_in_simulated_time(tmp_path: Path, bare: int) -> None:
    """Simulated time begins near 0; with the log time as stamp, objects would get new tracks.

    The estimate is not exact: masks may be displaced, which must be said.
    """
    expected = [7 + k * SECOND for k in range(4)]
    items = depth_items(*expected)
    items += [("/cam/color/image_raw", t + 9, raw(t, gradient(), "rgb8")) for t in expected]
    for _, _, message in items:
        if message.header.stamp.sec == bare:
            message.header = header(0, message.header.frame_id)
    logged = [(topic, EPOCH + time, message) for topic, time, message in in_order(items)]
    pairs, warnings = read(write(tmp_path / "a.mcap", logged))

    assert [frame.stamp_ns for frame, _ in pairs] == expected
    assert [view and view.image.stamp_ns for _, view in pairs] == expected
    estimated = "header.stamp is 0 (1×): it is estimated from the log time"
    topics = "/cam/depth/image_raw", "/cam/color/image_raw"
    assert {f"{topic}: {estimated}" for topic in topics} <= set(warnings)


@pytest.mark.parametrize(
    "kind", ["nv12", "h264", "foxglove.CompressedVideo", "theora_image_transport/msg/Packet"]
)
def test_unread_colour_is_reported(tmp_path: Path, kind: str) -> None:
    """Users did not learn that their recording has colour that cannot be read."""
    items = [
        *depth_items(EPOCH),
        ("/cam/aligned_depth_to_color", EPOCH, image(EPOCH, wavy_depth())),
    ]
    if kind == "nv12":
        colours = raw(EPOCH, np.zeros((48, 64), np.uint8), kind)
        items.append(("/cam/color/image_raw", EPOCH, colours))
    if kind == "h264":
        items.append(("/cam/color/image_raw", EPOCH, packed(EPOCH, b"\0\0\0\1g", kind)))
    path = write(tmp_path / "a.mcap", items)
    with open_recording(path) as recording:
        if kind.startswith(("foxglove", "theora")):
            recording.topics += (Topic("/cam/color/image_raw", kind, "protobuf", 1),)
        assert not pair_colours(recording, choose_streams(recording, ["/cam/depth/image_raw"]))
        (warning,) = recording.warnings

    assert warning == f"/cam/color/image_raw: there is no colour, since {kind} cannot be read"


def test_unread_colour_is_reported_beside_another_camera(tmp_path: Path) -> None:
    """The images of another camera hid that those of the depth camera cannot be read.

    They were paired with its depth if there was no other depth camera.
    """
    other = ("/web/image_raw", EPOCH, raw(EPOCH, gradient(), "rgb8", "web"))
    nv12 = raw(EPOCH, np.zeros((48, 64), np.uint8), "nv12", "color_optical")
    items = [*depth_items(EPOCH), ("/cam/color/image_raw", EPOCH, nv12), other]
    with open_recording(write(tmp_path / "a.mcap", items)) as recording:
        assert not pair_colours(recording, choose_streams(recording))
        (warning,) = recording.warnings

    assert warning == "/cam/color/image_raw: there is no colour, since nv12 cannot be read"

    second = depth_items(EPOCH, frame_id="b_optical")
    items += [(topic.replace("/cam/", "/b/"), *rest) for topic, *rest in second]
    items.append(("/b/color/image_raw", EPOCH, other[2]))
    with open_recording(write(tmp_path / "b.mcap", items)) as recording:
        assert list(pair_colours(recording, choose_streams(recording, ["/b/depth/image_raw"])))
        assert not recording.warnings  # the images of the other camera are not needed


def test_damaged_images_are_skipped_and_reported(tmp_path: Path) -> None:
    """A damaged image must neither end a run nor go unreported."""
    body = jpeg(gradient())
    bodies = [body[:-200], b"\xff\xd8\xff", b"", b"no image", body]
    stamps = [EPOCH + 100 * k * MS for k in range(5)]
    colours = [
        ("/cam/color/image_raw/compressed", s, packed(s, b))
        for s, b in zip(stamps, bodies, strict=True)
    ]
    path = write(tmp_path / "a.mcap", in_order([*depth_items(*stamps), *colours]))
    pairs, warnings = read(path, "/cam/color/image_raw/compressed")

    assert [view is not None for _, view in pairs] == [False, False, False, False, True]
    assert any("jpeg image is truncated" in w for w in warnings)
    assert any("neither JPEG nor PNG" in w for w in warnings)


def test_damaged_raw_images_are_skipped_and_reported(tmp_path: Path) -> None:
    """Counted as images of the run, damaged images would fail only when they are shown."""
    stamps = [EPOCH + 100 * k * MS for k in range(4)]
    images = [raw(stamp, gradient(), "rgb8") for stamp in stamps]
    images[0].data = images[0].data[:100]
    images[1].data = images[1].data[:0]
    images[2].step = 3 * 64 - 1
    colours = [("/cam/color/image_raw", s, m) for s, m in zip(stamps, images, strict=True)]
    pairs, warnings = read(write(tmp_path / "a.mcap", in_order([*depth_items(*stamps), *colours])))

    assert [view is not None for _, view in pairs] == [False, False, False, True]
    assert any("(1×): image of 64 x 48 pixels needs" in w and "has 100" in w for w in warnings)


def test_damaged_image_is_message_error() -> None:
    """The header of an image may claim more than its content holds."""
    bodies = {"jpeg": jpeg(gradient()), "png": png(gradient())}
    scan, half = bodies["jpeg"].index(b"\xff\xda"), len(bodies["png"]) // 2
    damaged = {
        "jpeg": bodies["jpeg"][:scan] + bodies["jpeg"][-2:],
        "png": bodies["png"][:half] + bodies["png"][-12:],
    }
    for kind, body in bodies.items():
        with pytest.raises(MessageError, match=f"{kind} image is damaged"):
            pixels_of(ColourImage("", 0, 0, "", kind, 64, 48, 0, damaged[kind]))
        with pytest.raises(MessageError, match="instead of"):
            pixels_of(ColourImage("", 0, 0, "", kind, 640, 480, 0, body))
    short = ColourImage("", 0, 0, "", "rgb8", 640, 480, 1920, bytes(1000))
    with pytest.raises(MessageError, match="needs 921600 bytes and has 1000"):
        pixels_of(short)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_non_finite_distortion_is_reported(tmp_path: Path, wrong: float) -> None:
    """Otherwise all masks would be empty without an explanation."""
    tf = ("/tf_static", EPOCH, static("camera", "color_optical", (0.05, 0, 0), (0, 0, 0, 1)))
    ((_, view),), warnings = read(paired(tmp_path / "a.mcap", tf, distortion=(wrong, 0, 0, 0, 0)))

    assert view is None
    assert any("lens distortion that is not finite" in w for w in warnings)


def test_pose_of_colour_camera_comes_from_transforms(tmp_path: Path) -> None:
    """The pose is rotated, so that an inverted transform cannot go unnoticed."""
    turn = (0.1, -0.2, 0.05, 0.97)
    tf = ("/tf_static", EPOCH, static("camera", "color_optical", (0.05, 0.01, -0.02), turn))
    ((_, view),), _ = read(paired(tmp_path / "a.mcap", tf))

    assert view is not None
    assert view.lens is not None
    assert view.lens.model == "plumb_bob"
    assert view.lens.pinhole == WIDE
    assert view.colour_from_depth is not None
    # depth_from_colour is what was published: a point 1 m ahead of the colour camera.
    ahead = rotation_from_quaternion(turn) @ [0, 0, 1] + [0.05, 0.01, -0.02]
    pose = view.colour_from_depth
    np.testing.assert_allclose(pose.rotation @ ahead + pose.translation, [0, 0, 1], atol=1e-9)


def test_moving_colour_camera_has_new_pose_in_each_frame(tmp_path: Path) -> None:
    """If the first pose were kept for all frames, later ones would get the wrong colours."""
    items = [
        *depth_items(EPOCH, EPOCH + SECOND),
        ("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE)),
    ]
    for stamp, x in ((EPOCH, 0.05), (EPOCH + SECOND, 0.09)):
        moved = static("camera", "color_optical", (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)
        colours = raw(stamp, gradient(60, 80), "rgb8", "color_optical")
        items += [("/tf", stamp, moved), ("/cam/color/image_raw", stamp + 1, colours)]
    pairs, _ = read(write(tmp_path / "a.mcap", in_order(items)))

    poses = [view.colour_from_depth for _, view in pairs if view is not None]
    assert [pose.translation[0] for pose in poses if pose is not None] == [-0.05, -0.09]


@pytest.mark.parametrize("first_s", [0.0, 0.1])
def test_calibration_recorded_once_is_used_for_all_images(tmp_path: Path, first_s: float) -> None:
    """A latched CameraInfo may come after the first image, or before those that --start selects."""
    once = EPOCH + round(first_s * SECOND)
    items = [("/cam/color/camera_info", once, info(once, WIDE))]
    for stamp in (EPOCH, EPOCH + 50 * MS, EPOCH + 100 * MS):
        items += depth_items(stamp, frame_id="color")
        items.append(("/cam/color/image_raw", stamp, raw(stamp, gradient(60, 80), "rgb8", "color")))
    path = write(tmp_path / "a.mcap", in_order(items))
    pairs, warnings = read(path, start_s=0.05 if first_s == 0 else None)

    lenses = [view and view.lens and view.lens.pinhole for _, view in pairs]
    assert lenses == [WIDE] * (2 if first_s == 0 else 3)
    assert not warnings


@pytest.mark.parametrize("zeros", [(0,), (0, 1), (1,), (2,), (0, 1, 2)])
def test_calibration_of_zeros_does_not_replace_valid_one(
    tmp_path: Path, zeros: Sequence[int]
) -> None:
    """Some drivers publish zeros at first; a valid calibration of another time is better."""
    items: list[tuple[str, int, Any]] = []
    for k in range(3):
        stamp = EPOCH + k * 50 * MS
        calibration = info(stamp, WIDE)
        if k in zeros:
            calibration.k, calibration.p = np.zeros(9), np.zeros(12)
        items.append(("/cam/color/camera_info", stamp, calibration))
        items += depth_items(stamp, frame_id="color")
        items.append(("/cam/color/image_raw", stamp, raw(stamp, gradient(60, 80), "rgb8", "color")))
    pairs, warnings = read(write(tmp_path / "a.mcap", items))

    lenses = [view and view.lens and view.lens.pinhole for _, view in pairs]
    assert lenses == [WIDE if len(zeros) < 3 else None] * 3
    if len(zeros) == 3:
        assert any("CameraInfo without intrinsics" in warning for warning in warnings)
    else:
        assert not warnings


def test_sensors_without_frame_ids_do_not_share_their_colour(tmp_path: Path) -> None:
    """Some drivers leave frame ids empty; two empty ids do not mean the same frame."""
    items: list[tuple[str, int, Any]] = []
    for name in ("a", "b"):
        items.append((f"/{name}/depth/camera_info", EPOCH, info(EPOCH)))
        depth = image(EPOCH, wavy_depth(), frame_id="")
        items.append((f"/{name}/depth/image_raw", EPOCH, depth))
    items.append(("/b/color/image_raw", EPOCH, raw(EPOCH, gradient(), "rgb8", "")))

    topics = ["/a/depth/image_raw", "/b/depth/image_raw"]
    pairs, _ = read(write(tmp_path / "a.mcap", items), topics=topics)

    assert {frame.topic: image is not None for frame, image in pairs} == {
        "/a/depth/image_raw": False,
        "/b/depth/image_raw": True,
    }


def test_colour_without_transform_is_unused(tmp_path: Path) -> None:
    """Misplaced colours are worse than no colours."""
    ((_, view),), warnings = read(paired(tmp_path / "a.mcap"))

    assert view is None
    assert any("no transform between camera and color_optical" in w for w in warnings)


@pytest.mark.parametrize("frame_id", ["wrist", "camera", ""])
def test_images_that_only_seem_registered_are_reported(tmp_path: Path, frame_id: str) -> None:
    """All cameras of a simulation may have equal intrinsics: masks were on images of the wrist."""
    colours = raw(EPOCH, gradient(), "rgb8", frame_id)
    items = depth_items(EPOCH, frame_id=frame_id and "camera")
    items += [("/w/camera_info", EPOCH, info(EPOCH)), ("/w/image_raw", EPOCH, colours)]
    ((_, view),), warnings = read(write(tmp_path / "a.mcap", items))

    assert view is not None
    assert view.registered
    guess = "its images count as registered, for their intrinsics"
    doubted = f"/w/image_raw: no transform between camera and wrist; {guess}"
    assert warnings == ([doubted] if frame_id == "wrist" else [])


def test_extrinsics_topic_without_messages_is_ignored(tmp_path: Path) -> None:
    """A recording that starts after the driver lacks its messages, and must still be processed."""
    declared = [("/cam/extrinsics/depth_to_color", "std_msgs/msg/String")]
    ((_, view),), warnings = read(paired(tmp_path / "a.mcap", empty=declared))

    assert view is None
    assert any("no transform between camera and color_optical" in w for w in warnings)


def test_image_of_same_frame_and_other_size_is_projected(tmp_path: Path) -> None:
    """An equal frame id means an equal camera position, not equal pixels."""
    ((_, view),), _ = read(paired(tmp_path / "a.mcap", frame_id="camera"))

    assert view is not None
    assert not view.registered
    np.testing.assert_array_equal(view.colour_from_depth.rotation, np.eye(3))  # type: ignore[union-attr]


def test_realsense_extrinsics_are_read_column_by_column(tmp_path: Path) -> None:
    """Read row by row, the rotation would be inverted, and the camera would face the wrong way."""
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    text = "std_msgs/Header header\nfloat64[9] rotation\nfloat64[3] translation\n"
    kind = "realsense2_camera/msg/Extrinsics"
    ros1.register(get_types_from_msg(text, kind))
    rotation = rotation_from_quaternion((0.02, 0.3, -0.1, 0.95))
    path = tmp_path / "a.bag"
    items = in_order(depth_items(EPOCH))
    items.append(("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE)))
    items.append(("/cam/color/image_raw", EPOCH, raw(EPOCH, gradient(60, 80), "bgr8", "color")))
    with Bag(path) as bag:
        for topic, time, message in items:
            name = message.__msgtype__
            connection = bag.add_connection(topic, name, typestore=ros1)
            data = STORE.cdr_to_ros1(STORE.serialize_cdr(message, name), name)
            bag.write(connection, time, data)
        own = ros1.types[kind](
            ros1.types["std_msgs/msg/Header"](0, header(EPOCH).stamp, ""),
            rotation.T.ravel(),
            np.array([0.015, 0.001, -0.002]),
        )
        connection = bag.add_connection("/cam/extrinsics/depth_to_color", kind, typestore=ros1)
        bag.write(connection, EPOCH, ros1.serialize_ros1(own, kind))
    ((_, view),), _ = read(path)

    assert view is not None
    assert view.colour_from_depth is not None
    np.testing.assert_allclose(view.colour_from_depth.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(view.colour_from_depth.translation, [0.015, 0.001, -0.002])


@pytest.mark.parametrize(
    ("metres", "expected"),
    [
        ({"/cam1": 1.0, "/cam2": 2.0}, 2.0),
        ({"/cam": 3.0, "/cam2": 2.0}, 2.0),  # /cam is not the namespace of /cam2
        ({"/cam1": 1.0, "/cam2": np.nan}, None),
        ({"": 3.0, "/cam2": 2.0}, 2.0),  # the nearer namespace
        ({"": 3.0, "/cam2": np.nan}, 3.0),
        ({"/cam1": 1.0}, 1.0),
        ({"/cam1": 1.0, "/cam3": 2.0}, None),
    ],
)
def test_extrinsics_are_those_of_the_same_camera(
    monkeypatch: pytest.MonkeyPatch, metres: dict[str, float], expected: float | None
) -> None:
    """With two cameras, colours could be projected with the extrinsics of the other camera."""
    topics = {f"{space}/extrinsics/depth_to_color": x for space, x in metres.items()}
    messages = {
        name: SimpleNamespace(rotation=np.eye(3).ravel(), translation=[x, 0, 0])
        for name, x in topics.items()
    }
    monkeypatch.setattr(extrinsics, "first_message", lambda _, name: messages[name])
    recording: Any = SimpleNamespace(topics=[Topic(name, "", "cdr", 1) for name in topics])
    depth = Stream("/cam2/depth/image_rect_raw", "", "depth", None, 1, "d")
    colour = ColourStream("/cam2/color/image_raw", "", "raw", None, 1, "c", "rgb8")

    pose = Extrinsics(recording, depth, colour)._realsense
    assert (None if pose is None else pose.translation[0]) == expected


@pytest.mark.parametrize("container", ["mcap", "ros1", "ros2"])
def test_simulated_colour_camera_is_equal_in_all_containers(tmp_path: Path, container: Any) -> None:
    from shapecat.simulation import simulate  # noqa: PLC0415  slow to load
    from shapecat.simulation.camera.colour_camera import (  # noqa: PLC0415  the same
        COLOUR_LENS,
        DEPTH_FROM_COLOUR,
    )

    path = simulate(tmp_path / "s", format=container, frames=2, seed=4, color=True)
    pairs, warnings = read(path)

    assert not warnings
    for frame, view in pairs:
        assert view is not None
        assert view.image.stamp_ns == frame.stamp_ns
        assert view.colour_from_depth is not None
        position = -view.colour_from_depth.rotation.T @ view.colour_from_depth.translation
        np.testing.assert_allclose(position, DEPTH_FROM_COLOUR.translation, atol=1e-8)
        assert view.lens == COLOUR_LENS
        assert pixels_of(view.image).shape == (720, 960, 3)


def test_unreadable_colour_messages_are_skipped_and_reported(tmp_path: Path) -> None:
    """Neither a truncated message nor one of another type may end the run.

    Three frames have no colour, and the warnings must not say four.
    """
    stamps = [EPOCH + k * 33 * MS for k in range(8)]
    messages: list[Any] = [raw(s, gradient(), "rgb8") for s in stamps]
    messages[5] = make("std_msgs/msg/String", "calibrating")
    messages[6] = (IMAGE, b"\0\1\0\0" + bytes(9))
    messages[7].encoding = "nv21"
    topic = "/cam/color/image_raw"
    colours = [(topic, s, m) for s, m in zip(stamps, messages, strict=True)]
    pairs, warnings = read(write(tmp_path / "a.mcap", in_order([*depth_items(*stamps), *colours])))

    assert [view is not None for _, view in pairs] == [True] * 5 + [False] * 3
    assert sorted(w.removeprefix(f"{topic}: ")[:60] for w in warnings) == [
        "frames without colour (1×): image encoding 'nv21' is not colour"[:60],
        "frames without colour (2×): no colour image near the time of the frame"[:60],
        "unreadable messages (1×): cannot decode sensor_msgs/msg/Image: the data end"[:60],
    ]


def test_json_image_without_data_is_reported(tmp_path: Path) -> None:
    """JSON messages may lack fields; an image without data ended the run with a traceback."""
    path, stamps = tmp_path / "a.mcap", [EPOCH, EPOCH + 33 * MS]
    stamp = {"sec": EPOCH // SECOND, "nanosec": 0}
    content = {"header": {"stamp": stamp, "frame_id": "camera"}, "encoding": "rgb8"}
    with mcap_writer(path) as writer:
        channels = McapChannels(writer, STORE)
        schema = writer.register_schema(IMAGE, "jsonschema", b"{}")
        colour = writer.register_channel("/cam/color/image_raw", "json", schema)
        writer.add_message(colour, EPOCH, json.dumps(content).encode(), EPOCH)
        for topic, time, message in depth_items(*stamps):
            kind = message.__msgtype__
            channels.write(topic, kind, time, bytes(STORE.serialize_cdr(message, kind)))
    pairs, warnings = read(path)

    assert [view for _, view in pairs] == [None, None]
    assert any("(1×): message does not match its type" in w for w in warnings)


def test_image_in_unknown_encoding_is_message_error() -> None:
    """The bytes would be mistaken for those of another encoding."""
    with pytest.raises(MessageError, match="encoding '32FC1' is not colour"):
        pixels_of(ColourImage("", 0, 0, "", "32FC1", 4, 3, 16, bytes(48)))


def test_clouds_that_lose_their_colours_are_reported(tmp_path: Path) -> None:
    """Objects would have the colours of an earlier cloud or, without an explanation, none."""
    points = organized_points(wavy_depth())
    data = np.zeros(48 * 64, [("xyz", "<f4", 3), ("rgb", "<u4")])
    data["xyz"], data["rgb"] = points.reshape(-1, 3), 0x0A141E
    changes = {"point_step": 16, "row_step": 16 * 64, "data": data.view(np.uint8).ravel()}
    full = cloud(EPOCH, points, **changes)
    full.fields.append(make("sensor_msgs/msg/PointField", "rgb", 12, 6, 1))
    bare = cloud(EPOCH + 33 * MS, points)

    pairs, warnings = read(
        write(tmp_path / "a.mcap", [("/c", EPOCH, full), ("/c", EPOCH + 33 * MS, bare)])
    )

    (_, view), (_, none) = pairs
    assert view is not None
    assert pixels_of(view.image)[0, 0].tolist() == [10, 20, 30]
    assert none is None
    assert any("cloud without colours" in text for text in warnings)


def test_raw_image_is_exported_as_png_with_the_same_pixels() -> None:
    """If red and blue were swapped, a model would be trained on wrong colours."""
    colours = gradient()
    raw_image = ColourImage("", 0, 0, "", "bgr8", 64, 48, 192, colours[..., ::-1].tobytes())

    suffix, content = encoded(raw_image, pixels_of(raw_image))

    assert suffix == ".png"
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(content))), colours)


def test_colour_camera_without_transform_at_some_frames_is_reported(tmp_path: Path) -> None:
    """If a pan-tilt unit starts late, the user must learn why the first frames have no colour."""
    items = [
        *depth_items(EPOCH, EPOCH + 2 * SECOND),
        ("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE)),
    ]
    for stamp in (EPOCH, EPOCH + 2 * SECOND):
        colours = raw(stamp, gradient(60, 80), "rgb8", "color_optical")
        items.append(("/cam/color/image_raw", stamp + 1, colours))
    late = EPOCH + 2 * SECOND
    moved = static("camera", "color_optical", (0.07, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), late)
    items.append(("/tf", late, moved))
    pairs, warnings = read(write(tmp_path / "a.mcap", in_order(items)))

    assert [view is not None for _, view in pairs] == [False, True]
    reason = "no transform from camera to color_optical at the time of some frames"
    assert f"/cam/color/image_raw: {reason}" in warnings
