"""Make and encode messages as CDR, ROS 1, JSON or protobuf, with the schemas in `schemas/`."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from importlib.resources import files
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from shapecat.outputs.annotation.content import AnnotationChannel, Encoders
from shapecat.recordings.decoding.protobuf import message_class

__all__ = ["ENCODINGS", "MessageKind", "Types", "encoders_of"]

Types = Mapping[str, Callable[..., Any]]
"""Functions that make messages, by the name of the message type without its package.

Each takes the fields of its message as keywords. Only ``Time``, which is also the type of
durations, takes nanoseconds.
"""
_T = TypeVar("_T")
_FOXGLOVE = "foxglove."
_ROS_TYPES = (
    "vision_msgs/msg/Detection3DArray",
    "foxglove_msgs/msg/SceneUpdate",
    "visualization_msgs/msg/MarkerArray",
    "vision_msgs/msg/Detection2DArray",
    "foxglove_msgs/msg/ImageAnnotations",
)
_INCOMPLETE = (
    "std_msgs/msg/Header",
    "geometry_msgs/msg/PoseWithCovariance",
    "vision_msgs/msg/Pose2D",
    "visualization_msgs/msg/Marker",
)
"""ROS types whose messages are filled with zeros before some of their fields are set.

In messages of the other types, all fields are set, and to fill them first would only take time.
"""


class MessageKind(NamedTuple, Generic[_T]):
    """The messages of a channel: topic, name of the type, and the function that makes a message.

    ``name`` is a Foxglove type, such as ``foxglove.SceneUpdate``, which is written in all
    encodings, or a ROS type, which is written only in ROS encodings.
    """

    topic: str
    name: str
    make: Callable[[_T, Types], Any]


def encoders_of(encoding: str, kinds: Iterable[MessageKind[_T]]) -> Encoders[_T]:
    """Return a channel and its encoder for each kind of message that the encoding supports.

    An unknown encoding is replaced by JSON.
    """
    chosen = ENCODINGS.get(encoding, ENCODINGS["json"])()
    return [
        _encoder(chosen, kind)
        for kind in kinds
        if chosen.name in {"cdr", "ros1"} or kind.name.startswith(_FOXGLOVE)
    ]


class _Encoding(NamedTuple):
    """Types, encoder and schemas of the messages in an encoding.

    ``encode`` takes a message and the name of its type. ``schema`` takes the name of a type, and
    returns the name, encoding and content of its schema.
    """

    name: str
    types: Types
    encode: Callable[[Any, str], bytes]
    schema: Callable[[str], tuple[str, str, bytes]]


def _encoder(
    encoding: _Encoding, kind: MessageKind[_T]
) -> tuple[AnnotationChannel, Callable[[_T], bytes]]:
    channel = AnnotationChannel(kind.topic, encoding.name, *encoding.schema(kind.name))
    return channel, lambda content: encoding.encode(kind.make(content, encoding.types), kind.name)


def _json() -> _Encoding:
    return _Encoding(
        "json",
        _plain("sec", "nsec"),
        lambda message, _name: json.dumps(message).encode(),
        lambda name: (name, "jsonschema", _file(name, ".json")),
    )


def _protobuf() -> _Encoding:
    def encode(message: Any, name: str) -> bytes:
        return bytes(_class_of(name)(**message).SerializeToString(deterministic=True))

    return _Encoding(
        "protobuf",
        _plain("seconds", "nanos"),
        encode,
        lambda name: (name, "protobuf", _file(name, ".binpb")),
    )


def _plain(*time_fields: str) -> Types:
    """Return types whose messages are dictionaries; ``time_fields`` are the fields of a time."""

    def time(time_ns: int) -> dict[str, int]:
        return dict(zip(time_fields, divmod(time_ns, 10**9), strict=True))

    return defaultdict(lambda: dict, Time=time)


def _ros(*, ros1: bool) -> _Encoding:
    store = _typestore(ros1)
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    types: dict[str, Callable[..., Any]] = {
        name.rpartition("/")[2]: kind for name, kind in store.types.items()
    }
    for name in _INCOMPLETE:
        kind = name.rpartition("/")[2]
        types[kind] = partial(types[kind], **_zeros(store, name))
    made = types["Time"]

    def time(time_ns: int) -> Any:
        """Return a time; its seconds are limited to 31 bits."""
        seconds, nanoseconds = divmod(time_ns, 10**9)
        return made(sec=min(seconds, 2**31 - 1), nanosec=nanoseconds)

    def schema(name: str) -> tuple[str, str, bytes]:
        text, _ = store.generate_msgdef(_ros_name(name), ros_version=1 if ros1 else 2)
        if ros1:
            return _ros_name(name).replace("/msg/", "/"), "ros1msg", text.encode()
        return _ros_name(name), "ros2msg", text.encode()

    def encode(message: Any, name: str) -> bytes:
        return bytes(serialize(message, _ros_name(name)))

    return _Encoding("ros1" if ros1 else "cdr", {**types, "Time": time}, encode, schema)


ENCODINGS: dict[str, Callable[[], _Encoding]] = {
    "cdr": partial(_ros, ros1=False),
    "ros1": partial(_ros, ros1=True),
    "json": _json,
    "protobuf": _protobuf,
}
"""For each encoding, the function that makes its `_Encoding`.

Annotations have the encoding of the recording: ROS tools fail on a file with mixed encodings.
"""


def _file(name: str, suffix: str) -> bytes:
    file = name.replace("/", ".").rpartition(".")[2] + suffix
    return files("shapecat.schemas").joinpath(file).read_bytes()


def _ros_name(name: str) -> str:
    return name.replace(_FOXGLOVE, "foxglove_msgs/msg/")


@cache
def _class_of(name: str) -> Any:
    return message_class(_file(name, ".binpb"), name)


@cache
def _typestore(ros1: bool) -> Typestore:  # noqa: FBT001  # a cache key
    store = get_typestore(Stores.EMPTY)
    ros1_types = dict(get_typestore(Stores.ROS1_NOETIC).fielddefs) if ros1 else {}
    for name in _ROS_TYPES:
        types = get_types_from_msg(_file(name, ".msg").decode(), name)
        # ROS 1 has a sequence number in its headers, and simpler markers.
        types = {key: ros1_types.get(key, value) for key, value in types.items()}
        store.register({key: value for key, value in types.items() if key not in store.fielddefs})
    return store


def _zeros(store: Typestore, name: str) -> dict[str, Any]:
    """Return zero or an empty value for each field of a message type."""
    fields: dict[str, Any] = {}
    definitions: Any = store.fielddefs[name][1]
    for field, (node, detail) in definitions:
        if node is Nodetype.BASE:
            fields[field] = {"string": "", "bool": False}.get(detail[0], 0)
        elif node is Nodetype.NAME:
            fields[field] = store.types[detail](**_zeros(store, detail))
        else:
            (item, content), length = detail
            fields[field] = np.zeros(length, content[0]) if item is Nodetype.BASE else []
    return fields
