"""Tests that annotated.mcap keeps all original messages, and that other tools can read it."""

import errno
import hashlib
import json
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from shapecat.errors import OutputError
from shapecat.outputs.annotation import ros1_conversion
from shapecat.outputs.annotation.annotated_mcap import write_annotated
from shapecat.outputs.annotation.mcap_append import Appender, copy_bytes
from shapecat.outputs.colours import CATEGORY_COLOURS, colour_of
from shapecat.recordings import Channel, open_recording
from shapecat.recordings.decoding.decoders import typestore_of
from shapecat.types import CATEGORIES, AnnotationBox, AnnotationFrame
from tests.mcap_files import mcap_writer, read_ros, summary_of
from tests.test_recordings import QOS

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)
STRING = "std_msgs/msg/String"
SECOND = 10**9
EPOCH = 1_700_000_000 * SECOND
RUN = {"version": "1", "counts": {"frames": 3}}


@pytest.mark.parametrize("in_kernel", [True, False])
def test_copying_a_shrinking_recording_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, in_kernel: bool
) -> None:
    """Space for the copy is reserved first, so bytes that are missing would read as zeros."""

    def refuse(*_: object) -> int:
        raise OSError(errno.EXDEV, "across file systems")

    if not in_kernel:
        monkeypatch.setattr(os, "copy_file_range", refuse)
    source, target = tmp_path / "source", tmp_path / "target"
    content = bytes(range(251)) * 10_000  # more than one block
    source.write_bytes(content)
    target.touch()
    copy_bytes(source, target, len(content) - 9)
    assert target.read_bytes()[: len(content) - 9] == content[:-9]
    with pytest.raises(OSError, match="became shorter"):
        copy_bytes(source, target, len(content) + 4000)


def annotation_frame(
    index: int, tracks: list[int], *, ended: tuple[int, ...] = ()
) -> AnnotationFrame:
    objects = tuple(
        AnnotationBox(
            track=track,
            category="cup",
            confidence=0.97,
            center=(0.1, 0.2, 1.0 + track),
            size=(0.1, 0.2, 0.3),
            orientation=(0, 0, 0.6, 0.8),
        )
        for track in tracks
    )
    return AnnotationFrame(
        topic="/points",
        index=index,
        stamp_ns=EPOCH + index * SECOND // 10,
        log_time_ns=EPOCH + index * SECOND // 10 + 7,
        frame_id="camera",
        objects=objects,
        ended=ended,
    )


FRAMES = [
    annotation_frame(0, [3, 4]),
    annotation_frame(1, [4]),
    annotation_frame(2, [], ended=(4,)),
]


def string(value: str) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[STRING](data=value), STRING))


def write_mcap(path: Path, **options: Any) -> Path:
    with mcap_writer(path, **({"chunk_size": 100} | options)) as writer:
        text = STORE.generate_msgdef(STRING, ros_version=2)[0].encode()
        schema = writer.register_schema(STRING, "ros2msg", text)
        channel = writer.register_channel("/points", "cdr", schema)
        for k in range(9):
            writer.add_message(channel, EPOCH + k, string(f"message {k}"), EPOCH, k)
            if k == 4:
                writer.add_attachment(1, 2, "photo", "image/png", b"\x89PNG")
                writer.add_metadata("robot", {"name": "r2"})
    return path


def annotate(source: Path, target: Path, **options: Any) -> None:
    with open_recording(source) as recording:
        write_annotated(recording, target, iter(FRAMES), run=RUN, **options)


