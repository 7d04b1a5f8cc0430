"""Tests of damaged containers: intact messages are read, and a warning or error names the rest."""

import errno
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from shapecat.errors import RecordingError
from shapecat.recordings import open_recording
from shapecat.recordings.containers import ros1_records
from shapecat.recordings.containers.mcap_index import read_message_index
from shapecat.recordings.overview import describe_recording
from tests.mcap_files import mcap_writer, summary_of
from tests.test_recordings import (
    SECOND,
    STRING,
    text,
    times_read,
    write_folder,
    write_mcap,
)
from tests.test_recordings_worked import bag_of


def read(path: Path) -> tuple[list[int], list[str]]:
    """Return the log times of all messages, and the warnings."""
    with open_recording(path) as recording:
        return [message.log_time_ns for message in recording.messages()], recording.warnings


def replace(path: Path, old: bytes, new: bytes, nth: int = 0) -> None:
    """Replace one occurrence of ``old`` in a file; ``nth`` counts from 0."""
    data = path.read_bytes()
    at = -1
    for _ in range(nth + 1):
        at = data.index(old, at + 1)
    path.write_bytes(data[:at] + new + data[at + len(old) :])


# ---- MCAP


@pytest.mark.parametrize(("opcode", "warned"), [(0x40, True), (0x90, False)])
def test_records_of_unknown_kind_are_skipped(tmp_path: Path, opcode: int, warned: bool) -> None:
    """A later format may define opcodes below 0x80, so these are reported; the rest is private."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, "", use_chunking=False, index_types=IndexType.NONE) as writer:
        channel = writer.register_channel("/a", "raw", 0)
        for time in (3, 5):
            writer.add_message(channel, time, b"x", time)
    data = path.read_bytes()
    at = data.index(struct.pack("<BQ", Opcode.MESSAGE, 23))
    path.write_bytes(data[:at] + struct.pack("<BQ", opcode, 4) + b"\x07\x08\x09\x0a" + data[at:])

    times, warnings = read(path)
    assert times == [3, 5]
    assert [w for w in warnings if "unknown kind" in w] == (
        ["skipped records of unknown kind 64"] if warned else []
    )


@pytest.mark.parametrize("damaged", ["", "std/String", "/topic"])
def test_index_without_checksum_is_compared_with_the_chunks(tmp_path: Path, damaged: str) -> None:
    """A damaged index would give messages a topic or a type that was not recorded."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, enable_crcs=False, compression=CompressionType.NONE) as writer:
        schema = writer.register_schema("std/String", "ros1msg", b"string data")
        channel = writer.register_channel("/topic", "ros1", schema)
        writer.add_message(channel, 5, text("a"), 5)
    if damaged:
        before, _, after = path.read_bytes().rpartition(damaged.encode())
        path.write_bytes(before + damaged.upper().encode() + after)

    with open_recording(path) as recording:
        (topic,) = recording.topics
        assert (topic.name, topic.type, topic.count) == ("/topic", "std/msg/String", 1)
        assert len(recording.warnings) == (1 if damaged else 0)


@pytest.mark.parametrize(
    ("needed", "full", "without_data"),
    [
        (None, [3, 4, 8, 9], []),  # a copy of the recording must not get empty messages
        ({3, 4, 5, 6, 8, 9}, [3, 4, 8, 9], [5, 6]),
        ({9}, [9], [3, 4, 5, 6, 8]),
    ],
)
def test_destroyed_messages_count_where_messages_are_chosen(
    tmp_path: Path, needed: set[int] | None, full: list[int], without_data: list[int]
) -> None:
    """Frames are found again by number, which must not depend on the messages that are read."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, chunk_size=120) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        for time in (3, 4, 5, 6, 8, 9):
            writer.add_message(channel, time, b"m" * 52, time)
    replace(path, b"\4\0\0\0zstd", b"\4\0\0\0zst9", 1)

    with open_recording(path) as recording:
        chosen = None if needed is None else lambda _topic, time: time in needed
        messages = list(recording.messages(needed=chosen))
    assert [m.log_time_ns for m in messages if m.data] == full
    assert [m.log_time_ns for m in messages if not m.data] == without_data


def test_messages_out_of_order_count_once_in_a_chunk_read_in_part(tmp_path: Path) -> None:
    """Some recorders do not sort messages: one would count twice, and another one not at all."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        for time in (9, 3, 8, 5):
            writer.add_message(channel, time, b"m" * 52, time)

    with open_recording(path) as recording:
        messages = list(recording.messages(needed=lambda _topic, time: time in {3, 9}))
    assert [(m.log_time_ns, len(m.data)) for m in messages] == [(3, 52), (5, 0), (8, 0), (9, 52)]


