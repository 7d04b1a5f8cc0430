"""Encoders of Foxglove messages as JSON and Protocol Buffers, with the schemas of our package."""

import json
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

from shapecat.outputs.annotation.content import AnnotationChannel, Encoders
from shapecat.recordings.decoding.protobuf import message_class

__all__ = ["Plain", "descriptors_of", "encode_foxglove", "json_encoder", "protobuf_encoder"]

_T = TypeVar("_T")

Plain = Callable[[_T, tuple[str, str]], dict[str, Any]]
"""Returns a message as plain values, from its content and the names of the fields of a time."""


def _schema(name: str, suffix: str) -> bytes:
    return files("shapecat.schemas").joinpath(name.rpartition(".")[2] + suffix).read_bytes()


def json_encoder(topic: str, name: str, plain: Plain[_T]) -> Encoders[_T]:
    """Return a channel of messages of a type such as ``foxglove.SceneUpdate``, as JSON."""
    channel = AnnotationChannel(topic, "json", name, "jsonschema", _schema(name, ".json"))
    return [(channel, lambda content: json.dumps(plain(content, ("sec", "nsec"))).encode())]


def protobuf_encoder(topic: str, name: str, plain: Plain[_T]) -> Encoders[_T]:
    """Return a channel of messages of a type such as ``foxglove.SceneUpdate``, as protobuf."""
    channel = AnnotationChannel(topic, "protobuf", name, "protobuf", descriptors_of(name))
    return [(channel, lambda content: encode_foxglove(plain(content, ("seconds", "nanos")), name))]


@cache
def descriptors_of(name: str) -> bytes:
    """Return the serialized FileDescriptorSet of a message type, as MCAP stores it."""
    return _schema(name, ".binpb")


@cache
def _class_of(name: str) -> Any:
    return message_class(descriptors_of(name), name)


def encode_foxglove(values: dict[str, Any], name: str) -> bytes:
    """Encode plain values as ``foxglove.SceneUpdate`` or ``foxglove.ImageAnnotations``."""
    encoded: bytes = _class_of(name)(**values).SerializeToString(deterministic=True)
    return encoded