def test_recording_that_cannot_be_copied_gives_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If an error of the thread that copies were lost, a file of zeros would look complete."""

    def fill_disk(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("shapecat.outputs.annotation.annotated_mcap.copy_bytes", fill_disk)
    source = write_mcap(tmp_path / "in.mcap")

    with pytest.raises(OutputError, match="No space left on device"):
        annotate(source, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [source]


def digest(path: Path) -> Counter[tuple[Any, ...]]:
    with path.open("rb") as file:
        return Counter(
            (c.topic, m.log_time, m.publish_time, m.sequence, hashlib.md5(m.data).hexdigest())  # noqa: S324  # compares
            for _, c, m in make_reader(file, validate_crcs=True).iter_messages()
        )


@pytest.mark.parametrize("compression", list(CompressionType))
def test_original_messages_stay_byte_for_byte(tmp_path: Path, compression: CompressionType) -> None:
    source = write_mcap(tmp_path / "a.mcap", compression=compression)
    target = tmp_path / "out.mcap"

    annotate(source, target, markers=True)

    assert not digest(source) - digest(target)
    assert digest(target).total() == 9 + 3 * 3
    summary = summary_of(target)
    # Users who record without zstd may be unable to read it.
    name = compression.name.lower().replace("none", "")
    assert {chunk.compression for chunk in summary.chunk_indexes} == {name}
    with open_recording(source) as recording:
        end = recording.summary.data_end  # type: ignore[attr-defined]  # it is an MCAP file
    assert target.read_bytes()[:end] == source.read_bytes()[:end]


def test_other_readers_accept_the_file(tmp_path: Path) -> None:
    """Summary, offsets and checksums are written without a library; readers reject wrong ones."""
    target = tmp_path / "out.mcap"
    annotate(write_mcap(tmp_path / "a.mcap"), target)

    with target.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 9 + 6
        assert summary.statistics.metadata_count == 2
        assert [a.name for a in reader.iter_attachments()] == ["photo"]
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    assert metadata["robot"] == {"name": "r2"}
    assert json.loads(metadata["shapecat"]["run.json"]) == RUN
    with target.open("rb") as file:
        stream = NonSeekingReader(file, validate_crcs=True)
        assert sum(1 for _ in stream.iter_messages(log_time_order=False)) == 15
    with AnyReader([target]) as other:
        assert other.message_count == sum(1 for _ in other.messages()) == 15
    with open_recording(target) as again:
        assert again.warnings == []
        assert sum(1 for _ in again.messages()) == 15
    rerun = Path(sys.executable).with_name("rerun")
    checked = subprocess.run([rerun, "mcap", "check", target], capture_output=True, check=False)
    assert checked.returncode == 0, checked.stderr
    assert b"/shapecat/scene" in checked.stdout


@pytest.mark.parametrize("markers", [False, True])
def test_original_channels_keep_their_ids(tmp_path: Path, *, markers: bool) -> None:
    """Channel ids may have gaps; an id given twice would mix the messages of two topics."""
    source, target, text = tmp_path / "a.mcap", tmp_path / "out.mcap", b"string data"
    with mcap_writer(source) as writer:
        for k, topic in enumerate(("/first", "/gone", "/points", "/last")):
            schema = writer.register_schema(STRING, "ros2msg", text + bytes(k))
            channel = writer.register_channel(topic, "cdr", schema)
            if topic != "/gone":
                # Before and after all annotations, so that the file begins and ends with these.
                writer.add_message(channel, EPOCH + (k - 1) * SECOND, string(topic), EPOCH, k)
        for kind in ("channels", "schemas"):  # gaps in the ids, which the library never leaves
            vars(writer)[f"_Writer__{kind}"].pop(2)
    annotate(source, target, markers=markers)

    own = {f"/{name}": string(f"/{name}") for name in ("first", "points", "last")}
    added = ("detections", "scene", *(("markers",) if markers else ()))
    with target.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        found = list(reader.iter_messages())
    assert summary is not None
    channels = list(summary.channels.values())
    assert sorted(one.topic for one in channels) == sorted(
        [*own, *(f"/shapecat/{name}" for name in added)]
    )
    assert len({one.schema_id for one in channels}) == len(summary.schemas) == len(channels)
    statistics = summary.statistics
    assert statistics is not None
    times = [m.log_time for _, _, m in found]
    assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
    assert statistics.channel_message_counts == Counter(c.id for _, c, _ in found)
    assert (statistics.channel_count, statistics.schema_count) == (len(channels), len(channels))
    assert statistics.chunk_count == len(summary.chunk_indexes)
    assert {c.topic: bytes(m.data) for _, c, m in found if c.topic in own} == own
    assert Counter(c.topic for _, c, _ in found if c.topic not in own) == {
        f"/shapecat/{name}": len(FRAMES) for name in added
    }
    for name in added:
        assert [time for time, _ in read_ros(target, f"/shapecat/{name}")] == [
            frame.log_time_ns for frame in FRAMES
        ]


def test_summary_checksum_is_correct(tmp_path: Path) -> None:
    """Readers in other languages verify the checksum; the Python library does not."""
    import zlib  # noqa: PLC0415  # only here

    target = tmp_path / "out.mcap"
    annotate(write_mcap(tmp_path / "a.mcap"), target)
    data = target.read_bytes()
    footer = len(data) - 8 - 20
    start = int.from_bytes(data[footer : footer + 8], "little")

    assert int.from_bytes(data[-12:-8], "little") == zlib.crc32(data[start:-12])


def test_scene_adds_updates_and_removes_tracks(tmp_path: Path) -> None:
    """Boxes must not stay after their object is gone."""
    target = tmp_path / "out.mcap"
    annotate(write_mcap(tmp_path / "a.mcap"), target)

    arrays = [array for _, array in read_ros(target, "/shapecat/detections")]
    scenes = [scene for _, scene in read_ros(target, "/shapecat/scene")]

    assert [[(d.id, d.bbox.center.position.z) for d in a.detections] for a in arrays] == [
        [("3", 4.0), ("4", 5.0)],
        [("4", 5.0)],
        [],
    ]
    assert [[e.id for e in scene.entities] for scene in scenes] == [
        ["track-3", "track-4"],
        ["track-4"],
        [],
    ]
    assert [[d.id for d in scene.deletions] for scene in scenes] == [[], ["track-3"], ["track-4"]]
    entity = scenes[0].entities[0]
    assert (entity.frame_id, entity.lifetime.sec, entity.lifetime.nanosec) == (
        "camera",
        0,
        150_000_000,
    )
    assert entity.texts[0].text == "#3 cup 0.97"
    assert entity.texts[0].pose.position.z > entity.cubes[0].pose.position.z + 0.15
    assert {m.key: m.value for m in entity.metadata} == {
        "category": "cup",
        "confidence": "0.9700",
        "track": "3",
    }


def test_markers_of_ended_tracks_are_deleted(tmp_path: Path) -> None:
    target = tmp_path / "out.mcap"
    annotate(write_mcap(tmp_path / "a.mcap"), target, markers=True)

    messages = [message for _, message in read_ros(target, "/shapecat/markers")]

    assert [[(m.id, m.type, m.action) for m in message.markers] for message in messages] == [
        [(3, 1, 0), (3, 9, 0), (4, 1, 0), (4, 9, 0)],
        [(3, 1, 2), (3, 9, 2), (4, 1, 0), (4, 9, 0)],
        [(4, 1, 2), (4, 9, 2)],
    ]


def test_truncated_recording_is_rewritten(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "a.mcap", finish=False)
    source.write_bytes(source.read_bytes()[:-5])
    target = tmp_path / "out.mcap"

    annotate(source, target)

    with open_recording(source) as recording:
        kept = [(*m[1:-1], bytes(m.data)) for m in recording.messages()]
    with open_recording(target) as recording:
        read = [(*m[1:-1], bytes(m.data)) for m in recording.messages() if m.topic == "/points"]
        assert recording.warnings == []
    assert read == kept
    assert len(kept) >= 5
    assert kept[2] == (EPOCH + 2, EPOCH, 2, string("message 2"))  # logged, published, sequence
    with target.open("rb") as file:
        assert {m.name for m in make_reader(file).iter_metadata()} == {"robot", "shapecat"}
    assert len(read_ros(target, "/shapecat/scene")) == 3


def test_ros1_messages_of_unfinished_mcap_stay_byte_for_byte(tmp_path: Path) -> None:
    """Only bags are converted to ROS 2: other channels of an MCAP file may need ROS 1."""
    source, target = tmp_path / "a.mcap", tmp_path / "out.mcap"
    data = b"\x05\0\0\0hello"
    with mcap_writer(source, "ros1", finish=False) as writer:
        schema = writer.register_schema("std_msgs/String", "ros1msg", b"string data")
        channel = writer.register_channel("/note", "ros1", schema)
        writer.add_message(channel, EPOCH, data, EPOCH)

    annotate(source, target)

    with target.open("rb") as file:
        ((schema, channel, message),) = make_reader(file).iter_messages(["/note"])
    assert (channel.message_encoding, message.data) == ("ros1", data)
    assert (schema.name, schema.encoding) == ("std_msgs/String", "ros1msg")


def test_both_definitions_of_a_type_are_kept(tmp_path: Path) -> None:
    """Robots may define a type differently: in merged recordings, each topic needs its own."""
    texts = {"/a": b"uint32 a", "/b": b"uint32 a\nuint32 b"}
    source, target = tmp_path / "a.mcap", tmp_path / "out.mcap"
    with mcap_writer(source, finish=False) as writer:
        for topic, text in texts.items():
            schema = writer.register_schema("lab/msg/Own", "ros2msg", text)
            channel = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channel, EPOCH, b"\0\1\0\0\7\0\0\0", EPOCH)

    annotate(source, target)

    with target.open("rb") as file:
        read = {c.topic: s.data for s, c, _ in make_reader(file).iter_messages(list(texts)) if s}
    assert read == texts


def test_attachments_and_metadata_of_all_parts_are_kept(tmp_path: Path) -> None:
    source, target = tmp_path / "bag", tmp_path / "out.mcap"
    source.mkdir()
    for k in range(2):
        write_mcap(source / f"bag_{k}.mcap")

    annotate(source, target)

    with target.open("rb") as file:
        reader = make_reader(file)
        attached = [
            (item.create_time, item.log_time, item.name, item.media_type, item.data)
            for item in reader.iter_attachments()
        ]
        names = [item.name for item in reader.iter_metadata()]
    # The two times differ, so that swapping them is noticed.
    assert attached == [(1, 2, "photo", "image/png", b"\x89PNG")] * 2
    assert sorted(names) == ["robot", "robot", "shapecat"]


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_messages_of_ros2_folder_stay_byte_for_byte(tmp_path: Path, plugin: StoragePlugin) -> None:
    source, target = tmp_path / "bag", tmp_path / "out.mcap"
    with FolderWriter(source, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection(
            "/points", STRING, typestore=STORE, offered_qos_profiles=[QOS]
        )
        for k in range(5):
            writer.write(connection, EPOCH + k, string(f"message {k}"))

    annotate(source, target)

    summary = summary_of(target)
    (channel,) = (one for one in summary.channels.values() if one.topic == "/points")
    # Without this profile, subscribers would not receive the played messages.
    assert parse_qos(channel.metadata["offered_qos_profiles"]) == [QOS]
    with AnyReader([target]) as reader:
        chosen = [c for c in reader.connections if c.topic == "/points"]
        read = [bytes(data) for _, _, data in reader.messages(chosen)]
    assert read == [string(f"message {k}") for k in range(5)]
    assert [time for time, _ in read_ros(target, "/points")] == [EPOCH + k for k in range(5)]


def ros1_messages() -> Iterator[tuple[str, str, Any]]:
    time = STORE1.types["builtin_interfaces/msg/Time"](1, 2)
    header = STORE1.types["std_msgs/msg/Header"](7, time, "frame")
    yield "/header", "std_msgs/msg/Header", header
    size = (np.zeros(0), np.arange(9.0), np.zeros(9), np.zeros(12), 0, 0)
    roi = STORE1.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    info = STORE1.types["sensor_msgs/msg/CameraInfo"](header, 4, 3, "plumb_bob", *size, roi)
    yield "/info", "sensor_msgs/msg/CameraInfo", info
    STORE1.register(
        get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf/msg/tfMessage")
        | get_types_from_msg("Header header\nstring[] words\nuint8 level", "lab/msg/Own")
        if "tf/msg/tfMessage" not in STORE1.fielddefs
        else {}
    )
    yield "/tf", "tf/msg/tfMessage", STORE1.types["tf/msg/tfMessage"]([])
    yield "/own", "lab/msg/Own", STORE1.types["lab/msg/Own"](header, ["a", "bc"], 3)


def test_ros1_bag_is_converted_to_ros2(tmp_path: Path) -> None:
    source, target = tmp_path / "a.bag", tmp_path / "out.mcap"
    with BagWriter(source) as writer:
        for k, (topic, kind, item) in enumerate(ros1_messages()):
            latching = 1 if topic == "/tf" else None
            connection = writer.add_connection(topic, kind, typestore=STORE1, latching=latching)
            writer.write(connection, EPOCH + k, STORE1.serialize_ros1(item, kind))

    annotate(source, target)

    ((time, header),) = read_ros(target, "/header")
    ((_, info),) = read_ros(target, "/info")
    ((_, own),) = read_ros(target, "/own")
    assert time == EPOCH
    assert (header.stamp.sec, header.frame_id) == (1, "frame")
    assert list(info.k) == list(range(9))  # ROS 1 calls it K
    assert (own.header.frame_id, own.words, own.level) == ("frame", ["a", "bc"], 3)
    with target.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert reader.get_header().profile == "ros2"
        assert {c.message_encoding for c in summary.channels.values()} == {"cdr"}
        assert "tf2_msgs/msg/TFMessage" in {s.name for s in summary.schemas.values()}
        (tf,) = (c for c in summary.channels.values() if c.topic == "/tf")
        assert "durability: 1" in tf.metadata["offered_qos_profiles"]
    with AnyReader([target]) as other:
        assert other.message_count == 4 + 6


def test_ros1_type_that_ros2_has_extended_keeps_its_definition(tmp_path: Path) -> None:
    """Markers have more fields in ROS 2: read by its definition, a ROS 1 marker ends too early.

    A MarkerArray has the same fields in both, but contains markers.
    """
    source, target = tmp_path / "a.bag", tmp_path / "out.mcap"
    kind, types = "visualization_msgs/msg/Marker", STORE1.types
    header = types["std_msgs/msg/Header"](7, types["builtin_interfaces/msg/Time"](1, 2), "map")
    place = types["geometry_msgs/msg/Point"](0.1, 0.2, 0.3)
    pose = types["geometry_msgs/msg/Pose"](
        place, types["geometry_msgs/msg/Quaternion"](0.4, 0.5, 0.6, 0.7)
    )
    scale = types["geometry_msgs/msg/Vector3"](0.8, 0.9, 1.1)
    colour = types["std_msgs/msg/ColorRGBA"](0.25, 0.5, 0.75, 1.0)
    lifetime = types["builtin_interfaces/msg/Duration"](3, 4)
    rest = (lifetime, True, [place], [colour], "words", "package://mesh", True)
    marker = types[kind](header, "shapes", 5, 1, 0, pose, scale, colour, *rest)
    several = types[f"{kind}Array"]([marker, marker])
    with BagWriter(source) as writer:
        for topic, name, item in (("/one", kind, marker), ("/all", f"{kind}Array", several)):
            connection = writer.add_connection(topic, name, typestore=STORE1)
            writer.write(connection, EPOCH, STORE1.serialize_ros1(item, name))

    annotate(source, target)

    ((_, one),), ((_, both),) = (read_ros(target, topic) for topic in ("/one", "/all"))
    assert len(both.markers) == 2
    for read in (one, *both.markers):
        assert (read.id, read.scale.y, read.text, read.mesh_resource) == (5, 0.9, "words", rest[5])
        assert (read.lifetime.nanosec, read.points[0].z, read.colors[0].b) == (4, 0.3, 0.75)


def test_names_of_ros1_fields_are_allowed_in_ros2(tmp_path: Path) -> None:
    """ROS 2 allows no capitals, as in O_T_EE of Franka robots; strict readers refuse the file."""
    source, target = tmp_path / "a.bag", tmp_path / "out.mcap"
    kind, store = "lab/msg/State", get_typestore(Stores.ROS1_NOETIC)
    text = "float64[2] O_T_EE\nint8 isOn\nint8 a\nint8 A\nint8 b2C_\nint8 TYPE=5"
    store.register(get_types_from_msg(text, kind))
    state = store.types[kind](np.array([0.5, 0.25]), 1, 2, 4, 6)
    with BagWriter(source) as writer:
        connection = writer.add_connection("/state", kind, typestore=store)
        writer.write(connection, EPOCH, store.serialize_ros1(state, kind))

    annotate(source, target)

    ((_, read),) = read_ros(target, "/state")
    assert (list(read.o_t_ee), read.is_on, read.a, read.a_2, read.b2_c) == ([0.5, 0.25], 1, 2, 4, 6)


def test_topics_of_one_type_share_its_conversion(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot may have thousands of topics, and parsing a definition takes milliseconds."""
    asked: list[Channel] = []

    def counted(channel: Channel) -> Any:
        asked.append(channel)
        return typestore_of(channel)

    monkeypatch.setattr(ros1_conversion, "typestore_of", counted)
    text = b"string data  # shared"
    latched = (("latching", "1"),)
    channels = [
        Channel(topic, STRING, "ros1", schema=text, metadata=about)
        for topic, about in (("/a", ()), ("/b", latched), ("/c", ()))
    ]

    found = [ros1_conversion.convert_channel(channel) for channel in channels]

    described = [converted[0] for converted in found if converted]
    assert [channel.topic for channel in described] == ["/a", "/b", "/c"]
    assert [bool(channel.metadata) for channel in described] == [False, True, False]
    assert len(asked) == 1


