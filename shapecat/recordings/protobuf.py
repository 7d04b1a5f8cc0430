"""Protocol Buffers by the descriptors that a recording holds.

The wire format is small: keys, variable-length integers, fixed words, and length-delimited
fields. Reading it here keeps the data of a cloud where they are, and needs no generated code.
"""

import struct
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, NamedTuple

__all__ = ["ProtobufField", "encode_message", "message_decoder"]

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_DEEPEST = 32
_MOST = 1 << 20
"""Repeated messages in one message."""


class ProtobufField(NamedTuple):
    """A field: its name, its type as numbered in descriptor.proto, whether it repeats."""

    name: str
    kind: int
    repeated: bool
    message: str = ""


Messages = dict[str, dict[int, ProtobufField]]
"""Fields by number, by full name of the message."""

# Type numbers of descriptor.proto.
_DOUBLE, _FLOAT, _STRING, _MESSAGE, _RAW = 1, 2, 9, 11, 12
_FIXED = {1: "<d", 2: "<f", 6: "<Q", 7: "<I", 15: "<i", 16: "<q"}
_SIGNED = {3, 5, 14}
_ZIGZAG = {17, 18}
_BOOL = 8

_DESCRIPTOR: Messages = {
    "set": {1: ProtobufField("file", _MESSAGE, repeated=True, message="file")},
    "file": {
        2: ProtobufField("package", _STRING, repeated=False),
        4: ProtobufField("message_type", _MESSAGE, repeated=True, message="type"),
    },
    "type": {
        1: ProtobufField("name", _STRING, repeated=False),
        2: ProtobufField("field", _MESSAGE, repeated=True, message="field"),
        3: ProtobufField("nested_type", _MESSAGE, repeated=True, message="type"),
    },
    "field": {
        1: ProtobufField("name", _STRING, repeated=False),
        3: ProtobufField("number", 5, repeated=False),
        4: ProtobufField("label", 5, repeated=False),
        5: ProtobufField("type", 5, repeated=False),
        6: ProtobufField("type_name", _STRING, repeated=False),
    },
}
"""The part of descriptor.proto that says how messages are laid out."""


def message_decoder(descriptors: bytes, name: str) -> Callable[[bytes | memoryview], Any]:
    """Return a decoder for a message, given a serialized FileDescriptorSet.

    Decoded messages have their fields as attributes, defaults where they are absent; an absent
    message is None.

    Raises
    ------
    ValueError : the descriptors do not describe the message, or are damaged.
    """
    known: Messages = {}
    for file in _decode(memoryview(descriptors), "set", _DESCRIPTOR, 0).file:
        for item in file.message_type:
            _collect(item, f"{file.package}." if file.package else "", known, 0)
    if name not in known:
        msg = f"no descriptor of {name}"
        raise ValueError(msg)
    return lambda data: _decode(memoryview(data), name, known, 0)


def _collect(item: Any, prefix: str, known: Messages, depth: int) -> None:
    if depth > _DEEPEST:
        msg = "descriptors are nested too deep"
        raise ValueError(msg)
    full = prefix + item.name
    known[full] = {
        field.number: ProtobufField(
            field.name, field.type, field.label == 3, field.type_name.removeprefix(".")
        )
        for field in item.field
    }
    for nested in item.nested_type:
        _collect(nested, f"{full}.", known, depth + 1)


def _decode(data: memoryview, name: str, known: Messages, depth: int) -> Any:
    if depth > _DEEPEST:
        msg = "messages are nested too deep"
        raise ValueError(msg)
    fields = known[name]
    values: dict[str, Any] = {}
    for number, wire, value in _split(data):
        field = fields.get(number)
        if field is None:
            continue
        if field.repeated:
            items = values.setdefault(field.name, [])
            if len(items) >= _MOST:
                msg = f"more than {_MOST} items in {field.name}"
                raise ValueError(msg)
            if wire == _BYTES and field.kind not in {_STRING, _MESSAGE, _RAW}:
                items.extend(_unpack(value, field))
            else:
                items.append(_value(value, field, known, depth))
        else:
            values[field.name] = _value(value, field, known, depth)
    for field in fields.values():
        if field.name not in values:
            values[field.name] = _default(field)
    return SimpleNamespace(**values)


