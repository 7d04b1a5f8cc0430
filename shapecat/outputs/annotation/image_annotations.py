"""Annotations of colour images, for each message encoding."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from shapecat.colour.image_masks import box_of
from shapecat.outputs.annotation.content import Encoders
from shapecat.outputs.annotation.foxglove_encoders import json_encoder, protobuf_encoder
from shapecat.outputs.annotation.ros_annotations import RosMessages
from shapecat.outputs.colours import colour_of
from shapecat.outputs.wording import caption
from shapecat.runs.labelled_tracks import LabelledTracks
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.tables.masks import read_nearest_masks

__all__ = ["ImageBox", "ImageFrame", "image_encoders_for", "read_image_frames"]

DETECTIONS_2D = "/shapecat/detections_2d"
DRAWN = "/shapecat/image_annotations"
_LINE_LOOP = 2


class ImageBox(NamedTuple):
    """An object on an image: left, top, width and height in pixels."""

    track: int
    category: str
    confidence: float
    box: tuple[int, int, int, int]

    @property
    def text(self) -> str:
        """The text above the box."""
        return caption(self.track, self.category, self.confidence)

    @property
    def corners(self) -> list[tuple[float, float]]:
        """The corners of the box from the top left one clockwise, on the borders of its pixels."""
        left, top, width, height = (float(value) for value in self.box)
        right, bottom = left + width, top + height
        return [(left, top), (right, top), (right, bottom), (left, bottom)]


class ImageFrame(NamedTuple):
    """An image and the objects on it."""

    topic: str
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    boxes: tuple[ImageBox, ...]


def read_image_frames(folder: Path, labels: Mapping[int, TrackLabel]) -> Iterator[ImageFrame]:
    """Yield the annotations of the colour images of a run; see `read_nearest_masks`.

    Unorganized clouds have no colour image.
    """
    tracks = LabelledTracks.read(folder, labels)
    for key, masks in read_nearest_masks(folder):
        if masks.height <= 1:
            continue
        boxes = [
            ImageBox(*label, box)
            for label, rows in tracks.objects(key).items()
            if (box := box_of(masks, tuple(rows))) is not None
        ]
        image = (masks.topic, masks.stamp_ns, masks.log_time_ns, masks.frame_id)
        yield ImageFrame(*image, tuple(boxes))


def image_encoders_for(encoding: str, topics: Iterable[str]) -> dict[str, Encoders[ImageFrame]]:
    """Return the channels that annotate the images of each topic, each with its encoder.

    Channels of several topics are named after these, since viewers draw all messages of a channel
    on an image. An unknown encoding is replaced by JSON.
    """
    encoders, names = _ENCODERS.get(encoding, _ENCODERS["json"]), list(topics)
    several = len(names) > 1
    return {name: encoders(f"/{name.strip('/')}" if several else "") for name in names}


def _ros(of_topic: str, *, ros1: bool) -> Encoders[ImageFrame]:
    ros, array_type = RosMessages(ros1=ros1), "vision_msgs/msg/Detection2DArray"
    drawn = "foxglove_msgs/msg/ImageAnnotations"
    return [
        ros.encoder(DETECTIONS_2D + of_topic, array_type, partial(_detections, ros)),
        ros.encoder(DRAWN + of_topic, drawn, partial(_drawn, ros)),
    ]


def _font_size(box: ImageBox) -> float:
    return float(min(max(box.box[3] / 6, 10), 18))


def _plain(frame: ImageFrame, parts: tuple[str, str]) -> dict[str, Any]:
    """Return a foxglove.ImageAnnotations as plain values; ``parts`` names the fields of a time."""
    time = dict(zip(parts, divmod(frame.stamp_ns, 10**9), strict=True))
    points, texts = [], []
    for box in frame.boxes:
        red, green, blue = (part / 255 for part in colour_of(box.category))
        colour = {"r": red, "g": green, "b": blue, "a": 1.0}
        corners = [{"x": x, "y": y} for x, y in box.corners]
        points.append(
            {
                "timestamp": time,
                "type": _LINE_LOOP,
                "points": corners,
                "outline_color": colour,
                "outline_colors": [],
                "fill_color": colour | {"a": 0.15},
                "thickness": 2.0,
            }
        )
        texts.append(
            {
                "timestamp": time,
                "position": corners[0],
                "text": box.text,
                "font_size": _font_size(box),
                "text_color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0},
                "background_color": colour | {"a": 0.7},
            }
        )
    return {"circles": [], "points": points, "texts": texts}


def _detections(ros: RosMessages, frame: ImageFrame) -> Any:
    """Make a vision_msgs/Detection2DArray."""
    header = ros.make("Header", frame)
    detections = []
    for one in frame.boxes:
        left, top, width, height = (float(value) for value in one.box)
        hypothesis = ros.make("ObjectHypothesis", one.category, float(one.confidence))
        result = ros.make("ObjectHypothesisWithPose", hypothesis, ros.no_pose)
        middle = ros.make("Point2D", left + width / 2, top + height / 2)
        bounds = ros.make("BoundingBox2D", ros.make("Pose2D", middle, 0.0), width, height)
        detections.append(ros.make("Detection2D", header, [result], bounds, str(one.track)))
    return ros.make("Detection2DArray", header, detections)


def _drawn(ros: RosMessages, frame: ImageFrame) -> Any:
    """Make a foxglove_msgs/ImageAnnotations."""
    time = ros.make("Header", frame).stamp
    points, texts, white = [], [], ros.make("Color", 1.0, 1.0, 1.0, 1.0)
    for box in frame.boxes:
        line, fill, behind = (
            ros.colour("Color", box.category, alpha) for alpha in (1.0, 0.15, 0.7)
        )
        corners = [ros.make("Point2", x, y) for x, y in box.corners]
        points.append(ros.make("PointsAnnotation", time, _LINE_LOOP, corners, line, [], fill, 2.0))
        written = (corners[0], box.text, _font_size(box), white, behind)
        texts.append(ros.make("TextAnnotation", time, *written))
    return ros.make("ImageAnnotations", [], points, texts)


_NAME = "foxglove.ImageAnnotations"
_ENCODERS: dict[str, Callable[[str], Encoders[ImageFrame]]] = {
    "cdr": partial(_ros, ros1=False),
    "ros1": partial(_ros, ros1=True),
    "json": lambda of_topic: json_encoder(DRAWN + of_topic, _NAME, _plain),
    "protobuf": lambda of_topic: protobuf_encoder(DRAWN + of_topic, _NAME, _plain),
}
