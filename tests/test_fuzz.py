"""Tests of damage anywhere in a recording: intact parts are read, and damage is reported."""

import resource
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as FolderWriter

from shapecat.errors import NoStreamError, RecordingError
from shapecat.geometry import IDENTITY
from shapecat.recordings import choose_streams, frames, open_recording
from shapecat.recordings.containers.ros1_bag import BagRecording
from shapecat.recordings.transforms.gravity import PoseFinder
from shapecat.simulation.messages import MessageFactory
from shapecat.types import Camera
from tests.messages import EPOCH, SECOND, write
from tests.odd_recordings import write_all
from tests.scenes import serialized

CAMERA = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)
FRAMES = 12


class Outcome(NamedTuple):
    """The exit code, the stamps and number of frames read, and the warnings or the error."""

    code: int
    stamps: frozenset[int]
    frames: int
    messages: str


def items(make: MessageFactory) -> Any:
    depth = np.random.default_rng(0).integers(500, 900, (12, 16)) / np.float32(1000)
    for k in range(FRAMES):
        stamp = EPOCH + k * SECOND
        yield "/tf", stamp, make.transforms([("map", "optical", IDENTITY)], stamp)
        yield "/depth/camera_info", stamp, make.camera_info(CAMERA, stamp, "optical")
        yield "/depth/image_raw", stamp, make.image(depth.astype(np.float32), stamp, "optical")


def mcap(parent: Path, **options: Any) -> Path:
    return write(parent / "a.mcap", items(MessageFactory(2)), **({"chunk_size": 4000} | options))


def bag(parent: Path, compression: Any = None) -> Path:
    make, path = MessageFactory(1), parent / "a.bag"
    writer = BagWriter(path)
    writer.chunk_threshold = 4000
    if compression is not None:
        writer.set_compression(compression)
    write_all(writer, serialized(items(make), make), make.typestore)
    return path


def folder(parent: Path, plugin: StoragePlugin) -> Path:
    make, path = MessageFactory(2), parent / "a"
    writer = FolderWriter(path, version=9, storage_plugin=plugin)
    write_all(writer, serialized(items(make), make), make.typestore)
    (part,) = (file for file in path.iterdir() if file.suffix in {".db3", ".mcap"})
    return part


WRITERS: dict[str, Callable[[Path], Path]] = {
    **{f"mcap-{c.name.lower()}": partial(mcap, compression=c) for c in CompressionType},
    "mcap-unchunked": partial(mcap, use_chunking=False),
    "ros1-none": bag,
    **{f"ros1-{c.name.lower()}": partial(bag, compression=c) for c in BagWriter.CompressionFormat},
    "ros2-sqlite": partial(folder, plugin=StoragePlugin.SQLITE3),
    "ros2-mcap": partial(folder, plugin=StoragePlugin.MCAP),
}


def read(path: Path) -> Outcome:
    """Read a recording as `process` does, up to the frames."""
    skipped: Counter[str] = Counter()
    try:
        with open_recording(path) as recording:
            streams = choose_streams(recording)
            poses = PoseFinder.of(recording, up="auto", fixed_frame=None)
            stamps = []
            for frame in frames(recording, streams, skipped=skipped):
                poses.accept(frame.topic, poses.orient(frame))
                stamps.append(frame.stamp_ns)
            messages = " ".join([*recording.warnings, *skipped])
            return Outcome(0 if stamps else 4, frozenset(stamps), len(stamps), messages)
    except (RecordingError, NoStreamError) as error:
        return Outcome(error.exit_code, frozenset(), 0, str(error))


def chunk_ends(path: Path) -> list[tuple[int, int]]:
    """Return, for each chunk, the offset of its end and the number of frames complete by then."""
    with path.open("rb") as file:
        if path.suffix == ".mcap":
            summary = make_reader(file).get_summary()
            chunks = summary.chunk_indexes if summary else []
            ends = [(c.chunk_start_offset + c.chunk_length, c.message_end_time) for c in chunks]
        elif path.suffix == ".bag":
            with BagRecording(path) as recording:
                ends = [
                    (record.end, max(m.log_time for m in recording._expand(record)))
                    for record in recording._records()
                    if record.op == 5
                ]
        else:
            return []
    # The last frame of a chunk may continue in the next one.
    return [(end, (time - EPOCH) // SECOND) for end, time in ends]


def check(path: Path, outcome: Outcome, at: int, ends: list[tuple[int, int]]) -> None:
    """Fail if a frame before the damage, at byte ``at``, is lost, or a loss is not reported."""
    assert outcome.code in {0, 3, 4}, outcome
    intact = max((count for end, count in ends if end <= at), default=0)
    stamps = {EPOCH + k * SECOND for k in range(intact)}
    assert stamps <= outcome.stamps, (path, at, len(outcome.stamps), intact, outcome.messages)
    assert outcome.frames >= FRAMES or outcome.messages, (path, at, outcome.frames)


def damage(name: str, tmp_path: Path, *, cuts: int, flips: int) -> None:
    rng = np.random.default_rng(sum(name.encode()))
    whole = WRITERS[name](tmp_path)
    data, ends = whole.read_bytes(), chunk_ends(whole)
    target = tmp_path / f"damaged{whole.suffix}"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    target.write_bytes(data)
    check(target, read(target), len(data), ends)
    for at in rng.integers(0, len(data), cuts).tolist():
        target.write_bytes(data[:at])
        check(target, read(target), at, ends)
    for at in rng.integers(0, len(data), flips).tolist():
        broken = bytearray(data)
        broken[at] ^= int(rng.integers(1, 256))
        target.write_bytes(broken)
        check(target, read(target), at, ends)
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 500 << 10, f"{grown} KiB more memory"


@pytest.mark.parametrize("name", WRITERS)
def test_damaged_recording_gives_intact_frames(name: str, tmp_path: Path) -> None:
    damage(name, tmp_path, cuts=6, flips=10)


@pytest.mark.many
@pytest.mark.parametrize("name", WRITERS)
def test_many_damaged_recordings_give_intact_frames(name: str, tmp_path: Path) -> None:
    damage(name, tmp_path, cuts=200, flips=2000)