def _default(field: ProtobufField) -> Any:
    if field.repeated:
        return []
    return {_MESSAGE: None, _STRING: "", _RAW: b"", _DOUBLE: 0.0, _FLOAT: 0.0, _BOOL: False}.get(
        field.kind, 0
    )


def _value(value: Any, field: ProtobufField, known: Messages, depth: int) -> Any:
    if field.kind == _MESSAGE:
        return _decode(value, field.message, known, depth + 1)
    if field.kind == _STRING:
        return str(value, "utf-8")
    if field.kind == _RAW:
        return value
    if field.kind in _FIXED:
        return struct.unpack(_FIXED[field.kind], value)[0]
    return _integer(value, field.kind)


def _integer(value: int, kind: int) -> int | bool:
    if kind in _ZIGZAG:
        return (value >> 1) ^ -(value & 1)
    if kind == _BOOL:
        return bool(value)
    return value - (1 << 64) if kind in _SIGNED and value >> 63 else value


def _unpack(data: memoryview, field: ProtobufField) -> Iterator[Any]:
    """Yield the numbers of a packed field."""
    if field.kind in _FIXED:
        yield from (item for (item,) in struct.iter_unpack(_FIXED[field.kind], data))
        return
    at = 0
    while at < len(data):
        value, at = _varint(data, at)
        yield _integer(value, field.kind)


def _split(data: memoryview) -> Iterator[tuple[int, int, Any]]:
    """Yield number, wire type and raw value of each field.

    Raises
    ------
    ValueError : a field reaches beyond the data, or has an unknown wire type.
    """
    at, end = 0, len(data)
    while at < end:
        key, at = _varint(data, at)
        wire = key & 7
        if wire == _VARINT:
            value, at = _varint(data, at)
            yield key >> 3, wire, value
            continue
        if wire == _BYTES:
            size, at = _varint(data, at)
        elif wire in {_FIXED64, _FIXED32}:
            size = 8 if wire == _FIXED64 else 4
        else:
            msg = f"wire type {wire}"
            raise ValueError(msg)
        if size > end - at:
            msg = f"field {key >> 3} is cut off"
            raise ValueError(msg)
        yield key >> 3, wire, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = shift = 0
    while shift < 64:
        byte = data[at]  # an IndexError is a cut-off number
        at += 1
        value |= (byte & 127) << shift
        if byte < 128:
            return value & (1 << 64) - 1, at
        shift += 7
    msg = "number of more than 64 bits"
    raise ValueError(msg)


def encode_message(values: dict[str, Any], name: str, known: Messages) -> bytes:
    """Encode plain values as a message; absent and default values take no room."""
    parts = []
    for number, field in known[name].items():
        value = values.get(field.name)
        items = [value] if value and not field.repeated else value or []
        parts += [_encode_field(number, field, item, known) for item in items]
    return b"".join(parts)


def _encode_field(number: int, field: ProtobufField, item: Any, known: Messages) -> bytes:
    if field.kind in _FIXED:
        body = struct.pack(_FIXED[field.kind], item)
        return _key(number, _FIXED64 if len(body) == 8 else _FIXED32) + body
    if field.kind in {_STRING, _MESSAGE, _RAW}:
        body = item.encode() if field.kind == _STRING else item
        if field.kind == _MESSAGE:
            body = encode_message(item, field.message, known)
        return _key(number, _BYTES) + _encode_varint(len(body)) + body
    return _key(number, _VARINT) + _encode_varint(int(item) & (1 << 64) - 1)


def _key(number: int, wire: int) -> bytes:
    return _encode_varint(number << 3 | wire)


def _encode_varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    out.append(value)
    return bytes(out)