@pytest.mark.parametrize("checked", [False, True])
def test_damaged_index_is_not_called_missing(tmp_path: Path, *, checked: bool) -> None:
    """Users were told that a damaged index is missing, or that it is both damaged and missing."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, enable_crcs=checked, compression=CompressionType.NONE) as writer:
        channel = writer.register_channel("/topic", "x-text", 0)
        writer.add_message(channel, 5, b"m", 5)
    before, _, after = path.read_bytes().rpartition(b"/topic")
    path.write_bytes(before + b"/tOpic" + after)

    warning = "the index is damaged: reading the file from beginning to end instead"
    assert read(path) == ([5], [warning])


def test_index_that_lacks_a_chunk_is_not_used(tmp_path: Path) -> None:
    """The chunk's messages would be missing; without a checksum, only the chunk count shows it."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, enable_crcs=False, chunk_size=60) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        for time in (3, 5, 8):
            writer.add_message(channel, time, b"m" * 52, time)
    entry = summary_of(path).chunk_indexes[1]
    data = path.read_bytes()
    at = data.index(struct.pack("<QQQ", 5, 5, entry.chunk_start_offset)) - 9
    assert data[at] == Opcode.CHUNK_INDEX
    path.write_bytes(data[:at] + b"\x90" + data[at + 1 :])  # an opcode for private use

    assert read(path) == ([3, 5, 8], ["no index: messages are read in file order"])


@pytest.mark.parametrize(("damage", "wanted"), [("time", 5), ("place", 3)])
def test_damaged_index_of_a_chunk_is_not_used(tmp_path: Path, damage: str, wanted: int) -> None:
    """A chunk's index has no checksum; the review would lack frames that the tables have."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, compression=CompressionType.NONE) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        for time in (3, 5, 8):
            writer.add_message(channel, time, b"m" * 52, time)
    with path.open("rb") as file:
        ((_, middle, _),) = (read_message_index(file, c) for c in summary_of(path).chunk_indexes)
    new = (0, middle.place) if damage == "time" else (middle.log_time, 1 << 40)
    replace(path, struct.pack("<QQ", *middle[1:]), struct.pack("<QQ", *new))

    with open_recording(path) as recording:
        messages = recording.messages(needed=lambda _, time: time == wanted)
        found = [(m.log_time_ns, len(m.data)) for m in messages]
        assert found == [(time, 52 * (time == wanted)) for time in (3, 5, 8)]
        assert recording.damaged
        assert recording.warnings == []  # nothing is missing


def test_damaged_chunk_is_reported_once_however_much_of_it_is_read(tmp_path: Path) -> None:
    """A read in part finds a wrong length, one in full a wrong checksum: one warning is enough."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, compression=CompressionType.NONE) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        for time in (3, 5, 8):
            writer.add_message(channel, time, b"m" * 52, time)
    replace(path, struct.pack("<BQ", 5, 74), struct.pack("<BQ", 5, 7400))

    with open_recording(path) as recording:
        list(recording.messages(needed=lambda _, time: time == 3))
        list(recording.messages(needed=lambda _, time: time == 8))
        assert recording.damaged
        (warning,) = recording.warnings
    assert warning.startswith("skipped the chunk at byte ")


