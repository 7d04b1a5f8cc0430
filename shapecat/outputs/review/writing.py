"""``review.rrd``: a run as a Rerun recording. Only this module and its siblings use Rerun.

Entities
--------
::

    world                      the fixed frame, with its handedness and up, if there is one
    ├── paths/<topic>          paths of the tracks (below <topic> without a fixed frame)
    ├── <topic>                the sensor: fixed_from_sensor, in every frame
    │   ├── camera             pinhole, for depth images
    │   └── objects
    │       ├── boxes          labelled "#track category confidence"
    │       └── captions       shorter, drawn above the boxes
    └── seen/<topic>           pose of the sensor when the scene below was drawn
        ├── scene              points on no object
        ├── planes             outlines;  planes/fill  translucent
        └── objects
            ├── points         in the colour of the category
            ├── full           boxes of the whole objects, dashed
            ├── graphs         edges of the growing neural gas
            └── surfaces       triangles of the growing neural gas
    images/<topic>             the colour image of a scene, as recorded if compressed
    ├── masks                  the pixels of each object, translucent in the colour of the category
    ├── boxes                  around the masks
    └── captions               labelled as in 3D
    tracks/<n>/posterior       fused posterior up to each frame, a line per category
    plots/objects/<category>   objects in view; plots/objects/<topic>/<category> if several topics
    plots/seconds/<stage>      time spent on each frame
    log                        starts and ends of tracks, warnings of the run
    run                        run.json as text

A scene is drawn up to eleven times a second, if it changes. Without a fixed frame, it is below
``world/<topic>``. Timelines: ``sensor_time`` (the stamp) and ``frame``.
"""

import json
import uuid
from collections import Counter
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
import rerun as rr

from shapecat.arrays import F8
from shapecat.geometry import IDENTITY, transform
from shapecat.outputs.colours import colour_of
from shapecat.outputs.review import shapes
from shapecat.outputs.review.clouds import PaintedCloud, paint
from shapecat.outputs.review.columns import Columns, Drawing, curve
from shapecat.outputs.review.file import forget_reviews, open_review
from shapecat.outputs.review.images import Images
from shapecat.outputs.review.layout import (
    Eye,
    TrackView,
    choose_eye,
    lay_out,
    send_layout,
    stepped_back,
)
from shapecat.outputs.review.paths import Paths
from shapecat.outputs.review.scenes import ReviewFrame
from shapecat.outputs.review.shapes import POSES, SCENE, SKETCH, DrawnScene
from shapecat.recordings import MessageError
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.run_info import RunInfo
from shapecat.types import Camera, Frame, LabelledFrame, Pose

__all__ = ["write_review"]

_FLUSH_FRAMES = 32  # frames written between two flushes


def write_review(
    path: Path,
    frames: Iterable[ReviewFrame],
    *,
    name: str,
    run: RunInfo,
    labels: Mapping[int, TrackLabel],
) -> None:
    """Write a run as a Rerun recording with its layout embedded.

    Parameters
    ----------
    path : the file; it appears when complete and replaces an older one.
    frames : all frames in the order of the recording, with points if their scene is drawn.
    name : name of the recording in the viewer.
    run : the content of run.json.
    labels : the final label of each track; other labels give another recording id.

    Raises
    ------
    OutputError : the file cannot be written.

    Notes
    -----
    The content depends only on the arguments. Memory does not grow with the number of frames,
    except for some numbers per track.
    """
    forget_reviews()
    stream = _stream(name, run, labels)
    with open_review(path, stream) as file:
        stream.send_recording_name(name)
        review = _Review(stream, run)
        for k, frame in enumerate(frames):
            file.check()
            review.add(frame)
            if k % _FLUSH_FRAMES == _FLUSH_FRAMES - 1:
                file.flush()
        review.end()
        file.flush()


def _stream(name: str, run: RunInfo, labels: Mapping[int, TrackLabel]) -> rr.RecordingStream:
    """Return a stream without log times, whose ids are hashes of the arguments.

    A viewer merges files with the same recording id, and has one layout per application id.
    """
    content = json.dumps([name, run, sorted(labels.items())], sort_keys=True, default=str)
    identity = uuid.uuid5(uuid.NAMESPACE_OID, content)
    application = f"shapecat-{identity.hex[:8]}"
    stream = rr.RecordingStream(application, recording_id=identity, send_properties=False)
    stream.set_log_time_enabled(False)
    return stream


