"""Make the recordings in the folder fixtures, and their expected tables.

    python -m tests.fixtures

Recordings come from the simulator and a seed, and can be reproduced byte for byte, except for the
pixels of colour images, which processors round differently. Only the tables change with the
detection and the model.
"""

import csv
import math
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow.parquet as pq
from mcap.reader import make_reader
from mcap.writer import Writer

from shapecat.runs.jobs import Job
from shapecat.simulation import KINECT, Sensor, make_scene, record
from shapecat.simulation.containers import FormatName
from shapecat.simulation.messages import MessageFactory
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.types import Camera
from tests.foxglove_messages import descriptors, encode, time

FIXTURES = Path(__file__).parents[1] / "fixtures"
EXPECTED = FIXTURES / "expected"
RATE_HZ = 10.0
TOLERANCE = 0.002
"""Largest accepted difference, absolute or relative: machines differ in how they round."""
DETECTIONS = (
    "frame",
    "detection",
    "plane",
    "on_detection",
    "touches_border",
    "occluded",
    "points",
    "category",
    "confidence",
    "novelty",
    "height_m",
    "center",
    "size",
)
PLANES = ("frame", "plane", "height_m", "area_m2", "normal", "offset")
"""Columns of both tables that are compared."""


class Scene(NamedTuple):
    """The contents of a recording; its images are ``downscale`` times smaller than a Kinect's."""

    kind: SceneKind
    container: FormatName
    frames: int
    seed: int
    downscale: int
    clouds: bool = False
    color: bool = False


SCENES = {
    "tabletop.mcap": Scene("tabletop", "mcap", 5, 3, 2, color=True),
    "shelf.bag": Scene("shelf", "ros1", 3, 5, 4, clouds=True),
    "clutter": Scene("clutter", "ros2", 4, 4, 2),
}
FOXGLOVE = "foxglove.mcap"
"""The depth images of tabletop.mcap as Foxglove messages; the tables are the same."""
RECORDINGS = (*SCENES, FOXGLOVE)
Row = dict[str, str]


def make_recordings(folder: Path) -> None:
    """Write the recordings and their truth."""
    for name, scene in SCENES.items():
        world = make_scene(
            scene.kind, np.random.default_rng(scene.seed), frames=scene.frames, rate_hz=RATE_HZ
        )
        record(
            world,
            folder / name,
            format=scene.container,
            seed=scene.seed,
            sensor=_downscaled(KINECT, scene.downscale),
            clouds=scene.clouds,
            color=scene.color,
            rate_hz=RATE_HZ,
        )
    _clear_library_version(folder / "clutter" / "clutter.db3")
    _as_foxglove(folder / "tabletop.mcap", folder / FOXGLOVE)


def processed_tables(recording: Path, folder: Path) -> dict[str, list[Row]]:
    """Process a recording into a folder, and return the tables to be compared."""
    from shapecat.pipeline import process  # noqa: PLC0415  loads the perception

    process(Job(source=recording, folder=folder, rrd=False))
    with (folder / "tracks.csv").open(encoding="utf-8", newline="") as file:
        tracks = [{**row, "run": ""} for row in csv.DictReader(file)]
    return {
        "tracks": sorted(tracks, key=lambda row: int(row["track"])),
        "detections": _rows(folder / "detections.parquet", DETECTIONS),
        "planes": _rows(folder / "planes.parquet", PLANES),
    }


def expected_path(name: str, table: str) -> Path:
    """Return the path of a recording's expected table."""
    stem = Path("tabletop.mcap" if name == FOXGLOVE else name).stem
    return EXPECTED / f"{stem}.{table}.csv"


def differences(found: Sequence[Row], wanted: Sequence[Row]) -> Iterator[str]:
    """Describe all differences of text and integers, and those of floats above `TOLERANCE`."""
    if len(found) != len(wanted):
        yield f"{len(found)} rows, expected {len(wanted)}"
    for number, (here, there) in enumerate(zip(found, wanted, strict=False)):
        if here.keys() != there.keys():
            yield f"columns {', '.join(here)}, expected {', '.join(there)}"
            return
        for name, value in here.items():
            if not _agree(value, there[name]):
                yield f"row {number}, {name}: {value}, expected {there[name]}"


