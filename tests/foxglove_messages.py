"""Foxglove messages in JSON and Protocol Buffers, and recordings of them."""

import base64
import json
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf.descriptor_pb2 import FileDescriptorSet

from shapecat.recordings.decoding.protobuf import message_class
from tests.mcap_files import mcap_writer
from tests.messages import EPOCH, SECOND

DOUBLE, STRING, MESSAGE, RAW, ENUM, FIXED, INT64 = 1, 9, 11, 12, 14, 7, 3
"""Types of fields, as in descriptor.proto."""


class Field(NamedTuple):
    """A field; ``kind`` is its type, as in descriptor.proto, ``message`` the type of a message."""

    name: str
    kind: int
    message: str
    repeated: bool


def field(name: str, kind: int, message: str = "", *, repeated: bool = False) -> Field:
    """Return a field, not repeated by default."""
    return Field(name, kind, message, repeated)


TIME = field("timestamp", MESSAGE, "google.protobuf.Timestamp")
VECTOR = {k + 1: field(name, DOUBLE) for k, name in enumerate("xyz")}
LAYOUT = {
    "google.protobuf.Timestamp": {1: field("seconds", INT64), 2: field("nanos", 5)},
    "foxglove.Vector3": VECTOR,
    "foxglove.Quaternion": VECTOR | {4: field("w", DOUBLE)},
    "foxglove.Pose": {
        1: field("position", MESSAGE, "foxglove.Vector3"),
        2: field("orientation", MESSAGE, "foxglove.Quaternion"),
    },
    "foxglove.PackedElementField": {
        1: field("name", STRING),
        2: field("offset", FIXED),
        3: field("type", ENUM),
    },
    "foxglove.PointCloud": {
        1: TIME,
        2: field("frame_id", STRING),
        3: field("pose", MESSAGE, "foxglove.Pose"),
        4: field("point_stride", FIXED),
        5: field("fields", MESSAGE, "foxglove.PackedElementField", repeated=True),
        6: field("data", RAW),
    },
    "foxglove.RawImage": {
        1: TIME,
        7: field("frame_id", STRING),
        2: field("width", FIXED),
        3: field("height", FIXED),
        4: field("encoding", STRING),
        5: field("step", FIXED),
        6: field("data", RAW),
    },
    "foxglove.CompressedImage": {
        1: TIME,
        4: field("frame_id", STRING),
        2: field("data", RAW),
        3: field("format", STRING),
    },
    "foxglove.CameraCalibration": {
        1: TIME,
        9: field("frame_id", STRING),
        2: field("width", FIXED),
        3: field("height", FIXED),
        4: field("distortion_model", STRING),
        **{5 + k: field(name, DOUBLE, repeated=True) for k, name in enumerate("DKRP")},
    },
    "foxglove.FrameTransform": {
        1: TIME,
        2: field("parent_frame_id", STRING),
        3: field("child_frame_id", STRING),
        4: field("translation", MESSAGE, "foxglove.Vector3"),
        5: field("rotation", MESSAGE, "foxglove.Quaternion"),
    },
}
"""Fields of each message by number."""


def descriptors() -> bytes:
    """Return the FileDescriptorSet of all messages of `LAYOUT`, a file for each package."""
    protos = FileDescriptorSet()
    files = {}
    for package in ("google.protobuf", "foxglove"):
        files[package] = protos.file.add(name=f"{package}.proto", package=package, syntax="proto3")
    files["foxglove"].dependency.append("google.protobuf.proto")
    files["foxglove"].enum_type.add(name="NumericType").value.add(name="UNKNOWN", number=0)
    for name, fields in LAYOUT.items():
        package, _, short = name.rpartition(".")
        message = files[package].message_type.add(name=short)
        for number, one in fields.items():
            added = message.field.add(
                name=one.name, number=number, label=3 if one.repeated else 1, type=one.kind
            )
            if one.message or one.kind == ENUM:
                added.type_name = f".{one.message or 'foxglove.NumericType'}"
    data: bytes = protos.SerializeToString(deterministic=True)
    return data


def encode(values: dict[str, Any], name: str) -> bytes:
    """Encode plain values as a message of `LAYOUT`."""
    encoded: bytes = _class_of(name)(**values).SerializeToString(deterministic=True)
    return encoded


@cache
def _class_of(name: str) -> Any:
    return message_class(descriptors(), name)


def time(stamp: int, encoding: str) -> dict[str, int]:
    """Return the fields of a stamp in nanoseconds; ``encoding`` is ``protobuf`` or ``json``."""
    names = ("seconds", "nanos") if encoding == "protobuf" else ("sec", "nsec")
    return dict(zip(names, divmod(stamp, SECOND), strict=True))


def content(data: bytes, encoding: str) -> Any:
    """Return the value of a field of bytes: in JSON, base64 text."""
    return data if encoding == "protobuf" else base64.b64encode(data).decode()


def write(path: Path, encoding: str, items: list[tuple[str, str, dict[str, Any]]]) -> Path:
    """Write messages given as topic, type and values; by default at `EPOCH`, in frame camera."""
    schema_encoding = "protobuf" if encoding == "protobuf" else "jsonschema"
    with mcap_writer(path, "") as writer:
        for k, (topic, kind, values) in enumerate(items):
            text = descriptors() if encoding == "protobuf" else b"{}"
            schema = writer.register_schema(kind, schema_encoding, text)
            channel = writer.register_channel(topic, encoding, schema)
            frame = {} if kind == "foxglove.FrameTransform" else {"frame_id": "camera"}
            filled = {"timestamp": time(EPOCH, encoding)} | frame | values
            data = encode(filled, kind) if encoding == "protobuf" else json.dumps(filled).encode()
            writer.add_message(channel, EPOCH + k, data, EPOCH + k)
    return path
