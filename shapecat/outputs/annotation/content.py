"""Content of annotations, independent of their encoding."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from shapecat.types import AnnotationFrame

__all__ = [
    "Annotation",
    "AnnotationChannel",
    "EncodedMessage",
    "Encoders",
]


_T = TypeVar("_T")


class AnnotationChannel(NamedTuple):
    """A channel to write: topic, encoding of the messages, schema, and (key, value) metadata."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    metadata: tuple[tuple[str, str], ...] = ()


class Annotation(NamedTuple):
    """A frame to write, the lifetime of its boxes, and the tracks whose boxes it removes."""

    frame: AnnotationFrame
    lifetime_ns: int
    gone: tuple[int, ...]

    @property
    def log_time_ns(self) -> int:
        """The log time of the frame."""
        return self.frame.log_time_ns


Encoders = list[tuple[AnnotationChannel, Callable[[_T], bytes]]]
"""Channels, each with the function that encodes a frame as a message of the channel."""


class EncodedMessage(NamedTuple):
    """An encoded annotation: index of its channel, log time, and bytes."""

    channel: int
    log_time_ns: int
    data: bytes
