"""Encode Foxglove messages as Protocol Buffers, with the descriptors in `shapecat.schemas`."""

from functools import cache
from importlib.resources import files
from typing import Any

from shapecat.recordings.protobuf import message_class

__all__ = ["descriptors_of", "encode_foxglove"]


@cache
def descriptors_of(name: str) -> bytes:
    """Return the serialized FileDescriptorSet of a message type, as MCAP stores it."""
    return files("shapecat.schemas").joinpath(f"{name.rpartition('.')[2]}.binpb").read_bytes()


@cache
def _class_of(name: str) -> Any:
    return message_class(descriptors_of(name), name)


def encode_foxglove(values: dict[str, Any], name: str) -> bytes:
    """Encode plain values as ``foxglove.SceneUpdate`` or ``foxglove.ImageAnnotations``."""
    encoded: bytes = _class_of(name)(**values).SerializeToString(deterministic=True)
    return encoded
