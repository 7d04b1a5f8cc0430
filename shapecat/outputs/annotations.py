"""What the annotation channels say about a frame, in the encodings of recordings."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from shapecat.outputs.colours import colour_of
from shapecat.outputs.scene_protobuf import encode_scene, scene_descriptors
from shapecat.types import LabelledFrame, LabelledObject

__all__ = ["ENCODERS", "Annotation", "AnnotationChannel", "encoder_for"]

DETECTIONS = "/shapecat/detections"
SCENE = "/shapecat/scene"
MARKERS = "/shapecat/markers"


class AnnotationChannel(NamedTuple):
    """A channel to write: its topic, the encoding of its messages, and its schema."""

    topic: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes
    metadata: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Annotation:
    """A frame to write, how long its entities live, and which tracks it no longer shows."""

    frame: LabelledFrame
    lifetime_ns: int
    gone: tuple[int, ...]


Encode = Callable[[Annotation], bytes | memoryview]


def encoder_for(encoding: str, *, markers: bool) -> list[tuple[AnnotationChannel, Encode]]:
    """Return the annotation channels in an encoding, and how each encodes a frame.

    An encoding that is not known gets JSON.
    """
    return ENCODERS.get(encoding, _json)(markers)


def _cdr(markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # one way to call
    return _ros(_RosMessages(ros1=False), "cdr", "ros2msg", markers)


def _ros1(markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # the same
    return _ros(_RosMessages(ros1=True), "ros1", "ros1msg", markers)


def _ros(
    ros: "_RosMessages",
    encoding: str,
    schema_encoding: str,
    markers: bool,  # noqa: FBT001  # the same
) -> list[tuple[AnnotationChannel, Encode]]:
    kinds: list[tuple[str, str, Callable[[Annotation], Any]]] = [
        (DETECTIONS, "vision_msgs/msg/Detection3DArray", ros.detections),
        (SCENE, "foxglove_msgs/msg/SceneUpdate", ros.scene),
    ]
    if markers:
        kinds.append((MARKERS, "visualization_msgs/msg/MarkerArray", ros.markers))
    return [
        (
            AnnotationChannel(
                topic,
                encoding,
                name.replace("/msg/", "/") if ros.ros1 else name,
                schema_encoding,
                ros.definition(name),
            ),
            lambda annotation, make=make, name=name: ros.serialize(make(annotation), name),  # type: ignore[misc]  # a default binds the loop variable
        )
        for topic, name, make in kinds
    ]


def _json(_markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # the same
    schema = files("shapecat.schemas").joinpath("SceneUpdate.json").read_bytes()
    channel = AnnotationChannel(SCENE, "json", "foxglove.SceneUpdate", "jsonschema", schema)
    return [(channel, lambda annotation: json.dumps(_plain_scene(annotation, _JSON)).encode())]


def _protobuf(_markers: bool) -> list[tuple[AnnotationChannel, Encode]]:  # noqa: FBT001  # the same
    name, schema = "foxglove.SceneUpdate", scene_descriptors()
    channel = AnnotationChannel(SCENE, "protobuf", name, "protobuf", schema)
    return [(channel, lambda annotation: encode_scene(_plain_scene(annotation, _PROTOBUF)))]


ENCODERS: dict[str, Callable[[bool], list[tuple[AnnotationChannel, Encode]]]] = {
    "cdr": _cdr,
    "ros1": _ros1,
    "json": _json,
    "protobuf": _protobuf,
}
"""Annotations by the encoding of the source: files of mixed encodings break ROS tools."""


def _entity_id(track: int) -> str:
    return f"track-{track}"


def _label(item: LabelledObject) -> str:
    return f"track {item.track} {item.category} {item.confidence:.2f}"


def _properties(item: LabelledObject) -> dict[str, str]:
    return {
        "category": item.category,
        "confidence": f"{item.confidence:.4f}",
        "track": str(item.track),
    }


def _above(item: LabelledObject) -> tuple[float, float, float]:
    """Return where the text goes: a little above the top of the box."""
    qx, qy, qz, qw = item.box.orientation.tolist()
    x, y, z = item.box.center.tolist()
    rise = float(item.box.size[2]) / 2 + 0.03
    # The third column of the rotation, in plain numbers: this runs for every object.
    up = (2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy))
    return x + rise * up[0], y + rise * up[1], z + rise * up[2]


class _RosMessages:
    """Builds the ROS messages with the definitions in `shapecat.schemas`."""

    def __init__(self, *, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = _typestore(ros1)
        self.types = {name.rsplit("/", 1)[1]: kind for name, kind in self.store.types.items()}
        self.colours: dict[tuple[str, str, float], Any] = {}
        self.no_covariance = np.zeros(36)
        self.no_indices = np.zeros(0, np.uint32)
        self.no_bytes = np.zeros(0, np.uint8)
        self.upright = self.types["Quaternion"](0.0, 0.0, 0.0, 1.0)

    def definition(self, name: str) -> bytes:
        """Return the definition to embed: that of the store that encodes."""
        text, _ = self.store.generate_msgdef(name, ros_version=1 if self.ros1 else 2)
        return text.encode()

    def serialize(self, message: Any, name: str) -> memoryview:
        """Encode a message."""
        if self.ros1:
            return self.store.serialize_ros1(message, name)
        return self.store.serialize_cdr(message, name)

    def detections(self, annotation: Annotation) -> Any:
        """Make a Detection3DArray."""
        t, frame = self.types, annotation.frame
        header = self._header(frame)
        detections = []
        for item in frame.objects:
            pose = self._pose(item)
            result = t["ObjectHypothesisWithPose"](
                t["ObjectHypothesis"](item.category, float(item.confidence)),
                t["PoseWithCovariance"](pose, self.no_covariance),
            )
            box = t["BoundingBox3D"](pose, self._size(item))
            detections.append(t["Detection3D"](header, [result], box, str(item.track)))
        return t["Detection3DArray"](header, detections)

    def scene(self, annotation: Annotation) -> Any:
        """Make a SceneUpdate."""
        t, frame = self.types, annotation.frame
        time = self._time(frame.stamp_ns)
        lifetime = t["Duration"](*divmod(annotation.lifetime_ns, 10**9))
        deletions = [
            t["SceneEntityDeletion"](time, 0, _entity_id(track)) for track in annotation.gone
        ]
        entities = [
            t["SceneEntity"](
                time,
                frame.frame_id,
                _entity_id(item.track),
                lifetime,
                False,  # noqa: FBT003  # frame_locked: it stays where it was seen
                [t["KeyValuePair"](key, value) for key, value in _properties(item).items()],
                [],
                [t["CubePrimitive"](self._pose(item), self._size(item), self._colour(item, 0.5))],
                *([] for _ in range(4)),
                [self._text(item)],
                [],
            )
            for item in frame.objects
        ]
        return t["SceneUpdate"](deletions, entities)

    def markers(self, annotation: Annotation) -> Any:
        """Make a MarkerArray: a cube and a text for each object."""
        t, frame = self.types, annotation.frame
        header = self._header(frame)
        lifetime = t["Duration"](*divmod(annotation.lifetime_ns, 10**9))
        markers = []
        for track in annotation.gone:
            markers += [self._marker(header, lifetime, kind, track) for kind in ("box", "text")]
        for item in frame.objects:
            markers += [
                self._marker(header, lifetime, kind, item.track, item) for kind in ("box", "text")
            ]
        return t["MarkerArray"](markers)

    def _marker(
        self, header: Any, lifetime: Any, kind: str, track: int, item: LabelledObject | None = None
    ) -> Any:
        t, cube = self.types, kind == "box"
        pose, size = t["Pose"](t["Point"](0.0, 0.0, 0.0), self.upright), t["Vector3"](0.0, 0.0, 0.0)
        colour, text = t["ColorRGBA"](0.0, 0.0, 0.0, 0.0), ""
        if item is not None and cube:
            pose, size, colour = self._pose(item), self._size(item), self._rgba(item, 0.5)
        elif item is not None:
            pose = t["Pose"](t["Point"](*_above(item)), self.upright)
            size, colour, text = t["Vector3"](0.0, 0.0, 0.03), self._rgba(item, 1.0), _label(item)
        values = {
            "header": header,
            "ns": f"shapecat/{kind}",
            "id": track,
            "type": 1 if cube else 9,
            "action": 0 if item is not None else 2,
            "pose": pose,
            "scale": size,
            "color": colour,
            "lifetime": lifetime,
            "frame_locked": False,
            "points": [],
            "colors": [],
            "text": text,
            "mesh_resource": "",
            "mesh_use_embedded_materials": False,
        }
        if not self.ros1:
            empty = t["CompressedImage"](header, "", self.no_bytes)
            mesh = t["MeshFile"]("", self.no_bytes)
            values |= {"texture_resource": "", "texture": empty, "uv_coordinates": []}
            values |= {"mesh_file": mesh}
        return t["Marker"](**values)

    def _time(self, stamp_ns: int) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        return self.types["Time"](min(seconds, 2**31 - 1), nanoseconds)

    def _header(self, frame: LabelledFrame) -> Any:
        values = (self._time(frame.stamp_ns), frame.frame_id)
        return self.types["Header"](*((0, *values) if self.ros1 else values))

    def _pose(self, item: LabelledObject) -> Any:
        t = self.types
        return t["Pose"](
            t["Point"](*item.box.center.tolist()), t["Quaternion"](*item.box.orientation.tolist())
        )

    def _size(self, item: LabelledObject) -> Any:
        return self.types["Vector3"](*item.box.size.tolist())

    def _colour(self, item: LabelledObject, alpha: float) -> Any:
        return self._colour_as("Color", item.category, alpha)

    def _rgba(self, item: LabelledObject, alpha: float) -> Any:
        return self._colour_as("ColorRGBA", item.category, alpha)

    def _colour_as(self, kind: str, category: str, alpha: float) -> Any:
        key = (kind, category, alpha)
        if key not in self.colours:
            parts = (part / 255 for part in colour_of(category))
            self.colours[key] = self.types[kind](*parts, alpha)
        return self.colours[key]

    def _text(self, item: LabelledObject) -> Any:
        t = self.types
        pose = t["Pose"](t["Point"](*_above(item)), self.upright)
        colour = self._colour(item, 1.0)
        return t["TextPrimitive"](pose, True, 0.03, False, colour, _label(item))  # noqa: FBT003  # the order of the definition


@cache
def _typestore(ros1: bool) -> Typestore:  # noqa: FBT001  # a cache key
    store = get_typestore(Stores.EMPTY)
    names = {
        "Detection3DArray": "vision_msgs/msg/Detection3DArray",
        "SceneUpdate": "foxglove_msgs/msg/SceneUpdate",
        "MarkerArray": "visualization_msgs/msg/MarkerArray",
    }
    known = dict(get_typestore(Stores.ROS1_NOETIC).fielddefs) if ros1 else {}
    for file, name in names.items():
        text = files("shapecat.schemas").joinpath(f"{file}.msg").read_text("utf-8")
        types = get_types_from_msg(text, name)
        # ROS 1 has a sequence number in its headers, and simpler markers.
        types = {key: known.get(key, value) for key, value in types.items()}
        store.register({key: value for key, value in types.items() if key not in store.fielddefs})
    return store


_JSON = ("sec", "nsec")
_PROTOBUF = ("seconds", "nanos")
"""What the parts of a time are called."""


def _plain_scene(annotation: Annotation, parts: tuple[str, str]) -> dict[str, Any]:
    """Make a foxglove.SceneUpdate of plain values."""
    frame = annotation.frame
    time, lifetime = (
        dict(zip(parts, divmod(value, 10**9), strict=True))
        for value in (frame.stamp_ns, annotation.lifetime_ns)
    )
    return {
        "deletions": [
            {"timestamp": time, "type": 0, "id": _entity_id(track)} for track in annotation.gone
        ],
        "entities": [_plain_entity(item, frame, time, lifetime) for item in frame.objects],
    }


def _plain_entity(
    item: LabelledObject, frame: LabelledFrame, time: Any, lifetime: Any
) -> dict[str, Any]:
    pose = {
        "position": _plain("xyz", item.box.center.tolist()),
        "orientation": _plain("xyzw", item.box.orientation.tolist()),
    }
    text_pose = {
        "position": _plain("xyz", _above(item)),
        "orientation": _plain("xyzw", (0.0, 0.0, 0.0, 1.0)),
    }
    colour = [part / 255 for part in colour_of(item.category)]
    return {
        "timestamp": time,
        "frame_id": frame.frame_id,
        "id": _entity_id(item.track),
        "lifetime": lifetime,
        "frame_locked": False,
        "metadata": [{"key": key, "value": value} for key, value in _properties(item).items()],
        "arrows": [],
        "cubes": [
            {
                "pose": pose,
                "size": _plain("xyz", item.box.size.tolist()),
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
                "text": _label(item),
            }
        ],
        "models": [],
    }


def _plain(names: str, values: Sequence[float]) -> dict[str, float]:
    return dict(zip(names, values, strict=True))