def test_damage_is_reported_once_and_only_where_it_is_read(tmp_path: Path) -> None:
    """Checking the index finds damage in all chunks, also in those that a run does not need."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, enable_crcs=False, chunk_size=60) as writer:
        for name, time in (("/a", 3), ("/b", 5)):
            channel = writer.register_channel(name, "x-text", 0)
            writer.add_message(channel, time, b"m" * 52, time)
    replace(path, b"\4\0\0\0zstd", b"\4\0\0\0zst9", 1)

    with open_recording(path) as recording:
        assert recording.indexed
        assert recording.warnings == []
        assert [message.log_time_ns for message in recording.messages(["/a"])] == [3]
        assert recording.warnings == []
        for _ in range(2):
            assert [message.log_time_ns for message in recording.messages()] == [3]
            (warning,) = recording.warnings
    assert warning.endswith("chunk compression 'zst9' is not supported")


@pytest.mark.parametrize(
    ("old", "new", "nth", "reason"),  # in the second chunk; the first one also holds the channel
    [
        (b"\4\0\0\0zstd", b"\4\0\0\0zst9", 1, "chunk compression 'zst9' is not supported"),
        (struct.pack("<Q", 83), struct.pack("<Q", 82), 0, "83 bytes where the header says 82"),
    ],
)
def test_chunk_that_is_not_what_it_claims_is_skipped(
    tmp_path: Path, old: bytes, new: bytes, nth: int, reason: str
) -> None:
    """The chunk's messages would be missing without a warning, or have wrong lengths."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, compression=CompressionType.ZSTD, chunk_size=60) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        for time in (3, 5, 8):
            writer.add_message(channel, time, b"m" * 52, time)
    replace(path, old, new, nth)

    times, (warning,) = read(path)

    assert times == [3, 8]
    assert warning.startswith("skipped the chunk at byte ")
    assert warning.endswith(reason)


def test_finished_file_that_is_damaged_is_not_called_unfinished(tmp_path: Path) -> None:
    """If a copy lost a block, the user should copy the file again, not record again."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, chunk_size=60) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        for time in (3, 5, 8):
            writer.add_message(channel, time, b"m" * 52, time)
    second = summary_of(path).chunk_indexes[1].chunk_start_offset
    data = path.read_bytes()
    path.write_bytes(data[: second + 2] + data[second + 9 :])

    times, warnings = read(path)

    assert times == [3]
    assert warnings[-1] == (
        "the recording is damaged; messages recovered: 1; the last "
        f"{len(data) - 7 - second} bytes are damaged, and read where possible"
    )


def test_messages_that_cannot_be_assigned_are_reported(tmp_path: Path) -> None:
    """Messages without a channel, or cut short, would be missing without a warning."""
    path = tmp_path / "a.mcap"
    with mcap_writer(path, finish=False, use_chunking=False) as writer:
        channel = writer.register_channel("/a", "x-text", 0)
        writer.add_message(channel, 3, b"first", 3)
    record = struct.Struct("<HIQQ")
    with path.open("ab") as file:
        file.write(struct.pack("<BQ", 5, 22 + 4) + record.pack(9, 0, 5, 5) + b"lost")
        short = file.tell() + 9
        file.write(struct.pack("<BQ", 5, 10) + bytes(10))
        file.write(struct.pack("<BQ", 5, 22 + 4) + record.pack(channel, 0, 8, 8) + b"last")

    times, warnings = read(path)

    assert times == [3, 8]
    assert "skipped messages of channel 9, which has no Channel record" in warnings
    assert f"skipped a record at byte {short}: message record of 10 bytes" in warnings


def test_message_that_claims_to_be_huge_is_not_unpacked(tmp_path: Path) -> None:
    """One damaged byte in a size field could exhaust memory."""
    claim = b"\x28\xb5\x2f\xfd\xc0\x00" + struct.pack("<Q", (1 << 30) + 1)
    with mcap_writer(tmp_path / "a.mcap") as writer:
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        channel = writer.register_channel("/a", "cdr", schema)
        writer.add_message(channel, 3, claim + bytes(20), 3)
        writer.add_message(channel, 5, text("small"), 5)

    assert read(tmp_path / "a.mcap") == (
        [5],
        ["/a: skipped a message that claims more than 1 GiB"],
    )


def test_error_of_the_disk_names_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`info` ended with a traceback, and an export blamed the file that it was writing."""
    path = tmp_path / "a.mcap"
    write_mcap(path, [5])

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    reason = f"{path}: cannot be read: Input/output error"
    with monkeypatch.context() as patch:
        patch.setattr("shapecat.recordings.overview.input_size", fail)
        with pytest.raises(RecordingError, match=reason):
            describe_recording(path)
    with open_recording(path) as recording:
        monkeypatch.setattr("shapecat.recordings.containers.mcap_file.read_content", fail)
        with pytest.raises(RecordingError, match=reason):
            list(recording.messages())


# ---- ROS 1


