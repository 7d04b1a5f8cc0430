"""Recordings of every format variant, damaged and unusual ones, with their expected outcomes.

*The table* is the recording of the scene in `tests.scenes`.
"""

import json
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zstandard
from mcap.writer import CompressionType, IndexType
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from shapecat.geometry import IDENTITY
from shapecat.simulation.messages import MessageFactory
from tests import depth_encodings as depth
from tests import foxglove_messages as foxglove
from tests import messages as ros
from tests.mcap_files import McapChannels, mcap_writer
from tests.messages import EPOCH, SECOND
from tests.scenes import OPTICAL, PERIOD, back_and_forth, record, serialized, stream, views

FRAMES = 2
FACTORY, FACTORY1 = MessageFactory(2), MessageFactory(1)


class Case(NamedTuple):
    """A recording: its writer, and the expected exit code, number of frames, and messages.

    ``write`` writes it into a folder and returns its path. ``reported`` is a part of the messages;
    if it is empty, there must be none.
    """

    write: Callable[[Path], Path]
    code: int = 0
    frames: int = FRAMES
    reported: str = ""


def write_all(writer: Any, items: Iterable[tuple[str, str, int, bytes]], types: Any) -> None:
    """Write topic, type, time (ns) and bytes of messages with a writer of rosbags."""
    connections: dict[str, Any] = {}
    with writer:
        for topic, kind, time, data in items:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=types)
            writer.write(connections[topic], time, data)


def mcap(
    path: Path, *, frames: int = FRAMES, finish: bool = True, cut: int = 0, **options: Any
) -> Path:
    """Write the table; remove ``cut`` bytes from the end."""
    path /= "a.mcap"
    with mcap_writer(path, finish=finish, **({"chunk_size": 60_000} | options)) as writer:
        channels = McapChannels(writer, FACTORY.typestore)
        for item in serialized(stream(FACTORY, frames), FACTORY):
            channels.write(*item)
    if cut:
        path.write_bytes(path.read_bytes()[:-cut])
    return path


def bag(path: Path, compression: Any = None) -> Path:
    """Write the table as a ROS 1 bag in chunks of about 60 kB."""
    writer = BagWriter(path / "a.bag")
    writer.chunk_threshold = 60_000
    if compression is not None:
        writer.set_compression(compression)
    write_all(writer, serialized(stream(FACTORY1, FRAMES), FACTORY1), FACTORY1.typestore)
    return path / "a.bag"


def active_bag(path: Path) -> Path:
    """Write the file that a killed rosbag leaves, which has no index."""
    finished = bag(path)
    data = finished.read_bytes().replace(b"index_pos=", b"index_pos=\0\0\0\0\0\0\0\0*", 1)
    at = data.index(b"index_pos=") + 10
    data = data[: at + 8] + data[at + 17 :]
    # The connections and chunk information after the last chunk are missing.
    finished.write_bytes(data[: data.rindex(b"op=\x05") + 60_000])
    return finished.rename(path / "a.bag.active")


def unsorted_bag(path: Path) -> Path:
    """Write a bag whose chunks are not in order of time."""
    writer = BagWriter(path / "a.bag")
    writer.chunk_threshold = 1
    items = list(serialized(stream(FACTORY1, FRAMES), FACTORY1))
    write_all(writer, [*items[:1], *items[:0:-1]], FACTORY1.typestore)
    return path / "a.bag"


