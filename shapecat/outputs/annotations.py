"""Annotation channels for each message encoding."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from importlib.resources import files
from typing import Any

from shapecat.outputs.annotation import (
    Annotation,
    AnnotationChannel,
    entity_id,
    properties,
    text,
    text_position,
)
from shapecat.outputs.colours import colour_of
from shapecat.outputs.ros_annotations import ArrayMessage, RosMessages
from shapecat.outputs.scene_protobuf import descriptors_of, encode_foxglove
from shapecat.types import ShownBox, ShownFrame

__all__ = ["ENCODERS", "Encode", "encoder_for"]

DETECTIONS = "/shapecat/detections"
SCENE = "/shapecat/scene"
MARKERS = "/shapecat/markers"

Encode = Callable[[Sequence[Annotation]], Iterable[bytes]]
"""Encodes the annotations of frames: one message per frame, in order."""


def encoder_for(encoding: str, *, markers: bool) -> list[tuple[AnnotationChannel, Encode]]:
    """Return the annotation channels for an encoding, each with its encoder.

    An unknown encoding is replaced by JSON. ``markers`` adds a channel for RViz, for ROS only.
    """
    return ENCODERS.get(encoding, _json)(markers)


def _cdr(markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # one way to call
    return _ros(RosMessages(ros1=False), "cdr", "ros2msg", markers)


def _ros1(markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # the same
    return _ros(RosMessages(ros1=True), "ros1", "ros1msg", markers)


def _ros(
    ros: RosMessages,
    encoding: str,
    schema_encoding: str,
    markers: bool,  # noqa: FBT001  # the same
) -> list[tuple[AnnotationChannel, Encode]]:
    kinds = {DETECTIONS: ros.detections, SCENE: ros.scene}
    if markers:
        kinds[MARKERS] = ros.markers
    return [
        (
            AnnotationChannel(
                topic,
                encoding,
                message.name.replace("/msg/", "/") if ros.ros1 else message.name,
                schema_encoding,
                ros.definition(message.name),
            ),
            partial(_serialized, ros, message),
        )
        for topic, message in kinds.items()
    ]


def _serialized(
    ros: RosMessages, message: ArrayMessage, annotations: Iterable[Annotation]
) -> Iterator[bytes]:
    return (ros.serialize(message.make(one), message.name) for one in annotations)


def _json(_markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # the same
    schema = files("shapecat.schemas").joinpath("SceneUpdate.json").read_bytes()
    channel = AnnotationChannel(SCENE, "json", "foxglove.SceneUpdate", "jsonschema", schema)
    return [
        (channel, lambda some: (json.dumps(_plain_scene(a, _JSON)).encode() for a in some)),
    ]


def _protobuf(_markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # the same
    name = "foxglove.SceneUpdate"
    channel = AnnotationChannel(SCENE, "protobuf", name, "protobuf", descriptors_of(name))
    return [
        (channel, lambda some: (encode_foxglove(_plain_scene(a, _PROTOBUF), name) for a in some)),
    ]


ENCODERS: dict[str, Callable[[bool], list[tuple[AnnotationChannel, Encode]]]] = {
    "cdr": _cdr,
    "ros1": _ros1,
    "json": _json,
    "protobuf": _protobuf,
}
"""Annotation channels by the encoding of the source: files with mixed encodings break ROS tools."""


_JSON = ("sec", "nsec")
_PROTOBUF = ("seconds", "nanos")
"""Names of the two fields of a time."""


def _plain_scene(annotation: Annotation, parts: tuple[str, str]) -> dict[str, Any]:
    """Return a foxglove.SceneUpdate as plain values; ``parts`` names the fields of a time."""
    frame = annotation.frame
    time, lifetime = (
        dict(zip(parts, divmod(value, 10**9), strict=True))
        for value in (frame.stamp_ns, annotation.lifetime_ns)
    )
    return {
        "deletions": [
            {"timestamp": time, "type": 0, "id": entity_id(track)} for track in annotation.gone
        ],
        "entities": [_plain_entity(box, frame, time, lifetime) for box in frame.objects],
    }


def _plain_entity(box: ShownBox, frame: ShownFrame, time: Any, lifetime: Any) -> dict[str, Any]:
    pose = {
        "position": _plain("xyz", box.center),
        "orientation": _plain("xyzw", box.orientation),
    }
    text_pose = {
        "position": _plain("xyz", text_position(*box[3:])),
        "orientation": _plain("xyzw", (0.0, 0.0, 0.0, 1.0)),
    }
    colour = [part / 255 for part in colour_of(box.category)]
    return {
        "timestamp": time,
        "frame_id": frame.frame_id,
        "id": entity_id(box.track),
        "lifetime": lifetime,
        "frame_locked": False,
        "metadata": [{"key": key, "value": value} for key, value in properties(box).items()],
        "arrows": [],
        "cubes": [
            {
                "pose": pose,
                "size": _plain("xyz", box.size),
                "color": _plain("rgba", (*colour, 0.5)),
            }
        ],
        "spheres": [],
        "cylinders": [],
        "lines": [],
        "triangles": [],
        "texts": [
            {
                "pose": text_pose,
                "billboard": True,
                "font_size": 0.03,
                "scale_invariant": False,
                "color": _plain("rgba", (*colour, 1.0)),
                "text": text(box),
            }
        ],
        "models": [],
    }


def _plain(names: str, values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))