class _Review:
    """Writes a review frame by frame, and keeps the data for its layout and paths."""

    def __init__(self, stream: rr.RecordingStream, run: RunInfo) -> None:
        """Write the data that do not change over time."""
        self._stream, self._columns = stream, Columns(stream)
        self._log = stream.log
        self._limit = run["settings"]["outputs"]["cloud_points"]
        categories = run["model"]["categories"]
        colours = [colour_of(category) for category in categories]
        widths, sizes = [1.5] * len(categories), [4.0] * len(categories)
        lines = rr.SeriesLines(names=categories, colors=colours, widths=widths)
        self._posterior = Drawing(curve, lines)
        self._dots = rr.SeriesPoints(names=categories, colors=colours, marker_sizes=sizes)
        self._fixed_frame = run["fixed_frame"]
        self._eyes: dict[str, Eye] = {}
        # Bounds of objects in the fixed frame.
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._cameras: dict[str, Camera] = {}
        self._tracks: dict[int, TrackView] = {}
        self._aimed: set[str] = set()  # topics whose eye was chosen with an object in view
        self._paths = Paths(self._columns)
        self._images = Images(self._columns)
        self._counted: dict[str, dict[str, None]] = {}  # categories so far of each topic, in order
        self._several = len(run["options"]["topics"]) > 1
        self._warnings = run["warnings"]
        text = rr.TextDocument(shapes.markdown(run), media_type="text/markdown")
        self._log("run", text, static=True)
        if self._fixed_frame is not None:
            self._log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def add(self, chosen: ReviewFrame) -> None:
        """Write one frame."""
        labelled, frame, _ = chosen
        entity = rr.new_entity_path(["world", labelled.topic])
        self._stream.set_time("sensor_time", timestamp=np.datetime64(labelled.stamp_ns, "ns"))
        self._stream.set_time("frame", sequence=labelled.index)
        if frame is not None:
            self._place_sensor(entity, labelled, frame)
            self._draw_scene(entity, labelled, *self._paint(chosen, frame))
        at, pose = (labelled.stamp_ns, labelled.index), self._pose(labelled)
        if pose is not None:
            self._columns.add(entity, at, pose, POSES)
        sketch = shapes.sketch(labelled)
        for name, drawing in SKETCH.items():
            self._columns.add(f"{entity}/{name}", at, sketch, drawing, size=64)
        self._trace(entity, labelled)
        self._log_events(labelled)
        self._plot(labelled)

    def _paint(self, chosen: ReviewFrame, frame: Frame) -> tuple[PaintedCloud, PaintedCloud]:
        """Write the colour image; return the points on no object and those on objects.

        If the image is damaged, a warning is written, and the points have no true colours.
        """
        labelled, coloured = chosen.labelled, chosen.coloured
        parts = (labelled.planes, labelled.objects)
        if coloured is not None:
            try:
                clouds = paint(frame, *parts, limit=self._limit, view=coloured.view)
                self._images.add(labelled, coloured)
            except MessageError as error:
                text = f"{coloured.view.image.topic}: {error}"
                self._log("log", rr.TextLog(text, level="WARN"))
            else:
                return clouds
        return paint(frame, *parts, limit=self._limit)

    def end(self) -> None:
        """Write the remaining rows and the layout."""
        self._columns.send()
        world = "/world"
        scenes = [
            (world if self._fixed_frame else entity, self._fixed_frame or topic, eye)
            for topic, eye in self._eyes.items()
            for entity in [rr.new_entity_path(["world", topic])]
        ]
        if self._fixed_frame:
            scenes = [
                (entity, title, stepped_back(eye, self._low, self._high))
                for entity, title, eye in scenes[:1]
            ]
        nothing = (world, "no frame", Eye(np.ones(3), np.zeros(3), np.array([0.0, 0.0, 1.0])))
        tracks = [self._tracks[number] for number in sorted(self._tracks)]
        for track in tracks:
            if track.frames == 1:  # a line with one point is invisible
                self._log(f"{track.entity}/posterior", self._dots, static=True)
        images = self._images.entities
        send_layout(self._stream, lay_out(scenes or [nothing], tracks, images))

    def _draw_scene(
        self, entity: str, labelled: LabelledFrame, rest: PaintedCloud, points: PaintedCloud
    ) -> None:
        at = (labelled.stamp_ns, labelled.index)
        if self._fixed_frame is not None:
            entity = rr.new_entity_path(["world", "seen", labelled.topic])
            self._columns.add(entity, at, self._pose(labelled) or IDENTITY, POSES)
        scene = DrawnScene(labelled, rest, points)
        for name, drawing in SCENE.items():
            self._columns.add(f"{entity}/{name}", at, scene, drawing, size=scene.size)

    def _place_sensor(self, entity: str, labelled: LabelledFrame, frame: Frame) -> None:
        """Write the axes and frustum of the sensor if they are new, and choose the topic's eye.

        The eye is chosen at the first drawn frame, and again at the first one with objects.
        """
        topic = labelled.topic
        if topic not in self._eyes or (labelled.objects and topic not in self._aimed):
            self._eyes[topic] = choose_eye(labelled, frame, fixed=self._fixed_frame is not None)
            self._log(entity, _axes(frame, self._eyes[topic]), static=True)
        if labelled.objects:
            self._aimed.add(topic)
        if frame.camera is not None and frame.camera != self._cameras.get(topic):
            self._cameras[topic] = frame.camera
            self._log(f"{entity}/camera", shapes.pinhole(frame.camera))

    def _pose(self, labelled: LabelledFrame) -> Pose | None:
        return None if self._fixed_frame is None else labelled.fixed_from_sensor

    def _trace(self, entity: str, labelled: LabelledFrame) -> None:
        """Extend the paths of the tracks, unless the pose in the fixed frame is unknown."""
        pose = self._pose(labelled)
        positions: dict[int, tuple[str, F8]] = {}
        if pose is not None or self._fixed_frame is None:
            for item in labelled.objects:
                place: F8 = np.asarray((item.full or item.box).center, np.float64)
                positions[item.track] = (
                    item.category,
                    place if pose is None else transform(pose, place),
                )
        if self._fixed_frame is not None:
            entity = "world"
            for _, place in positions.values():
                self._low = np.minimum(self._low, place)
                self._high = np.maximum(self._high, place)
        where = f"{entity}/paths/{rr.escape_entity_path_part(labelled.topic)}"
        self._paths.add(where, (labelled.stamp_ns, labelled.index), positions, labelled.ended)

    def _log_events(self, labelled: LabelledFrame) -> None:
        for text in self._warnings:
            self._log("log", rr.TextLog(text, level="WARN"))
        self._warnings = []
        for item in labelled.objects:
            if item.track not in self._tracks:
                track = TrackView(f"/tracks/{item.track}", shapes.label(item))
                self._tracks[item.track] = track
                self._log("log", rr.TextLog(f"{shapes.label(item)} appears", level="INFO"))
        for number in labelled.ended:
            title = self._tracks[number].title if number in self._tracks else f"#{number}"
            self._log("log", rr.TextLog(f"{title} disappears", level="INFO"))

    def _plot(self, labelled: LabelledFrame) -> None:
        at = (labelled.stamp_ns, labelled.index)
        for item in labelled.objects:
            track = self._tracks[item.track]
            track.frames += 1
            self._columns.add(f"{track.entity}/posterior", at, item.causal, self._posterior)
        counts = Counter(item.category for item in labelled.objects)
        counted = self._counted.setdefault(labelled.topic, {})
        counted.update(dict.fromkeys(counts))
        group, sensor = "/plots/objects", ""
        if self._several:
            sensor = f" {labelled.topic}"
            group += f"/{rr.escape_entity_path_part(labelled.topic)}"
        for category in counted:
            entity = f"{group}/{rr.escape_entity_path_part(category)}"
            self._columns.add(entity, at, [counts[category]], _count(category, sensor))
        for stage, seconds in labelled.seconds.items():
            entity = f"/plots/seconds/{rr.escape_entity_path_part(stage)}"
            self._columns.add(entity, at, [seconds], _seconds(stage))


@cache
def _count(category: str, sensor: str) -> Drawing:
    """Return the step plot of a count; ``category + sensor`` is the name of its line."""
    style = rr.SeriesLines(
        names=category + sensor,
        colors=colour_of(category),
        widths=2,
        interpolation_mode=rr.components.InterpolationMode.StepAfter,
    )
    return Drawing(curve, style)


@cache
def _seconds(stage: str) -> Drawing:
    return Drawing(curve, rr.SeriesLines(names=stage, widths=2))


def _axes(frame: Frame, eye: Eye) -> rr.ViewCoordinates:
    """Return the axes of the sensor: optical for images and for up along -y, else z up."""
    optical = frame.organized or eye.up[1] < -0.7
    return rr.ViewCoordinates.RDF if optical else rr.ViewCoordinates.RIGHT_HAND_Z_UP