def folder(
    path: Path, plugin: StoragePlugin, mode: CompressionMode | None = None, *, metadata: bool = True
) -> Path:
    """Write the table as a ROS 2 folder."""
    writer = FolderWriter(path / "a", version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    write_all(writer, serialized(stream(FACTORY, FRAMES), FACTORY), FACTORY.typestore)
    if not metadata:
        (path / "a" / "metadata.yaml").unlink()
    return path / "a"


def database(path: Path, *, definitions: bool) -> Path:
    """Write a ROS 2 folder; return its database, with or without message ``definitions``."""
    file = folder(path, StoragePlugin.SQLITE3) / "a.db3"
    if not definitions:
        connection = sqlite3.connect(file)
        connection.execute("DELETE FROM message_definitions")
        connection.commit()
        connection.close()
    return file


def splits(path: Path) -> Path:
    """Write two parts without metadata; the second continues the first, and is compressed."""
    first, second = path / "a" / "a_0.mcap", path / "a" / "a_1.mcap"
    first.parent.mkdir()
    items = list(serialized(stream(FACTORY, 2 * FRAMES), FACTORY))
    split = next(k for k, (_, _, time, _) in enumerate(items) if time == EPOCH + FRAMES * PERIOD)
    for part, messages in ((first, items[:split]), (second, items[split:])):
        with mcap_writer(part, chunk_size=60_000) as writer:
            channels = McapChannels(writer, FACTORY.typestore)
            for item in messages:
                channels.write(*item)
    second.with_name("a_1.mcap.zstd").write_bytes(zstandard.compress(second.read_bytes()))
    second.unlink()
    return first.parent


def ros1_mcap(path: Path) -> Path:
    """Write ROS 1 messages to MCAP, as `mcap convert` does."""
    path /= "a.mcap"
    with mcap_writer(path, "ros1") as writer:
        channels = McapChannels(writer, FACTORY1.typestore, version=1)
        for item in serialized(stream(FACTORY1, FRAMES), FACTORY1):
            channels.write(*item)
    return path


def plain(path: Path, items: Any) -> Path:
    """Write messages to a.mcap in a folder."""
    return ros.write(path / "a.mcap", items)


def changed(path: Path, change: Callable[[str, Any], Any], *, clouds: bool = False) -> Path:
    """Write the table with each message replaced by ``change(topic, message)``."""
    items = ((t, time, change(t, m)) for t, time, m in stream(FACTORY, FRAMES, clouds=clouds))
    return plain(path, items)


def compressed_depth(path: Path, pack: Callable[[Any], bytes]) -> Path:
    """Write two frames of the table with depth images compressed by ``pack``."""

    def change(topic: str, message: Any) -> Any:
        if not topic.endswith("image_raw"):
            return message
        depth = message.data.view("<u2").reshape(message.height, message.width)
        stamp = message.header.stamp
        packed = ros.compressed(stamp.sec * SECOND + stamp.nanosec, pack(depth))
        packed.header.frame_id = OPTICAL
        return packed

    return plain(path, ((t, time, change(t, m)) for t, time, m in stream(FACTORY, 2)))


def realsense(path: Path) -> Path:
    """Write the table as RealSense Viewer records it."""
    sensor = "/device_0/sensor_0"
    camera = views()[0].camera
    items: list[tuple[str, int, Any]] = [
        (f"{sensor}/option/Depth_Units/value", 0, ros.make("std_msgs/msg/Float32", 0.0005)),
        (f"{sensor}/Depth_0/info/camera_info", 0, ros.info(0, camera)),
    ]
    for k, view in enumerate(back_and_forth(FRAMES)):
        depth = np.round(view.depth * 2000).astype(np.uint16)
        image = ros.image(EPOCH + k * PERIOD, depth, "mono16")
        items.append((f"{sensor}/Depth_0/image/data", k + 1, image))
    return plain(path, items)


def layout(kind: str) -> Callable[[Path], Path]:
    """Return a writer of clouds with another layout of a point, by its name in `CASES`."""
    order = ">" if kind == "big-endian" else "<"
    step = {"padded": 32, "unaligned": 15, "f8": 24, "extra": 20}.get(kind, 12)
    offset = {"unaligned": 3, "extra": 4}.get(kind, 0)
    number, code = ("f8", 8) if kind == "f8" else ("f4", 7)

    def change(topic: str, message: Any) -> Any:
        if not topic.endswith("points"):
            return message
        h, w = message.height, message.width
        points = message.data.view("<f4").reshape(h, w, 4)[..., :3]
        size = np.dtype(number).itemsize
        gap = 7 if kind == "row-padded" else 0
        rows = np.zeros((h, w * step + gap), np.uint8)
        records = rows[:, : w * step].reshape(h, w, step)
        packed = np.ascontiguousarray(points, order + number).view(np.uint8)
        records[..., offset : offset + 3 * size] = packed.reshape(h, w, 3 * size)
        field = "sensor_msgs/msg/PointField"
        message.fields = [
            ros.make(field, name, offset + size * k, code, 1) for k, name in enumerate("xyz")
        ]
        if kind == "extra":
            message.fields += [ros.make(field, "ring", 0, 4, 1), ros.make(field, "rgb", 16, 6, 1)]
        message.is_bigendian = order == ">"
        message.is_dense = kind == "dense-lie"
        message.point_step, message.row_step = step, rows.shape[1]
        message.data = rows.reshape(-1)
        return message

    return lambda path: changed(path, change, clouds=True)


def hostile_cloud(path: Path) -> Path:
    """Write clouds; the first one claims to have 2^32 points."""

    def change(topic: str, message: Any) -> Any:
        if topic.endswith("points") and message.header.stamp.nanosec == 0:
            message.height = message.width = 65535
            message.row_step = 0
        return message

    return changed(path, change, clouds=True)


def empty_cloud(path: Path) -> Path:
    """Write clouds; the first one has no points."""

    def change(topic: str, message: Any) -> Any:
        if topic.endswith("points") and message.header.stamp.nanosec == 0:
            message.height, message.width, message.row_step = 1, 0, 0
            message.data = np.zeros(0, np.uint8)
        return message

    return changed(path, change, clouds=True)


def flat_cloud(path: Path) -> Path:
    """Write unorganized clouds without invalid points."""

    def change(topic: str, message: Any) -> Any:
        if topic.endswith("points"):
            points = message.data.view("<f4").reshape(-1, 4)
            points = points[np.isfinite(points).all(axis=1)]
            message.height, message.width = 1, len(points)
            message.row_step = 16 * len(points)
            message.data = np.ascontiguousarray(points).view(np.uint8).reshape(-1)
        return message

    return changed(path, change, clouds=True)


def distorted(path: Path, *, strong: bool) -> Path:
    """Write the table with the calibration of a distorted lens."""
    coefficients = (0.3, -0.2, 0.01, 0.01, 0.0) if strong else (0.001, 0.0, 0.0, 0.0, 0.0)

    def change(topic: str, message: Any) -> Any:
        if topic.endswith("camera_info"):
            message.d = np.array(coefficients)
        return message

    return changed(path, change)


def foreign(path: Path) -> Path:
    """Write the table with channels of other programs: unknown encodings and schemas."""
    path /= "a.mcap"
    with mcap_writer(path) as writer:
        broken = writer.register_schema("my/srv/Do_Event", "ros2msg", b"service_msgs/Nothing info")
        channels = [
            writer.register_channel("/do/_service_event", "cdr", broken),
            writer.register_channel("/proprietary", "capnproto", 0),
            writer.register_channel("/no_schema", "cdr", 0),
            writer.register_channel("/tf", "cdr", broken),
        ]
        ours = McapChannels(writer, FACTORY.typestore)
        for item in serialized(stream(FACTORY, FRAMES), FACTORY):
            for channel in channels:
                writer.add_message(channel, item[2], b"\x00\x01\x00\x00\xff\xff\xff\xff", item[2])
            ours.write(*item)
    return path


def clocks(path: Path, kind: str) -> Path:
    """Write stamps that count from power-on, are missing, stay the same, or jump."""

    def stamps() -> Iterator[tuple[str, int, Any]]:
        for number, (topic, time, message) in enumerate(stream(FACTORY, FRAMES)):
            if hasattr(message, "header"):
                stamp = {"uptime": time - EPOCH + SECOND, "stuck": EPOCH}.get(kind, 0)
                if kind == "jump":
                    stamp = time + (3600 * SECOND if number > 3 else 0)
                stamp_of = message.header.stamp
                stamp_of.sec, stamp_of.nanosec = divmod(stamp, SECOND)
            yield topic, time, message

    return plain(path, stamps())


def late_transforms(path: Path) -> Path:
    """Write the static transforms last, and transforms that form a loop."""
    first, *others = stream(FACTORY, FRAMES)
    links = [(f"f{k}", f"f{(k + 1) % 300}", IDENTITY) for k in range(300)]
    loop = ("/tf", EPOCH, FACTORY.transforms(links, EPOCH))
    return plain(path, [*others, loop, (first[0], others[-1][1] + 1, first[2])])


def absurd_numbers(path: Path) -> Path:
    """Write the table with JSON messages whose numbers fit no type, or stand in place of lists."""
    huge = 10**400
    time = {"sec": huge, "nanosec": 0}
    zeros = dict.fromkeys("xyzw", 0)
    header = {"stamp": time, "frame_id": "map"}
    link = {"header": header, "child_frame_id": "b"}
    link["transform"] = {"translation": zeros, "rotation": zeros}
    texts = {
        "/tf": ("tf2_msgs/msg/TFMessage", {"transforms": [link]}),
        "/points": (ros.CLOUD, {"header": header, "fields": 1}),
        "/image": (ros.IMAGE, {"header": header, "encoding": "16UC1"}),
        "/colour": (ros.COMPRESSED, {"header": header, "format": "jpeg", "data": 1}),
        "/camera/depth/camera_info": (ros.INFO, {"header": header}),
    }
    path /= "a.mcap"
    with mcap_writer(path) as writer:
        for topic, (kind, content) in texts.items():
            schema = writer.register_schema(kind, "jsonschema", b"{}")
            channel = writer.register_channel(topic, "json", schema)
            writer.add_message(channel, EPOCH, json.dumps(content).encode(), EPOCH)
        channels = McapChannels(writer, FACTORY.typestore)
        for item in serialized(stream(FACTORY, FRAMES), FACTORY):
            channels.write(*item)
    return path


def hostile_chunk(path: Path) -> Path:
    """Write the table; its first chunk claims to hold 10^9 bytes."""
    found = mcap(path, compression=CompressionType.ZSTD, chunk_size=1)
    data = bytearray(found.read_bytes())
    at = 8 + 9 + struct.unpack_from("<Q", data, 9)[0]
    data[at + 9 + 16 : at + 9 + 24] = struct.pack("<Q", 10**9)
    found.write_bytes(data)
    return found


def bad_frames(path: Path) -> Path:
    """Write images with less data than their headers claim."""

    def change(topic: str, message: Any) -> Any:
        if topic.endswith("image_raw"):
            message.data = message.data[:100]
        return message

    return changed(path, change)


def foxglove_clouds(path: Path, encoding: str) -> Path:
    """Write the table as Foxglove point clouds."""
    items = []
    for k, view in enumerate(back_and_forth(FRAMES)):
        names = [{"name": n, "offset": 4 * j, "type": 7} for j, n in enumerate("xyz")]
        points = view.points().reshape(-1, 3)
        data = points[np.isfinite(points).all(axis=1)].astype("<f4").tobytes()
        values = {
            "timestamp": foxglove.time(EPOCH + k * PERIOD, encoding),
            "point_stride": 12,
            "fields": names,
            "data": foxglove.content(data, encoding),
            "pose": {
                "position": {"x": 0.0, "y": 0.0, "z": 0.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
        }
        items.append(("/points", "foxglove.PointCloud", values))
    return foxglove.write(path / "a.mcap", encoding, items)


def file(path: Path, name: str, content: bytes) -> Path:
    """Write a file with some content."""
    (path / name).write_bytes(content)
    return path / name


def empty_folder(path: Path) -> Path:
    """Make a folder without a recording."""
    (path / "a").mkdir()
    return path / "a"


def text_only(path: Path) -> Path:
    """Write a recording that holds only text."""
    return plain(path, [("/log", EPOCH, ros.make("std_msgs/msg/String", "hello"))])


def damaged_part(path: Path) -> Path:
    """Write a bag as a folder of several parts, one of which is damaged."""
    found = folder(path, StoragePlugin.SQLITE3, metadata=False)
    (found / "a.db3").rename(found / "a_0.db3")
    (found / "a_1.db3").write_bytes(b"SQLite format 3\0" + bytes(500))
    return found


def with_other_files(path: Path) -> Path:
    """Write a recording beside files that do not belong to it."""
    found = folder(path, StoragePlugin.MCAP)
    (found / "notes.txt").write_text("mine")
    shutil.copy(found / "a.mcap", found / "old.mcap")
    return found


_SQL, _MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
_MODE = CompressionMode
_CUT = "not finished; messages recovered"

CASES: dict[str, Case] = {
    **{f"mcap {c.name.lower()}": Case(partial(mcap, compression=c)) for c in CompressionType},
    "mcap without chunks": Case(lambda p: mcap(p, use_chunking=False), reported="no index"),
    "mcap without index": Case(lambda p: mcap(p, index_types=IndexType.NONE), reported="no index"),
    "mcap without message index": Case(lambda p: mcap(p, index_types=IndexType.CHUNK)),
    "mcap without channels in summary": Case(
        lambda p: mcap(p, repeat_channels=False, repeat_schemas=False), reported="no index"
    ),
    "mcap without statistics": Case(
        lambda p: mcap(p, use_statistics=False, use_summary_offsets=False), reported="no index"
    ),
    "mcap unfinished": Case(lambda p: mcap(p, finish=False), reported=_CUT),
    "mcap cut": Case(
        lambda p: mcap(p, compression=CompressionType.NONE, finish=False, cut=30_000),
        frames=FRAMES - 1,
        reported=_CUT,
    ),
    "mcap cut in its only chunk": Case(
        lambda p: mcap(
            p, compression=CompressionType.LZ4, chunk_size=1 << 30, finish=False, cut=1000
        ),
        frames=FRAMES - 1,
        reported="the rest of the chunk",
    ),
    "mcap of ros 1": Case(ros1_mcap),
    "mcap with a hostile chunk": Case(hostile_chunk, reported="claims to hold"),
    "foxglove json": Case(lambda p: foxglove_clouds(p, "json")),
    "foxglove protobuf": Case(lambda p: foxglove_clouds(p, "protobuf")),
    "ros 1": Case(bag),
    **{
        f"ros 1 {c.name.lower()}": Case(partial(bag, compression=c))
        for c in BagWriter.CompressionFormat
    },
    "ros 1 unsorted": Case(unsorted_bag),
    "ros 1 active": Case(active_bag, frames=FRAMES - 1, reported="no index"),
    "ros 2 sqlite": Case(lambda p: folder(p, _SQL)),
    "ros 2 mcap": Case(lambda p: folder(p, _MCAP)),
    "ros 2 without metadata": Case(lambda p: folder(p, _SQL, metadata=False), reported="metadata"),
    "ros 2 file-compressed": Case(lambda p: folder(p, _SQL, _MODE.FILE)),
    "ros 2 message-compressed": Case(lambda p: folder(p, _SQL, _MODE.MESSAGE)),
    "ros 2 mcap file-compressed": Case(lambda p: folder(p, _MCAP, _MODE.FILE)),
    "ros 2 splits": Case(splits, frames=2 * FRAMES, reported="metadata"),
    "ros 2 with a damaged part": Case(damaged_part, reported="skipped a_1.db3"),
    "ros 2 beside other files": Case(with_other_files, reported="old.mcap"),
    "db3": Case(lambda p: database(p, definitions=True)),
    "db3 without definitions": Case(lambda p: database(p, definitions=False), reported="Humble"),
    "compressed depth png": Case(lambda p: compressed_depth(p, depth.png), frames=2),
    "compressed depth rvl": Case(lambda p: compressed_depth(p, depth.rvl), frames=2),
    "realsense viewer": Case(realsense),
    "organized cloud": Case(lambda p: record(p / "a.mcap", FRAMES, clouds=True)),
    **{
        f"cloud {kind}": Case(layout(kind))
        for kind in ("padded", "unaligned", "big-endian", "f8", "row-padded", "extra", "dense-lie")
    },
    "cloud unorganized": Case(flat_cloud),
    "cloud of 2^32 points": Case(hostile_cloud, frames=FRAMES - 1, reported="needs"),
    "cloud of no points": Case(empty_cloud, frames=FRAMES - 1, reported="empty cloud"),
    "slight distortion": Case(lambda p: distorted(p, strong=False)),
    "strong distortion": Case(lambda p: distorted(p, strong=True), reported="undistorted rays"),
    "foreign channels": Case(foreign),
    "absurd numbers": Case(
        absurd_numbers,
        reported="CameraInfo: /camera/depth/camera_info: message does not match its type",
    ),
    "clock from power-on": Case(lambda p: clocks(p, "uptime"), reported="is not Unix time"),
    "clock missing": Case(lambda p: clocks(p, "zero"), reported="stamp is 0"),
    "clock stuck": Case(lambda p: clocks(p, "stuck"), reported="repeats the previous one"),
    "clock jump": Case(lambda p: clocks(p, "jump"), reported="jumps"),
    "static transforms last": Case(late_transforms, reported="form a loop"),
    "every image too short": Case(bad_frames, 4, 0, "no usable frame"),
    "no clouds": Case(text_only, 4, 0, "no point clouds"),
    "empty file": Case(lambda p: file(p, "a.bag", b""), 3, 0, "is empty"),
    "text": Case(lambda p: file(p, "a.mcap", b"hello world\n"), 3, 0, "not a recording"),
    "name that is not utf-8": Case(
        lambda p: mcap(p).rename(p / os.fsdecode(b"k\xfcche.mcap")), 3, 0, "not valid UTF-8"
    ),
    "magic alone": Case(lambda p: file(p, "a.mcap", b"\x89MCAP0\r\n"), 4, 0, "empty"),
    "zeros": Case(lambda p: file(p, "a.db3", b"SQLite format 3\0" + bytes(999)), 3, 0, "not a"),
    "old bag": Case(lambda p: file(p, "a.bag", b"#ROSBAG V1.2\n"), 3, 0, "version 2.0"),
    "empty folder": Case(empty_folder, 3, 0, "no recording found"),
    "missing": Case(lambda p: p / "a.mcap", 3, 0, "does not exist"),
}
"""The cases by name."""
