"""Tests of annotations of a rotated box in every encoding; all numbers differ, to notice swaps."""

import json
from collections.abc import Iterable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.testing import assert_allclose
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from shapecat.outputs.annotation.annotated_mcap import write_annotated
from shapecat.outputs.annotation.channels import annotation_encoders, text_position
from shapecat.outputs.annotation.content import Annotation, AnnotationChannel
from shapecat.outputs.annotation.image_annotations import ImageBox, ImageFrame, image_encoders_for
from shapecat.outputs.colours import colour_of
from shapecat.recordings import open_recording
from shapecat.recordings.decoding.protobuf import message_decoder
from shapecat.types import AnnotationBox, AnnotationFrame
from tests.mcap_files import read_ros, summary_of
from tests.test_annotated_mcap import EPOCH, write_mcap

SECOND = 10**9
STAMP = 1_700_000_123 * SECOND + 456_789_012
ROTATION = Rotation.from_euler("zyx", [0.9, -0.5, 2.4])
CENTER, SIZE = (0.31, -0.22, 1.17), (0.06, 0.11, 0.19)
BOX = AnnotationBox(7, "bowl", 0.625, CENTER, SIZE, tuple(ROTATION.as_quat().tolist()))
FRAME = AnnotationFrame("/points", 4, STAMP, STAMP + 11, "optical", (BOX,), (5, 6))
ANNOTATION = Annotation(FRAME, 2 * SECOND + 250_000_000, (5, 6))
ABOVE = CENTER + ROTATION.apply([0, 0, SIZE[2] / 2 + 0.03])


def decode_ros(name: str, schema: bytes, data: bytes, *, ros1: bool) -> Any:
    """Decode with the embedded definition, as an independent reader has to."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.decode(), name.replace("/msg/", "/")))
    kind = name if "/msg/" in name else name.replace("/", "/msg/")
    return (store.deserialize_ros1 if ros1 else store.deserialize_cdr)(data, kind)


def plain(message: Any) -> Any:
    """Return a message as attributes, whatever decoded it; times in nanoseconds."""
    if isinstance(message, dict):
        message = SimpleNamespace(**message)
    if isinstance(message, list | tuple):
        return [plain(item) for item in message]
    fields = getattr(message, "__dict__", None) or {
        name: getattr(message, name) for name in getattr(message, "__slots__", ())
    }
    if not fields:
        return message
    names = set(fields) - {"__msgtype__"}
    for seconds in ("sec", "seconds"):
        if seconds in names and len(names) == 2:
            (rest,) = names - {seconds}
            return fields[seconds] * SECOND + fields[rest]
    return SimpleNamespace(**{name: plain(fields[name]) for name in names})


def read_back(channel: AnnotationChannel, data: bytes) -> Any:
    """Return a message, decoded by its channel's own schema."""
    if channel.encoding == "json":
        message = json.loads(data)
        import_module("jsonschema").validate(message, json.loads(channel.schema))
        return plain(message)
    if channel.encoding == "protobuf":
        return plain(message_decoder(channel.schema, channel.schema_name)(data))
    ros1 = channel.encoding == "ros1"
    return plain(decode_ros(channel.schema_name, channel.schema, bytes(data), ros1=ros1))


def messages(encoding: str) -> dict[str, Any]:
    """Return the message of each topic."""
    encoders = annotation_encoders(encoding, markers=True)
    return {channel.topic: read_back(channel, make(ANNOTATION)) for channel, make in encoders}


def numbers(record: Any, names: str) -> list[float]:
    return [getattr(record, name) for name in names]


def rotation_error(quaternion: Any) -> float:
    """Return the angle in radians between a quaternion message and the rotation of the box."""
    return float((Rotation.from_quat(numbers(quaternion, "xyzw")) * ROTATION.inv()).magnitude())


def check_box(pose: Any, size: Any) -> None:
    assert_allclose(numbers(pose.position, "xyz"), CENTER, atol=1e-6)
    assert rotation_error(pose.orientation) < 1e-6
    assert_allclose(numbers(size, "xyz"), SIZE, atol=1e-6)


def test_label_is_above_top_of_box() -> None:
    """With a transposed rotation, the label would be beside a tilted box."""
    assert_allclose(text_position(BOX), ABOVE, atol=1e-12)