def test_encrypted_bag_is_refused_with_its_method(tmp_path: Path) -> None:
    """Encrypted chunks look damaged; the user must learn the real reason."""
    path = bag_of(tmp_path / "a.bag")
    data, begin = path.read_bytes(), len(b"#ROSBAG V2.0\n")
    (size,) = struct.unpack_from("<I", data, begin)
    field = b"encryptor=rosbag/AesCbcEncryptor"
    header = data[begin + 4 : begin + 4 + size] + struct.pack("<I", len(field)) + field
    rest = data[begin + 4 + size :]
    path.write_bytes(data[:begin] + struct.pack("<I", len(header)) + header + rest)

    with pytest.raises(RecordingError, match="encrypted with 'rosbag/AesCbcEncryptor'"):
        open_recording(path)


def test_bag_chunk_of_unknown_compression_is_reported(tmp_path: Path) -> None:
    path = bag_of(tmp_path / "a.bag")
    whole = times_read(path)
    replace(path, b"compression=none", b"compression=zstd", 1)

    times, (warning,) = read(path)

    assert 0 < len(times) < len(whole)
    assert set(times) < set(whole)
    assert warning.endswith(": compression 'zstd' is not supported")


def test_bag_chunk_that_unpacks_to_too_much_is_skipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory must depend on the content of the file, not on its claims."""
    import bz2  # noqa: PLC0415  only used here

    monkeypatch.setattr(ros1_records, "_FREELY", 5000)
    monkeypatch.setattr(ros1_records, "_RATIO", 1)
    record = ros1_records.Record({"compression": b"bz2"}, 0, 0, 0)
    small, large = bz2.compress(bytes(4999)), bz2.compress(bytes(9000))

    found = [ros1_records.expand(record, data) for data in (small, large)]

    assert [len(plain) for plain, _ in found] == [4999, 0]
    assert [problem for _, problem in found] == ["", f"{len(large)} bytes hold more than 5000"]


@pytest.mark.parametrize("broken", ["place", "connection"])
def test_bag_with_a_wrong_index_is_read_without_it(tmp_path: Path, broken: str) -> None:
    """Tools that cut bags may keep the old index; messages it misplaces would be missing."""
    path = bag_of(tmp_path / "a.bag")
    whole = times_read(path)
    data = path.read_bytes()
    header = data.index(b"op=\x06")  # of the first chunk info
    at = data.rindex(b"chunk_pos=", 0, header + 60) + len(b"chunk_pos=")
    if broken == "place":
        (start,) = struct.unpack_from("<Q", data, at)
        (size,) = struct.unpack_from("<I", data, start)
        (length,) = struct.unpack_from("<I", data, start + 4 + size)
        new = struct.pack("<Q", start + 8 + size + length)  # the next record, an index
        path.write_bytes(data[:at] + new + data[at + 8 :])
    else:
        pairs = data.index(b"count=", header - 40)
        (count,) = struct.unpack_from("<I", data, pairs + 6)
        end = data.index(struct.pack("<I", 8 * count), pairs + 10)
        path.write_bytes(data[: end + 4] + struct.pack("<I", 9) + data[end + 8 :])

    times, warnings = read(path)

    assert sorted(times) == whole
    assert warnings == ["no index, or a damaged one; messages recovered: 12"]


@pytest.mark.parametrize("hole", ["length", "header"])
def test_bag_is_read_on_after_a_hole(tmp_path: Path, hole: str) -> None:
    """One bad sector would cost all later messages, although the index lists their chunks."""
    path = bag_of(tmp_path / "a.bag")
    data = path.read_bytes()
    ops = [at for at in range(len(data)) if data.startswith(b"op=\x05", at)]
    begin = ops[1] - 8
    size = 4 if hole == "length" else 60
    path.write_bytes(data[:begin] + bytes(size) + data[begin + size :])
    whole, _ = read(bag_of(tmp_path / "b.bag"))

    times, warnings = read(path)

    assert len(times) == len(whole) - 2  # those of the second chunk
    assert set(times) <= set(whole)
    (lost,) = (text for text in warnings if text.endswith("is lost"))
    assert lost.endswith(f": the rest up to byte {ops[2] - 8} is lost")


def test_damaged_record_of_a_bag_is_reported_with_its_place(tmp_path: Path) -> None:
    """Everything after it is lost; its position tells how much that is."""
    path = bag_of(tmp_path / "a.bag")
    data = path.read_bytes()
    at = data.rindex(b"op=\x05")
    start = at - 8  # the lengths of the header and of its first field
    path.write_bytes(data[:at] + b"op_\x05" + data[at + 4 :])

    times, warnings = read(path)

    assert 0 < len(times) < 12
    assert f"damaged record header at byte {start}: everything after it is lost" in warnings


def test_bag_messages_of_an_unknown_connection_are_reported(tmp_path: Path) -> None:
    """Their topic is unknown; the messages would be missing without a warning."""
    path = bag_of(tmp_path / "a.bag")
    data = path.read_bytes()
    at = data.index(b"op=\x02")
    conn = data.rfind(b"conn=", 0, at)
    if at - conn > 40:
        conn = data.index(b"conn=", at)
    path.write_bytes(data[: conn + 5] + struct.pack("<I", 7) + data[conn + 9 :])

    times, warnings = read(path)

    assert len(times) == 11
    assert "skipped messages of connection 7, which has no connection record" in warnings


def test_message_lost_in_a_bag_chunk_is_reported(tmp_path: Path) -> None:
    """A damaged opcode hides a message; only the count in the index reveals the loss."""
    path = bag_of(tmp_path / "a.bag")
    data = path.read_bytes()
    at = data.index(b"op=\x02") + len(b"op=")
    path.write_bytes(data[:at] + b"\x09" + data[at + 1 :])

    times, warnings = read(path)

    assert len(times) == 11
    assert [text for text in warnings if "the index does not list its" in text]


# ---- ROS 2


@pytest.mark.parametrize("time", ["'a text'", "NULL", "-5"])
def test_database_message_without_time_is_skipped_and_reported(tmp_path: Path, time: str) -> None:
    """Such a message can be neither sorted nor written to annotated.mcap."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"
    with closing(sqlite3.connect(path)) as base:
        (made,) = base.execute("SELECT sql FROM sqlite_master WHERE name = 'messages'").fetchone()
        base.execute("ALTER TABLE messages RENAME TO strict")
        base.execute(made.replace("timestamp INTEGER NOT NULL", "timestamp INTEGER"))
        base.execute("INSERT INTO messages SELECT * FROM strict")
        base.execute(f"UPDATE messages SET timestamp = {time} WHERE id = 3")  # noqa: S608  above
        base.commit()

    times, warnings = read(path)

    assert times == [0, SECOND, 3 * SECOND, 4 * SECOND]
    assert warnings == ["/a: skipped a message without a time"]


