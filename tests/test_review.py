"""Tests of review.rrd, read back with Rerun's own reader."""

import dataclasses
import errno
import resource
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import rerun as rr
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from shapecat.cameras.colour import ColourImage, ColourView
from shapecat.colour.masks import Mask
from shapecat.errors import OutputError
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.colours import colour_of
from shapecat.outputs.review import layout as review_layout
from shapecat.outputs.review import viewer as review_viewer
from shapecat.outputs.review import writing as review
from shapecat.outputs.review.clouds import paint
from shapecat.outputs.review.columns import At, Columns, Drawing, curve
from shapecat.outputs.review.file import ReviewFile
from shapecat.outputs.review.images import Images
from shapecat.outputs.review.layout import Eye, TrackView, _track_tabs, choose_eye, stepped_back
from shapecat.outputs.review.scenes import ReviewFrame, choose_scenes
from shapecat.outputs.review.shapes import SCENE, markdown, short_label
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.types import Box, Camera, Frame, LabelledFrame, LabelledObject, NeuralGas, Plane, Pose
from tests.processes import alive

CATEGORIES = ("cup", "can")
TOPIC = "/camera/depth"
CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
GAS = NeuralGas(
    np.array([[0, 0, 1], [0.1, 0, 1], [0, 0.1, 1], [0.1, 0.1, 1]]),
    np.array([[0, 1], [0, 2], [1, 2], [1, 3]]),
)
OUTLINE = np.array([[-1, 0.4, 0.5], [1, 0.4, 0.5], [1, 0.4, 2], [-1, 0.4, 2]])
UP = np.array([0, -1, 0])
FLOOR = Plane(UP, -0.4, OUTLINE, 3.0, 0.0)
RERUN = Path(sys.executable).with_name("rerun")


def labelled_object(track: int, category: str = "cup", x: float = 0.0) -> LabelledObject:
    box = Box(np.array([x, 0.1, 1.0]), np.array([0.1, 0.2, 0.3]), np.array([0, 0, 0, 1]))
    first = 64 * 20 + 10 * track
    pixels = np.arange(first, first + 8)
    view, so_far = np.array([0.9, 0.1]), np.array([0.8, 0.2])
    return LabelledObject(track, category, 0.97, box, pixels, GAS, view, so_far)


def image(k: int = 0) -> Frame:
    depth = np.full((48, 64), 1.0, np.float32)
    depth[:, :4] = 0
    return Frame(TOPIC, k, stamp(k), stamp(k), "optical", depth, CAMERA)


def stamp(k: int) -> int:
    return 1_700_000_000_123_456_789 + k * 100_000_001


def scene(
    k: int,
    objects: Iterable[LabelledObject] = (),
    *,
    pose: Pose | None = None,
    ended: tuple[int, ...] = (),
) -> tuple[LabelledFrame, Frame]:
    about = (TOPIC, k, stamp(k), stamp(k), "optical", pose)
    seconds = {"detect": 0.01 * k}
    return LabelledFrame(*about, (FLOOR,), tuple(objects), ended, seconds, UP), image(k)


def write(path: Path, scenes: Iterable[tuple[LabelledFrame, Frame]], **options: Any) -> Path:
    pairs = list(scenes)
    fixed = options.get("run", {}).get("fixed_frame") is not None
    chosen = choose_scenes([labelled for labelled, _ in pairs], fixed=fixed)
    frames = [
        ReviewFrame(labelled, frame if due else None)
        for (labelled, due), (_, frame) in zip(chosen, pairs, strict=True)
    ]
    return write_frames(path, frames, **options)


def write_frames(path: Path, frames: Iterable[ReviewFrame], **options: Any) -> Path:
    run: Any = {
        "warnings": ["no transforms"],
        "counts": {"frames": 3},
        "options": {"topics": [TOPIC]},
        "settings": {"outputs": {"cloud_points": 1000}},
        "model": {"categories": list(CATEGORIES)},
        "fixed_frame": None,
    }
    run |= options.pop("run", {})
    review.write_review(path, frames, **({"name": "lab", "run": run, "labels": {}} | options))
    return path