@pytest.mark.parametrize("encoding", ["cdr", "ros1", "json", "protobuf"])
def test_scene_is_equal_in_every_encoding(encoding: str) -> None:
    scene = messages(encoding)["/shapecat/scene"]
    (entity,), colour = scene.entities, np.array(colour_of("bowl")) / 255

    assert (entity.timestamp, entity.frame_id, entity.id) == (STAMP, "optical", "track-7")
    assert entity.lifetime == 2 * SECOND + 250_000_000
    assert entity.frame_locked is False
    (cube,), (text,) = entity.cubes, entity.texts
    check_box(cube.pose, cube.size)
    assert_allclose(numbers(cube.color, "rgba"), [*colour, 0.5], atol=1e-6)
    assert_allclose(numbers(text.pose.position, "xyz"), ABOVE, atol=1e-6)
    assert (text.billboard, text.font_size, text.scale_invariant) == (True, 0.03, False)
    assert_allclose(numbers(text.color, "rgba"), [*colour, 1.0], atol=1e-6)
    assert "7" in text.text
    assert "bowl" in text.text
    entries = {item.key: item.value for item in entity.metadata}
    assert entries == {"category": "bowl", "confidence": "0.6250", "track": "7"}


@pytest.mark.parametrize("encoding", ["cdr", "ros1", "json", "protobuf"])
def test_deletions_remove_single_entities(encoding: str) -> None:
    """Type 1 of foxglove.SceneEntityDeletion removes all entities of the topic."""
    deletions = messages(encoding)["/shapecat/scene"].deletions

    assert [(d.timestamp, int(d.type), d.id) for d in deletions] == [
        (STAMP, 0, "track-5"),
        (STAMP, 0, "track-6"),
    ]


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_detections_have_right_values(encoding: str) -> None:
    message = messages(encoding)["/shapecat/detections"]
    (item,) = message.detections

    for header in (message.header, item.header):
        assert (header.stamp, header.frame_id) == (STAMP, "optical")
    check_box(item.bbox.center, item.bbox.size)
    (result,) = item.results
    check_box(result.pose.pose, item.bbox.size)
    assert (result.hypothesis.class_id, result.hypothesis.score) == ("bowl", 0.625)
    assert item.id == "7"


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_markers_match_boxes(encoding: str) -> None:
    """In RViz, type 1 is a cube, type 9 a text facing the viewer, and action 2 deletes a marker."""
    markers = messages(encoding)["/shapecat/markers"].markers
    deletions, (cube, text) = markers[:4], markers[4:]

    assert [(m.ns, m.id, m.action) for m in deletions] == [
        (f"shapecat/{kind}", track, 2) for track in (5, 6) for kind in ("box", "text")
    ]
    for marker in (cube, text):
        assert (marker.header.stamp, marker.header.frame_id) == (STAMP, "optical")
        assert (marker.id, marker.action) == (7, 0)
        assert marker.lifetime == 2 * SECOND + 250_000_000
    assert (cube.ns, cube.type, text.ns, text.type) == ("shapecat/box", 1, "shapecat/text", 9)
    check_box(cube.pose, cube.scale)
    assert_allclose(numbers(text.pose.position, "xyz"), ABOVE, atol=1e-6)
    assert text.scale.z == pytest.approx(0.03)
    colour = np.array(colour_of("bowl")) / 255
    assert_allclose(numbers(cube.color, "rgba"), [*colour, 0.5], atol=1e-6)
    assert_allclose(numbers(text.color, "rgba"), [*colour, 1.0], atol=1e-6)


def annotated(folder: Path, frames: Iterable[AnnotationFrame], *, markers: bool = False) -> Path:
    """Annotate a recording with ``frames``; return the path of the result."""
    target = folder / "out.mcap"
    with open_recording(write_mcap(folder / "a.mcap")) as recording:
        write_annotated(recording, target, iter(frames), run={}, markers=markers)
    return target


def index_end(data: bytes, at: int, count: int) -> int:
    """Return the end of the message index records (opcode 7) that begin at an offset."""
    for _ in range(count):
        assert data[at] == 7
        at += 9 + int.from_bytes(data[at + 1 : at + 9], "little")
    return at


