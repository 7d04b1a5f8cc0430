"""The pictures of a report: the best view of each track, and a strip of frames with boxes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.errors import RecordingError, ShapecatError
from shapecat.geometry import level_from_sensor, transform
from shapecat.outputs.colouring import Coloured, with_colour
from shapecat.outputs.colours import colour_of
from shapecat.outputs.level_clouds import support_offset
from shapecat.outputs.report.choosing import Choice
from shapecat.outputs.report.images import (
    Crop,
    FramePicture,
    crop_of,
    encode,
    prepare_picture,
    worth_of,
)
from shapecat.outputs.report.surfaces import MOST_POINTS, Snapshot, SurfaceDrawing, draw
from shapecat.runs.finished import FinishedRun, open_source
from shapecat.runs.labelled_frames import read_labelled_frames
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.types import Frame, LabelledFrame, LabelledObject, NeuralGas

__all__ = ["Pictures", "StripFrame", "TrackPictures", "take_pictures"]


class TrackPictures(NamedTuple):
    """The best view of a track: crop, drawings of the surface, and size of the box in metres.

    ``crop`` is None if the recording cannot be read, or if no pixel shows the object. The box is
    the full box, or the visible box if the full box is unknown.
    """

    crop: Crop | None
    surfaces: tuple[SurfaceDrawing, ...]
    size: tuple[float, float, float]


class StripFrame(NamedTuple):
    """A frame of the overview strip: data URI, size, and time in seconds since the first frame.

    ``boxes`` are left, top, width and height of each track, in pixels of the picture. ``shaded``
    says whether the picture is a shaded depth image instead of a colour image.
    """

    image: str
    width: int
    height: int
    seconds: float
    topic: str
    boxes: Mapping[int, tuple[float, float, float, float]]
    shaded: bool = False


@dataclass(frozen=True)
class Pictures:
    """All pictures of a run.

    ``reason`` says why surfaces are drawn without points; it is empty if they have points.
    """

    tracks: Mapping[int, TrackPictures]
    frames: Sequence[StripFrame]
    reason: str = ""


class _Best(NamedTuple):
    """The best view of a track so far."""

    worth: float
    crop: Crop | None
    shot: Snapshot
    item: LabelledObject


@dataclass
class _Collector:
    """The pictures so far: the best view of each track, and the overview strip."""

    choice: Choice
    best: dict[int, _Best] = field(default_factory=dict)
    frames: list[StripFrame] = field(default_factory=list)

    def add(self, labelled: LabelledFrame, frame: Frame | None, coloured: Coloured | None) -> None:
        """Add a chosen frame; if ``frame`` is None, only the meshes are used."""
        key = (labelled.topic, labelled.index)
        if frame is not None:
            _require_unchanged(labelled, frame)
        image = None if frame is None else prepare_picture(labelled, frame, coloured)
        candidate_tracks = self.choice.candidates.get(key, frozenset())
        for number, item in enumerate(labelled.objects):
            if item.track not in candidate_tracks:
                continue
            worth = 1e-9 * item.indices.size if image is None else worth_of(image, number)
            if item.track not in self.best or worth > self.best[item.track].worth:
                visible = image is not None and image.masks[number].pixels.size > 0
                crop = crop_of(image, number) if image is not None and visible else None
                shot = _snapshot(labelled, frame, item)
                self.best[item.track] = _Best(worth, crop, shot, item)
        if image is not None and key in self.choice.strip:
            self.frames.append(_strip_frame(labelled, image, self.choice.strip[key]))

    def pictures(self, reason: str = "") -> Pictures:
        """Draw the surfaces and return all pictures."""
        tracks = {}
        for track, (_, crop, shot, item) in self.best.items():
            x, y, z = (float(side) for side in (item.full or item.box).size)
            tracks[track] = TrackPictures(crop, draw(shot, colour_of(item.category)), (x, y, z))
        return Pictures(tracks, sorted(self.frames, key=lambda frame: frame.seconds), reason)


def take_pictures(finished: FinishedRun, choice: Choice) -> Pictures:
    """Read the frames of a choice again and make the pictures.

    If the recording cannot be read, tracks get only drawings of their meshes, and there is no
    overview strip. Corrections are not used.
    """
    collector = _Collector(choice)
    advice = "run `shapecat annotate` with --recording PATH first"
    try:
        with open_source(finished.info, advice=advice) as recording:
            for item in with_colour(_frames(finished, choice), recording, finished.info):
                collector.add(*item)
    except ShapecatError as error:
        collector = _Collector(choice)
        for labelled in _frames(finished, choice):
            collector.add(labelled, None, None)
        return collector.pictures(str(error))
    return collector.pictures()


def _frames(finished: FinishedRun, choice: Choice) -> Iterator[LabelledFrame]:
    """Yield the frames of a choice; tracks have their own category, without corrections."""
    rows = finished.table.rows
    labels = {row.track: TrackLabel(row.track, row.category, row.confidence) for row in rows}
    left = set(choice.frames)
    for labelled in read_labelled_frames(finished.folder, labels):
        if (labelled.topic, labelled.index) in left:
            yield labelled
            left.discard((labelled.topic, labelled.index))
        if not left:
            return


def _strip_frame(labelled: LabelledFrame, image: FramePicture, seconds: float) -> StripFrame:
    uri, width, height = encode(image.pixels())
    scale = width / image.shape[1]
    boxes = {
        item.track: (scale * mask.left, scale * mask.top, scale * mask.box[2], scale * mask.box[3])
        for item, mask in zip(labelled.objects, image.masks, strict=True)
        if mask.pixels.size
    }
    shaded = image.colour is None
    return StripFrame(uri, width, height, seconds, labelled.topic, boxes, shaded)


def _snapshot(labelled: LabelledFrame, frame: Frame | None, item: LabelledObject) -> Snapshot:
    """Return the points and mesh of an object in the level frame, with its support at z = 0."""
    points = _points(frame, item)
    neurons, middle = item.gas.neurons, np.asarray([item.box.center])
    body = next(points for points in (points, neurons, middle) if len(points))
    level = level_from_sensor(labelled.up, support_offset(item, labelled.up), body)
    gas = NeuralGas(transform(level, neurons), item.gas.edges)
    return Snapshot(transform(level, points), gas, level.translation)


def _points(frame: Frame | None, item: LabelledObject) -> F4:
    """Return at most `MOST_POINTS` points (n, 3) of an object, metres, sensor frame."""
    if frame is None:
        return np.zeros((0, 3), np.float32)
    return frame.finite_xyz(item.indices[:: 1 + item.indices.size // MOST_POINTS])


def _require_unchanged(labelled: LabelledFrame, frame: Frame) -> None:
    """Check that the pixels or points of all objects exist in a frame.

    Raises
    ------
    RecordingError : the frame is smaller than when it was processed.
    """
    samples = frame.depth.size if frame.depth is not None else len(frame.xyz())
    if any(item.indices.size and item.indices.max() >= samples for item in labelled.objects):
        msg = f"frame {frame.index} of {frame.topic} has changed since it was processed"
        raise RecordingError(msg)
