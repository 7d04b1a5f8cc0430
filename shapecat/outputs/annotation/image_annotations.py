"""Annotations of colour images, for each message encoding."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from shapecat.colour.image_masks import box_of
from shapecat.outputs.annotation.content import Encoders
from shapecat.outputs.annotation.encoders import MessageKind, Types, encoders_of
from shapecat.outputs.colours import colour_of
from shapecat.outputs.wording import caption
from shapecat.runs.labelled_tracks import LabelledTracks
from shapecat.runs.tables.masks import read_nearest_masks

__all__ = ["ImageBox", "ImageFrame", "image_encoders_for", "read_image_frames"]

_LINE_LOOP = 2  # ``type`` of a closed PointsAnnotation


class ImageBox(NamedTuple):
    """An object in an image; ``box`` is its left, top, width and height in pixels."""

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
        """The corners (x, y) of the box in pixels, clockwise from the top left."""
        left, top, width, height = (float(value) for value in self.box)
        right, bottom = left + width, top + height
        return [(left, top), (right, top), (right, bottom), (left, bottom)]


class ImageFrame(NamedTuple):
    """An image and the objects in it."""

    topic: str
    stamp_ns: int
    log_time_ns: int
    frame_id: str
    boxes: tuple[ImageBox, ...]


def read_image_frames(folder: Path, tracks: LabelledTracks) -> Iterator[ImageFrame]:
    """Yield each colour image of a run once, with the objects of the frame nearest to it in time.

    Objects without a mask on the image are left out, and so are images of a single row, the colours
    of unorganized clouds.
    """
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

    If there are several topics, the name of each channel ends in the topic of its images, since
    viewers draw all messages of a channel on one image. An unknown encoding is replaced by JSON.
    """
    names, found = list(topics), {}
    for name in names:
        suffix = f"/{name.strip('/')}" if len(names) > 1 else ""
        boxes, drawn = f"/shapecat/detections_2d{suffix}", f"/shapecat/image_annotations{suffix}"
        kinds = [
            MessageKind(boxes, "vision_msgs/msg/Detection2DArray", _detections),
            MessageKind(drawn, "foxglove.ImageAnnotations", _drawn),
        ]
        found[name] = encoders_of(encoding, kinds)
    return found


def _detections(frame: ImageFrame, t: Types) -> Any:
    header = t["Header"](stamp=t["Time"](frame.stamp_ns), frame_id=frame.frame_id)
    turn = t["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    nowhere = t["Pose"](position=t["Point"](x=0.0, y=0.0, z=0.0), orientation=turn)
    no_pose = t["PoseWithCovariance"](pose=nowhere)
    detections = []
    for one in frame.boxes:
        left, top, width, height = (float(value) for value in one.box)
        label = t["ObjectHypothesis"](class_id=one.category, score=float(one.confidence))
        result = t["ObjectHypothesisWithPose"](hypothesis=label, pose=no_pose)
        middle = t["Pose2D"](position=t["Point2D"](x=left + width / 2, y=top + height / 2))
        bounds = t["BoundingBox2D"](center=middle, size_x=width, size_y=height)
        detections.append(
            t["Detection2D"](header=header, results=[result], bbox=bounds, id=str(one.track))
        )
    return t["Detection2DArray"](header=header, detections=detections)


def _drawn(frame: ImageFrame, t: Types) -> Any:
    time = t["Time"](frame.stamp_ns)
    white = t["Color"](r=1.0, g=1.0, b=1.0, a=1.0)
    points, texts = [], []
    for box in frame.boxes:
        red, green, blue = (part / 255 for part in colour_of(box.category))
        line, fill, behind = (
            t["Color"](r=red, g=green, b=blue, a=alpha) for alpha in (1.0, 0.15, 0.7)
        )
        corners = [t["Point2"](x=x, y=y) for x, y in box.corners]
        points.append(
            t["PointsAnnotation"](
                timestamp=time,
                type=_LINE_LOOP,
                points=corners,
                outline_color=line,
                outline_colors=[],
                fill_color=fill,
                thickness=2.0,
            )
        )
        texts.append(
            t["TextAnnotation"](
                timestamp=time,
                position=corners[0],
                text=box.text,
                font_size=float(min(max(box.box[3] / 6, 10), 18)),
                text_color=white,
                background_color=behind,
            )
        )
    return t["ImageAnnotations"](circles=[], points=points, texts=texts)
