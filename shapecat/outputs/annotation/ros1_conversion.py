"""Convert ROS 1 channels and their messages to ROS 2."""

import re
from collections.abc import Callable
from functools import cache, lru_cache
from importlib.resources import files
from itertools import chain, count
from typing import Any

import numpy as np
from rosbags.interfaces import (
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

from shapecat.outputs.annotation.content import AnnotationChannel
from shapecat.recordings.decoding.decoders import LIBRARY_ERRORS, typestore_of
from shapecat.recordings.messages import Channel

__all__ = ["convert_channel", "raw_channel", "wrap_raw"]

_RAW_TYPE = "shapecat_msgs/msg/RawMessage"
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
"""The quality of service that corresponds to a latched ROS 1 topic."""
_HEADER = "std_msgs/msg/Header"
_FIELD = re.compile("[a-z](_?[a-z0-9])*")
"""Field names that ROS 2 allows."""

_KEPT = 64
"""Largest number of definitions in the cache; thousands of topics may share one definition."""

_ConvertedChannel = tuple[AnnotationChannel, Callable[[bytes | memoryview], memoryview]]


def convert_channel(channel: Channel) -> _ConvertedChannel | None:
    """Convert a ROS 1 channel to ROS 2.

    Types keep their definition from the bag. Only fields whose names ROS 2 does not allow are
    renamed: ``O_T_EE`` becomes ``o_t_ee``, and ``K`` of CameraInfo becomes ``k``, as ROS 2 itself
    names it. ``tf/tfMessage`` becomes ``tf2_msgs/TFMessage``, and a latched topic gets the
    corresponding quality of service. The sequence numbers of headers are lost, since ROS 2 has
    none.

    Returns
    -------
    The channel to write, and the function that converts its messages; None if the definition is
    invalid.
    """
    name = _RENAMED.get(channel.type, channel.type)
    try:
        store, text = _ros2_types(channel._replace(topic="", metadata=()), name)
    except LIBRARY_ERRORS:
        return None
    latched = dict(channel.metadata).get("latching") == "1"
    quality = (("offered_qos_profiles", dump_qos_v8([_LATCHED])),) if latched else ()
    described = AnnotationChannel(channel.topic, "cdr", name, "ros2msg", text, quality)
    return described, lambda data: store.ros1_to_cdr(data, name)


@lru_cache(_KEPT)
def _ros2_types(channel: Channel, name: str) -> tuple[Typestore, bytes]:
    """Return the message types of a channel for ROS 2, and the definition of its own type.

    ``name`` is the name of this type in ROS 2.
    """
    types = dict(typestore_of(channel).fielddefs)
    if name != channel.type:
        types[name] = types.pop(channel.type)
    store = get_typestore(Stores.EMPTY)
    types[_HEADER] = get_typestore(Stores.ROS2_HUMBLE).fielddefs[_HEADER]
    types = {kind: _renamed(*definition) for kind, definition in types.items()}
    store.register(types)
    text, _ = store.generate_msgdef(name, ros_version=2)
    store.get_msgdef(name)
    return store, text.encode()


def _renamed(constants: Any, fields: Any) -> Any:
    """Return a message definition with fields renamed where ROS 2 does not allow their names.

    Strict readers refuse a file with such a name.
    """
    names: list[str] = []
    for name, _ in fields:
        words = [name]
        if not _FIELD.fullmatch(name):
            words = re.sub("(?<=[a-z0-9])(?=[A-Z])", "_", name).lower().split("_")
        plain = "_".join(filter(None, words))
        numbered = (f"{plain}_{k}" for k in count(2))
        names.append(next(n for n in chain([plain], numbered) if n not in names))
    return constants, [(name, kind) for name, (_, kind) in zip(names, fields, strict=True)]


def raw_channel(topic: str) -> AnnotationChannel:
    """Return the channel for messages that are kept as recorded; see `wrap_raw`."""
    text = files("shapecat.schemas").joinpath("RawMessage.msg").read_bytes()
    return AnnotationChannel(topic, "cdr", _RAW_TYPE, "ros2msg", text)


def wrap_raw(channel: Channel, data: bytes | memoryview) -> memoryview:
    """Return a CDR message that holds an unconverted message, its type, encoding and definition.

    The whole file then has one encoding. Most ROS tools cannot open a file with two.
    """
    store = _raw_store()
    message = store.types[_RAW_TYPE](
        type=channel.type,
        encoding=channel.encoding,
        definition=channel.schema.decode("utf-8", "replace"),
        data=np.frombuffer(data, np.uint8),
    )
    return store.serialize_cdr(message, _RAW_TYPE)


@cache
def _raw_store() -> Typestore:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(raw_channel("").schema.decode(), _RAW_TYPE))
    return store