def test_few_frames_are_held_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is not flushed stays in memory: the frames of hours would fill it."""
    held, flush = [0], ReviewFile.flush

    def flushed(file: ReviewFile) -> None:
        held[0] = 0
        flush(file)

    def frames() -> Iterator[ReviewFrame]:
        for k in range(70):
            assert held[0] < 32
            held[0] += 1
            yield ReviewFrame(scene(k, [labelled_object(1)])[0])

    monkeypatch.setattr(ReviewFile, "flush", flushed)
    write_frames(tmp_path / "review.rrd", frames())

    assert held == [0]


def as_rows(batch: Any) -> list[dict[str, Any]]:
    """Return the rows of a batch, times as nanoseconds: Python's times have only microseconds."""
    names = batch.schema.names
    if "sensor_time" in names:
        k = names.index("sensor_time")
        batch = batch.set_column(k, "sensor_time", batch.column(k).cast("int64"))
    return list(batch.to_pylist())


def rows(path: Path, entity: str) -> list[dict[str, Any]]:
    """Return the rows of an entity of a recording, in the order of frames, without static ones."""
    from rerun.chunk import RrdReader  # noqa: PLC0415  heavy

    chunks = RrdReader(str(path)).stream().to_chunks()
    found = [
        row
        for chunk in chunks
        if str(chunk.entity_path).replace("\\", "") == entity
        for row in as_rows(chunk.to_record_batch())
        if "frame" in row
    ]
    return sorted(found, key=lambda row: row["frame"])


def static(path: Path) -> set[str]:
    """Return the entities with values that hold in all frames."""
    from rerun.chunk import RrdReader  # noqa: PLC0415  heavy

    chunks = RrdReader(str(path)).stream().to_chunks()
    return {
        str(chunk.entity_path).replace("\\", "")
        for chunk in chunks
        if "frame" not in chunk.to_record_batch().schema.names
    }


def scalars(path: Path, entity: str) -> list[list[float]]:
    """Return the values of a curve, without the row of its style."""
    values = [row.get("Scalars:scalars") for row in rows(path, entity)]
    return [value for value in values if value]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write three frames with two objects, one object and none."""
    path = tmp_path_factory.mktemp("review") / "review.rrd"
    scenes = [
        scene(0, [labelled_object(1), labelled_object(2, "can", 0.3)]),
        scene(1, [labelled_object(1, x=0.05)], ended=(2,)),
        scene(2, ended=(1,)),
    ]
    return write(path, scenes)


def test_boxes_match_objects_of_each_frame(recording: Path) -> None:
    """A box must vanish in the frame where its object is gone."""
    boxes = rows(recording, f"/world/{TOPIC}/objects/boxes")
    assert [row["Boxes3D:labels"] for row in boxes] == [
        ["#1 cup 0.97", "#2 can 0.97"],
        ["#1 cup 0.97"],
        [],
    ]


def test_times_are_sensor_stamps_in_nanoseconds(recording: Path) -> None:
    """Wall-clock time would make two runs differ; seconds as floats would lose the nanoseconds."""
    boxes = rows(recording, f"/world/{TOPIC}/objects/boxes")
    assert [row["frame"] for row in boxes] == [0, 1, 2]
    assert [row["sensor_time"] for row in boxes] == [stamp(k) for k in range(3)]
    assert "log_time" not in boxes[0]


def test_posterior_counts_and_times_are_plotted_for_every_frame(recording: Path) -> None:
    assert np.allclose(scalars(recording, "/tracks/1/posterior"), [[0.8, 0.2], [0.8, 0.2]])
    assert scalars(recording, "/plots/objects/cup") == [[1], [1], [0]]
    assert scalars(recording, "/plots/seconds/detect") == [[0], [0.01], [0.02]]


def test_log_has_warnings_and_begin_and_end_of_tracks(recording: Path) -> None:
    texts = [row["TextLog:text"][0] for row in rows(recording, "/log")]
    assert texts == [
        "no transforms",
        "#1 cup 0.97 appears",
        "#2 can 0.97 appears",
        "#2 can 0.97 disappears",
        "#1 cup 0.97 disappears",
    ]


def test_layout_is_embedded_and_file_is_complete(recording: Path) -> None:
    """Without a footer, a file opens slowly; without a layout, as unsorted views."""
    from rerun.chunk import RrdReader  # noqa: PLC0415  heavy

    assert len(RrdReader(str(recording)).blueprints()) == 1
    verified = subprocess.run([RERUN, "rrd", "verify", recording], check=False, capture_output=True)
    assert verified.returncode == 0, verified.stderr


def test_same_run_gives_same_content(tmp_path: Path) -> None:
    scenes = [scene(k, [labelled_object(1)]) for k in range(3)]
    one, two = write(tmp_path / "1.rrd", scenes), write(tmp_path / "2.rrd", scenes)
    compared = subprocess.run([RERUN, "rrd", "compare", one, two], check=False, capture_output=True)
    assert compared.returncode == 0, compared.stderr


def test_reviews_in_one_process_leave_no_threads(tmp_path: Path) -> None:
    """Rerun kept four threads and 3 MB for each review: a batch of thousands ran out of both."""
    threads = []
    for k in range(6):
        write(tmp_path / f"{k}.rrd", [scene(0, [labelled_object(1)])], name=f"lab{k}")
        threads.append(len(list(Path("/proc/self/task").iterdir())))

    # Threads end a little later; four of each review would be 16 more.
    assert threads[5] < threads[1] + 5, threads


def test_recording_of_the_calling_program_stays_active(tmp_path: Path) -> None:
    """The program's own recording was ended, and what it logged later was lost."""
    rr.init("program")
    rr.save(tmp_path / "program.rrd")
    try:
        write(tmp_path / "review.rrd", [scene(0)])
        rr.set_time("frame", sequence=0)
        rr.log("later", rr.Scalars(1.0))
    finally:
        rr.disconnect()
        rr.set_global_data_recording(None)

    assert scalars(tmp_path / "program.rrd", "/later") == [[1.0]]


