"""Tests of calibrations, poses and views that change in a recording or differ between topics."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapecat.cameras.colour import LensCamera
from shapecat.colour.projection import rectified
from shapecat.geometry import IDENTITY
from shapecat.recordings import choose_streams, frames, open_recording
from shapecat.recordings.colour_frames import frames_with_colour
from shapecat.recordings.colour_streams import pair_colours
from shapecat.recordings.decoding.decoders import decode
from shapecat.recordings.messages import Channel, Message
from shapecat.recordings.transforms.buffer import TransformBuffer
from shapecat.recordings.transforms.gravity import PoseFinder
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.reuse import KeyView, find_repeats, view_object
from shapecat.reuse.agreement import agreement
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.runs.tables.placed_frames import DetectedFrames, streams_with_poses
from shapecat.types import Camera, Frame, Pose
from tests.colour_messages import gradient, raw
from tests.frame_detections import FrameDetections, gather
from tests.messages import CAMERA, EPOCH, image, info, wavy_depth, write
from tests.test_recordings_colour import MS, WIDE, Pairs, depth_items, in_order, static
from tests.test_recordings_colour import read as read_colour
from tests.test_tables import CATEGORIES, detection, perception

STILL = (0.0, 0.0, 0.0, 1.0)
ZOOMED = replace(CAMERA, fx=75.0, fy=76.0)
TOPICS = ("/cam/depth/image_raw", "/cam/depth/other_raw")
"""Two streams of one depth camera, which share its calibration."""


def test_frame_id_of_each_image_counts(tmp_path: Path) -> None:
    """A restarted driver may rename the frame of either camera."""
    names = [("depth", "color"), ("depth", "color_b"), ("depth_b", "color"), ("depth_b", "color_b")]
    items: list[Any] = [("/cam/color/camera_info", EPOCH, info(EPOCH, WIDE))]
    for name, x in (("depth", 0.01), ("depth_b", 0.02), ("color", 0.1), ("color_b", 0.4)):
        items.append(("/tf_static", EPOCH, static("body", name, (x, 0.0, 0.0), STILL)))
    for k, (depth, colour) in enumerate(names):
        stamp = EPOCH + 100 * k * MS
        items += depth_items(stamp, frame_id=depth)
        items.append(("/cam/color/image_raw", stamp, raw(stamp, gradient(60, 80), "rgb8", colour)))
    pairs, _ = read_colour(write(tmp_path / "a.mcap", in_order(items)))

    assert [frame.frame_id for frame, _ in pairs] == [depth for depth, _ in names]
    poses = [None if view is None else view.colour_from_depth for _, view in pairs]
    found = [float(pose.translation[0]) for pose in poses if pose is not None]
    assert found == pytest.approx([-0.09, -0.39, -0.08, -0.38])


def test_colour_image_in_another_frame_is_not_registered(tmp_path: Path) -> None:
    """A user may switch off the alignment of colour to depth while recording."""
    items: list[Any] = [("/tf_static", EPOCH, static("camera", "color", (0.05, 0, 0), STILL))]
    for k, name in enumerate(("camera", "color")):
        stamp = EPOCH + 100 * k * MS
        colours = raw(stamp, gradient(), "rgb8", name)
        items += [*depth_items(stamp), ("/cam/color/camera_info", stamp, info(stamp))]
        items.append(("/cam/color/image_raw", stamp, colours))
    pairs, _ = read_colour(write(tmp_path / "a.mcap", in_order(items)))

    assert [view is not None and view.registered for _, view in pairs] == [True, False]


def test_rectified_image_uses_current_projection(tmp_path: Path) -> None:
    """The lens may stay while the image is rectified to another focal length."""
    items: list[Any] = [("/tf_static", EPOCH, static("camera", "color", (0.05, 0, 0), STILL))]
    for k, focal in enumerate((71.0, 90.0)):
        stamp = EPOCH + 100 * k * MS
        calibration = info(stamp, WIDE)
        calibration.p[0] = focal
        colours = raw(stamp, gradient(60, 80), "rgb8", "color")
        items += [*depth_items(stamp), ("/cam/color/camera_info", stamp, calibration)]
        items.append(("/cam/color/image_rect", stamp, colours))
    pairs, _ = read_colour(write(tmp_path / "a.mcap", in_order(items)))

    assert [view and view.lens and view.lens.pinhole.fx for _, view in pairs] == [71.0, 90.0]


def test_colour_period_follows_latest_images(tmp_path: Path) -> None:
    """Long exposures lower the rate: the nearest image may then be 40 ms away."""
    times = [*range(0, 100, 10), *range(190, 700, 100)]
    stamps = [EPOCH + t * MS for t in times]
    colours = [("/cam/color/image_raw", s, raw(s, gradient(), "rgb8")) for s in stamps]
    items = [*depth_items(EPOCH + 6 * MS, stamps[-1] + 40 * MS), *colours]
    pairs, _ = read_colour(write(tmp_path / "a.mcap", in_order(items)))

    assert [view and view.image.stamp_ns for _, view in pairs] == [stamps[1], stamps[-1]]


def read_both(path: Path, wanted: str | None = None) -> Pairs:
    with open_recording(path) as recording:
        streams = choose_streams(recording, TOPICS)
        colours = pair_colours(recording, streams, wanted)
        return list(frames_with_colour(recording, streams, colours))


def test_new_calibration_applies_to_both_streams_of_camera(tmp_path: Path) -> None:
    """Raw and filtered depth images have one calibration, and one colour camera beside them."""
    items: list[Any] = [("/tf_static", EPOCH, static("camera", "color", (0.05, 0, 0), STILL))]
    for k, (depth, colour) in enumerate(((CAMERA, WIDE), (ZOOMED, replace(WIDE, fx=90.0)))):
        stamp = EPOCH + 100 * k * MS
        items.append(("/cam/depth/camera_info", stamp, info(stamp, depth)))
        items.append(("/cam/color/camera_info", stamp, info(stamp, colour)))
        items.append(("/cam/color/image_raw", stamp, raw(stamp, gradient(60, 80), "rgb8", "color")))
        items += [(topic, stamp, image(stamp, wavy_depth())) for topic in TOPICS]
    pairs = read_both(write(tmp_path / "a.mcap", in_order(items)), "/cam/color/image_raw")

    lenses = [view.lens.pinhole.fx for _, view in pairs if view and view.lens]
    assert sorted(frame.topic for frame, _ in pairs) == sorted([*TOPICS, *TOPICS])
    assert [f.camera and f.camera.fx for f, _ in pairs] == [CAMERA.fx] * 2 + [ZOOMED.fx] * 2
    assert lenses == [WIDE.fx] * 2 + [90.0] * 2


@pytest.mark.parametrize("bend", [(0.3, 0.1, 0.0, 0.0, 0.0), ()])
def test_rays_follow_new_focal_lengths(tmp_path: Path, bend: Any) -> None:
    """If the distortion stays, rays of the old calibration must not be reused."""

    def read_frames(*cameras: Camera) -> list[Frame]:
        items = []
        for k, camera in enumerate(cameras):
            items.append(("/depth/camera_info", k, info(EPOCH + k, camera, bend)))
            items.append(("/depth/image", k, image(EPOCH + k, wavy_depth())))
        with open_recording(write(tmp_path / f"{len(cameras)}.mcap", items)) as recording:
            return list(frames(recording, choose_streams(recording)))

    _, second = read_frames(CAMERA, ZOOMED)
    (alone,) = read_frames(ZOOMED)

    assert second.camera == alone.camera
    np.testing.assert_array_equal(second.xyz(), alone.xyz())


def test_missing_pose_or_up_affects_only_its_topic() -> None:
    """One sensor may lack transforms, and planes may contradict the up direction of another."""
    transforms = TransformBuffer()
    transforms.add("map", "head", 0, ((1.0, 2.0, 3.0), STILL), static=True)
    poses = PoseFinder(TransformWindow(transforms), None, None, ("tf", "imu"))
    lost, head, hand = (
        Frame(f"/{name}", 0, 5, 5, frame_id, points=np.zeros((1, 3)))
        for name, frame_id in (("lost", "nowhere"), ("head", "head"), ("hand", "head"))
    )
    poses.contradict("/hand", "transforms, z of map", [40.0])

    assert poses.fixed_from_sensor(lost) is None
    assert poses.fixed_from_sensor(head) is not None
    ups = [poses.accept(frame.topic, poses.orient(frame)) for frame in (lost, head, hand)]
    assert [up is None for up in ups] == [True, False, True]


def test_republished_static_transform_replaces_the_first() -> None:
    """The robot may have been calibrated again."""
    transforms = TransformBuffer()
    for x in (1.0, 2.5):
        transforms.add("base", "camera", 0, ((x, 0.0, 0.0), STILL), static=True)

    assert transforms.lookup("base", "camera", 7).translation[0] == 2.5


def test_messages_are_decoded_by_definition_of_their_channel() -> None:
    """Two robots in one recording may define or encode a type differently."""
    known: dict[Any, Any] = {}
    bits = b"\0\1\0\0" + np.array([3, 8], "<u4").tobytes()

    def read(text: str, encoding: str = "cdr", data: bytes = bits) -> Any:
        channel = Channel("/t", "lab/msg/Pair", encoding, "lab/Pair", "ros2msg", text.encode())
        return decode(Message(channel, 0, 0, 0, data), known)

    assert read("uint32 a\nuint32 b").a == 3
    assert read("uint32 b\nuint32 a").a == 8
    assert read("uint32 b\nuint32 a", "json", b'{"a": 5}').a == 5


BENT = LensCamera(WIDE, "plumb_bob", (-1.2, 0.0, 0.02, 0.01, 0.0))


def test_image_is_rectified_with_its_own_lens() -> None:
    """The map of another lens of the same camera and model must not be reused."""
    pixels = gradient(60, 80)
    straight = replace(BENT, coefficients=(0.0,) * 5)

    assert not np.array_equal(rectified(pixels, BENT), pixels)
    assert np.array_equal(rectified(pixels, straight), pixels)


def test_depth_images_are_compared_with_their_own_cameras() -> None:
    """After a zoom, an object at rest is at other pixels."""

    def slope(camera: Camera) -> Any:
        """Return the depth (h, w) of the plane z = 1 + x / 2, whose pixels are all different."""
        u = np.broadcast_to(np.arange(camera.width), (camera.height, camera.width))
        return (1 / (1 - 0.5 * (u - camera.cx) / camera.fx)).astype(np.float32)

    middle = np.arange(48 * 64).reshape(48, 64)[15:33:2, 20:44:2].ravel().astype(np.uint32)
    share, bias = agreement(middle, slope(CAMERA), CAMERA, slope(ZOOMED), replace(ZOOMED), IDENTITY)

    assert share == 1
    assert abs(bias) < 0.002


def test_only_views_of_same_kind_are_reused() -> None:
    """Occluded or cut objects show another part; a view without a pose cannot be compared."""
    depth = np.full((48, 64), 0.8, np.float32)
    frame = Frame("/depth", 0, 0, 0, "camera", depth=depth, camera=CAMERA)
    whole = detection(3, points=40).candidate
    up = np.array([0, -1, 0], np.float32)
    (key,) = [KeyView(view_object(frame, None, whole, up, 0.1), detection(3))]

    def repeats(pose: Pose | None = None, **changes: Any) -> bool:
        sight = view_object(frame, pose, replace(whole, **changes), up, 0.1)
        return find_repeats([sight], [key])[0] is not None

    assert repeats()
    assert not repeats(IDENTITY)
    assert not repeats(occluded=True)
    assert not repeats(touches_border=True)


def test_views_of_both_sensors_count() -> None:
    """Frames of two sensors have equal numbers, but neither repeats the other."""
    found = [
        replace(
            FrameDetections(
                *("", k, k, np.arange(1), np.array([[0.0, 0.0, 1.0]]), np.ones((1, 3))),
                *(np.array([[0.8, 0.2]]), np.zeros(1, bool), np.zeros(1), np.eye(4)[3:]),
            ),
            topic=topic,
        )
        for k in range(2)
        for topic in TOPICS
    ]
    (hits,) = gather(found, together=TOPICS)

    assert (hits.weights(np.arange(4)) > 0).all()
    first = np.flatnonzero(hits.topics[hits.rows] == 0)  # a track that one sensor saw
    assert hits.on_topics_of(first, np.arange(4)).tolist() == first.tolist()


def test_each_topic_has_its_own_poses(tmp_path: Path) -> None:
    """A topic may begin later and lack some poses, which must not be taken from another topic."""
    order = [("/head", 0), ("/head", 1), ("/hand", 0), ("/head", 2), ("/hand", 1)]
    moved = Pose(np.eye(3), np.array([1.0, 2.0, 3.0]))
    with PerceptionTables(tmp_path, categories=CATEGORIES, model_id="m") as tables:
        for topic, k in order:
            pose = None if (topic, k) == ("/hand", 1) else moved
            tables.write([replace(perception(k, 1), topic=topic)], [FrameRow(k, pose)])
    frames = DetectedFrames.read(tmp_path, {"/head"})
    rows = np.arange(5)  # of one detection in each frame

    assert streams_with_poses(tmp_path) == {"/head"}
    assert frames.numbers_of(rows).tolist() == [0] * 5
    assert frames.poses_of(rows)[:, 0, 3].tolist() == [float(t == "/head") for t, _ in order]