def test_topics_without_messages_are_kept(tmp_path: Path) -> None:
    """A topic without messages shows that a camera was there, although it sent nothing."""
    source, target = tmp_path / "a.bag", tmp_path / "out.mcap"
    with BagWriter(source) as writer:
        connection = writer.add_connection("/text", STRING, typestore=STORE1)
        writer.add_connection("/silent", "sensor_msgs/msg/Image", typestore=STORE1)
        writer.write(connection, EPOCH, STORE1.serialize_ros1(STORE1.types[STRING]("fine"), STRING))

    annotate(source, target)

    with open_recording(target) as recording:
        counts = {topic.name: (topic.type, topic.count) for topic in recording.topics}
    assert counts["/silent"] == ("sensor_msgs/msg/Image", 0)
    assert counts["/text"] == (STRING, 1)


def test_unconvertible_message_is_wrapped(tmp_path: Path) -> None:
    """Two encodings in one file would make it unreadable for ROS tools."""
    source, target = tmp_path / "a.bag", tmp_path / "out.mcap"
    with BagWriter(source) as writer:
        connection = writer.add_connection("/text", STRING, typestore=STORE1)
        writer.write(connection, EPOCH, STORE1.serialize_ros1(STORE1.types[STRING]("fine"), STRING))
        writer.write(connection, EPOCH + 1, b"\xff\xff\xff\x7fcut")
        other = writer.add_connection("/more", STRING, typestore=STORE1)
        writer.write(other, EPOCH + 2, b"\xff\xff\xff\x7f")

    annotate(source, target)

    with open_recording(target) as recording:
        fine, wrapped = (m for m in recording.messages() if m.topic == "/text")
        assert recording.decode(fine).data == "fine"
        raw = recording.decode(wrapped)
        (more,) = (m for m in recording.messages() if m.topic == "/more")
        assert bytes(recording.decode(more).data) == b"\xff\xff\xff\x7f"
    assert (raw.type, raw.encoding, bytes(raw.data)) == (STRING, "ros1", b"\xff\xff\xff\x7fcut")