def test_database_message_without_bytes_is_skipped_and_reported(tmp_path: Path) -> None:
    """Scripts that edit bags with SQL may leave text as data; this must not end a run."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"
    with closing(sqlite3.connect(path)) as base:
        base.execute("UPDATE messages SET data = 'a text' WHERE timestamp = ?", (2 * SECOND,))
        base.commit()

    times, warnings = read(path)

    assert times == [0, SECOND, 3 * SECOND, 4 * SECOND]
    assert warnings == ["/a: skipped a message without bytes"]


@pytest.mark.parametrize("counted", [False, True])
def test_damaged_message_of_a_database_is_skipped(tmp_path: Path, *, counted: bool) -> None:
    """One bad page must not cost the rest of a bag, nor change the numbers of later frames."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"
    with closing(sqlite3.connect(path)) as base:
        rows = [(10 * SECOND + k, text("x" * 12_000 + str(k))) for k in range(9)]
        base.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", rows)
        base.commit()
        (size,) = base.execute("PRAGMA page_size").fetchone()
    data = bytearray(path.read_bytes())
    last = data.index(b"x4\0") // size  # the last page of a message, to which another page points
    pages = range(0, len(data), size)
    (before,) = (at for at in pages if data[at : at + 4] == struct.pack(">I", last + 1))
    data[before : before + 4] = b"\xff" * 4
    path.write_bytes(data)

    with open_recording(path) as recording:
        messages = list(recording.messages(needed=(lambda *_: True) if counted else None))
        assert recording.warnings == ["/a: skipped a damaged message"]
        rest = list(recording.messages(start_ns=10 * SECOND, stop_ns=10 * SECOND + 7))

    times = [*(k * SECOND for k in range(5)), *(10 * SECOND + k for k in range(9))]
    assert [m.log_time_ns for m in messages] == [
        t for k, t in enumerate(times) if counted or k != 9
    ]
    assert [m.log_time_ns for m in messages if not m.data] == times[9:10] * counted
    assert messages[-1].data == text("x" * 12_000 + "8")
    assert [m.log_time_ns - 10 * SECOND for m in rest] == [0, 1, 2, 3, 5, 6]


