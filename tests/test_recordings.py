"""Tests of recording containers: messages are read, and damage is reported."""

import gzip
import os
import shutil
import socket
import struct
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter
from rosbags.typesys import Stores, get_typestore

from shapecat.errors import RecordingError
from shapecat.recordings import Channel, MessageError, Topic, open_recording
from shapecat.recordings.decoding.decoders import typestore_of
from shapecat.system.files import lock
from tests.mcap_files import mcap_writer
from tests.scenes import record

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)
STRING = "std_msgs/msg/String"
SECOND = 10**9
ODD = Path(__file__).parents[2] / "shared" / "data" / "odd"


def text(value: str) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[STRING](data=value), STRING))


def write_mcap(path: Path, times: list[int], **options: Any) -> Path:
    """Write a text message at each log time (ns), on /a and /b in turn."""
    options = {"chunk_size": 200, "compression": CompressionType.NONE} | options
    with mcap_writer(path, **options) as writer:
        definition = STORE.generate_msgdef(STRING, ros_version=2)[0].encode()
        schema = writer.register_schema(STRING, "ros2msg", definition)
        channels = [writer.register_channel(topic, "cdr", schema) for topic in ("/a", "/b")]
        for k, time in enumerate(times):
            writer.add_message(channels[k % 2], time, text(f"message {k}"), time + 1, k)
    return path


def times_read(path: Path, **options: Any) -> list[int]:
    with open_recording(path) as recording:
        return [message.log_time_ns for message in recording.messages(**options)]


@pytest.mark.parametrize("container", ["mcap", "ros1", "ros2"])
@pytest.mark.parametrize("read", [0, 1, 3])
def test_messages_of_closed_recording_are_refused(
    tmp_path: Path, container: str, read: int
) -> None:
    """Some readers ended as if there were no more messages, others raised an error of a library.

    Messages that are already in memory when the recording is closed are refused as well.
    """
    path = record(tmp_path / "a", 5, container=container)
    with open_recording(path) as recording:
        messages = recording.messages(["/tf"])
        for _ in range(read):
            next(messages)

    assert recording.closed
    closed = f"^{path}: is closed; read its frames before you close it$"
    with pytest.raises(RecordingError, match=closed):
        next(messages)
    with pytest.raises(RecordingError, match="is closed"):
        list(recording.messages())


@pytest.mark.parametrize("compression", list(CompressionType))
def test_indexed_mcap_is_read_in_order_of_time(
    tmp_path: Path, compression: CompressionType
) -> None:
    times = [30, 10, 50, 20, 40, 0] * 5
    path = write_mcap(tmp_path / "a.mcap", times, compression=compression)

    with open_recording(path) as recording:
        messages = list(recording.messages())
        assert recording.kind == "mcap"
        assert recording.topics == (
            Topic("/a", STRING, "cdr", 15),
            Topic("/b", STRING, "cdr", 15),
        )
        assert (recording.start_ns, recording.end_ns, recording.warnings) == (0, 50, [])
        assert [m.log_time_ns for m in messages] == sorted(times)
        assert sorted(recording.decode(m).data for m in messages) == sorted(
            f"message {k}" for k in range(30)
        )
        first = messages[-1]
        assert (first.publish_time_ns, first.sequence % 6) == (51, 2)


def test_time_window_and_topics_are_selected(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", list(range(0, 100, 10)))

    assert times_read(path, start_ns=20, stop_ns=60) == [20, 30, 40, 50]
    assert times_read(path, topics=["/b"], stop_ns=60) == [10, 30, 50]
    assert times_read(path, topics=["/none"]) == []


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"repeat_channels": False},
        {"repeat_schemas": False},
        {"repeat_channels": False, "use_statistics": False, "use_summary_offsets": False},
    ],
)
def test_mcap_without_index_is_read_in_file_order(tmp_path: Path, options: dict[str, Any]) -> None:
    """The mcap library would sort all messages in memory, or raise a bare KeyError."""
    times = [30, 10, 20, 0]
    path = write_mcap(tmp_path / "a.mcap", times, **options)

    assert times_read(path) == times
    with open_recording(path) as recording:
        assert {topic.count for topic in recording.topics} == {2}
        assert "no index" in recording.warnings[0]


