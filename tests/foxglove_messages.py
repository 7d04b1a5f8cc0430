"""Foxglove's messages in JSON and Protocol Buffers, and recordings made of them."""

import base64
import json
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from shapecat.recordings.protobuf import ProtobufField, encode_message

SECOND = 10**9
EPOCH = 1_700_000_000 * SECOND
DOUBLE, STRING, MESSAGE, RAW, ENUM, FIXED, INT64 = 1, 9, 11, 12, 14, 7, 3


def field(name: str, kind: int, message: str = "", *, repeated: bool = False) -> ProtobufField:
    return ProtobufField(name, kind, repeated, message)


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
DESCRIPTOR = {
    "set": {1: field("file", MESSAGE, "file", repeated=True)},
    "file": {2: field("package", STRING), 4: field("message_type", MESSAGE, "type", repeated=True)},
    "type": {1: field("name", STRING), 2: field("field", MESSAGE, "field", repeated=True)},
    "field": {
        1: field("name", STRING),
        3: field("number", 5),
        4: field("label", 5),
        5: field("type", 5),
        6: field("type_name", STRING),
    },
}


def descriptors(layout: dict[str, dict[int, ProtobufField]] = LAYOUT) -> bytes:
    files = [
        {
            "package": name.rpartition(".")[0],
            "message_type": [
                {
                    "name": name.rpartition(".")[2],
                    "field": [
                        {
                            "name": f.name,
                            "number": number,
                            "label": 3 if f.repeated else 1,
                            "type": f.kind,
                            "type_name": f".{f.message}" if f.message else "",
                        }
                        for number, f in fields.items()
                    ],
                }
            ],
        }
        for name, fields in layout.items()
    ]
    return encode_message({"file": files}, "set", DESCRIPTOR)


def time(stamp: int, encoding: str) -> dict[str, int]:
    names = ("seconds", "nanos") if encoding == "protobuf" else ("sec", "nsec")
    return dict(zip(names, divmod(stamp, SECOND), strict=True))


def content(data: bytes, encoding: str) -> Any:
    return data if encoding == "protobuf" else base64.b64encode(data).decode()


def write(path: Path, encoding: str, items: list[tuple[str, str, dict[str, Any]]]) -> Path:
    schema_encoding = "protobuf" if encoding == "protobuf" else "jsonschema"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("", "test")
        for k, (topic, kind, values) in enumerate(items):
            text = descriptors() if encoding == "protobuf" else b"{}"
            schema = writer.register_schema(kind, schema_encoding, text)
            channel = writer.register_channel(topic, encoding, schema)
            filled = {"timestamp": time(EPOCH, encoding), "frame_id": "camera"} | values
            data = (
                encode_message(filled, kind, LAYOUT)
                if encoding == "protobuf"
                else json.dumps(filled).encode()
            )
            writer.add_message(channel, EPOCH + k, data, EPOCH + k)
        writer.finish()
    return path
