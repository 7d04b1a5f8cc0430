"""Annotations as ROS messages, with the definitions in `shapecat.schemas`."""

from collections.abc import Callable
from functools import cache
from importlib.resources import files
from typing import Any, TypeVar

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from shapecat.outputs.annotation.content import (
    Annotation,
    AnnotationChannel,
    entity_id,
    properties,
    text,
    text_position,
)
from shapecat.outputs.colours import colour_of
from shapecat.types import AnnotationBox

__all__ = ["RosMessages"]

_T = TypeVar("_T")


class RosMessages:
    """Makes and serializes the messages of the annotations, for ROS 1 or ROS 2."""

    def __init__(self, *, ros1: bool) -> None:
        """Prepare the types."""
        self.ros1 = ros1
        self._store = _typestore(ros1)
        self._types = {name.rsplit("/", 1)[1]: kind for name, kind in self._store.types.items()}
        self._no_covariance = np.zeros(36)
        self._no_bytes = np.zeros(0, np.uint8)
        self._upright = self._types["Quaternion"](0.0, 0.0, 0.0, 1.0)
        self._nowhere = self._types["Pose"](self._types["Point"](0.0, 0.0, 0.0), self._upright)
        self.no_pose = self._types["PoseWithCovariance"](self._nowhere, self._no_covariance)
        self._colours: dict[tuple[str, str, float], Any] = {}

    def encoder(
        self, topic: str, name: str, make: Callable[[_T], Any]
    ) -> tuple[AnnotationChannel, Callable[[_T], bytes]]:
        """Return a channel for messages of the type ``name``, and the encoder of those made."""
        encoding, schema = ("ros1", "ros1msg") if self.ros1 else ("cdr", "ros2msg")
        written = name.replace("/msg/", "/") if self.ros1 else name
        channel = AnnotationChannel(topic, encoding, written, schema, _definition(self.ros1, name))
        return channel, lambda frame: self.serialize(make(frame), name)

    def make(self, kind: str, *values: Any) -> Any:
        """Make a message of the type ``kind`` from its fields, or a Header from a frame."""
        if kind == "Header":
            return self._header(*values)
        return self._types[kind](*values)

    def colour(self, kind: str, category: str, alpha: float) -> Any:
        """Return the colour of a category as a ``Color`` or ``ColorRGBA`` message, from a cache."""
        key = kind, category, alpha
        if key not in self._colours:
            tone = (part / 255 for part in colour_of(category))
            self._colours[key] = self._types[kind](*tone, alpha)
        return self._colours[key]

    def serialize(self, message: Any, name: str) -> bytes:
        """Encode a message."""
        if self.ros1:
            return bytes(self._store.serialize_ros1(message, name))
        return bytes(self._store.serialize_cdr(message, name))

    def detections(self, annotation: Annotation) -> Any:
        """Make a vision_msgs/Detection3DArray."""
        items = [self._detection(annotation, box) for box in annotation.frame.objects]
        return self._types["Detection3DArray"](self._header(annotation.frame), items)

    def _detection(self, annotation: Annotation, box: AnnotationBox) -> Any:
        t, pose = self._types, self._pose(box)
        result = t["ObjectHypothesisWithPose"](
            t["ObjectHypothesis"](box.category, float(box.confidence)),
            t["PoseWithCovariance"](pose, self._no_covariance),
        )
        bounds = t["BoundingBox3D"](pose, self._size(box))
        return t["Detection3D"](self._header(annotation.frame), [result], bounds, str(box.track))

    def scene(self, annotation: Annotation) -> Any:
        """Make a foxglove_msgs/SceneUpdate."""
        t, time = self._types, self._time(annotation.frame.stamp_ns)
        deletions = [
            t["SceneEntityDeletion"](time, 0, entity_id(track)) for track in annotation.gone
        ]
        entities = [self._entity(annotation, box) for box in annotation.frame.objects]
        return t["SceneUpdate"](deletions, entities)

    def _entity(self, annotation: Annotation, box: AnnotationBox) -> Any:
        t, frame = self._types, annotation.frame
        cube = t["CubePrimitive"](
            self._pose(box), self._size(box), self.colour("Color", box.category, 0.5)
        )
        return t["SceneEntity"](
            self._time(frame.stamp_ns),
            frame.frame_id,
            entity_id(box.track),
            self._duration(annotation.lifetime_ns),
            False,  # noqa: FBT003  # frame_locked: it stays where it was seen
            [t["KeyValuePair"](key, value) for key, value in properties(box).items()],
            [],
            [cube],
            *([] for _ in range(4)),
            [self._text(box)],
            [],
        )

    def _text(self, box: AnnotationBox) -> Any:
        pose, colour = self._text_pose(box), self.colour("Color", box.category, 1.0)
        return self._types["TextPrimitive"](pose, True, 0.03, False, colour, text(box))  # noqa: FBT003  # the order of the definition

    def markers(self, annotation: Annotation) -> Any:
        """Make a visualization_msgs/MarkerArray: a cube and a text for each object."""
        gone = [
            self._marker(annotation, kind, track, action=2)
            for track in annotation.gone
            for kind in ("box", "text")
        ]
        cubes_and_texts = [
            make(annotation, box)
            for box in annotation.frame.objects
            for make in (self._cube_marker, self._text_marker)
        ]
        return self._types["MarkerArray"](gone + cubes_and_texts)

    def _cube_marker(self, annotation: Annotation, box: AnnotationBox) -> Any:
        geometry = {"pose": self._pose(box), "scale": self._size(box)}
        colour = self.colour("ColorRGBA", box.category, 0.5)
        return self._marker(annotation, "box", box.track, color=colour, **geometry)

    def _text_marker(self, annotation: Annotation, box: AnnotationBox) -> Any:
        geometry = {"pose": self._text_pose(box), "scale": self._types["Vector3"](0.0, 0.0, 0.03)}
        colour = self.colour("ColorRGBA", box.category, 1.0)
        return self._marker(annotation, "text", box.track, color=colour, text=text(box), **geometry)

    def _marker(self, annotation: Annotation, kind: str, number: int, **changes: Any) -> Any:
        t, header = self._types, self._header(annotation.frame)
        values = {
            "header": header,
            "ns": f"shapecat/{kind}",
            "id": number,
            "type": 1 if kind == "box" else 9,
            "action": 0,
            "pose": self._nowhere,
            "scale": t["Vector3"](0.0, 0.0, 0.0),
            "color": t["ColorRGBA"](0.0, 0.0, 0.0, 0.0),
            "lifetime": self._duration(annotation.lifetime_ns),
            "frame_locked": False,
            "points": [],
            "colors": [],
            "text": "",
            "mesh_resource": "",
            "mesh_use_embedded_materials": False,
        }
        if not self.ros1:
            empty = t["CompressedImage"](header, "", self._no_bytes)
            mesh = t["MeshFile"]("", self._no_bytes)
            values |= {"texture_resource": "", "texture": empty, "uv_coordinates": []}
            values |= {"mesh_file": mesh}
        return t["Marker"](**values | changes)

    def _time(self, stamp_ns: int) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        return self._types["Time"](min(seconds, 2**31 - 1), nanoseconds)

    def _duration(self, lifetime_ns: int) -> Any:
        return self._types["Duration"](*divmod(lifetime_ns, 10**9))

    def _header(self, frame: Any) -> Any:
        values = (self._time(frame.stamp_ns), frame.frame_id)
        return self._types["Header"](*((0, *values) if self.ros1 else values))

    def _pose(self, box: AnnotationBox) -> Any:
        t = self._types
        return t["Pose"](t["Point"](*box.center), t["Quaternion"](*box.orientation))

    def _text_pose(self, box: AnnotationBox) -> Any:
        return self._types["Pose"](self._types["Point"](*text_position(box)), self._upright)

    def _size(self, box: AnnotationBox) -> Any:
        return self._types["Vector3"](*box.size)