def stores(path: Path, kind: str) -> list[tuple[str, str]]:
    """Return application and id of the recordings or blueprints in a file."""
    from rerun.chunk import RrdReader  # noqa: PLC0415  heavy

    found = getattr(RrdReader(str(path)), kind)()
    return [(one.application_id, one.recording_id) for one in found]


def test_corrected_review_is_another_recording(tmp_path: Path) -> None:
    """A viewer merges recordings of the same id, so that deleted tracks stayed visible."""
    ids = set()
    for category in ("cup", "can"):
        path = write(tmp_path / category, [scene(0)], labels={1: TrackLabel(1, category, 1.0)})
        ids |= set(stores(path, "recordings"))

    assert len(ids) == 2


def test_layout_is_only_for_its_own_review(tmp_path: Path) -> None:
    """A viewer draws all recordings of an application in the layout that it opened last."""
    found = []
    for k, warnings in enumerate(([], ["no transforms"])):
        path = write(tmp_path / f"{k}.rrd", [scene(0)], run={"warnings": warnings})
        (application, _), *_ = stores(path, "recordings")
        assert {name for name, _ in stores(path, "blueprints")} == {application}
        found.append(application)

    assert found[0] != found[1]


def test_fixed_frame_has_sensor_poses_and_track_paths(tmp_path: Path) -> None:
    poses = [Pose(np.eye(3), np.array([0.1 * k, 0, 0])) for k in range(3)]
    scenes = [scene(k, [labelled_object(1)], pose=pose) for k, pose in enumerate(poses)]
    path = write(tmp_path / "r.rrd", scenes, run={"fixed_frame": "map"})
    translations = [
        row["Transform3D:translation"]
        for row in rows(path, f"/world/{TOPIC}")
        if row.get("Transform3D:translation")
    ]
    assert np.allclose(np.array(translations)[:, 0, 0], [0, 0.1, 0.2])
    track_path = rows(path, f"/world/paths/{TOPIC}")[-1]["LineStrips3D:strips"]
    assert np.allclose(track_path, [[[0, 0.1, 1], [0.1, 0.1, 1], [0.2, 0.1, 1]]])


def test_path_of_track_joins_centres_of_whole_object(tmp_path: Path) -> None:
    """The visible part of an object at rest wanders while the camera moves around it."""
    turns = [Rotation.from_euler("zyx", [0.3 * k, 0.2, -0.7]) for k in range(3)]
    poses = [Pose(turn.as_matrix(), np.array([0.5, 0.1 * k, 1.3])) for k, turn in enumerate(turns)]
    place = np.array([0.2, 0.7, 0.4])  # in the fixed frame
    scenes = []
    for k, pose in enumerate(poses):
        center = turns[k].inv().apply(place - pose.translation)
        seen = labelled_object(1, x=0.3 * k)
        full = Box(center, seen.box.size, np.array([0, 0, 0, 1])) if k else None
        scenes.append(scene(k, [dataclasses.replace(seen, full=full)], pose=pose))
    path = write(tmp_path / "r.rrd", scenes, run={"fixed_frame": "map"})

    first = turns[0].apply([0, 0.1, 1.0]) + poses[0].translation  # only the visible box is known
    (strip,) = rows(path, f"/world/paths/{TOPIC}")[-1]["LineStrips3D:strips"]
    assert np.allclose(strip[0], first, atol=1e-6)
    assert len(strip) > 1
    assert np.allclose(strip[1:], place, atol=1e-6)


