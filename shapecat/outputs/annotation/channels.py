"""Annotation channels for each message encoding."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from shapecat.outputs.annotation.content import (
    Annotation,
    Encoders,
    entity_id,
    properties,
    text,
    text_position,
)
from shapecat.outputs.annotation.foxglove_encoders import json_encoder, protobuf_encoder
from shapecat.outputs.annotation.ros_annotations import RosMessages
from shapecat.outputs.colours import colour_of
from shapecat.types import AnnotationBox, AnnotationFrame

__all__ = ["ENCODERS", "encoder_for"]

DETECTIONS = "/shapecat/detections"
SCENE = "/shapecat/scene"
MARKERS = "/shapecat/markers"


def encoder_for(encoding: str, *, markers: bool) -> Encoders[Annotation]:
    """Return the annotation channels for an encoding, each with its encoder.

    An unknown encoding is replaced by JSON. ``markers`` adds a channel for RViz, for ROS only.
    """
    encoders = ENCODERS.get(encoding, ENCODERS["json"])()
    return [
        (channel, encode) for channel, encode in encoders if markers or channel.topic != MARKERS
    ]


def _ros(*, ros1: bool) -> Encoders[Annotation]:
    ros = RosMessages(ros1=ros1)
    return [
        ros.encoder(DETECTIONS, "vision_msgs/msg/Detection3DArray", ros.detections),
        ros.encoder(SCENE, "foxglove_msgs/msg/SceneUpdate", ros.scene),
        ros.encoder(MARKERS, "visualization_msgs/msg/MarkerArray", ros.markers),
    ]


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


def _plain_entity(
    box: AnnotationBox, frame: AnnotationFrame, time: Any, lifetime: Any
) -> dict[str, Any]:
    pose = {
        "position": _plain("xyz", box.center),
        "orientation": _plain("xyzw", box.orientation),
    }
    text_pose = {
        "position": _plain("xyz", text_position(box)),
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


_SCENE = (SCENE, "foxglove.SceneUpdate", _plain_scene)
ENCODERS: dict[str, Callable[[], Encoders[Annotation]]] = {
    "cdr": partial(_ros, ros1=False),
    "ros1": partial(_ros, ros1=True),
    "json": partial(json_encoder, *_SCENE),
    "protobuf": partial(protobuf_encoder, *_SCENE),
}
"""Annotation channels by the encoding of the source: files with mixed encodings break ROS tools."""