@pytest.mark.parametrize(
    ("profile", "encoding", "schema", "expected"),
    [
        ("ros1", "ros1", ("std_msgs/String", "ros1msg"), "ros1"),
        ("", "json", ("foxglove.PointCloud", "jsonschema"), "json"),
    ],
)
def test_annotations_use_encoding_of_source(
    tmp_path: Path, profile: str, encoding: str, schema: tuple[str, str], expected: str
) -> None:
    source, target = tmp_path / "a.mcap", tmp_path / "out.mcap"
    with mcap_writer(source, profile) as writer:
        number = writer.register_schema(*schema, b"string data" if encoding == "ros1" else b"{}")
        channel = writer.register_channel("/points", encoding, number)
        writer.add_message(channel, EPOCH, b"\1\0\0\0a" if encoding == "ros1" else b"{}", EPOCH)

    annotate(source, target)

    with open_recording(target) as recording:
        assert {topic.encoding for topic in recording.topics} == {expected}
        scenes = [recording.decode(m) for m in recording.messages(["/shapecat/scene"])]
    assert [entity.id for entity in scenes[0].entities] == ["track-3", "track-4"]
    assert [deletion.id for deletion in scenes[1].deletions] == ["track-3"]
    assert scenes[0].entities[0].cubes[0].size.z == pytest.approx(0.3)