def test_path_leaves_out_frame_without_pose(tmp_path: Path) -> None:
    """Positions that are known only in the sensor frame would be drawn at the origin of the map."""
    pose = Pose(Rotation.from_euler("zyx", [0.3, 0.2, -0.7]).as_matrix(), np.array([0.5, 0.1, 1.3]))
    scenes = [
        scene(k, [labelled_object(1, x=0.2 * k)], pose=None if k == 1 else pose) for k in range(3)
    ]
    path = write(tmp_path / "r.rrd", scenes, run={"fixed_frame": "map"})

    (strip,) = rows(path, f"/world/paths/{TOPIC}")[-1]["LineStrips3D:strips"]
    places = [pose.rotation @ [x, 0.1, 1.0] + pose.translation for x in (0.0, 0.4)]
    assert np.allclose(strip, places, atol=1e-6)


def test_frame_without_pose_is_reviewed(tmp_path: Path) -> None:
    """Transforms may be missing at either end of a recording."""
    scenes = [scene(k, [labelled_object(1)]) for k in range(2)]
    path = write(tmp_path / "r.rrd", scenes, run={"fixed_frame": "map"})
    assert len(rows(path, f"/world/{TOPIC}/objects/boxes")) == 2


def drawn_frames(scenes: Iterable[tuple[LabelledFrame, Frame]], *, fixed: bool) -> list[int]:
    chosen = choose_scenes((labelled for labelled, _ in scenes), fixed=fixed)
    return [labelled.index for labelled, due in chosen if due]


def moving_camera(places: Iterable[float]) -> list[tuple[LabelledFrame, Frame]]:
    """Return scenes of an object at given x in the fixed frame, seen by a camera moving along x."""
    poses = [Pose(np.eye(3), np.array([0.1 * k, 0, 0])) for k in range(9)]
    return [
        scene(k, [labelled_object(1, x=x - 0.1 * k)], pose=pose)
        for (k, pose), x in zip(enumerate(poses), places, strict=True)
    ]


def test_recalibrated_camera_is_drawn_again(tmp_path: Path) -> None:
    """After a zoom, the frustum of the first frame would stay."""
    (first, frame), (second, zoomed) = scene(0), scene(1, [labelled_object(1)])
    zoomed = dataclasses.replace(zoomed, camera=dataclasses.replace(CAMERA, fx=80.0))
    path = write(tmp_path / "review.rrd", [(first, frame), (second, zoomed)])

    cameras = rows(path, f"/world/{TOPIC}/camera")
    assert [row["Pinhole:image_from_camera"][0][0] for row in cameras] == [60.0, 80.0]


