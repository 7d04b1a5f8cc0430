"""ROS 1 messages become ROS 2 messages: same fields, other encoding."""

from collections.abc import Callable
from importlib.resources import files
from typing import Any

import numpy as np
from rosbags.interfaces import (
    Nodetype,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import dump_qos_v8
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from shapecat.outputs.annotation import AnnotationChannel
from shapecat.recordings.decoding import LIBRARY_ERRORS, typestore_of
from shapecat.recordings.messages import Channel

__all__ = ["RAW_TYPE", "ConvertedChannel", "convert_channel", "raw_channel", "wrap_raw"]

RAW_TYPE = "shapecat_msgs/msg/RawMessage"
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage"}
_FOREVER = QosTime(2147483647, 4294967295)
_LATCHED = Qos(
    QosHistory.KEEP_LAST,
    1,
    QosReliability.RELIABLE,
    QosDurability.TRANSIENT_LOCAL,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    avoid_ros_namespace_conventions=False,
)
"""What ROS 2 calls a latched topic."""
_HEADER = "std_msgs/msg/Header"

ConvertedChannel = tuple[AnnotationChannel, Callable[[bytes | memoryview], memoryview]]


def convert_channel(channel: Channel) -> ConvertedChannel | None:
    """Describe a ROS 1 channel in ROS 2 terms.

    Types that ROS 2 still has, laid out the same, get the ROS 2 definition (field names differ:
    ``K`` became ``k``); all others keep the definition of the bag. Only the sequence number of
    headers is lost: ROS 2 has none.

    Returns
    -------
    The channel to write and the conversion of its messages; None if the definition cannot be
    understood.
    """
    name = _RENAMED.get(channel.type, channel.type)
    try:
        types = dict(typestore_of(channel).fielddefs)
        if name != channel.type:
            types[name] = types.pop(channel.type)
        modern = get_typestore(Stores.ROS2_HUMBLE)
        store = get_typestore(Stores.EMPTY)
        types[_HEADER] = modern.fielddefs[_HEADER]
        known = name in modern.fielddefs and _same_layout(name, types, modern.fielddefs)
        store.register({**types, **(_reachable(name, modern) if known else {})})
        text, _ = store.generate_msgdef(name, ros_version=2)
        store.get_msgdef(name)
    except LIBRARY_ERRORS:
        return None
    latched = dict(channel.metadata).get("latching") == "1"
    quality = (("offered_qos_profiles", dump_qos_v8([_LATCHED])),) if latched else ()
    described = AnnotationChannel(channel.topic, "cdr", name, "ros2msg", text.encode(), quality)
    return described, lambda data: store.ros1_to_cdr(data, name)


def _same_layout(name: str, old: Any, new: Any) -> bool:
    """Tell whether two definitions have the same types in the same order, whatever their names."""
    if name == _HEADER:
        return True
    if name not in old or name not in new or len(old[name][1]) != len(new[name][1]):
        return False
    for (_, a), (_, b) in zip(old[name][1], new[name][1], strict=True):
        if a != b:
            return False
        inner = a[1][0] if a[0] in {Nodetype.ARRAY, Nodetype.SEQUENCE} else a
        if inner[0] == Nodetype.NAME and not _same_layout(inner[1], old, new):
            return False
    return True


def _reachable(name: str, store: Typestore) -> dict[str, Any]:
    """Return the definitions that a type is made of."""
    found: dict[str, Any] = {}
    waiting = [name]
    while waiting:
        current = waiting.pop()
        if current in found:
            continue
        found[current] = store.fielddefs[current]
        for _, field in store.fielddefs[current][1]:
            inner: Any = field[1][0] if field[0] in {Nodetype.ARRAY, Nodetype.SEQUENCE} else field
            if inner[0] == Nodetype.NAME:
                waiting.append(str(inner[1]))
    return found


def raw_channel(topic: str) -> AnnotationChannel:
    """Describe a channel of messages that are kept as they were recorded."""
    text = files("shapecat.schemas").joinpath("RawMessage.msg").read_bytes()
    return AnnotationChannel(topic, "cdr", RAW_TYPE, "ros2msg", text)


def wrap_raw(channel: Channel, data: bytes | memoryview) -> memoryview:
    """Wrap a message that cannot be converted, byte for byte, with all that is needed to read it.

    A file of two encodings cannot be played or opened by most ROS tools.
    """
    store = _raw_store()
    message = store.types[RAW_TYPE](
        type=channel.type,
        encoding=channel.encoding,
        definition=channel.schema.decode("utf-8", "replace"),
        data=np.frombuffer(data, np.uint8),
    )
    return store.serialize_cdr(message, RAW_TYPE)


def _raw_store() -> Typestore:
    if not _STORES:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(raw_channel("").schema.decode(), RAW_TYPE))
        _STORES.append(store)
    return _STORES[0]


_STORES: list[Typestore] = []
