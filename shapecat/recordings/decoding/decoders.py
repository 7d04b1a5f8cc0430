"""Decode messages with the definitions stored in their recording."""

import json
import re
import struct
from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from types import SimpleNamespace
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from shapecat.recordings.decoding.foxglove import as_ros
from shapecat.recordings.messages import Channel, Message, MessageError

__all__ = ["LIBRARY_ERRORS", "Decoder", "decode", "schema_of", "typestore_of"]

Decoder = Callable[[bytes | memoryview], Any]

LIBRARY_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    SerdeError,
    SyntaxError,
    TypeError,
    TypesysError,
    ValueError,
    struct.error,
)
"""Errors that decoding may raise on malformed definitions or data."""

_MAX_DEFINITION = 1 << 20
"""Longest definition of a message type that is parsed, bytes."""
_MAX_UNROLLED = 4096
"""Largest number of items in a fixed-size array of strings or messages."""
_SEPARATOR = "=" * 80 + "\n"
"""Line before each IDL definition in a schema that holds several."""


def decode(message: Message, decoders: dict[tuple[str, str, bytes], Decoder]) -> Any:
    """Decode a message to an object with its fields as attributes; cache decoders in ``decoders``.

    Foxglove messages get the fields of the corresponding ROS messages, see `as_ros`.

    Raises
    ------
    MessageError : the message cannot be decoded; the error message names topic, type and reason.
    """
    channel = message.channel
    key = (channel.type, channel.encoding, channel.schema)
    try:
        if not message.data:  # in Protocol Buffers this would be a message of default values
            msg = "it has no data"
            raise ValueError(msg)
        if key not in decoders:
            decoders[key] = _DECODERS[channel.encoding](channel)
        return as_ros(channel.type, decoders[key](message.data))
    except LIBRARY_ERRORS as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        if channel.encoding not in _DECODERS:
            reason = f"encoding {channel.encoding!r} is not supported"
        msg = f"{channel.topic}: cannot decode {channel.type}: {reason}"
        raise MessageError(msg) from error


def typestore_of(channel: Channel) -> Typestore:
    """Return a type store with the message types of a channel's definition.

    If the channel has no definition, the store holds the types of ROS 1 Noetic or ROS 2 Humble.

    Raises
    ------
    ValueError : the definition is too long; other `LIBRARY_ERRORS` if it is malformed.
    """
    if not channel.schema:
        return _builtin(channel.encoding)
    if len(channel.schema) > _MAX_DEFINITION:
        msg = f"the definition is too long, {len(channel.schema)} bytes"
        raise ValueError(msg)
    return _defined(channel.type, channel.schema_encoding, channel.schema)


@lru_cache(maxsize=32)  # recordings of one robot share their definitions
def _defined(kind: str, encoding: str, schema: bytes) -> Typestore:
    text = schema.decode("utf-8")
    types: dict[str, Any] = {}
    if encoding in {"ros2idl", "omgidl"}:
        for part in _idl_parts(text):
            types.update(get_types_from_idl(part))
    else:
        types.update(get_types_from_msg(text.replace("\r\n", "\n"), kind))
    _refuse_unrolling(types)
    # One store per definition, since two topics may define the same type differently.
    store = get_typestore(Stores.EMPTY)
    store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})
    return store


def _idl_parts(text: str) -> Iterator[str]:
    text = re.sub(r"^[ \t]*#.*", "", text, flags=re.MULTILINE)  # rosbags refuses #include
    if not text.startswith(f"{_SEPARATOR}IDL: "):
        yield text
        return
    for part in text.split(_SEPARATOR)[1:]:
        yield part.partition("\n")[2]


def _refuse_unrolling(types: dict[str, Any]) -> None:
    """Reject long fixed-size arrays of strings or messages, which rosbags would unroll into code.

    Raises
    ------
    ValueError : such an array has more than 4096 items.
    """
    for name, (_, fields) in types.items():
        for field, description in fields:
            if description[0] != Nodetype.ARRAY:
                continue
            (kind, base), length = description[1]
            primitive = kind == Nodetype.BASE and base[0] != "string"
            if length > _MAX_UNROLLED and not primitive:
                msg = f"{name}.{field}: an array of {length} is too long"
                raise ValueError(msg)


@cache
def _builtin(encoding: str) -> Typestore:
    return get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)


def _ros(channel: Channel) -> Decoder:
    store = typestore_of(channel)
    read = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr
    return lambda data: read(data, channel.type)


def _json(_channel: Channel) -> Decoder:
    return lambda data: json.loads(bytes(data), object_hook=lambda item: SimpleNamespace(**item))


def _protobuf(channel: Channel) -> Decoder:
    from shapecat.recordings.decoding.protobuf import message_decoder  # noqa: PLC0415  on first use

    return message_decoder(channel.schema, channel.schema_name)


_DECODERS: dict[str, Callable[[Channel], Decoder]] = {
    "cdr": _ros,
    "ros1": _ros,
    "json": _json,
    "protobuf": _protobuf,
}


def schema_of(channel: Channel) -> tuple[str, str, bytes]:
    """Return name, encoding and text of a channel's schema.

    A CDR channel without a schema gets that of ROS 2 Humble; encoding and text are empty if its
    type is unknown there.
    """
    if channel.schema or channel.encoding != "cdr":
        return channel.schema_name, channel.schema_encoding, channel.schema
    store = _builtin("cdr")
    if channel.type not in store.fielddefs:
        return channel.schema_name, "", b""
    text, _ = store.generate_msgdef(channel.type, ros_version=2)
    return channel.schema_name, "ros2msg", text.encode()