def test_database_is_read_up_to_where_it_ends_too_early(tmp_path: Path) -> None:
    """The first hour of a bag on a failing disk is useful; the user must learn where it ends."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"
    with closing(sqlite3.connect(path)) as base:  # more than the library keeps in memory
        rows = [(10 * SECOND + k, text("x" * 3000)) for k in range(1500)]
        base.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?, ?)", rows)
        base.commit()

    with open_recording(path) as recording:
        with path.open("r+b") as file:
            file.truncate(path.stat().st_size // 2)
        times = [message.log_time_ns for message in recording.messages()]
        (warning,) = recording.warnings

    assert times == [*(k * SECOND for k in range(5)), *(t for t, _ in rows)][: len(times)]
    assert 500 < len(times) < 1000
    assert warning.startswith("damaged: nothing after this was read: ")


@pytest.mark.parametrize("plugin", list(StoragePlugin))
def test_folder_named_like_a_part_is_not_read_as_one(tmp_path: Path, plugin: StoragePlugin) -> None:
    """A subfolder old.mcap or old.db3 made a bag unreadable, with a misleading error."""
    bag = write_folder(tmp_path / "bag", plugin)
    (bag / "metadata.yaml").unlink()
    (bag / f"old.{'mcap' if plugin == StoragePlugin.MCAP else 'db3'}").mkdir()

    times, (warning,) = read(bag)

    assert times == [k * SECOND for k in range(5)]
    assert warning.startswith("no metadata.yaml")


def test_damaged_temporary_copy_is_not_named(tmp_path: Path) -> None:
    """The copy is gone when the user reads the error, so its path would not help."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3) / "bag.db3"
    whole = path.read_bytes()
    for data, reason in (
        (whole[:5000], "database disk image is malformed"),
        (whole.replace(b"messages", b"massages"), "Cannot open database or database missing tab"),
    ):
        path.unlink(missing_ok=True)
        path.with_name("bag.db3.zstd").write_bytes(zstandard.compress(data))
        with pytest.raises(RecordingError) as found:
            open_recording(path.parent)
        assert str(found.value).startswith(
            f"{path.parent}: bag.db3.zstd: not a readable ROS 2 bag: {reason}"
        )


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("notes.txt", b"x", "a folder without .mcap or .db3 files"),
        ("a.db3", b"", "a.db3: is empty"),
        ("a.mcap", b"", "a.mcap: is empty"),
        ("a.db3", b"SQLite format 3\0" + bytes(200), "a.db3: not a readable ROS 2 bag"),
        ("a.db3.zstd", b"\x28\xb5\x2f\xfd" + b"\xff" * 40, "a.db3.zstd: damaged: "),
        ("a.db3.zstd", zstandard.compress(b"x" * 600), "a.db3.zstd: not enough space in the temp"),
    ],
)
def test_folder_without_readable_part_is_refused_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, content: bytes, reason: str
) -> None:
    """Parts unpacked before the error must not remain in the temporary folder."""
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").write_text("")
    (tmp_path / "bag" / name).write_bytes(content)
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1000))

    with pytest.raises(RecordingError, match=reason):
        open_recording(tmp_path / "bag")

    assert list((tmp_path / "tmp").iterdir()) == []


def test_damaged_part_of_a_folder_is_skipped_and_reported(tmp_path: Path) -> None:
    """Minutes in the middle of a recording would be missing without a warning."""
    path = write_folder(tmp_path / "bag", StoragePlugin.SQLITE3, CompressionMode.FILE)
    (part,) = path.glob("*.zstd")
    (path / "metadata.yaml").unlink()
    (path / "later.mcap").write_bytes(write_mcap(tmp_path / "b.mcap", [7 * SECOND]).read_bytes())
    (path / "broken.mcap.zstd").write_bytes(part.read_bytes()[:-9])

    times, warnings = read(path)

    assert times == [*(k * SECOND for k in range(5)), 7 * SECOND]
    assert any(text.startswith("skipped broken.mcap.zstd: ") for text in warnings)


def test_folder_without_messages_has_no_times(tmp_path: Path) -> None:
    """A recorder that is stopped at once leaves such a bag; it must be opened all the same."""
    (tmp_path / "bag").mkdir()
    write_mcap(tmp_path / "bag" / "bag_0.mcap", [])

    with open_recording(tmp_path / "bag") as recording:
        assert (recording.start_ns, recording.end_ns) == (0, 0)
        assert [(topic.name, topic.count) for topic in recording.topics] == [("/a", 0), ("/b", 0)]
        assert list(recording.messages()) == []