@cache
def _typestore(ros1: bool) -> Typestore:  # noqa: FBT001  # a cache key
    store = get_typestore(Stores.EMPTY)
    names = {
        "Detection3DArray": "vision_msgs/msg/Detection3DArray",
        "SceneUpdate": "foxglove_msgs/msg/SceneUpdate",
        "MarkerArray": "visualization_msgs/msg/MarkerArray",
        "Detection2DArray": "vision_msgs/msg/Detection2DArray",
        "ImageAnnotations": "foxglove_msgs/msg/ImageAnnotations",
    }
    ros1_types = dict(get_typestore(Stores.ROS1_NOETIC).fielddefs) if ros1 else {}
    for file, name in names.items():
        definition = files("shapecat.schemas").joinpath(f"{file}.msg").read_text("utf-8")
        types = get_types_from_msg(definition, name)
        # ROS 1 has a sequence number in its headers, and simpler markers.
        types = {key: ros1_types.get(key, value) for key, value in types.items()}
        store.register({key: value for key, value in types.items() if key not in store.fielddefs})
    return store


@cache
def _definition(ros1: bool, name: str) -> bytes:  # noqa: FBT001  # the same
    definition, _ = _typestore(ros1).generate_msgdef(name, ros_version=1 if ros1 else 2)
    return definition.encode()