def test_chunk_indexes_have_length_of_message_indexes(tmp_path: Path) -> None:
    """Readers that fetch a chunk with its index in one request rely on this length."""
    frames = [replace(FRAME, index=k, log_time_ns=STAMP + k) for k in range(900)]
    target = annotated(tmp_path, frames, markers=True)
    data, found = target.read_bytes(), summary_of(target).chunk_indexes

    assert len(found) > 3
    for index in found:
        after = index.chunk_start_offset + index.chunk_length
        end = index_end(data, after, len(index.message_index_offsets))
        assert end - after == index.message_index_length
        assert min(index.message_index_offsets.values()) == after


def test_added_messages_are_found_by_time(tmp_path: Path) -> None:
    """A seek reads only the chunks whose time range contains the target."""
    frames = [replace(FRAME, index=k, log_time_ns=STAMP + k * SECOND) for k in range(400)]
    with annotated(tmp_path, frames).open("rb") as file:
        reader = make_reader(file)
        window = {"starting_at": STAMP + 150 * SECOND, "ending_before": STAMP + 155 * SECOND}
        times = [
            message.log_time
            for *_, message in reader.iter_messages(["/shapecat/detections"], **window)
        ]
        summary = reader.get_summary()

    assert times == [STAMP + k * SECOND for k in range(150, 155)]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_end_time == STAMP + 399 * SECOND
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 3
    topics = {channel.id: channel.topic for channel in summary.channels.values()}
    counts = {topics[k]: n for k, n in summary.statistics.channel_message_counts.items()}
    assert counts == {"/points": 9, "/shapecat/detections": 400, "/shapecat/scene": 400}


def test_unordered_messages_are_found_by_time(tmp_path: Path) -> None:
    """Frames of two sensors are not in order of time; a seek must find them nevertheless."""
    offsets = (50, 20, 90, 70)
    frames = [replace(FRAME, index=k, log_time_ns=EPOCH + t) for k, t in enumerate(offsets)]
    with annotated(tmp_path, frames).open("rb") as file:
        reader = make_reader(file)
        for start, stop, expected in ((20, 21, [20]), (80, 99, [90]), (3, 60, [20, 50])):
            window = {"starting_at": EPOCH + start, "ending_before": EPOCH + stop}
            found = reader.iter_messages(["/shapecat/scene"], **window)
            assert [message.log_time - EPOCH for *_, message in found] == expected


def test_stamps_beyond_ros_range_are_clamped() -> None:
    """ROS seconds have 31 bits: larger stamps must not stop the writer."""
    channel, make = annotation_encoders("cdr", markers=False)[0]
    for seconds, written in ((2**31 - 2, 2**31 - 2), (2**31, 2**31 - 1), (9 * 10**9, 2**31 - 1)):
        frame = replace(FRAME, stamp_ns=seconds * SECOND + 7, objects=())
        made = read_back(channel, make(Annotation(frame, SECOND, ())))
        assert made.header.stamp == written * SECOND + 7


@pytest.mark.parametrize(
    ("offsets", "first", "last"),
    [((50, 20, 90, 70), 0, 90), ((5, 2, 7, 3), 0, 8), ((-4, 6), -4, 8)],
)
def test_statistics_cover_times_of_all_messages(
    tmp_path: Path, offsets: tuple[int, ...], first: int, last: int
) -> None:
    """Players take the length from the statistics and would not play messages beyond it.

    The original messages are at 0 to 8 ns, the annotations at ``offsets``.
    """
    frames = [replace(FRAME, index=k, log_time_ns=EPOCH + t) for k, t in enumerate(offsets)]
    summary = summary_of(annotated(tmp_path, frames))

    assert summary.statistics is not None
    assert summary.statistics.message_start_time == EPOCH + first
    assert summary.statistics.message_end_time == EPOCH + last


def test_object_visible_to_another_sensor_is_not_deleted(tmp_path: Path) -> None:
    """Two sensors share tracks: an object that only one of them has lost must stay."""

    def frame_of(topic: str, k: int, *, visible: bool) -> AnnotationFrame:
        boxes = (BOX,) if visible else ()
        return AnnotationFrame(topic, k, STAMP + k, STAMP + k, "optical", boxes, ())

    frames = [
        frame_of("/a", 0, visible=True),
        frame_of("/b", 1, visible=True),
        frame_of("/a", 2, visible=False),
        frame_of("/b", 3, visible=False),
    ]
    scenes = [scene for _, scene in read_ros(annotated(tmp_path, frames), "/shapecat/scene")]

    assert [[d.id for d in scene.deletions] for scene in scenes] == [[], [], [], ["track-7"]]