def test_json_messages_match_their_schemas(tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema")
    source, target = tmp_path / "a.mcap", tmp_path / "out.mcap"
    with mcap_writer(source, "") as writer:
        writer.register_channel("/points", "json", 0)

    annotate(source, target)

    with target.open("rb") as file:
        for schema, _, message in make_reader(file).iter_messages():
            jsonschema.validate(json.loads(message.data), json.loads(schema.data))


def test_failure_leaves_no_file(tmp_path: Path) -> None:
    source = write_mcap(tmp_path / "a.mcap")
    target = tmp_path / "out.mcap"

    def failing() -> Iterator[AnnotationFrame]:
        yield from FRAMES
        raise OSError(28, os.strerror(28))

    with (
        open_recording(source) as recording,
        pytest.raises(OutputError, match=r"out\.mcap: cannot be written: No space left"),
    ):
        write_annotated(recording, target, failing(), run=RUN)

    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
    with pytest.raises(OutputError, match="No such file"):
        annotate(source, tmp_path / "no" / "out.mcap")


def test_full_disk_in_writing_thread_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = write_mcap(tmp_path / "a.mcap")

    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr(Appender, "_write_chunk", full)
    with pytest.raises(OutputError, match=r"out\.mcap: cannot be written: No space left"):
        annotate(source, tmp_path / "out.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_recording_without_frames_is_copied(tmp_path: Path) -> None:
    source, target = write_mcap(tmp_path / "a.mcap"), tmp_path / "out.mcap"

    with open_recording(source) as recording:
        write_annotated(recording, target, [], run=RUN)

    assert digest(target) == digest(source)


def test_every_category_has_its_own_colour() -> None:
    assert {*CATEGORIES, "unknown"} <= CATEGORY_COLOURS.keys()
    assert len(set(CATEGORY_COLOURS.values())) == len(CATEGORY_COLOURS)
    assert colour_of("teapot") == colour_of("teapot") != colour_of("kettle")