def test_two_sensors_are_drawn_separately(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames of two equal cameras alternate; neither may replace what is drawn of the other."""
    views: list[tuple[str, str, Eye]] = []

    def lay_out(scenes: Any, *more: Any) -> Any:
        views.extend(scenes)
        return review_layout.lay_out(scenes, *more)

    monkeypatch.setattr(review, "lay_out", lay_out)
    scenes = []
    for k in range(4):
        for side, (topic, track) in enumerate((("/left", 1), ("/right", 2))):
            objects = [labelled_object(track, x=0.1 * k + side)] if 0 < k < 3 else ()
            labelled, frame = scene(k, objects, ended=(track,) if k == 3 else ())
            late = dataclasses.replace(labelled, topic=topic, stamp_ns=stamp(k) + side * 40_000_000)
            scenes.append((late, dataclasses.replace(frame, topic=topic)))
    due = [due for _, due in choose_scenes((labelled for labelled, _ in scenes), fixed=False)]
    path = write(tmp_path / "review.rrd", scenes)

    left, right = ({e.replace(t, "") for e in static(path) if t in e} for t in ("/left", "/right"))
    assert left == right
    assert len(left) > 3
    assert due == [True] * 8
    for side, topic in enumerate(("/left", "/right")):
        (camera_row,) = rows(path, f"/world/{topic}/camera")
        assert camera_row["Pinhole:image_from_camera"][0][0] == 60
        paths = [row["LineStrips3D:strips"] for row in rows(path, f"/world/{topic}/paths/{topic}")]
        assert np.allclose(paths[0], [[[0.1 + side, 0.1, 1], [0.2 + side, 0.1, 1]]])
        assert paths[1:] == [[]]  # it has ended
        assert np.allclose(views[side][2].target, [0.1 + side, 0.1, 1])


def test_counts_of_two_sensors_are_separate_lines(tmp_path: Path) -> None:
    """Drawn as one line, the count jumped between the two sensors."""
    topics, scenes = ("/left/depth", "/right/depth"), []
    for k in range(4):
        seen = [labelled_object(track) for track in range(1 + k % 2)]
        labelled, frame = scene(k, seen)
        topic = topics[k % 2]
        here = dataclasses.replace(labelled, topic=topic), dataclasses.replace(frame, topic=topic)
        scenes.append(here)
    run = {"options": {"topics": list(topics)}}
    path = write(tmp_path / "r.rrd", scenes, run=run)

    counts = [scalars(path, f"/plots/objects/{topic}/cup") for topic in topics]
    assert counts == [[[1], [1]], [[2], [2]]]
    assert scalars(path, "/plots/objects/cup") == []


def test_two_sensors_may_share_their_colour_camera() -> None:
    stream = rr.RecordingStream("test")
    images = Images(Columns(stream))
    for topic in ("/left", "/right"):
        photo = ColourImage("/colour", 0, 0, "camera", "png", 64, 48, 0, b"")
        labelled = dataclasses.replace(scene(0)[0], topic=topic)
        images.add(labelled, Coloured(ColourView(photo), ()))

    assert list(images.entities.values()) == ["/colour", "/colour"]


@pytest.mark.parametrize(("rows", "size"), [(256, 1), (3, 50_000)])
def test_few_rows_or_numbers_are_held_back(rows: int, size: int) -> None:
    """256 images would take hundreds of megabytes, and small rows must not wait for the end."""
    sent: list[int] = []

    def draw(held: Sequence[Any]) -> Iterable[rr.ComponentColumn]:
        sent.append(len(held))
        return curve(held)

    columns = Columns(rr.RecordingStream("test"))
    for k in range(2 * rows):
        columns.add("plot", (k, k), [0.5], Drawing(draw), size=size)
        assert sum(sent) == (k + 1) // rows * rows


def test_large_images_and_masks_are_not_held_back() -> None:
    """If each image counted as one row, 256 images would be held in memory."""
    sent: list[str] = []
    stream: Any = SimpleNamespace(
        log=lambda *_, **__: None, send_columns=lambda entity, *_: sent.append(entity)
    )
    images = Images(Columns(stream))
    photo = ColourImage("/colour", 0, 0, "camera", "png", 1600, 1500, 0, bytes(270_000))
    noise = np.random.default_rng(3).random((1500, 1600)) < 0.5  # its PNG file has 300 kB
    coloured = Coloured(ColourView(photo), (Mask(0, 0, noise),))
    for k in range(5):
        images.add(scene(k, [labelled_object(4)])[0], coloured)

    name = rr.new_entity_path(["images", TOPIC])
    assert sent == [name, f"{name}/masks"] * 2  # whenever two hold 512 kB


def test_rows_of_a_scene_count_as_what_they_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If each scene counted as one row, 256 with all their points would be held in memory."""
    sizes, add = {}, Columns.add

    def added(columns: Columns, entity: str, at: At, row: Any, *rest: Any, size: int = 1) -> None:
        sizes[entity] = size
        add(columns, entity, at, row, *rest, size=size)

    monkeypatch.setattr(Columns, "add", added)
    settings = {"outputs": {"cloud_points": 0}}
    seen = scene(0, [labelled_object(1), labelled_object(2)])
    write(tmp_path / "review.rrd", [seen], run={"settings": settings})

    entity = rr.new_entity_path(["world", TOPIC])
    points, listed = 48 * 60, 2 * 8  # four columns of the depth image are empty
    assert {sizes[f"{entity}/{name}"] for name in SCENE} == {points + listed}


def test_label_has_only_low_confidences() -> None:
    """High confidences are not worth mentioning, and long captions cover the scene."""
    item = labelled_object(7)
    low, high, unknown = (
        short_label(dataclasses.replace(item, confidence=confidence, category=category))
        for confidence, category in ((0.61, "cup"), (0.93, "cup"), (0.5, "unknown"))
    )

    assert (low, high, unknown) == ("#7 cup 0.61", "#7 cup", "#7 unknown")


def test_tabs_show_longest_tracks() -> None:
    """Most of hundreds of tracks are short and need no tab; tabs are sorted by track number."""
    frames = {k: 300 if k % 2 else k for k in range(1, 101)}
    tracks = [TrackView(f"/tracks/{k}", f"#{k}", n) for k, n in frames.items()]
    titles = [str(view.name) for view in _track_tabs(tracks).contents]
    few = [str(view.name) for view in _track_tabs(tracks[:3]).contents]

    assert titles == [f"#{k}" for k in range(1, 97, 2)]
    assert few == ["#1", "#2", "#3"]


def test_static_scenes_are_drawn_less_often() -> None:
    at_rest = [0.5] * 9
    assert drawn_frames(moving_camera(at_rest), fixed=True) == [0, 3, 6]
    assert drawn_frames(moving_camera(at_rest), fixed=False) == list(range(9))
    assert drawn_frames(moving_camera([0.5, 0.5, *[0.52] * 7]), fixed=True) == [0, 2, 5, 8]


def test_appearing_or_disappearing_object_is_drawn_at_once() -> None:
    scenes = [scene(k, [labelled_object(1)] if k == 2 else []) for k in range(7)]
    assert drawn_frames(scenes, fixed=False) == [0, 2, 3, 6]


def test_repeated_frame_is_not_drawn() -> None:
    repeated = [dataclasses.replace(scene(k)[0], reused_from=0) for k in range(1, 9)]
    scenes = [scene(0), *((labelled, image(labelled.index)) for labelled in repeated)]
    assert drawn_frames(scenes, fixed=False) == [0]


def test_run_without_frames_or_objects_gives_review(tmp_path: Path) -> None:
    assert write(tmp_path / "0.rrd", []).stat().st_size > 0
    assert rows(write(tmp_path / "1.rrd", [scene(0)]), f"/world/{TOPIC}/scene")


def test_clouds_have_limited_points_and_category_colours() -> None:
    labelled, frame = scene(0, [labelled_object(1), labelled_object(2, "can")])
    rest, foreground = paint(frame, labelled.planes, labelled.objects, limit=600)
    assert 300 < len(rest.points) <= 600
    assert np.isfinite(rest.points).all()
    everything = [*paint(frame, labelled.planes, labelled.objects, limit=0)]
    assert sum(len(cloud.points) for cloud in everything) == 48 * 60
    assert len(everything[1].points) == 16
    shades = {tuple(c) for c in foreground.colours.view(np.uint8).reshape(-1, 4)[:, :0:-1].tolist()}
    ratios = {tuple(np.round(np.array(shade) / max(shade), 1)) for shade in shades}
    expected = [np.array(colour_of(category)) for category in CATEGORIES]
    assert ratios == {tuple(np.round(c / c.max(), 1)) for c in expected}


def test_points_of_each_cloud_nearly_touch() -> None:
    """Objects are thinned less, so their points are smaller than those of the background."""
    labelled, frame = scene(0, [labelled_object(1)])
    for cloud in paint(frame, labelled.planes, labelled.objects, limit=600):
        nearest_m = pdist(cloud.points).min()
        assert 0.5 < cloud.radius_m / nearest_m < 0.6


def test_unorganised_clouds_and_points_near_plane_are_painted() -> None:
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (500, 3)) + np.array([0, 0, 1])
    points[:200, 1], points[200] = 0.4, np.nan
    frame = Frame("/lidar", 0, 0, 0, "lidar", points=points)
    item = dataclasses.replace(labelled_object(1), indices=np.arange(300, 310))
    rest, foreground = paint(frame, (FLOOR,), (item,), limit=0)
    assert (len(rest.points), len(foreground.points)) == (489, 10)
    on_floor = np.abs(rest.points[:, 1] - 0.4) < 0.01
    assert len(set(rest.colours[on_floor].tolist())) == 1
    assert not set(rest.colours[on_floor].tolist()) & set(rest.colours[~on_floor].tolist())


