"""The boxes of a frame as messages: detections, a scene, and markers."""

from typing import Any

from shapecat.outputs.annotation.content import Annotation, Encoders
from shapecat.outputs.annotation.encoders import MessageKind, Types, encoders_of
from shapecat.outputs.colours import colour_of
from shapecat.outputs.wording import caption
from shapecat.types import AnnotationBox

__all__ = ["annotation_encoders", "text_position"]


def annotation_encoders(encoding: str, *, markers: bool) -> Encoders[Annotation]:
    """Return the annotation channels for an encoding, each with its encoder.

    An unknown encoding is replaced by JSON. ``markers`` adds a channel for RViz if the encoding
    is a ROS encoding.
    """
    kinds = [
        MessageKind("/shapecat/detections", "vision_msgs/msg/Detection3DArray", _detections),
        MessageKind("/shapecat/scene", "foxglove.SceneUpdate", _scene),
    ]
    if markers:
        kinds.append(
            MessageKind("/shapecat/markers", "visualization_msgs/msg/MarkerArray", _markers)
        )
    return encoders_of(encoding, kinds)


def _detections(annotation: Annotation, t: Types) -> Any:
    header = _header(annotation, t)
    detections = []
    for box in annotation.frame.objects:
        pose = _pose(box, t)
        label = t["ObjectHypothesis"](class_id=box.category, score=float(box.confidence))
        place = t["PoseWithCovariance"](pose=pose)
        result = t["ObjectHypothesisWithPose"](hypothesis=label, pose=place)
        bounds = t["BoundingBox3D"](center=pose, size=_size(box, t))
        detections.append(
            t["Detection3D"](header=header, results=[result], bbox=bounds, id=str(box.track))
        )
    return t["Detection3DArray"](header=header, detections=detections)


def _scene(annotation: Annotation, t: Types) -> Any:
    frame, time = annotation.frame, t["Time"](annotation.frame.stamp_ns)
    deletions = [
        t["SceneEntityDeletion"](timestamp=time, type=0, id=_entity_id(track))
        for track in annotation.gone
    ]
    lifetime = t["Time"](annotation.lifetime_ns)
    shared = {"timestamp": time, "frame_id": frame.frame_id, "lifetime": lifetime}
    entities = [
        t["SceneEntity"](
            **shared,
            id=_entity_id(box.track),
            frame_locked=False,
            metadata=_properties(box, t),
            arrows=[],
            cubes=[_cube(box, t)],
            spheres=[],
            cylinders=[],
            lines=[],
            triangles=[],
            texts=[_words(box, t)],
            models=[],
        )
        for box in frame.objects
    ]
    return t["SceneUpdate"](deletions=deletions, entities=entities)


def _entity_id(track: int) -> str:
    return f"track-{track}"


def _properties(box: AnnotationBox, t: Types) -> list[Any]:
    values = {
        "category": box.category,
        "confidence": f"{box.confidence:.4f}",
        "track": str(box.track),
    }
    return [t["KeyValuePair"](key=key, value=value) for key, value in values.items()]


def _caption(box: AnnotationBox) -> str:
    return caption(box.track, box.category, box.confidence)


def _cube(box: AnnotationBox, t: Types) -> Any:
    colour = _colour("Color", box, 0.5, t)
    return t["CubePrimitive"](pose=_pose(box, t), size=_size(box, t), color=colour)


def _words(box: AnnotationBox, t: Types) -> Any:
    return t["TextPrimitive"](
        pose=_text_pose(box, t),
        billboard=True,
        font_size=0.03,
        scale_invariant=False,
        color=_colour("Color", box, 1.0, t),
        text=_caption(box),
    )


def _markers(annotation: Annotation, t: Types) -> Any:
    """Make a cube and a text for each object; delete those of the tracks that are gone."""
    header, lifetime = _header(annotation, t), t["Time"](annotation.lifetime_ns)

    def marker(kind: str, track: int, **fields: Any) -> Any:
        name, number = f"shapecat/{kind}", 1 if kind == "box" else 9
        place = {"header": header, "ns": name, "id": track, "type": number}
        return t["Marker"](**place, lifetime=lifetime, **fields)

    nowhere = t["Pose"](position=t["Point"](x=0.0, y=0.0, z=0.0), orientation=_upright(t))
    markers = [
        marker(kind, track, action=2, pose=nowhere)
        for track in annotation.gone
        for kind in ("box", "text")
    ]
    height = t["Vector3"](x=0.0, y=0.0, z=0.03)
    for box in annotation.frame.objects:
        pale, full = (_colour("ColorRGBA", box, alpha, t) for alpha in (0.5, 1.0))
        cube = {"pose": _pose(box, t), "scale": _size(box, t), "color": pale}
        words = {"pose": _text_pose(box, t), "scale": height, "color": full, "text": _caption(box)}
        markers += [marker("box", box.track, **cube), marker("text", box.track, **words)]
    return t["MarkerArray"](markers=markers)


def _header(annotation: Annotation, t: Types) -> Any:
    frame = annotation.frame
    return t["Header"](stamp=t["Time"](frame.stamp_ns), frame_id=frame.frame_id)


def _pose(box: AnnotationBox, t: Types) -> Any:
    (x, y, z), (qx, qy, qz, qw) = box.center, box.orientation
    orientation = t["Quaternion"](x=qx, y=qy, z=qz, w=qw)
    return t["Pose"](position=t["Point"](x=x, y=y, z=z), orientation=orientation)


def _text_pose(box: AnnotationBox, t: Types) -> Any:
    x, y, z = text_position(box)
    return t["Pose"](position=t["Point"](x=x, y=y, z=z), orientation=_upright(t))


def _upright(t: Types) -> Any:
    return t["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)


def _size(box: AnnotationBox, t: Types) -> Any:
    x, y, z = box.size
    return t["Vector3"](x=x, y=y, z=z)


def _colour(kind: str, box: AnnotationBox, alpha: float, t: Types) -> Any:
    red, green, blue = colour_of(box.category)
    return t[kind](r=red / 255, g=green / 255, b=blue / 255, a=alpha)


def text_position(box: AnnotationBox) -> tuple[float, float, float]:
    """Return the position (x, y, z) of the text just above a box, metres, sensor frame."""
    x, y, z = box.center
    qx, qy, qz, qw = box.orientation
    rise = box.size[2] / 2 + 0.03
    # The z axis of the box: the third column of its rotation matrix.
    up = (2 * (qx * qz + qw * qy), 2 * (qy * qz - qw * qx), 1 - 2 * (qx * qx + qy * qy))
    return x + rise * up[0], y + rise * up[1], z + rise * up[2]