@pytest.mark.parametrize("index", [IndexType.CHUNK, IndexType.ALL])
def test_message_indexes_are_not_needed(tmp_path: Path, index: IndexType) -> None:
    path = write_mcap(tmp_path / "a.mcap", [30, 10, 20, 0], index_types=index)

    assert times_read(path, topics=["/a"]) == [20, 30]


def test_unfinished_mcap_is_recovered(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", list(range(20)), finish=False)
    path.write_bytes(path.read_bytes()[:-10])

    with open_recording(path) as recording:
        read = [message.log_time_ns for message in recording.messages()]
        assert read == list(range(len(read)))
        assert len(read) >= 15
        assert recording.end_ns == read[-1]
        assert any(f"messages recovered: {len(read)}" in text for text in recording.warnings)


@pytest.mark.parametrize("rest", [b"", b"\x05" + struct.pack("<Q", 1000) + b"abc"])
def test_warning_states_lost_bytes_of_unfinished_mcap(tmp_path: Path, rest: bytes) -> None:
    """The user must learn whether a power cut cost twelve bytes or nothing."""
    path = write_mcap(tmp_path / "a.mcap", list(range(20)), finish=False)
    path.write_bytes(path.read_bytes() + rest)
    with open_recording(path) as recording:
        (warning,) = recording.warnings

    lost = "; the last 12 bytes are truncated, and read where possible" if rest else ""
    assert warning.startswith("the recording was not finished; messages recovered: ")
    assert warning.partition("recovered: ")[2].lstrip("0123456789") == lost


def test_chunk_without_messages_does_not_set_start(tmp_path: Path) -> None:
    """By the format, the times of an empty chunk are 0: the recording would begin in 1970.

    `--end 5` would then read nothing. Some writers begin with a chunk of schemas and channels.
    """
    path = tmp_path / "a.mcap"
    with mcap_writer(path, compression=CompressionType.NONE) as writer:
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        channel = writer.register_channel("/a", "cdr", schema)
        vars(writer)["_Writer__chunk_builder"].num_messages = 1  # the library writes no such chunk
        getattr(writer, "_Writer__finalize_chunk")()  # noqa: B009  a plain name would be mangled
        for k in range(3):
            writer.add_message(channel, 10**18 + k, text("hello"), 10**18 + k)
    with open_recording(path) as recording:
        assert (recording.start_ns, recording.end_ns) == (10**18, 10**18 + 2)
        assert [m.log_time_ns - 10**18 for m in recording.messages()] == [0, 1, 2]
        assert not recording.warnings


def test_mcap_truncated_anywhere_gives_first_messages(tmp_path: Path) -> None:
    """A power cut can happen at any byte."""
    whole = write_mcap(tmp_path / "a.mcap", list(range(8))).read_bytes()
    contents = [text(f"message {k}") for k in range(8)]
    ends = [whole.index(content) + len(content) for content in contents]
    for size in range(0, len(whole), 7):
        path = tmp_path / "cut.mcap"
        path.write_bytes(whole[:size])
        if size < 8:
            with pytest.raises(RecordingError):
                times_read(path)
        else:
            assert times_read(path) == [k for k, end in enumerate(ends) if end <= size]


def test_flipped_bytes_in_mcap_raise_only_message_errors(tmp_path: Path) -> None:
    """Wrong length fields must not cause huge allocations, endless loops or tracebacks."""
    whole = write_mcap(tmp_path / "a.mcap", list(range(6)), compression=CompressionType.LZ4)
    data = whole.read_bytes()
    path = tmp_path / "flipped.mcap"
    for at in range(8, len(data), 3):
        damaged = bytearray(data)
        damaged[at] ^= 0xFF
        path.write_bytes(damaged)
        with open_recording(path) as recording:
            for message in recording.messages():
                try:
                    recording.decode(message)
                except MessageError:
                    continue


@pytest.mark.parametrize("compression", list(CompressionType))
def test_chunk_is_read_only_up_to_last_wanted_message(
    tmp_path: Path, compression: CompressionType
) -> None:
    """Otherwise reading transforms would decompress the whole recording again."""
    path = tmp_path / "a.mcap"
    noise = np.random.default_rng(0).integers(0, 256, 100_000, np.uint8).tobytes()
    with mcap_writer(path, chunk_size=10**6, compression=compression) as writer:
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        small, large = (writer.register_channel(name, "cdr", schema) for name in ("/a", "/b"))
        for time in range(3):
            writer.add_message(small, time, text(f"message {time}"), time)
        for time in range(3, 6):
            writer.add_message(large, time, noise, time)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF  # in a message of /b

    assert times_read(path) == list(range(6))
    path.write_bytes(data)
    with open_recording(path) as recording:
        assert [message.log_time_ns for message in recording.messages(["/a"])] == [0, 1, 2]
        assert not recording.warnings
        assert list(recording.messages(["/a", "/b"])) == []
        assert "skipped the chunk" in recording.warnings[0]


def test_incomplete_message_index_is_ignored(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", [0, 1, 2], chunk_size=10_000)
    data = path.read_bytes()
    first = data.index(b"\x07" + struct.pack("<QH", 38, 1))  # the index of /a
    path.write_bytes(data[: first + 9] + struct.pack("<H", 9) + data[first + 11 :])

    assert times_read(path, topics=["/a"]) == [0, 2]


def test_damaged_chunk_is_skipped(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.mcap", list(range(20)))
    data = bytearray(path.read_bytes())
    at = data.index(b"message 9")
    data[at : at + 9] = b"massage 9"
    path.write_bytes(data)

    with open_recording(path) as recording:
        read = [message.log_time_ns for message in recording.messages()]
        assert 0 < len(read) < 20
        assert 9 not in read
        assert "skipped the chunk" in recording.warnings[0]
        assert [message.log_time_ns for message in recording.messages()] == read


@pytest.mark.parametrize("size", [10**9, 2**62])
def test_chunk_with_huge_claimed_size_is_skipped(tmp_path: Path, size: int) -> None:
    """Memory must depend on the content of the file, not on its claims."""
    path = write_mcap(tmp_path / "a.mcap", [1, 2], compression=CompressionType.ZSTD)
    data = bytearray(path.read_bytes())
    chunk = data.index(b"\x06", 8 + 9 + 16)
    data[chunk + 9 + 16 : chunk + 9 + 24] = struct.pack("<Q", size)
    path.write_bytes(data)

    with open_recording(path) as recording:
        assert list(recording.messages()) == []
        assert "claims to hold" in recording.warnings[0]


def test_memory_does_not_grow_with_recording(tmp_path: Path) -> None:
    """A recording may be larger than the memory; only chunks that overlap in time are held."""
    tracemalloc = pytest.importorskip("tracemalloc")
    path = tmp_path / "a.mcap"
    with mcap_writer(path, "", compression=CompressionType.NONE, chunk_size=1 << 20) as writer:
        channel = writer.register_channel("/blob", "raw", 0)
        for time in range(64):
            writer.add_message(channel, time, bytes(1 << 20), time)
    with open_recording(path) as recording:
        tracemalloc.start()
        count = sum(1 for _ in recording.messages())
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()

    assert count == 64
    assert peak < 8 << 20


def test_kept_small_message_does_not_keep_its_chunk(tmp_path: Path) -> None:
    """Thousands of transforms are kept; each would keep its chunk of megabytes in memory."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, "") as writer:
        channel = writer.register_channel("/blob", "raw", 0)
        for time, size in ((3, 10), (5, 1 << 20), (8, 70)):
            writer.add_message(channel, time, bytes(size), time)
    with open_recording(path) as recording:
        kept = [memoryview(message.data).obj for message in recording.messages()]

    assert [memoryview(buffer).nbytes for buffer in kept[::2]] == [10, 70]


def write_bag(path: Path, compression: Any = None) -> Path:
    writer = BagWriter(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        kinds = (STRING, "std_msgs/msg/Header")
        connections = [writer.add_connection("/a", kind, typestore=STORE1) for kind in kinds]
        time = STORE1.types["builtin_interfaces/msg/Time"](1, 2)
        header = STORE1.types[kinds[1]](7, time, "frame")
        string = STORE1.types[STRING]("hello")
        for k, (connection, item) in enumerate(zip(connections, (string, header), strict=True)):
            data = STORE1.serialize_ros1(item, connection.msgtype)
            writer.write(connection, (k + 1) * SECOND, data)
    return path


@pytest.mark.parametrize("compression", [None, *BagWriter.CompressionFormat])
def test_bag_with_two_types_on_one_topic_is_read(tmp_path: Path, compression: Any) -> None:
    path = write_bag(tmp_path / "a.bag", compression)

    with open_recording(path) as recording:
        string, header = (recording.decode(message) for message in recording.messages())
        assert recording.kind == "ros1"
        assert [topic.type for topic in recording.topics] == ["std_msgs/msg/Header", STRING]
        assert (recording.start_ns, recording.end_ns) == (SECOND, 2 * SECOND)
        assert (string.data, header.seq, header.stamp.nanosec) == ("hello", 7, 2)


def test_bag_truncated_anywhere_gives_first_messages(tmp_path: Path) -> None:
    """A killed recorder leaves a bag without an index; its messages must still be read."""
    whole = write_bag(tmp_path / "a.bag")
    data = whole.read_bytes()
    path = tmp_path / "cut.bag"
    counts = []
    for size in range(1, len(data), 97):
        path.write_bytes(data[:size])
        try:
            with open_recording(path) as recording:
                read = [message.log_time_ns for message in recording.messages()]
                assert read == [SECOND, 2 * SECOND][: len(read)]
                ends = (read[0], read[-1]) if read else (0, 0)
                assert (recording.start_ns, recording.end_ns) == ends
                assert "recovered" in " ".join(recording.warnings)
                counts.append(len(read))
        except RecordingError as error:
            assert "cut.bag: not a" in str(error)  # noqa: PT017  not every size is an error
    assert counts == sorted(counts)
    assert counts[-1] == 2


@pytest.mark.parametrize("compression", list(BagWriter.CompressionFormat))
def test_damaged_bag_chunk_does_not_stop_others(tmp_path: Path, compression: Any) -> None:
    path = tmp_path / "a.bag"
    writer = BagWriter(path)
    writer.chunk_threshold = 100
    writer.set_compression(compression)
    with writer:
        connection = writer.add_connection("/a", STRING, typestore=STORE1)
        item = STORE1.types[STRING]("x" * 200)
        for k in range(5):
            writer.write(connection, (k + 1) * SECOND, STORE1.serialize_ros1(item, STRING))
    data = bytearray(path.read_bytes())
    chunk = [at for at in range(len(data)) if data[at : at + 4] == b"op=\x05"][2]
    for at in range(chunk + 70, chunk + 110):
        data[at] ^= 0x55
    path.write_bytes(data)

    with open_recording(path) as recording:
        read = [message.log_time_ns // SECOND for message in recording.messages()]
        assert read == [1, 2, 4, 5]
        assert "the rest of the record" in recording.warnings[0]


def write_folder(path: Path, plugin: StoragePlugin, mode: CompressionMode | None = None) -> Path:
    writer = FolderWriter(path, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/a", STRING, typestore=STORE)
        for k in range(5):
            writer.write(connection, k * SECOND, text(f"message {k}"))
    return path


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("mode", [None, CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("metadata", [True, False])
def test_ros2_folder_is_read(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode | None, metadata: Any
) -> None:
    if plugin is StoragePlugin.MCAP and mode is CompressionMode.MESSAGE:
        pytest.skip("only rosbag2 itself writes this, see the next test")
    path = write_folder(tmp_path / "bag", plugin, mode)
    if not metadata:
        (path / "metadata.yaml").unlink()

    with open_recording(path) as recording:
        read = [recording.decode(message).data for message in recording.messages()]
        assert recording.kind == "ros2"
        assert read == [f"message {k}" for k in range(5)]
        assert recording.topics == (Topic("/a", STRING, "cdr", 5),)
        assert bool(recording.warnings) is not metadata


def test_messages_compressed_one_by_one_in_mcap_are_read(tmp_path: Path) -> None:
    """``ros2 bag record -s mcap --compression-mode message`` compresses messages, not chunks."""
    pack = zstandard.ZstdCompressor().compress
    with mcap_writer(tmp_path / "a.mcap") as writer:
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        a = writer.register_channel("/a", "cdr", schema)
        for k in range(3):
            writer.add_message(a, k, pack(text(f"message {k}")), k)
        writer.add_message(a, 3, pack(text("damaged"))[:-3], 3)
        raw = writer.register_channel("/raw", "x-video", 0)
        writer.add_message(raw, 4, pack(b"frame"), 4)

    with open_recording(tmp_path / "a.mcap") as recording:
        *messages, other = recording.messages()
        read = [recording.decode(message).data for message in messages]
        assert read == ["message 0", "message 1", "message 2"]
        assert bytes(other.data) == pack(b"frame")
        assert recording.warnings == ["/a: skipped a damaged compressed message"]


@pytest.mark.parametrize("start", [None, 30, 10])
def test_damage_found_while_a_folder_is_read_is_reported(tmp_path: Path, start: int | None) -> None:
    """The frames of a damaged part would be missing without a warning.

    The damaged part may be the last one, or overlap the next one in time.
    """
    path = tmp_path / "bag"
    path.mkdir()
    part = write_mcap(path / "bag_0.mcap", list(range(20)))
    later = [] if start is None else list(range(start, start + 20))
    if later:
        write_mcap(path / "bag_1.mcap", later)
    data = bytearray(part.read_bytes())
    at = data.index(b"message 9")
    data[at : at + 9] = b"massage 9"
    part.write_bytes(data)

    with open_recording(path) as recording:
        assert 0 < len(list(recording.messages())) - len(later) < 20
        assert any(text.startswith("bag_0.mcap: skipped the chunk") for text in recording.warnings)


def test_file_not_listed_in_metadata_is_not_read(tmp_path: Path) -> None:
    """Another recording, or a repaired copy of a part, may lie beside the parts of a bag."""
    path = write_folder(tmp_path / "bag", StoragePlugin.MCAP)
    write_mcap(path / "another.mcap", [7, 8])
    plain = (path / "metadata.yaml").read_text()

    for quote in ("", "'", '"'):  # YAML needs quotes around some names
        listed = plain.replace("- bag.mcap\n", f"- {quote}bag.mcap{quote}\n")
        (path / "metadata.yaml").write_text(listed)
        assert times_read(path) == [k * SECOND for k in range(5)]
    with open_recording(path) as recording:  # a recording in the wrong folder must be noticed
        skipped = "files that metadata.yaml does not name are not read: another.mcap"
        assert recording.warnings == [skipped]
    (path / "metadata.yaml").unlink()
    assert len(times_read(path)) == 7


@pytest.mark.parametrize(
    ("kind", "length", "refused"),
    [("string", 5000, True), ("uint8", 5000, False), ("string", 9, False)],
)
def test_long_string_arrays_are_refused(kind: str, length: int, *, refused: bool) -> None:
    """Code is generated for each element: one line of a definition could exhaust memory."""
    name, definition = "lab/msg/Long", f"{kind}[{length}] data".encode()
    channel = Channel("/a", name, "cdr", name, "ros2msg", definition)
    expected = pytest.raises(ValueError, match=f"an array of {length} is too long")

    with expected if refused else nullcontext():
        assert name in typestore_of(channel).types


def test_parts_unpacked_by_killed_process_are_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.FILE)
    temporary = tmp_path / "tmp"
    name = f"shapecat-scratch-{socket.gethostname()}+"
    old, other = temporary / f"{name}old", temporary / f"{name}other"
    for folder in (old, other):
        folder.mkdir(parents=True)
        os.utime(folder, (0, 0))
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    held = lock(other)
    assert held is not None

    with open_recording(path) as recording:
        assert not old.exists()
        assert len(list(temporary.iterdir())) == 2
        assert sum(1 for _ in recording.messages()) == 5

    assert list(temporary.iterdir()) == [other]
    os.close(held)


@pytest.mark.parametrize("before", [[], [3, 8]])
@pytest.mark.parametrize("after", [[], [101, 107]])
def test_overlapping_splits_are_merged(tmp_path: Path, before: list[int], after: list[int]) -> None:
    """Read one after the other, splits that overlap would give frames that go back in time."""
    for k, times in enumerate((before, [10, 20, 40, 60], [30, 50, 70, 90], after)):
        if times:
            write_mcap(tmp_path / f"b_{k}.mcap", times)

    assert times_read(tmp_path) == [*before, 10, 20, 30, 40, 50, 60, 70, 90, *after]


def test_unfinished_split_is_reported_before_messages_are_read(tmp_path: Path) -> None:
    """`info` does not read all messages, so it would not report that a split is unfinished."""
    write_mcap(tmp_path / "b_0.mcap", [3, 8])
    write_mcap(tmp_path / "b_1.mcap", [10, 20], finish=False)

    with open_recording(tmp_path) as recording:
        expected = "b_1.mcap: the recording was not finished; messages recovered: 2"
        assert expected in recording.warnings


QOS = Qos(
    QosHistory.KEEP_LAST,
    7,
    QosReliability.BEST_EFFORT,
    QosDurability.VOLATILE,
    *(QosTime(2147483647, 4294967295),) * 2,
    QosLiveliness.AUTOMATIC,
    QosTime(2147483647, 4294967295),
    avoid_ros_namespace_conventions=False,
)


def two_publishers(path: Path, container: str) -> Path:
    """Write three messages of one publisher on /a, four of another, and two on /b.

    ``container`` is mcap, ros1, or, for a ROS 2 folder, the name of a `StoragePlugin`.
    """
    published = [("/a", "one", 3), ("/a", "two", 4), ("/b", "one", 2)]
    if container == "mcap":
        with mcap_writer(path) as writer:
            schema = writer.register_schema(STRING, "ros2msg", b"string data")
            for topic, publisher, count in published:
                channel = writer.register_channel(topic, "cdr", schema, {"who": publisher})
                for k in range(count):
                    writer.add_message(channel, 10 + k, text("hello"), 10 + k)
    elif container == "ros1":
        store = get_typestore(Stores.ROS1_NOETIC)
        with BagWriter(path) as bag:
            for topic, publisher, count in published:
                link = bag.add_connection(topic, STRING, typestore=store, callerid=f"/{publisher}")
                hello = store.serialize_ros1(store.types[STRING]("hello"), STRING)
                for k in range(count):
                    bag.write(link, 10 + k, hello)
    else:
        with FolderWriter(path, version=9, storage_plugin=StoragePlugin[container]) as folder:
            for topic, publisher, count in published:
                qos = [QOS] if publisher == "two" else []
                end = folder.add_connection(
                    topic, STRING, typestore=STORE, offered_qos_profiles=qos
                )
                for k in range(count):
                    folder.write(end, 10 + k, text("hello"))
    return path


@pytest.mark.parametrize("container", ["mcap", "ros1", "MCAP", "SQLITE3"])
def test_topic_count_includes_all_publishers(tmp_path: Path, container: str) -> None:
    """The count decides which topic is chosen, and progress is shown relative to it."""
    suffix = {"mcap": ".mcap", "ros1": ".bag"}.get(container, "")
    with open_recording(two_publishers(tmp_path / f"lab{suffix}", container)) as recording:
        assert [(topic.name, topic.count) for topic in recording.topics] == [("/a", 7), ("/b", 2)]
        assert [sum(1 for _ in recording.messages([name])) for name in ("/a", "/b")] == [7, 2]
        assert (recording.start_ns, recording.end_ns) == (10, 13)


def test_recording_ends_with_split_that_ends_last(tmp_path: Path) -> None:
    """Of two recorders, the one started first may have been stopped last."""
    write_mcap(tmp_path / "b_0.mcap", [11, 40, 97])
    write_mcap(tmp_path / "b_1.mcap", [23, 58])

    with open_recording(tmp_path) as recording:
        assert (recording.start_ns, recording.end_ns) == (11, 97)
        assert [topic.count for topic in recording.topics] == [3, 2]
    assert times_read(tmp_path) == [11, 23, 40, 58, 97]


def test_missing_split_is_reported(tmp_path: Path) -> None:
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3)
    file = path / "metadata.yaml"
    listed = file.read_text().replace("  - bag.db3\n", "  - bag.db3\n  - gone.db3\n")
    file.write_text(listed)

    with open_recording(path) as recording:
        assert recording.warnings == ["parts named in metadata.yaml are missing: gone.db3"]


def test_part_beside_its_compressed_copy_is_read_once(tmp_path: Path) -> None:
    """A recorder that is killed while it compresses a part leaves both, and no metadata."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3)
    (path / "metadata.yaml").unlink()
    (path / "bag.db3.zstd").write_bytes(zstandard.compress((path / "bag.db3").read_bytes()))

    assert times_read(path) == [k * SECOND for k in range(5)]


def test_end_beyond_any_time_selects_the_rest(tmp_path: Path) -> None:
    """SQLite refuses integers of more than 64 bits, which `--end 1e10` gives."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3)

    assert len(times_read(path, start_ns=SECOND, stop_ns=10**19)) == 4
    assert times_read(path, start_ns=10**19) == []


def test_database_without_definitions_uses_humble(tmp_path: Path) -> None:
    """Bags from before ROS 2 Iron do not hold the definitions of their messages."""
    import sqlite3  # noqa: PLC0415  only used here

    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"
    base = sqlite3.connect(path)
    base.execute("DELETE FROM message_definitions")
    base.commit()
    base.close()

    with open_recording(path) as recording:
        read = [recording.decode(message).data for message in recording.messages()]
        assert read[-1] == "message 4"
        assert "Humble" in recording.warnings[0]


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("none.mcap", None, "does not exist"),
        ("empty.bag", b"", "is empty"),
        ("text.mcap", b"hello world", "begins with 'hello wo'"),
        ("folder.mcap", b"folder of robots", "begins with 'folder o'"),
        ("a.mcap.zstd", zstandard.compress(b"\x89MCAP0"), "a compressed file: unpack it first"),
        ("a.bag.gz", gzip.compress(b"#ROSBAG", mtime=0), "a compressed file: unpack it first"),
        ("bag.bag", b"#ROSBAG V1.2\n", "not a readable ROS 1 bag"),
        ("base.db3", b"SQLite format 3\0" + bytes(200), "not a readable ROS 2 bag"),
    ],
)
def test_unreadable_file_gives_one_line_error(
    tmp_path: Path, name: str, content: bytes | None, reason: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)

    with pytest.raises(RecordingError) as caught:
        open_recording(path)

    assert str(path) in str(caught.value)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_pipe_is_not_opened_as_recording(tmp_path: Path) -> None:
    """Opening a pipe waits for its writer; a pipe among recordings would stop the whole run."""
    os.mkfifo(tmp_path / "pipe.mcap")
    writer = os.open(tmp_path / "pipe.mcap", os.O_RDWR)  # so that a failing test ends
    os.write(writer, bytes(16))

    with pytest.raises(RecordingError, match="is a pipe or a device"):
        open_recording(tmp_path / "pipe.mcap")
    os.close(writer)


@pytest.mark.parametrize("name", ["lab%41.db3", "run#1.db3", "what?.db3", "a%20#b/c.db3"])
def test_database_may_have_signs_of_urls_in_its_path(tmp_path: Path, name: str) -> None:
    """SQLite read the path as a URL: it found no file, or opened another one."""
    whole = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"
    (tmp_path / name).parent.mkdir(exist_ok=True)
    whole.rename(tmp_path / name)
    (tmp_path / "labA.db3").write_bytes(b"another")

    assert len(times_read(tmp_path / name)) == 5


def test_format_is_detected_from_content_not_suffix(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "a.bag", [1])
    database = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"

    assert times_read(path) == [1]
    assert len(times_read(database.rename(tmp_path / "LAB.DB3"))) == 5


@pytest.mark.parametrize(
    "definition",
    [
        "float64[99999999] x\nstring[99999999] y",
        "Self next\n================================================================\nMSG: a/Self",
        "not a definition",
        "string x=" + "a" * 100,
        "uint8 class",
    ],
)
def test_hostile_definition_is_message_error(tmp_path: Path, definition: str) -> None:
    path = tmp_path / "a.mcap"
    with mcap_writer(path) as writer:
        schema = writer.register_schema("a/msg/Self", "ros2msg", definition.encode())
        channel = writer.register_channel("/a", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0", 1)
    with open_recording(path) as recording, pytest.raises(MessageError, match="/a: cannot decode"):
        recording.decode(next(iter(recording.messages())))


def odd_files() -> Iterator[Path]:
    if ODD.exists():
        yield from sorted(path for path in ODD.rglob("*") if path.is_file() or path.parent == ODD)


@pytest.mark.skipif(not ODD.exists(), reason="needs the collection of odd recordings")
@pytest.mark.parametrize("path", list(odd_files()), ids=lambda path: str(path.name))
def test_odd_file_is_read_or_refused(path: Path) -> None:
    if path.name in {"asci-file.txt", "empty-file.bag", "metadata.yaml", "conformance"}:
        if path.is_file():
            with pytest.raises(RecordingError, match=path.name):
                open_recording(path)
        return
    with open_recording(path) as recording:
        counts = {(t.name, t.type): t.count for t in recording.topics}
        read: dict[tuple[str, str], int] = dict.fromkeys(counts, 0)
        for message in recording.messages():
            if (message.topic, message.type) in counts:
                read[message.topic, message.type] += 1
            assert np.frombuffer(message.data, np.uint8).size == len(message.data)

        assert read == counts


def killed_recorder(path: Path) -> Path:
    """Write, in a folder, a database whose last two messages are only in its write-ahead log."""
    import sqlite3  # noqa: PLC0415  only used here

    whole, left = write_folder(path / "bag", StoragePlugin.SQLITE3) / "bag.db3", path / "left"
    base = sqlite3.connect(whole)
    base.execute("PRAGMA journal_mode=WAL")
    rows = base.execute("SELECT * FROM messages WHERE timestamp >= ?", [3 * SECOND]).fetchall()
    base.execute("DELETE FROM messages WHERE timestamp >= ?", [3 * SECOND])
    base.commit()
    base.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    base.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    base.commit()
    left.mkdir()
    for name in ("bag.db3", "bag.db3-wal"):
        shutil.copy(whole.with_name(name), left)
    base.close()
    return left / "bag.db3"


@pytest.mark.parametrize("free", [1 << 40, 1000])
def test_log_of_killed_recorder_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free: int
) -> None:
    """SQLite would merge the log into the database, but recordings must not be changed."""
    path = killed_recorder(tmp_path)
    before = [file.read_bytes() for file in sorted(path.parent.iterdir())]
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=free))

    with open_recording(path) as recording:
        read = [recording.decode(message).data for message in recording.messages()]
        (warning,) = recording.warnings

    assert read == [f"message {k}" for k in range(5 if free > 1000 else 3)]
    assert ("not read: not enough space" in warning) is (free == 1000)
    assert [file.read_bytes() for file in sorted(path.parent.iterdir())] == before
    assert list(temporary.iterdir()) == []


IDL = """\
================================================================================
IDL: lab_msgs/msg/Grip
// generated from rosidl_adapter/resource/msg.idl.em

#include "builtin_interfaces/msg/Time.idl"

module lab_msgs {
  module msg {
    struct Grip {
      builtin_interfaces::msg::Time at;

      @verbatim (language="comment", text=
        "Newton")
      double force;

      sequence<int16> counts;
    };
  };
};

================================================================================
IDL: builtin_interfaces/msg/Time
// generated from rosidl_adapter/resource/msg.idl.em

module builtin_interfaces {
  module msg {
    struct Time {
      int32 sec;

      uint32 nanosec;
    };
  };
};
"""


def test_messages_defined_in_idl_are_decoded(tmp_path: Path) -> None:
    """For packages without .msg files, ``ros2 bag record`` stores the IDL and its includes."""
    data = b"\0\1\0\0" + struct.pack("<iIdI3h", 17, 250, 4.5, 3, 2, -3, 5)
    with mcap_writer(tmp_path / "a.mcap") as writer:
        one = IDL.rpartition("IDL: ")[2].partition("\n")[2]
        for kind, idl, size in (
            ("lab_msgs/msg/Grip", IDL, len(data)),
            ("builtin_interfaces/msg/Time", one, 12),
        ):
            schema = writer.register_schema(kind, "ros2idl", idl.encode())
            channel = writer.register_channel(kind, "cdr", schema)
            writer.add_message(channel, 1, data[:size], 1)

    with open_recording(tmp_path / "a.mcap") as recording:
        grip, time = (recording.decode(message) for message in recording.messages())

    assert (grip.at.sec, grip.at.nanosec, grip.force) == (17, 250, 4.5)
    assert list(grip.counts) == [2, -3, 5]
    assert (time.sec, time.nanosec) == (17, 250)


@pytest.mark.parametrize(
    ("encoding", "definition", "reason"),
    [
        ("cbor", b"string data", "encoding 'cbor' is not supported"),
        ("cdr", b"# " + b"x" * (1 << 20) + b"\nstring data", "the definition is too long, 104859"),
    ],
)
def test_reason_why_messages_cannot_be_decoded_is_given(
    tmp_path: Path, encoding: str, definition: bytes, reason: str
) -> None:
    """A bare KeyError would not tell the reason; a long definition takes minutes to parse."""
    with mcap_writer(tmp_path / "a.mcap") as writer:
        schema = writer.register_schema("a/msg/Text", "ros2msg", definition)
        channel = writer.register_channel("/a", encoding, schema)
        writer.add_message(channel, 1, text("x"), 1)

    with open_recording(tmp_path / "a.mcap") as recording:
        (message,) = recording.messages()
        with pytest.raises(MessageError, match=f"^/a: cannot decode a/msg/Text: {reason}"):
            recording.decode(message)