def test_failure_leaves_no_file_and_keeps_older_review(tmp_path: Path) -> None:
    """No partial file may remain, neither under the final name nor hidden."""
    (tmp_path / "r.rrd").write_bytes(b"old")

    def broken() -> Iterator[ReviewFrame]:
        yield ReviewFrame(*scene(0, [labelled_object(1)]))
        msg = "the recording ends here"
        raise ValueError(msg)

    with pytest.raises(ValueError, match="ends here"):
        write_frames(tmp_path / "r.rrd", broken())
    assert [p.name for p in tmp_path.iterdir()] == ["r.rrd"]
    assert (tmp_path / "r.rrd").read_bytes() == b"old"


def test_full_disk_while_writing_raises_error(tmp_path: Path) -> None:
    """Rerun's own writer stops at the first error, and later logging blocks forever."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, before[1]))
    try:
        with pytest.raises(OutputError, match="File too large"):
            write(tmp_path / "r.rrd", [scene(k) for k in range(300)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_review_whose_end_cannot_be_written_does_not_appear(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the disk is full at the very end, the review would lack its layout."""
    close, closed = ReviewFile.close, []

    def close_on_full_disk(file: ReviewFile) -> None:
        close(file)
        closed.append(file._thread.is_alive())
        file._error = OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(ReviewFile, "close", close_on_full_disk)
    with pytest.raises(OutputError, match="No space left"):
        write(tmp_path / "r.rrd", [scene(0)])
    assert closed == [False]
    assert not list(tmp_path.iterdir())


