"""Foxglove's messages as Protocol Buffers, from the definitions in `shapecat.schemas`."""

import re
from functools import cache
from importlib.resources import files
from typing import Any

from shapecat.recordings.protobuf import ProtobufField, encode_message

__all__ = ["descriptors_of", "encode_foxglove", "encode_scene", "scene_descriptors"]

_SCENE = "foxglove.SceneUpdate"

_KINDS = {"double": 1, "bool": 8, "string": 9, "int32": 5, "int64": 3}
_MESSAGE, _ENUM = 11, 14
_GOOGLE = {
    "google.protobuf.Timestamp": ("int64 seconds = 1;", "int32 nanos = 2;"),
    "google.protobuf.Duration": ("int64 seconds = 1;", "int32 nanos = 2;"),
}
_FIELD = re.compile(r"^\s*(repeated )?([\w.]+) (\w+) = (\d+);", re.MULTILINE)
_BLOCK = re.compile(r"^message (\w+) \{\n(.*?)^\}", re.MULTILINE | re.DOTALL)
_ENUM_LINE = re.compile(r"enum (\w+) \{(.*?)\}")

Messages = dict[str, dict[int, ProtobufField]]


def encode_scene(scene: dict[str, Any]) -> bytes:
    """Encode a SceneUpdate of plain values; times have ``seconds`` and ``nanos``."""
    return encode_foxglove(scene, _SCENE)


def encode_foxglove(values: dict[str, Any], name: str) -> bytes:
    """Encode a message of plain values: ``foxglove.SceneUpdate`` or ``ImageAnnotations``."""
    return encode_message(values, name, _messages(name))


@cache
def _blocks(whole: str) -> dict[str, str]:
    """Return the text of each message in the file of one by its full name."""
    file = f"{whole.rpartition('.')[2]}.proto"
    text = files("shapecat.schemas").joinpath(file).read_text("utf-8")
    own = {f"foxglove.{name}": body for name, body in _BLOCK.findall(text)}
    used = {name: lines for name, lines in _GOOGLE.items() if name in text}
    return own | {name: "\n".join(lines) for name, lines in used.items()}


@cache
def _messages(whole: str) -> Messages:
    """Return the fields of each message by number."""
    return {name: _fields(body, name) for name, body in _blocks(whole).items()}


def _fields(body: str, owner: str) -> dict[int, ProtobufField]:
    fields = {}
    for repeated, kind, name, number in _FIELD.findall(_ENUM_LINE.sub("", body)):
        if kind in _KINDS:
            field = ProtobufField(name, _KINDS[kind], bool(repeated))
        elif kind == "Type":
            field = ProtobufField(name, _ENUM, bool(repeated), f"{owner}.Type")
        else:
            full = kind if kind.startswith("google.") else f"foxglove.{kind}"
            field = ProtobufField(name, _MESSAGE, bool(repeated), full)
        fields[int(number)] = field
    return fields


def scene_descriptors() -> bytes:
    """Return the FileDescriptorSet of foxglove.SceneUpdate, as MCAP embeds it."""
    return descriptors_of(_SCENE)


@cache
def descriptors_of(whole: str) -> bytes:
    """Return the FileDescriptorSet of a message, as MCAP embeds it."""
    blocks = _blocks(whole)
    google = {
        name: f"google/protobuf/{name.rsplit('.', 1)[1].lower()}.proto"
        for name in _GOOGLE
        if name in blocks
    }
    described = [
        {
            "name": file,
            "package": "google.protobuf",
            "message_type": [_describe(name, whole)],
            "syntax": "proto3",
        }
        for name, file in google.items()
    ]
    own = {
        "name": f"{whole.replace('.', '/')}.proto",
        "package": "foxglove",
        "dependency": list(google.values()),
        "message_type": [_describe(name, whole) for name in blocks if name not in google],
        "syntax": "proto3",
    }
    return encode_message({"file": [*described, own]}, "set", _DESCRIPTOR)


def _describe(name: str, whole: str) -> dict[str, Any]:
    fields = [
        {
            "name": field.name,
            "number": number,
            "label": 3 if field.repeated else 1,
            "type": field.kind,
            "type_name": f".{field.message}" if field.message else "",
        }
        for number, field in _messages(whole)[name].items()
    ]
    enums = [
        {
            "name": enum,
            "value": [
                {"name": key, "number": int(value)}
                for key, value in re.findall(r"(\w+) = (\d+);", values)
            ],
        }
        for enum, values in _ENUM_LINE.findall(_blocks(whole)[name])
    ]
    return {"name": name.rsplit(".", 1)[1], "field": fields, "enum_type": enums}


def _text(name: str, *, repeated: bool = False) -> ProtobufField:
    return ProtobufField(name, _KINDS["string"], repeated)


def _number(name: str) -> ProtobufField:
    return ProtobufField(name, _KINDS["int32"], repeated=False)


def _items(name: str, kind: str) -> ProtobufField:
    return ProtobufField(name, _MESSAGE, repeated=True, message=kind)


_DESCRIPTOR: Messages = {
    "set": {1: _items("file", "file")},
    "file": {
        1: _text("name"),
        2: _text("package"),
        3: _text("dependency", repeated=True),
        4: _items("message_type", "type"),
        12: _text("syntax"),
    },
    "type": {1: _text("name"), 2: _items("field", "field"), 4: _items("enum_type", "enum")},
    "field": {
        1: _text("name"),
        3: _number("number"),
        4: _number("label"),
        5: _number("type"),
        6: _text("type_name"),
    },
    "enum": {1: _text("name"), 2: _items("value", "value")},
    "value": {1: _text("name"), 2: _number("number")},
}
"""The part of descriptor.proto that is needed."""