def read_table(path: Path) -> list[Row]:
    """Return the rows of an expected table."""
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def write_table(path: Path, rows: Sequence[Row]) -> None:
    """Write an expected table."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _agree(value: str, wanted: str) -> bool:
    if "." not in wanted:
        return value == wanted
    try:
        return math.isclose(float(value), float(wanted), rel_tol=TOLERANCE, abs_tol=TOLERANCE)
    except ValueError:
        return False


def _downscaled(sensor: Sensor, k: int) -> Sensor:
    c = sensor.camera
    focal = c.fx / k
    camera = Camera(c.width // k, c.height // k, focal, focal, c.cx / k, c.cy / k)
    left, right, top, bottom = (width // k for width in sensor.border_px)
    return replace(sensor, camera=camera, border_px=(left, right, top, bottom))


def _clear_library_version(database: Path) -> None:
    """Clear the SQLite version number in a database: bytes 96 to 99, which readers ignore."""
    with database.open("r+b") as file:
        file.seek(96)
        file.write(bytes(4))


def _rows(path: Path, columns: Sequence[str]) -> list[Row]:
    """Return columns of a table as text; vectors get a column for each axis."""
    rows = []
    for record_ in pq.read_table(path, columns=list(columns)).to_pylist():
        row: Row = {}
        for name in columns:
            value = record_[name]
            parts = (
                {f"{name}_{axis}": v for axis, v in zip("xyz", value, strict=True)}
                if isinstance(value, list)
                else {name: value}
            )
            row |= {key: _text(part) for key, part in parts.items()}
        rows.append(row)
    return rows


def _text(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.4f}" if isinstance(value, float) else str(value).lower()


def _as_foxglove(source: Path, target: Path) -> None:
    """Write the depth images, camera and transforms of a recording as Foxglove messages."""
    types = MessageFactory(2).typestore
    with source.open("rb") as file, target.open("wb") as out:
        writer = Writer(out)
        writer.start("", "shapecat")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(file).iter_messages(log_time_order=False):
            if schema is None or "/color/" in channel.topic:
                continue
            ros = types.deserialize_cdr(message.data, schema.name)
            for kind, values in _foxglove(schema.name, ros):
                if channel.topic not in channels:
                    number = writer.register_schema(kind, "protobuf", descriptors())
                    topic = channel.topic
                    channels[topic] = writer.register_channel(topic, "protobuf", number)
                data = encode(values, kind)
                writer.add_message(
                    channels[channel.topic], message.log_time, data, message.publish_time
                )
        writer.finish()


def _foxglove(kind: str, ros: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the Foxglove messages that correspond to a ROS message."""
    if kind.endswith("TFMessage"):
        for link in ros.transforms:
            yield "foxglove.FrameTransform", _transform(link)
        return
    values = {**_header(ros), "width": ros.width, "height": ros.height}
    if kind.endswith("CameraInfo"):
        matrices = {name.upper(): getattr(ros, name).tolist() for name in "dkrp"}
        values |= {"distortion_model": ros.distortion_model, **matrices}
        yield "foxglove.CameraCalibration", values
    else:
        data = ros.data.tobytes()
        yield (
            "foxglove.RawImage",
            {**values, "encoding": ros.encoding, "step": ros.step, "data": data},
        )


def _header(ros: Any) -> dict[str, Any]:
    stamp = ros.header.stamp.sec * 10**9 + ros.header.stamp.nanosec
    return {"timestamp": time(stamp, "protobuf"), "frame_id": ros.header.frame_id}


def _transform(link: Any) -> dict[str, Any]:
    move, turn = link.transform.translation, link.transform.rotation
    return {
        "timestamp": _header(link)["timestamp"],
        "parent_frame_id": link.header.frame_id,
        "child_frame_id": link.child_frame_id,
        "translation": {axis: getattr(move, axis) for axis in "xyz"},
        "rotation": {axis: getattr(turn, axis) for axis in "xyzw"},
    }


def main() -> None:
    """Make the recordings again, and renew their expected tables."""
    for path in FIXTURES.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.suffix != ".md":
            path.unlink()
    make_recordings(FIXTURES)
    EXPECTED.mkdir()
    for name in SCENES:
        sys.stdout.write(f"processing {name}\n")
        with tempfile.TemporaryDirectory() as folder:
            for table, rows in processed_tables(FIXTURES / name, Path(folder) / "run").items():
                write_table(expected_path(name, table), rows)


if __name__ == "__main__":
    main()