def test_missing_folder_is_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write(tmp_path / "nowhere" / "r.rrd", [scene(0)])


def test_run_json_is_formatted_as_text() -> None:
    text = markdown({"version": "1", "counts": {"frames": 3}, "warnings": [], "seconds": 0.123456})
    assert text.splitlines() == [
        "- **version**: 1",
        "- **warnings**: none",
        "- **seconds**: 0.1235",
        "",
        "## counts",
        "",
        "- **frames**: 3",
    ]


def test_missing_review_or_viewer_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(OutputError, match="no review there"):
        review_viewer.open_viewer(tmp_path / "none.rrd")
    (tmp_path / "r.rrd").touch()
    monkeypatch.setattr("shutil.which", lambda *_, **__: None)
    with pytest.raises(OutputError, match="rerun-sdk"):
        review_viewer.take_screenshot(tmp_path / "r.rrd", tmp_path / "r.png")


_ANSWERS = "import socket, time; s = socket.create_server(('127.0.0.1', PORT)); time.sleep(0.5)"


@pytest.mark.parametrize(
    ("begins", "says"),
    [("exit", "No graphics adapter was found"), ("answers", "Failed to get render context")],
    ids=["no graphics", "OpenGL without Vulkan"],
)
def test_viewer_without_graphics_names_missing_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begins: str, says: str
) -> None:
    """A container has no graphics card: the message must name the package to install."""
    fake = tmp_path / "rerun"
    answer = (
        f'{sys.executable} -c "{_ANSWERS}"'.replace("PORT", "$4") if begins == "answers" else ""
    )
    fake.write_text(f"#!/bin/sh\n{answer}\necho '{says}' >&2\nexit 1\n")
    fake.chmod(0o755)
    monkeypatch.setattr(review_viewer, "_viewer", lambda: str(fake))
    with pytest.raises(OutputError, match="mesa-vulkan-drivers"):
        review_viewer.take_screenshot(fake, tmp_path / "r.png")


def test_viewer_that_panics_is_not_taken_for_one_without_graphics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The viewer lacked a font for a Japanese category; the package named would not have helped."""
    fake = tmp_path / "rerun"
    (tmp_path / "log").write_text(
        "INFO re_renderer::context: wgpu adapter backend: Vulkan\n"
        "thread 'main' panicked at 'No glyph for 「コ」 in Proportional.'\n"
        "   6: core::panicking::panic_fmt\n",
        "utf-8",
    )
    fake.write_text(f"#!/bin/sh\ncat '{tmp_path / 'log'}' >&2\nexit 1\n")
    fake.chmod(0o755)
    monkeypatch.setattr(review_viewer, "_viewer", lambda: str(fake))
    with pytest.raises(OutputError, match=r"the viewer ended: No glyph for 「コ」 in Proportional"):
        review_viewer.take_screenshot(fake, tmp_path / "r.png")


def test_screenshot_ends_viewer_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program `rerun` is a script; killing it alone would leave its child process."""
    fake = tmp_path / "rerun"
    fake.write_text(f"#!/bin/sh\nsleep 60 &\necho $! > {tmp_path / 'pid'}\nwait\n")
    fake.chmod(0o755)
    monkeypatch.setattr(review_viewer, "_viewer", lambda: str(fake))
    monkeypatch.setattr(review_viewer, "_LOAD_S", 0.6)
    monkeypatch.setattr(review_viewer, "_SETTLE_S", 0.1)
    with pytest.raises(OutputError, match="no answer"):
        review_viewer.take_screenshot(fake, tmp_path / "r.png")
    pid = int((tmp_path / "pid").read_text())
    deadline = time.monotonic() + 10  # killed at once, but a zombie until reaped
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(pid)