IMAGE_BOXES = (
    ImageBox(7, "bowl", 0.625, (31, 44, 120, 66)), ImageBox(9, "cup", 0.25, (5, 8, 13, 210))
)  # fmt: skip
IMAGE = ImageFrame("/color", STAMP, STAMP + 3, "colour", IMAGE_BOXES)


def image_messages(encoding: str) -> dict[str, Any]:
    """Return the annotations of an image by topic."""
    encoders = image_encoders_for(encoding, ["/color"])["/color"]
    return {channel.topic: read_back(channel, make(IMAGE)) for channel, make in encoders}


@pytest.mark.parametrize("encoding", ["cdr", "ros1", "json", "protobuf"])
def test_image_annotations_are_equal_in_every_encoding(encoding: str) -> None:
    """Boxes have the colour of their category, labels a background; type 2 is a closed line."""
    message = image_messages(encoding)["/shapecat/image_annotations"]
    expected = [
        ("bowl", "#7 bowl 0.63", 11.0, [(31, 44), (151, 44), (151, 110), (31, 110)]),
        ("cup", "#9 cup 0.25", 18.0, [(5, 8), (18, 8), (18, 218), (5, 218)]),
    ]

    assert len(message.circles) == 0
    for line, text, (category, words, font_size, corners) in zip(
        message.points, message.texts, expected, strict=True
    ):
        colour = np.array(colour_of(category)) / 255
        assert (line.timestamp, text.timestamp) == (STAMP, STAMP)
        assert [(p.x, p.y) for p in line.points] == corners
        assert (text.position.x, text.position.y) == corners[0]
        assert (int(line.type), line.thickness, len(line.outline_colors)) == (2, 2.0, 0)
        assert (text.text, text.font_size) == (words, font_size)
        assert_allclose(numbers(line.outline_color, "rgba"), [*colour, 1.0], atol=1e-6)
        assert_allclose(numbers(line.fill_color, "rgba"), [*colour, 0.15], atol=1e-6)
        assert_allclose(numbers(text.background_color, "rgba"), [*colour, 0.7], atol=1e-6)
        assert_allclose(numbers(text.text_color, "rgba"), [1.0, 1.0, 1.0, 1.0], atol=1e-6)


def test_each_of_several_cameras_has_its_annotations(tmp_path: Path) -> None:
    """Viewers draw all messages of a channel: in a shared one, also the boxes of other cameras."""
    images = [
        ImageFrame(topic, STAMP, STAMP + k, "colour", IMAGE_BOXES[:1] * boxes)
        for k, (topic, boxes) in enumerate([("/l/rgb", 1), ("r/rgb", 2), ("/l/rgb", 3)])
    ]
    target, topics = tmp_path / "out.mcap", ["/l/rgb", "r/rgb"]
    with open_recording(write_mcap(tmp_path / "a.mcap")) as recording:
        write_annotated(recording, target, [], run={}, images=iter(images), image_topics=topics)
    kinds = ("/shapecat/image_annotations", "/shapecat/detections_2d")
    found = {
        kind + topic: [
            len(getattr(message, "points", None) or getattr(message, "detections", []))
            for _, message in read_ros(target, kind + topic)
        ]
        for kind in kinds
        for topic in ("", *(f"/{name.strip('/')}" for name in topics))
    }

    expected = {"": [], "/l/rgb": [1, 3], "/r/rgb": [2]}
    assert found == {kind + topic: boxes for kind in kinds for topic, boxes in expected.items()}


@pytest.mark.parametrize("encoding", ["cdr", "ros1"])
def test_image_detections_have_right_values(encoding: str) -> None:
    message = image_messages(encoding)["/shapecat/detections_2d"]
    expected = [("7", "bowl", 0.625, (91, 77, 120, 66)), ("9", "cup", 0.25, (11.5, 113, 13, 210))]

    for header in (message.header, *(item.header for item in message.detections)):
        assert (header.stamp, header.frame_id) == (STAMP, "colour")
    for item, (number, category, score, box) in zip(message.detections, expected, strict=True):
        (result,), bbox = item.results, item.bbox
        middle = bbox.center.position
        assert (middle.x, middle.y, bbox.size_x, bbox.size_y) == box
        assert (result.hypothesis.class_id, result.hypothesis.score) == (category, score)
        assert (item.id, bbox.center.theta) == (number, 0.0)
