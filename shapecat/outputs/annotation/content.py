"""Content of annotations, independent of their encoding."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

from shapecat.outputs.wording import caption
from shapecat.types import AnnotationBox, AnnotationFrame

__all__ = [
    "Annotation",
    "AnnotationChannel",
    "EncodedMessage",
    "Encoders",
    "entity_id",
    "properties",
    "text",
    "text_position",
]


_T = TypeVar("_T")


class AnnotationChannel(NamedTuple):
    """A channel to write: its topic, the encoding of its messages, and its schema."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    metadata: tuple[tuple[str, str], ...] = ()


class Annotation(NamedTuple):
    """A frame to write, the lifetime of its entities, and the tracks to delete in it."""

    frame: AnnotationFrame
    lifetime_ns: int
    gone: tuple[int, ...]

    @property
    def log_time_ns(self) -> int:
        """The log time of the frame."""
        return self.frame.log_time_ns


Encoders = list[tuple[AnnotationChannel, Callable[[_T], bytes]]]
"""Channels, each with the function that encodes a frame as its message."""


class EncodedMessage(NamedTuple):
    """An encoded annotation: index of its channel, log time, and bytes."""

    channel: int
    log_time_ns: int
    data: bytes


def entity_id(track: int) -> str:
    """Return the entity id of a track."""
    return f"track-{track}"


def text(box: AnnotationBox) -> str:
    """Return the text above a box."""
    return caption(box.track, box.category, box.confidence)


def properties(box: AnnotationBox) -> dict[str, str]:
    """Return the properties of a box for viewers."""
    return {
        "category": box.category,
        "confidence": f"{box.confidence:.4f}",
        "track": str(box.track),
    }


def text_position(box: AnnotationBox) -> tuple[float, float, float]:
    """Return the position (x, y, z) of the text just above a box, metres, sensor frame."""
    x, y, z = box.center
    qx, qy, qz, qw = box.orientation
    rise = box.size[2] / 2 + 0.03
    # The third column of the rotation.
    up = (2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy))
    return x + rise * up[0], y + rise * up[1], z + rise * up[2]