def test_silent_viewer_ends_command_with_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A viewer that hangs would end ``view --web`` with a traceback."""
    fake = tmp_path / "rerun"
    fake.write_text("#!/bin/sh\nexec sleep 60\n")
    fake.chmod(0o755)
    monkeypatch.setattr(review_viewer, "_viewer", lambda: str(fake))
    monkeypatch.setattr(review_viewer, "_LOAD_S", 0.2)

    with (
        pytest.raises(OutputError, match="the viewer gave no answer"),
        review_viewer.serve_viewer(fake),
    ):
        pytest.fail("it is not served")


def test_slow_screenshot_is_tried_again(tmp_path: Path) -> None:
    """Rerun waits 15 s for a picture; a loaded machine needs longer."""
    answers = [TimeoutError("Deadline expired"), TimeoutError("Deadline expired"), None]
    client, viewer = Mock(), Mock()
    viewer.poll.return_value = None
    client.save_screenshot.side_effect = list(answers)
    review_viewer._save(client, tmp_path / "r.png", viewer)
    assert client.save_screenshot.call_count == 3

    client.save_screenshot.side_effect = TimeoutError("Deadline expired")
    with pytest.raises(TimeoutError, match="Deadline"):
        review_viewer._save(client, tmp_path / "r.png", viewer)


@pytest.mark.slow
@pytest.mark.skipif(
    not any(Path("/usr/share/vulkan").glob("icd.d/*.json")), reason="nothing to draw with"
)
def test_screenshot_shows_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views that fail to draw, or an eye that looks away, would give an empty picture.

    The last frame is shown, which has the can.
    """
    monkeypatch.setattr(review_viewer, "_SETTLE_S", 2.0)  # welcome messages may still be visible
    png = tmp_path / "r.png"
    objects = [labelled_object(1), labelled_object(2, "can", 0.3)]
    path = write(tmp_path / "r.rrd", [scene(0, objects[:1]), scene(1, objects)])
    review_viewer.take_screenshot(path, png)
    image_module = pytest.importorskip("PIL.Image")
    with image_module.open(png) as picture:
        assert picture.size == (1280, 800)
        pixels = np.asarray(picture.convert("RGB"), float)[:, :800].reshape(-1, 3)
    green = np.array(colour_of("can"), float)  # no part of the viewer itself is so green
    similarity = pixels @ green / np.linalg.norm(green) / np.linalg.norm(pixels + 1, axis=1)
    assert np.count_nonzero((similarity > 0.98) & (pixels.max(axis=1) > 90)) > 100


def test_eye_steps_back_to_show_all_objects_if_near() -> None:
    """The eye must show objects that a camera has passed, but not all those of a long drive."""
    eye = Eye(np.array([0.0, -1.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    low, high = np.array([-1.0, -0.2, 0.0]), np.array([1.0, 0.2, 0.2])

    farther = stepped_back(eye, low, high)

    assert np.allclose(farther.target, (low + high) / 2)
    away = farther.position - farther.target
    assert np.allclose(np.cross(away, eye.position), 0, atol=1e-9)
    assert np.linalg.norm(away) > np.linalg.norm(high - low)
    assert stepped_back(eye, low * 10, high * 10) is eye
    assert stepped_back(eye, np.full(3, np.inf), np.full(3, -np.inf)) is eye  # without objects


@pytest.mark.parametrize("kind", ["planes", "image", "cloud", "nothing"])
def test_view_of_a_frame_without_objects_shows_what_there_is(kind: str) -> None:
    """A run without objects is opened to see why; its view must not be empty or upside down.

    Where no plane is found, detection takes the up direction of a camera even for a lidar.
    """
    labelled, frame = scene(0)
    if kind != "planes":
        labelled = dataclasses.replace(labelled, planes=())
    if kind in {"cloud", "nothing"}:
        points = np.full((9, 3), np.nan if kind == "nothing" else 3.0, np.float32)
        points[:4, 0] -= 1
        frame = Frame(TOPIC, 0, stamp(0), stamp(0), "lidar", points=points)

    eye = choose_eye(labelled, frame, fixed=False)

    targets = {"planes": [0, 0.4, 1.25], "cloud": [2.5, 3, 3], "nothing": [0, 0, 0]}
    assert eye.target == pytest.approx(targets.get(kind, eye.target))
    assert np.array_equal(eye.up, [0, -1, 0] if kind in {"planes", "image"} else [0, 0, 1])
    assert (eye.position - eye.target) @ eye.up > 0.3
    assert kind != "image" or 0.9 < eye.target[2] < 1.1


def test_view_has_measured_up_direction_even_without_planes() -> None:
    """Otherwise the scene of a camera that looks down would seem to lie on a slope."""
    labelled, frame = scene(0)
    labelled = dataclasses.replace(labelled, planes=(), up=np.array([0.1, -0.7, -0.7]))
    assert choose_eye(labelled, frame, fixed=False).up == pytest.approx([0.1, -0.7, -0.7])
