"""Tests of the outputs of a run, on worked examples whose numbers all differ."""

import csv
import io
import json
import os
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike
from PIL import Image
from scipy.spatial.transform import Rotation

from shapecat.cameras.colour import ColourImage, ColourView, LensCamera
from shapecat.colour.masks import Mask
from shapecat.errors import OutputError, RecordingError
from shapecat.geometry import IDENTITY
from shapecat.outputs.annotation.annotated_mcap import _annotations, _encoding
from shapecat.outputs.annotation.channels import annotation_encoders
from shapecat.outputs.annotation.content import Annotation
from shapecat.outputs.annotation.image_annotations import ImageBox, read_image_frames
from shapecat.outputs.colouring import Coloured, with_colour
from shapecat.outputs.colours import colour_of
from shapecat.outputs.exports.coco import DATASETS
from shapecat.outputs.exports.dataset_frames import (
    ImageSelection,
    _chosen,
    _colour_file,
    _depth_file,
    _different,
    _view_features,
    image_stems,
    images_of,
    snapped_masks,
    split_runs,
    thinned,
)
from shapecat.outputs.exports.formats import (
    _made_by_export,
    _require_own,
    _staged,
    export_dataset,
)
from shapecat.outputs.exports.points import write_point_labels
from shapecat.outputs.level_clouds import support_offset, upright_cloud
from shapecat.outputs.opened_run import RunFrame
from shapecat.outputs.png import png
from shapecat.outputs.report.cards import _guess
from shapecat.outputs.report.pictures import _frames, _require_unchanged
from shapecat.outputs.review.colour import true_colours
from shapecat.outputs.review.columns import At
from shapecat.outputs.review.images import mask_layer
from shapecat.outputs.review.paths import Paths
from shapecat.outputs.review.scenes import choose_scenes, with_clouds
from shapecat.outputs.scene_graph import Node, format_tree
from shapecat.outputs.scene_tree import (
    _apply_labels,
    _candidate,
    _described,
    _topic,
    describe_scene,
)
from shapecat.outputs.wording import different_names, safe_name
from shapecat.recordings.messages import Topic
from shapecat.runs.labelled_frames import _join, read_labelled_frames
from shapecat.runs.labelled_tracks import LabelledTracks
from shapecat.runs.labels.meaning import TrackLabel, _slips
from shapecat.runs.labels.track_table import TrackTable
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.runs.tables.masks import mask_columns, masks_in, read_nearest_masks
from shapecat.runs.tables.reading import Key
from shapecat.runs.tables.schemas import FRAMES, MASKS
from shapecat.runs.tables.writing import arrow_table
from shapecat.types import (
    AnnotationBox,
    AnnotationFrame,
    Box,
    Camera,
    Candidate,
    Frame,
    ImageMasks,
    LabelledFrame,
    LabelledObject,
    NeuralGas,
    Plane,
    Pose,
    Scene,
)
from tests.test_exports_worked import UP
from tests.test_tables import perception
from tests.track_tables import write_tracks

MS = 1_000_000
NO_GAS = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))
UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def box_at(center: ArrayLike, size: ArrayLike) -> Box:
    return Box(np.asarray(center, float), np.asarray(size, float), np.array(UPRIGHT))


def labelled_object(track: int, indices: Any = (), **changes: Any) -> LabelledObject:
    box = box_at((0.3, -0.2, 1.1), (0.12, 0.07, 0.19))
    one = LabelledObject(
        *(track, "cup", 0.6, box, np.array(indices, np.uint32), NO_GAS), np.ones(1), np.ones(1)
    )
    return replace(one, **changes)


def labelled_frame(index: int, *objects: LabelledObject, topic: str = "/depth") -> LabelledFrame:
    return LabelledFrame(topic, index, index * MS, 0, "cam", None, (), objects, (), {}, UP)


def test_records_print_in_one_short_line() -> None:
    """A console would print every element of the arrays, a hundred thousand characters."""
    item = labelled_object(7, range(3000))
    labelled = labelled_frame(12, item)
    depth = Frame("/depth", 12, 0, 0, "cam", np.ones((4, 6)), Camera(6, 4, 5, 5, 3, 2))

    assert repr(item) == "<LabelledObject #7: cup, confidence 0.60>"
    assert repr(RunFrame(labelled, depth)) == "<RunFrame /depth 12: 1 object>"
    assert repr(item.gas) == "NeuralGas(neurons=float32 (0, 3), edges=uint16 (0, 2))"
    assert repr(depth).endswith(
        "frame_id='cam', depth=float32 (4, 6), "
        "camera=Camera(width=6, height=4, fx=5, fy=5, cx=3, cy=2), points=None, "
        "frame_from_sensor=None)"
    )
    masks = ImageMasks("/color", 0, 0, "cam", 6, 4, {}, {3: np.arange(999, dtype=np.uint32)})
    assert repr(masks).endswith("boxes={}, counts={3: uint32 (999,)})")


def test_object_has_its_own_mask_though_other_detections_have_no_track() -> None:
    """Masks are numbered like the objects, not the detections: a wrong mask would be returned."""
    objects = [labelled_object(k, detections=(k,)) for k in (2, 5)]
    masks = (Mask(1, 0, np.ones((2, 3), np.bool_)), Mask(4, 1, np.ones((1, 2), np.bool_)))
    image = ColourImage("/c", 5, 6, "c", "rgb8", 7, 3, 21, bytes(63))
    depth = Frame("/depth", 0, 0, 0, "cam", np.ones((4, 6)), Camera(6, 4, 5, 5, 3, 2))
    frame = RunFrame(labelled_frame(0, *objects), depth, Coloured(ColourView(image), masks))

    found = [frame.color_mask(item) for item in objects]

    assert [mask is not None and mask.sum() for mask in found] == [6, 2]
    assert found[1] is not None
    assert np.argwhere(found[1]).tolist() == [[1, 4], [1, 5]]


# ---- annotations: lifetime and deletion


def annotation_frame(
    topic: str, stamp: int, *tracks: int, ended: tuple[int, ...] = ()
) -> AnnotationFrame:
    boxes = tuple(AnnotationBox(t, "cup", 0.9, (0, 0, 1), (1, 1, 1), UPRIGHT) for t in tracks)
    return AnnotationFrame(topic, stamp, stamp, 3 * stamp + 7, "cam", boxes, ended)


def test_annotations_outlive_their_period_and_are_deleted_once() -> None:
    """The period is the time to the next frame of the topic, else from the previous one."""
    frames = [
        annotation_frame("/a", 100, 1, 2),
        annotation_frame("/a", 140, 2),
        annotation_frame("/b", 150, 2, 7),
        annotation_frame("/a", 200, 3, ended=(9,)),
        annotation_frame("/b", 250, ended=(7,)),
        annotation_frame("/c", 260, 4),
        annotation_frame("/c", 300, 4),
        annotation_frame("/c", 400),
    ]
    found = [(a.lifetime_ns, a.gone) for a in _annotations(frames)]

    assert found == [
        (180, ()),  # 120 of log time to the next
        (270, (1,)),
        (450, ()),  # 300 to the next of its topic
        (270, (9,)),  # 2 is still visible on /b
        (450, (2, 7)),
        (180, ()),
        (450, ()),  # the next frame comes late
        (450, (4,)),
    ]


def test_boxes_of_two_cameras_stay_until_the_next_frame_of_their_own() -> None:
    """Timed by the frames of both, a box vanished wherever its camera dropped a frame."""
    frames = [annotation_frame(t, s, 1) for s in (0, 10, 40, 50) for t in ("/a", "/b")]
    frames += [annotation_frame("/b", 50 + k, 1) for k in range(1, 200)]
    frames.append(annotation_frame("/a", 900, 1))

    found = list(_annotations(frames))
    assert [one.frame for one in found] == frames
    lifetimes = [one.lifetime_ns for one in found if one.frame.topic == "/a"]
    # 1.5 * 3, the factor of log time; beyond 64 frames, the time before a frame is used
    assert lifetimes == [45, 135, 45, 45, 3825]


@pytest.mark.parametrize("slow", [1, 3])
def test_boxes_stay_until_the_next_message(slow: int) -> None:
    """Viewers count in log time, which passes faster than the time of a slow simulation."""
    frames = [
        replace(annotation_frame("/a", 100 * k, 1), log_time_ns=100 * slow * k) for k in (1, 2)
    ]

    assert [a.lifetime_ns for a in _annotations(frames)] == [150 * slow] * 2


@pytest.mark.parametrize("encoding", ["cdr", "ros1", "protobuf", "json"])
def test_lifetime_does_not_span_jump_of_clock(encoding: str) -> None:
    """If a clock jumps from time since start-up to time since 1970, a ROS duration overflows."""
    frames = [
        annotation_frame("/a", 12 * 10**9, 1),
        annotation_frame("/a", 1_700_000_000 * 10**9, 1),
    ]
    for annotation in _annotations(frames):
        assert annotation.lifetime_ns == 5400 * 10**9
        for _, encode in annotation_encoders(encoding, markers=True):
            assert encode(annotation)


def write_masks(folder: Path, masks: list[tuple[Key, ImageMasks]], stamps: list[int]) -> None:
    """Write the masks of a run, and the stamps of their frames."""
    frames = [
        dict.fromkeys(FRAMES.names) | {"topic": topic, "frame": k, "stamp_ns": stamp}
        for ((topic, k), _), stamp in zip(masks, stamps, strict=True)
    ]
    perceived: Any = [SimpleNamespace(topic=key[0], index=key[1], masks=own) for key, own in masks]
    tables = {
        "frames": pa.Table.from_pylist(frames, FRAMES),
        "masks": arrow_table(mask_columns(perceived), MASKS),
    }
    for name, table in tables.items():
        pq.write_table(table, folder / f"{name}.parquet", row_group_size=32)


def test_image_has_masks_of_the_frame_nearest_in_time(tmp_path: Path) -> None:
    """Several frames may share an image: its boxes were those of the first, half a period early."""
    stamps = [20, 40, 55, 90, 150, 160]
    masks = [
        (("/d", k), ImageMasks("/l", image, image + 60, "c", 40, 30, {}, {}))  # logged late
        for k, image in enumerate([50, 50, 50, 150, 150, 150])
    ]
    write_masks(tmp_path, masks, stamps)

    found = [(key, image.stamp_ns) for key, image in read_nearest_masks(tmp_path)]
    assert found == [(("/d", 2), 50), (("/d", 4), 150)]


def test_successive_images_with_equal_stamps_are_all_annotated(tmp_path: Path) -> None:
    """A clock that was set back by one period gives the next image the same stamp."""
    masks = [
        (("/d", k), ImageMasks("/l", 50, logged, "c", 40, 30, {}, {}))
        for k, logged in enumerate([60, 60, 160])
    ]
    write_masks(tmp_path, masks, [50, 50, 50])

    found = [(key, image.log_time_ns) for key, image in read_nearest_masks(tmp_path)]
    assert found == [(("/d", 0), 60), (("/d", 2), 160)]


@pytest.mark.parametrize("every", [1, 3])
@pytest.mark.parametrize("late", [0, 1, 100])
def test_image_of_two_sensors_is_annotated_once_if_one_is_late(
    late: int, every: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boxes would flicker: those of one sensor, then of the other, in messages out of order.

    The late sensor is nearer in time and ends early. The other one may skip images.
    """
    frames: list[tuple[str, int, int]] = []  # topic, number, stamp
    for k in range(600):
        if k % every == 0:
            frames.append(("/early", k, 10 * k + 2))
        if late <= k < 400:
            frames.append(("/late", k - late, 10 * (k - late) + 1))
    masks = [
        ((topic, k), ImageMasks("/rgb", 10 * k, 10 * k + 5, "c", 40, 30, {}, {}))
        for topic, k, _ in frames
    ]
    write_masks(tmp_path, masks, [stamp for *_, stamp in frames])
    taken: set[int] = set()

    def count_taken(table: pa.Table) -> Iterator[tuple[Key, ImageMasks]]:
        for key, image in masks_in(table):
            taken.add(image.stamp_ns)
            yield key, image

    monkeypatch.setattr("shapecat.runs.tables.masks.masks_in", count_taken)
    found, waiting = [], []
    for (topic, _), image in read_nearest_masks(tmp_path):
        found.append((topic, image.stamp_ns // 10))
        waiting.append(len(taken) - len(found))

    nearer = range(400 - late)
    kept = [k for k in range(600) if k in nearer or k % every == 0]
    assert found == [("/late" if k in nearer else "/early", k) for k in kept]
    assert max(waiting) <= 256  # memory does not grow with the length


def test_simultaneous_images_of_two_cameras_are_annotated(tmp_path: Path) -> None:
    """Images of two cameras may have equal stamps. An image of two depth streams counts once."""
    images = [("/l", 5, 30), ("/r", 5, 30)] * 2 + [("/r", 9, 30), ("/cloud", 11, 1)]
    masks = [
        (("/d", k), ImageMasks(topic, stamp, stamp + 1, "c", 40, height, {0: (3, 4, 7, 9)}, {}))
        for k, (topic, stamp, height) in enumerate(images)
    ]
    write_masks(tmp_path, masks, [5] * len(masks))
    tracks: Any = SimpleNamespace(objects=lambda _key: {TrackLabel(6, "cup", 0.8): {0: 0}})
    frames = list(read_image_frames(tmp_path, tracks))

    assert [frame.stamp_ns for frame in frames] == [5, 5, 9]
    assert {frame.boxes for frame in frames} == {(ImageBox(6, "cup", 0.8, (3, 4, 7, 9)),)}


def test_full_box_of_merged_object_includes_part_without_full_box() -> None:
    """Otherwise the box would end where the full box of the other part does."""
    left, right = (labelled_object(6, box=box_at((x, 0.1, 1), (0.1, 0.2, 0.3))) for x in (0, 0.3))
    wide = box_at((-0.05, 0.1, 1.0), (0.2, 0.2, 0.4))

    whole = _join([replace(left, full=wide), right], [0.0, 0.0, 1.0])
    visible = _join([left, right], [0.0, 0.0, 1.0])

    assert whole.full is not None
    ends = whole.full.center[0] - whole.full.size[0] / 2, whole.full.center[0]
    assert np.allclose(ends, (-0.15, 0.1))
    assert np.allclose(np.sort(whole.full.size), [0.2, 0.4, 0.5])
    assert np.allclose(np.sort(whole.box.size), [0.2, 0.3, 0.4])
    assert visible.full is None


def test_merged_track_has_one_box_on_image(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A model would learn half an object from a box around one part; a part may be out of view."""
    boxes = {0: (3, 4, 7, 9), 1: (20, 1, 2, 3), 2: (5, 11, 12, 6)}
    masks = ImageMasks("/l", 5, 6, "c", 40, 30, boxes, {})
    whole, other = TrackLabel(6, "cup", 0.8), TrackLabel(9, "can", 0.7)
    labels = {6: whole, 9: other, 11: whole, 12: whole}
    place = "shapecat.outputs.annotation.image_annotations"
    monkeypatch.setattr(f"{place}.read_nearest_masks", lambda _folder: iter([(("/d", 0), masks)]))
    none = np.zeros((4, 0))
    numbers = np.arange(4)  # the last one has no mask
    tracks = LabelledTracks(
        {("/d", 0): slice(0, 4)}, numbers, np.array([11, 9, 6, 12]), labels, {}, none, none
    )
    (frame,) = read_image_frames(Path(), tracks)

    assert frame.boxes == (
        ImageBox(6, "cup", 0.8, (3, 4, 14, 13)),
        ImageBox(9, "can", 0.7, (20, 1, 2, 3)),
    )


def test_colour_image_requires_masks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Runs of older versions have no masks: exports then omit colour instead of failing."""
    masks = ImageMasks("/color", 5, 6, "c", 40, 30, {}, {})
    labelled = [replace(labelled_frame(k), masks=masks if k % 2 else None) for k in range(4)]
    read: Any = [(SimpleNamespace(topic="/depth", index=k), "view" if k < 2 else None)
                 for k in range(4)]  # fmt: skip
    monkeypatch.setattr("shapecat.outputs.colouring.read_frames", lambda *_, **__: iter(read))
    run: Any = {"options": {"topics": ["/depth"]}, "color": {}}
    recording: Any = SimpleNamespace(path="a.mcap")
    found = [coloured for *_, coloured in with_colour(labelled, recording, run)]

    assert [one is not None for one in found] == [False, True, False, False]


# ---- the review: which scenes are drawn


@pytest.mark.parametrize(("fixed_frame", "drawn"), [("map", [0, 3]), (None, [0, 1, 2, 3])])
def test_moving_camera_does_not_redraw_static_scene(
    monkeypatch: pytest.MonkeyPatch, fixed_frame: str | None, drawn: list[int]
) -> None:
    """Otherwise the review of a static table would be ten times larger."""
    rotation = Rotation.from_euler("zyx", [0.7, -0.4, 0.3]).as_matrix()
    center = np.array([1.31, -0.24, 0.87])
    frames = []
    for k in range(4):
        pose = Pose(rotation, np.array([0.12 * k, 0.05, -0.03]))
        shift = np.array([0.02 if k == 3 else 0.0, 0.0, 0.0])  # it moves in the last frame
        box = box_at(rotation.T @ (center + shift - pose.translation), (0.12, 0.07, 0.19))
        one = labelled_frame(k, labelled_object(6, box=box))
        frames.append(replace(one, stamp_ns=100 * k * MS, fixed_from_sensor=pose))
    monkeypatch.setattr(
        "shapecat.outputs.review.scenes.with_colour",
        lambda some, _recording, _run: ((one, object(), None) for one in some),
    )
    run: Any = {"fixed_frame": fixed_frame}
    recording: Any = None
    found = list(with_clouds(frames, recording, run))

    assert [one.labelled.index for one in found] == [0, 1, 2, 3]
    assert [one.labelled.index for one in found if one.frame is not None] == drawn


def test_scene_at_unknown_place_is_not_drawn() -> None:
    """Before the first transform, the cloud would appear at the origin, on its side."""
    pose = Pose(np.eye(3), np.array([0.4, 0.7, 1.5]))
    frames = [
        replace(labelled_frame(1000 * k, topic=topic), fixed_from_sensor=pose if known else None)
        for k, (topic, known) in enumerate([("/a", 0), ("/a", 1), ("/a", 0), ("/a", 1), ("/b", 0)])
    ]

    chosen = choose_scenes(frames, fixed=True, placed={"/a"})
    assert [drawn for _, drawn in chosen] == [False, True, False, True, True]


def test_scene_is_redrawn_if_object_moves_or_time_goes_back() -> None:
    """The visible part of an object at rest varies from frame to frame."""
    resting = box_at((0.31, -0.24, 1.17), (0.12, 0.07, 0.19))
    data = [(0, 0.0, 0.0), (100, 0.03, 0.0), (200, 0.03, 0.02), (150, 0.03, 0.02), (220, 0.0, 0.02)]
    frames = []
    for k, (time, visible, whole) in enumerate(data):
        box, full = (
            replace(resting, center=resting.center + np.array([x, 0, 0])) for x in (visible, whole)
        )
        one = labelled_frame(k, labelled_object(6, box=box, full=full))
        frames.append(replace(one, stamp_ns=time * MS))

    assert [drawn for _, drawn in choose_scenes(frames, fixed=False)] == [
        *(True, False),
        *(True, True, False),  # the fourth is earlier than the third, the last one soon after it
    ]


# ---- the review: paths


def test_long_path_keeps_newest_positions() -> None:
    """The newest 500 positions are kept; steps of at most 15 mm are ignored."""
    drawn: list[Any] = []
    sizes: list[int] = []

    def add(_entity: str, _at: At, ways: Any, _drawing: Any, *, size: int) -> None:
        drawn.append(ways)
        sizes.append(size)

    columns: Any = SimpleNamespace(add=add)
    paths = Paths(columns)
    for k in range(507):
        paths.add("/p", (k, k), {4: ("cup", np.array([0.02 * k, 0.3, 1.1]))}, ())
        paths.add("/p", (k, k), {4: ("cup", np.array([0.02 * k, 0.3, 1.114]))}, ())
    ((category, places),) = drawn[-1]

    assert (len(drawn), category, places.shape) == (506, "cup", (500, 3))
    assert_allclose(places[:, 0], 0.02 * np.arange(7, 507))
    paths.add("/p", (508, 508), {}, (4,))
    assert drawn[-1] == []
    assert (sizes[0], *sizes[-2:]) == (2 * 3, 500 * 3, 0)  # otherwise, memory fills with copies


def test_path_of_ended_track_leaves_all_sensors() -> None:
    """Only the last sensor to see a track reports its end: paths on other sensors would stay."""
    drawn: list[Any] = []
    columns: Any = SimpleNamespace(
        add=lambda entity, *row, **_: drawn.append((entity, len(row[1])))
    )
    paths = Paths(columns)
    for k in range(2):
        for entity, tracks in (("/left", (4, 5)), ("/right", (4,))):
            place = np.array([0.02 * k, 0, 1])
            paths.add(entity, (k, k), dict.fromkeys(tracks, ("cup", place)), ())
    assert drawn == [("/left", 2), ("/right", 1)]
    paths.add("/right", (2, 2), {}, (4,))

    assert drawn[2:] == [("/left", 1), ("/right", 0)]


# ---- data sets of images: which frames


@pytest.mark.parametrize(
    ("annotated", "kind", "expected"),
    [
        ("/depth", "mcap", "cdr"),  # its own, though most topics are JSON
        ("/bytes", "mcap", "json"),  # an encoding that annotations do not support
        ("/depth", "ros1", "cdr"),
        (None, "mcap", "json"),
    ],
)
def test_annotations_use_encoding_of_their_topic(
    annotated: str | None, kind: str, expected: str
) -> None:
    """Viewers that read only one encoding would show the sensor without its objects."""
    encodings = {"/a": "json", "/b": "json", "/depth": "cdr", "/bytes": "flatbuffer"}
    topics = tuple(Topic(name, "t", encoding, 9) for name, encoding in encodings.items())
    recording: Any = SimpleNamespace(kind=kind, topics=topics)
    unsupported: Any = SimpleNamespace(kind="mcap", topics=topics[3:])
    first = None if annotated is None else Annotation(annotation_frame(annotated, 5, 1), 7, ())

    assert _encoding(recording, first) == expected
    assert _encoding(unsupported, first) == "json"


def finished(frames: list[LabelledFrame]) -> Any:
    return SimpleNamespace(frames=lambda: iter(frames))


def test_frames_are_thinned_per_topic() -> None:
    topics = ["/a", "/b", "/a", "/a", "/b", "/a", "/b"]
    frames = [labelled_frame(k, topic=topic) for k, topic in enumerate(topics)]

    assert [f.index for f in thinned(frames, 2)] == [0, 1, 3, 6]
    chosen = _chosen(finished(frames), ImageSelection(every=2), set())
    assert chosen == {("/a", 0), ("/b", 1), ("/a", 3), ("/b", 6)}


@pytest.mark.parametrize("per_track", [0, 9])
def test_image_is_in_a_data_set_once(per_track: int) -> None:
    """Frames may share a colour image: only the nearest frame has masks that fit it."""
    images = [("/c", 1), ("/c", 1), ("/e", 1), ("/c", 3), None]
    masks = [one and ImageMasks(one[0], one[1] * MS, 0, "c", 4, 3, {}, {}) for one in images]
    views = (labelled_frame(k, labelled_object(1, range(9 + k))) for k in range(len(images)))
    frames = [replace(view, masks=one) for view, one in zip(views, masks, strict=True)]

    chosen = _chosen(finished(frames), ImageSelection(per_track=per_track), set())
    assert chosen == {("/depth", k) for k in (1, 2, 3, 4)}
    depth = ImageSelection(per_track=per_track, depth=True)
    assert _chosen(finished(frames), depth, set()) == {("/depth", k) for k in range(5)}


def test_most_different_views_of_track_are_selected() -> None:
    """The first view has the most pixels; each next one differs most from those already chosen."""
    columns = np.zeros((5, 8))
    columns[:, 0], columns[:, 4] = [0, 1.0, 5, 5.4, 9], [0.1, 0.3, 0.1, 0.1, 0.2]
    assert _different(columns, 3) == [1, 4, 2]
    assert _different(columns, 9) == [1, 4, 2, 0, 3]

    frames = [
        labelled_frame(k, labelled_object(1, range(pixels), box=box_at((x, 0, 1), (1, 1, 1))))
        for k, (pixels, x) in enumerate([(30, 0.0), (99, 0.1), (30, 2.0), (30, 0.2)])
    ]
    chosen = _chosen(finished(frames), ImageSelection(per_track=2), set())
    assert chosen == {("/depth", 1), ("/depth", 2)}
    above = ImageSelection(per_track=2, min_confidence=0.61)
    assert _chosen(finished(frames), above, set()) == set()
    assert _chosen(finished(frames), above, {1}) == chosen
    exact = ImageSelection(per_track=2, min_confidence=0.6)
    assert _chosen(finished(frames), exact, set()) == chosen
    corrected = ImageSelection(per_track=2, corrected_only=True)
    assert _chosen(finished(frames), corrected, set()) == set()


def test_view_vector_has_direction_distance_size_and_shape() -> None:
    R = Rotation.from_euler("zyx", [0.4, 1.1, -0.3])
    direction, size = np.array([-0.36, 0.48, -0.8]), np.array([0.12, 0.07, 0.24])
    item = labelled_object(1, range(55), box=box_at(-1.7 * direction, size))
    frame = replace(labelled_frame(0, item), fixed_from_sensor=Pose(R.as_matrix(), np.zeros(3)))
    found = _view_features(frame, item)

    assert_allclose(found[:3], R.apply(direction), atol=1e-6)
    assert_allclose(found[3:5], [np.log(1.7), 0.3 * np.log(55)], atol=1e-6)
    assert_allclose(found[5:], [0.25, 0.07 / 0.48, 0.5], atol=1e-6)
    assert_allclose(_view_features(labelled_frame(0, item), item)[:3], direction, atol=1e-6)


def test_images_without_certain_objects_are_omitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """A detector would learn that an image with only uncertain objects is empty.

    Frames of another sensor are omitted, too, although chosen frames have the same numbers.
    """
    images = [
        None,
        *(
            SimpleNamespace(objects=[SimpleNamespace(sure=one) for one in sure])
            for sure in ((False, True), (False,), (), (True,))
        ),
    ]
    place = "shapecat.outputs.exports.dataset_frames"
    sensors = ("/other", "/depth")
    labelled = [labelled_frame(k, topic=topic) for k in range(len(images)) for topic in sensors]
    stubs: dict[str, Any] = {
        "_chosen": lambda *_: {("/depth", k) for k in range(len(images))},
        "open_source": lambda *_: nullcontext(),
        "with_colour": lambda frames, *_: ((one, None, None) for one in frames),
        "_image": lambda _name, one, *_: images[one.index],
    }
    for name, stub in stubs.items():
        monkeypatch.setattr(f"{place}.{name}", stub)
    run: Any = {"options": {"topics": ["/depth"]}, "color": {"/depth": "/color"}}
    finished: Any = SimpleNamespace(
        info=run, name="lab", table=TrackTable((), (), ()), frames=lambda: iter(labelled)
    )

    left_out = Counter[str]()
    stems = dict.fromkeys(sensors, "lab")
    found = images_of(finished, ImageSelection(), stems=stems, left_out=left_out)

    assert list(found) == [images[1], images[4]]
    assert left_out == {"no image": 1, "no object with a reliable label": 2}


def test_images_of_a_run_named_like_a_topic_keep_their_names() -> None:
    """Otherwise images of one run would replace those of the other, with the labels of both."""
    named = [("a", ["/left", "/x/y", "/x_y"]), ("a__left", ["/left"]), ("a", ["/left"])]
    runs: Any = [
        SimpleNamespace(name=name, info={"options": {"topics": topics}}) for name, topics in named
    ]

    assert [list(stems.values()) for stems in image_stems(runs)] == [
        ["a__left", "a__x_y", "a__x_y-2"],
        ["a__left-2"],
        ["a-2"],
    ]


@pytest.mark.parametrize(("pose", "most"), [(IDENTITY, 160), (None, 840)])
def test_outlines_move_by_pixels_of_the_depth_camera(pose: Pose | None, most: int) -> None:
    """An error of 7 pixels is corrected only in images of three times the depth's resolution."""
    inside = np.zeros((110, 130), bool)
    inside[25:85, 35:95] = True
    pixels = np.where(inside[..., None], (128, 138, 148), (120, 130, 140)).astype(np.uint8)
    image = ColourImage("/color", 5, 6, "color", "rgb8", 130, 110, 390, pixels.tobytes())
    lens = LensCamera(Camera(130, 110, 129.0, 127.0, 66.0, 52.0))
    mask = Mask(28, 25, np.ones((60, 60), bool))
    coloured = Coloured(ColourView(image, lens, pose), (mask,))
    depth = np.ones((37, 43), np.float32)
    frame = Frame("/depth", 0, 0, 0, "cam", depth, Camera(43, 37, 43.0, 42.0, 21.0, 18.0))

    (moved,) = snapped_masks(frame, coloured, pixels)
    wrong = int((moved.full(110, 130) ^ inside).sum())
    assert most / 2 < wrong <= most if pose is None else wrong <= most


def test_depth_images_are_millimetres_without_overflow() -> None:
    """Larger depths would wrap around and appear near, or be read as 65.535 m."""
    depth = np.array([[0.0, 1.2346, 65.535], [65.6, 70.0, 0.0004]], np.float32)
    frame = Frame("/depth", 0, 0, 0, "cam", depth=depth, camera=Camera(3, 2, 5.0, 6.0, 1.0, 0.5))
    found = _depth_file(labelled_frame(0), frame)
    assert found is not None
    suffix, contents, size, masks = found

    assert (suffix, size, masks) == (".png", (2, 3), ())
    image = np.asarray(Image.open(io.BytesIO(contents)))
    assert image.tolist() == [[0, 1235, 65535], [0, 0, 0]]


def runs(count: int, same: int = 0) -> Any:
    digests = [f"xxh3:{max(k, same)}" for k in range(count)]
    return [
        SimpleNamespace(name=str(k), info={"input": {"digest": d}}) for k, d in enumerate(digests)
    ]


@pytest.mark.parametrize(
    ("count", "val", "expected"),
    [(1, 0.9, 0), (10, 0.2, 2), (10, 0.26, 3), (3, 0.99, 2), (5, 0, 0)],
)
def test_share_of_recordings_is_used_for_validation(count: int, val: float, expected: int) -> None:
    """At least one recording is left for training; runs of one recording stay together."""
    splits = split_runs(runs(count), val)
    assert splits.count("val") == expected
    assert split_runs(runs(count)[::-1], val) == splits[::-1]
    assert len(set(split_runs(runs(10, same=6), 0.4)[:7])) == 1
    assert split_runs(runs(5, same=9), 0.9) == ["train"] * 5  # of one recording


# ---- exports: replacing earlier ones


def test_export_of_another_recording_is_not_replaced(tmp_path: Path) -> None:
    """Recordings of two days may have the same name; the first export would be gone."""
    monday, tuesday = ({**KITTI, "input": {"digest": f"xxh3:{k}"}} for k in (3, 5))
    (tmp_path / "export.json").write_text(json.dumps({**monday, "made": [], "objects": 3}))

    _require_own(tmp_path, monday)
    with pytest.raises(OutputError, match="of another recording; choose another --out"):
        _require_own(tmp_path, tuesday)


def test_data_set_with_other_recordings_is_not_replaced(tmp_path: Path) -> None:
    """Crops are added to a data set; users who expect the same of images would lose some."""
    monday, tuesday, both = (
        {"format": "coco", "recordings": list(names)} for names in ("a", "b", "ab")
    )
    (tmp_path / "export.json").write_text(json.dumps({**monday, "made": [], "objects": 3}))

    _require_own(tmp_path, monday)
    _require_own(tmp_path, both)
    with pytest.raises(OutputError, match="of another recording; choose another --out"):
        _require_own(tmp_path, tuesday)


def test_data_set_of_several_recordings_is_not_replaced_by_one_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Exporting only a corrected run again would delete the images of the other runs."""

    def read(folder: Path) -> Any:
        name, info = folder.name, {"counts": {"frames": 1}, "input": {"digest": f"d-{folder.name}"}}
        run = {"id": f"id-{name}", "color": {"/depth": "/color"}, **info}
        return SimpleNamespace(name=name, folder=folder, categories=("cup",), info=run)

    monkeypatch.setitem(DATASETS, "coco", lambda *_: 3)
    a, b, c = (read(tmp_path / name) for name in "abc")
    out = tmp_path / "out"
    export_dataset([b, a], "coco", out, ImageSelection())
    for alone in (a, b):
        with pytest.raises(OutputError, match=r"of another recording; .* export all runs together"):
            export_dataset([alone], "coco", out, ImageSelection())
    export_dataset([c, b, a], "coco", out, ImageSelection())

    assert json.loads((out / "export.json").read_text()) == {
        "format": "coco",
        "runs": {"a": "id-a", "b": "id-b", "c": "id-c"},
        "recordings": ["d-a", "d-b", "d-c"],
        "objects": 3,
        "made": [],
    }


def test_export_of_other_topics_is_not_replaced(tmp_path: Path) -> None:
    """Two runs of one recording, one for each camera, may have the same name."""
    left, right = ({**KITTI, "topics": [name]} for name in ("/left", "/right"))
    mark = tmp_path / "export.json"
    mark.write_text(json.dumps({**left, "made": [], "objects": 3}))

    _require_own(tmp_path, left)
    with pytest.raises(OutputError, match="of other topics; choose another --out"):
        _require_own(tmp_path, right)


@pytest.mark.parametrize(
    ("earlier", "later", "kept"),
    [
        ((None, 5.0), (5.0, None), True),
        ((None, None), (None, 5.0), True),
        ((2.0, 5.0), (3.0, 9.0), True),
        ((2.0, 5.0), (2.0, 5.0), False),
        ((2.0, 5.0), (None, 5.5), False),
        ((2.0, None), (None, None), False),
    ],
)
def test_export_of_other_time_range_is_not_replaced(
    tmp_path: Path, earlier: Any, later: Any, kept: bool
) -> None:
    """Two runs of one recording, one for each part, may have the same name."""
    before, after = ({**KITTI, "range_s": list(part)} for part in (earlier, later))
    mark = tmp_path / "export.json"
    mark.write_text(json.dumps({**before, "made": [], "objects": 3}))

    refused = pytest.raises(OutputError, match="of another time range; choose another --out")
    with refused if kept else nullcontext():
        _require_own(tmp_path, after)


@pytest.mark.parametrize("wrong", [{"range_s": 3}, {"range_s": ["a", 2]}, {"recordings": 3}])
def test_export_json_of_other_programs_is_not_taken_for_an_export(
    tmp_path: Path, wrong: Any
) -> None:
    """An export.json that another program had made ended in a traceback."""
    (tmp_path / "export.json").write_text(json.dumps({**KITTI, "made": [], "objects": 3, **wrong}))

    with pytest.raises(OutputError, match="holds something else"):
        _require_own(tmp_path, KITTI)


def test_file_moved_into_export_is_not_deleted_with_it(tmp_path: Path) -> None:
    """A moved file keeps its time of change, which may be before the export."""
    out, mine = tmp_path / "out", tmp_path / "mine.png"
    mine.write_bytes(b"mine")
    os.utime(mine, ns=(0, 0))

    def write(hidden: Path) -> int:
        (hidden / "images").mkdir()
        (hidden / "images" / "new.png").write_bytes(b"new")
        return 1

    _staged(out, KITTI, write)
    _staged(out, KITTI, write)
    mine.rename(out / "images" / "mine.png")
    with pytest.raises(OutputError, match="images: was changed after the export"):
        _staged(out, KITTI, write)
    assert (out / "images" / "mine.png").read_bytes() == b"mine"


def test_link_in_export_counts_by_its_own_time(tmp_path: Path) -> None:
    """A link to a missing file ended in a traceback."""
    gone, mark = tmp_path / "gone", tmp_path / "export.json"
    gone.symlink_to("nowhere")
    mark.write_text(json.dumps({**KITTI, "made": [], "objects": 3}))
    exported = mark.stat().st_mtime_ns
    os.utime(gone, ns=(exported, exported), follow_symlinks=False)
    _require_own(tmp_path, KITTI)

    os.utime(gone, ns=(exported, exported + 1000), follow_symlinks=False)
    with pytest.raises(OutputError, match="gone: was changed after the export"):
        _require_own(tmp_path, KITTI)


def test_export_excludes_files_of_interrupted_export(tmp_path: Path) -> None:
    """Left-over images would have no labels, and be mistaken for background."""
    out = tmp_path / "out"

    def interrupted(hidden: Path) -> int:
        (hidden / "images").mkdir()
        (hidden / "images" / "old.png").write_bytes(b"old")
        raise KeyboardInterrupt

    def write(hidden: Path) -> int:
        (hidden / "images").mkdir()
        (hidden / "images" / "new.png").write_bytes(b"new")
        return 7

    with pytest.raises(KeyboardInterrupt):
        _staged(out, KITTI, interrupted)
    assert not out.exists()
    assert _staged(out, KITTI, write) == 7
    assert [path.name for path in tmp_path.rglob("*.png")] == ["new.png"]
    mark = json.loads((out / "export.json").read_text())
    assert mark == {"format": "kitti", "objects": 7, "made": ["images"]}


KITTI = {"format": "kitti"}


def test_only_unchanged_export_of_same_format_is_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out"
    _require_own(out, KITTI)
    out.mkdir()
    _require_own(out, KITTI)
    (out / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="holds something else"):
        _require_own(out, KITTI)
    mark = out / "export.json"
    mark.write_text("[" * 100_000)
    with pytest.raises(OutputError, match="holds something else"):
        _require_own(out, KITTI)
    mark.write_text(json.dumps({"format": "kitti", "made": ["notes.txt"], "objects": 3}))
    _require_own(out, KITTI)
    assert _made_by_export(out) == ["notes.txt", "export.json"]
    with pytest.raises(OutputError, match="holds kitti, not an earlier labelcloud"):
        _require_own(out, {"format": "labelcloud"})
    later = mark.stat().st_mtime_ns + 1000
    (out / "deep").mkdir()
    (out / "deep" / "label.txt").write_text("by hand")
    os.utime(out / "deep" / "label.txt", ns=(later, later))
    with pytest.raises(OutputError, match=r"label\.txt: was changed after the export"):
        _require_own(out, KITTI)
    mark.write_text(json.dumps({"format": "kitti", "made": ["../notes.txt"]}))  # killed in between
    assert sorted(_made_by_export(out) or ()) == ["deep", "export.json", "notes.txt"]
    mark.write_text(json.dumps({"made": "all"}))
    assert _made_by_export(out) is None


# ---- point labels


def point_labels(out: Path) -> int:
    depth = np.array([[0.5004, 1.2346, 65.5354], [70.0, 0.0, 65.536]], np.float32)
    camera = Camera(3, 2, 143.0, 139.0, 1.25, 0.75)
    image = Frame("/depth", 4, 5, 6, "cam", depth, camera)
    none = [np.nan, 0, 0]
    points = np.array([none, [1, 2, 3], none, [4, 5, 6], [7, 8, np.inf]], np.float32)
    cloud = Frame("/scan", 9, 7, 8, "laser", points=points)
    cup, box = labelled_object(3, [0, 5]), labelled_object(300, [2], category="box")
    scanned = labelled_frame(9, replace(box, indices=np.array([0, 3])), topic="/scan")
    frames = [
        (replace(labelled_frame(4, cup, box), stamp_ns=5), image, None),
        (replace(scanned, stamp_ns=7), cloud, None),
    ]
    labels = {3: TrackLabel(3, "cup", 0.6), 300: TrackLabel(300, "box", 1.0)}
    run: Any = SimpleNamespace(folder=out, labels=labels, categories=("cup", "can", "box"))
    return write_point_labels(out, frames, run)


def test_point_labels_have_class_and_instance_of_each_point(tmp_path: Path) -> None:
    assert point_labels(tmp_path) == 3

    def pixels(folder: str) -> list[list[int]]:
        data = (tmp_path / folder / "000000.png").read_bytes()
        return np.asarray(Image.open(io.BytesIO(data))).tolist()  # type: ignore[no-any-return]

    assert pixels("depth") == [[500, 1235, 65535], [0, 0, 0]]
    assert pixels("semantic") == [[2, 0, 4], [0, 0, 2]]
    assert pixels("instance") == [[3, 0, 300], [0, 0, 3]]
    rows = np.fromfile(tmp_path / "velodyne" / "000001.bin", "<f4").reshape(-1, 4)
    assert rows.tolist() == [[1, 2, 3, 0], [4, 5, 6, 0]]
    assert np.fromfile(tmp_path / "labels" / "000001.label", "<u4").tolist() == [0, 300 * 65536 + 4]
    with (tmp_path / "frames.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert list(first.values()) == ["000000", "/depth", "4", "5", "3", "2", "143.0", "139.0",
                                    "1.25", "0.75"]  # fmt: skip
    assert list(second.values()) == ["000001", "/scan", "9", "7", *[""] * 6]


def test_tracks_beyond_16_bits_are_refused(tmp_path: Path) -> None:
    """Cut to 16 bits, their numbers would become the numbers of other tracks."""
    run: Any = SimpleNamespace(folder=tmp_path, labels={65536: TrackLabel(65536, "cup", 1.0)})
    with pytest.raises(OutputError, match="65535"):
        write_point_labels(tmp_path, [], run)


def test_point_label_legends_have_right_colours(tmp_path: Path) -> None:
    """The tools of SemanticKITTI read colours as blue, green, red."""
    point_labels(tmp_path)
    legend = json.loads((tmp_path / "labels.json").read_text())

    assert legend["classes"] == {"0": "none", "1": "unknown", "2": "cup", "3": "can", "4": "box"}
    assert list(legend["colours"].values()) == [
        [0, 0, 0], [226, 226, 220], [229, 72, 77], [70, 167, 88], [62, 130, 246]
    ]  # fmt: skip
    assert legend["instances"] == {"3": "cup", "300": "box"}
    same = [f"  {k}: {k}" for k in range(5)]
    assert (tmp_path / "semantic-kitti.yaml").read_text().splitlines() == [
        "name: shapecat",
        "labels:", '  0: "none"', '  1: "unknown"', '  2: "cup"', '  3: "can"', '  4: "box"',
        "color_map:", "  0: [0, 0, 0]", "  1: [220, 226, 226]", "  2: [77, 72, 229]",
        "  3: [88, 167, 70]", "  4: [246, 130, 62]",
        "learning_map:", *same, "learning_map_inv:", *same,
        "learning_ignore:", "  0: true", *(f"  {k}: false" for k in range(1, 5)),
    ]  # fmt: skip


# ---- crops


def test_crop_height_starts_at_its_support() -> None:
    """The height above the support is used if known, else half of the height of the box."""
    item = labelled_object(1, [0, 2], height_m=0.31)
    middle = float(UP @ item.box.center)
    assert support_offset(item, UP) == pytest.approx(middle - 0.31)
    assert support_offset(replace(item, height_m=np.nan), UP) == pytest.approx(middle - 0.095)
    points = np.array([[0.3, -0.2, 1.2], [9, 9, 9], [np.nan, 0, 1], [0.1, 0.4, 1.0]], np.float32)
    frame = Frame("/scan", 0, 0, 0, "cam", points=points)
    one = replace(item, indices=np.array([0, 2, 3]))
    found = upright_cloud(labelled_frame(0, one), frame, one)
    assert found is not None
    assert_allclose(found[0][:, 2], points[[0, 3]] @ UP - (middle - 0.31), atol=1e-6)
    empty = replace(item, indices=np.array([2]))
    assert upright_cloud(labelled_frame(0, empty), frame, empty) is None


# ---- the hierarchy of a frame as text


def row(**changes: Any) -> dict[str, Any]:
    return {
        "indices": [7, 8], "center": [0.3, -0.2, 1.1], "size": [0.124, 0.071, 0.196],
        "orientation": UPRIGHT, "plane": 0, "on_detection": None, "height_m": 0.1,
        "touches_border": False, "occluded": False,
    } | changes  # fmt: skip


def test_support_height_is_relative_to_plane() -> None:
    """The support's height is the centre's height above the plane minus that above the support."""
    normal = np.array([0.6, 0.0, 0.8])
    plane = Plane(normal, 0.4, np.zeros((3, 3)), 0.5, 0.7)
    high = 0.6 * 0.3 + 0.8 * 1.1 - 0.4
    stacked = _candidate(row(height_m=0.25, on_detection=3), [plane])
    assert stacked.support_m == pytest.approx(high - 0.25)
    assert stacked.on_candidate == 3
    assert _candidate(row(height_m=high + 9e-6), [plane]).support_m == 0
    assert _candidate(row(height_m=high + 2e-5), [plane]).support_m == pytest.approx(-2e-5, rel=0.1)
    assert _candidate(row(plane=None), [plane]).support_m == 0


def test_scene_node_text_has_track_size_and_flags() -> None:
    plane = Plane(np.array([0, 0, 1.0]), 0.4, np.zeros((3, 3)), 0.567, 0.734)
    found = [
        _candidate(row(**changes), [plane])
        for changes in ({}, {"touches_border": True, "occluded": True}, {"occluded": True})
    ]
    scene = Scene(np.array([0, 0, 1.0]), (plane,), tuple(found))
    item = labelled_object(6, [7, 8], box=found[0].box)
    items = {0: item, 1: replace(item, touches_border=True, occluded=True)}
    texts = [_described(scene, Node("object", k), items) for k in range(3)]
    whole = replace(found[0].box, size=np.array([0.14, 0.08, 0.21]))
    texts.append(_described(scene, Node("object", 0), {0: replace(item, full=whole)}))

    assert _described(scene, Node("plane", 0), {}) == "plane 0: 0.73 m high, 0.57 m²"
    assert texts == [
        "cup #6: 12 x 7 x 20 cm",
        "cup #6: 12 x 7 x 20 cm, cut by the border, occluded",
        "object in no track: 12 x 7 x 20 cm, occluded",
        "cup #6: 14 x 8 x 21 cm",  # of the whole object, where it is known
    ]


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.48, -0.6, -0.64)])
def test_scene_shows_merged_objects_once_and_no_deleted_ones(up: Any) -> None:
    """A mug found in three parts stands on a deleted plate, and a ball on the upper part.

    The first part of the mug, its rim, was thought to stand on the can beside it.
    """
    up = np.array(up)
    plane = Plane(up, 0.0, np.zeros((3, 3)), 0.5, 0.7)
    heights = {"rim": 0.12, "ball": 0.2, "plate": 0.01, "handle": 0.09, "body": 0.05, "can": 0.3}
    number = {name: k for k, name in enumerate(heights)}
    below = {"rim": "can", "ball": "rim", "handle": "body", "body": "plate", "can": "plate"}
    candidates = [
        Candidate(
            np.array([k]), box_at(height * up, (0.01, 0.01, 0.01)), 0,
            number.get(below.get(name, "")), 0.1 if name in below else 0.0, False, name == "body",
        )
        for k, (name, height) in enumerate(heights.items())
    ]  # fmt: skip
    scene = Scene(up, (plane,), tuple(candidates))
    box = box_at(0.085 * up, (0.08, 0.1, 0.14))
    mug = labelled_object(8, [0, 3, 4], box=box, category="mug", detections=(0, 3, 4))
    ball = labelled_object(1, [1], category="ball", detections=(1,))
    mug = replace(mug, occluded=True)

    changed, objects = _apply_labels(scene, [mug, ball], {number["plate"]})
    lines = format_tree(changed, lambda node: _described(changed, node, objects)).splitlines()

    assert [line.partition(":")[0] for line in lines] == [
        "plane 0",
        "  mug #8",
        "    ball #1",
        "  object in no track",
    ]
    assert lines[1].endswith(": 8 x 10 x 14 cm, occluded")


# ---- masks on images


def test_overlay_with_many_categories_shows_all_masks_in_their_colours() -> None:
    names = [f"kind {'abcdefghijklmnopqrst'[k]}" for k in range(20)]
    objects = [labelled_object(k, [k], category=name) for k, name in enumerate(names)]
    masks = tuple(Mask(k + 1, 1, np.ones((1, 1), bool)) for k in range(len(names)))
    layer = mask_layer(list(zip(objects, masks, strict=True)), 3, 23)
    overlay = np.asarray(Image.open(io.BytesIO(layer)).convert("RGBA"))

    assert np.argwhere(overlay[..., 3]).tolist() == [[1, k + 1] for k in range(len(names))]
    assert overlay[1, 1:21, :3].tolist() == [list(colour_of(name)) for name in names]


# ---- image boxes and labels


def test_missing_frame_error_lists_existing_frames(tmp_path: Path) -> None:
    """With a time range or every n-th message, frames are not numbered from 0 to the end."""
    keys = [("/a", 3), ("/b", 0), ("/a", 6), ("/b", 2), ("/a", 9)]
    rows = [{"topic": topic, "frame": frame} for topic, frame in keys]
    pq.write_table(pa.Table.from_pylist(rows, FRAMES), tmp_path / "frames.parquet")

    assert _topic(tmp_path, 6, None) == "/a"
    for frame, topic, message in (
        (2, "/a", "no frame 2 on /a; its frames: 3 to 9 of /a"),
        (4, None, "no frame 4; its frames: 3 to 9 of /a, 0 to 2 of /b"),
        (6, "/c", "no frame on /c; its topics: /a, /b"),
    ):
        with pytest.raises(OutputError) as error:
            _topic(tmp_path, frame, topic)
        assert str(error.value) == f"{tmp_path}: {message}"


def test_image_box_corners_enclose_its_pixels() -> None:
    box = ImageBox(6, "cup", 0.8, (11, 23, 40, 7))
    assert box.corners == [(11, 23), (51, 23), (51, 30), (11, 30)]
    assert box.text == "#6 cup 0.80"


def damerau(a: str, b: str) -> int:
    """Return the Damerau-Levenshtein distance, by trying all edits recursively."""
    if not a or not b:
        return len(a) + len(b)
    counts = [
        damerau(a[:-1], b) + 1,
        damerau(a, b[:-1]) + 1,
        damerau(a[:-1], b[:-1]) + (a[-1] != b[-1]),
    ]
    if len(a) > 1 and len(b) > 1 and a[-1] == b[-2] and a[-2] == b[-1]:
        counts.append(damerau(a[:-2], b[:-2]) + 1)
    return min(counts)


def test_slips_match_damerau_levenshtein_distance() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        a, b = ("".join(rng.choice(list("abc"), rng.integers(0, 6))) for _ in range(2))
        assert _slips(a, b) == _slips(b, a) == damerau(a, b)


@pytest.mark.parametrize("rows", [(0, 0), (0, 9), (3, 4), (0, 1), (8, 9)])
def test_png_of_masks_reads_back(rows: tuple[int, int]) -> None:
    """Level 1 encodes only runs of equal bytes, such as blank rows."""
    entries = np.zeros((9, 12), np.uint8)
    entries[slice(*rows)] = np.arange(12) % 5
    palette = np.arange(15, dtype=np.uint8).reshape(5, 3)
    data = png(entries, palette, level=1)
    at = data.index(b"IDAT")
    zlib.decompress(data[at + 4 : at + 4 + int.from_bytes(data[at - 4 : at], "big")])
    with Image.open(io.BytesIO(data)) as file:
        np.testing.assert_array_equal(np.asarray(file), entries)


def test_export_of_recording_that_lost_frames_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames would be missing from the export without a word."""
    labelled = [labelled_frame(k) for k in (1, 4)]
    read: Any = [(SimpleNamespace(topic="/depth", index=k), None) for k in (0, 1, 2, 3)]
    monkeypatch.setattr("shapecat.outputs.colouring.read_frames", lambda *_, **__: iter(read))
    run: Any = {"options": {"topics": ["/depth"]}, "color": {}}
    recording: Any = SimpleNamespace(path="a.mcap")
    paired = with_colour(labelled, recording, run)

    label, frame, _ = next(paired)
    assert (label.index, frame.index) == (1, 1)
    with pytest.raises(OutputError, match=r"^a\.mcap: has changed since it was processed"):
        next(paired)


def test_frames_of_sensors_with_equal_numbers_are_not_confused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The cloud and colours of one sensor would be shown or exported with objects of the other."""
    sensors = ("/left", "/right")
    asked: dict[str, Any] = {}

    def read_frames(*_: Any, **options: Any) -> Any:
        asked.update(options)
        return iter([(SimpleNamespace(topic=t, index=k), None) for k in range(4) for t in sensors])

    monkeypatch.setattr("shapecat.outputs.colouring.read_frames", read_frames)
    images = {("/right", 0): 50, ("/left", 2): 70, ("/right", 2): 80}
    labelled = [
        replace(
            labelled_frame(number, topic=topic),
            masks=ImageMasks(f"{topic}/color", 5, log_time, "cam", 6, 4, {}, {}),
        )
        for (topic, number), log_time in images.items()
    ]
    colours = {topic: f"{topic}/color" for topic in sensors}
    run: Any = {"options": {"topics": [*sensors]}, "color": colours}
    recording: Any = SimpleNamespace(path="a.bag")
    paired = with_colour(labelled, recording, run)

    found = [next(paired)]
    keys = [(topic, number) for number in range(4) for topic in sensors]
    image_of = {key: asked["same_images"](*key) for key in keys}
    needed = [(t, at) for t in colours.values() for at in images.values() if asked["needed"](t, at)]
    found += paired

    assert {key: at for key, at in image_of.items() if at is not None} == images
    assert needed == [("/left/color", 70), ("/right/color", 50), ("/right/color", 80)]
    assert [(label.topic, label.index) for label, *_ in found] == [*images]
    assert [(frame.topic, frame.index) for _, frame, _ in found] == [*images]


def test_tree_and_pictures_of_a_frame_are_of_its_own_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two sensors share frame numbers: one would be shown with the tracks of the other."""
    with PerceptionTables(tmp_path, categories=("cup", "can"), model_id="m1") as tables:
        for topic, count in (("/a", 2), ("/b", 1)):
            tables.write([perception(3, count, topic)], [FrameRow(5, None)])
    write_tracks(tmp_path, [(5, 3, 0), (6, 3, 1), (7, 3, 0)], topics=["/a", "/a", "/b"])
    labels = {track: TrackLabel(track, "cup", 0.9) for track in (5, 6, 7)}
    rows = [SimpleNamespace(track=k, category="cup", confidence=0.9) for k in labels]
    finished: Any = SimpleNamespace(
        folder=tmp_path,
        table=SimpleNamespace(rows=rows),
        labels=labels,
        frames=lambda: read_labelled_frames(tmp_path, labels),
    )
    monkeypatch.setattr("shapecat.outputs.scene_tree.read_finished", lambda _: finished)

    for topic, shown in (("/b", {7}), ("/a", {5, 6})):
        text = describe_scene(tmp_path, 3, topic=topic)
        assert {track for track in labels if f"#{track}:" in text} == shown
        assert len(text.splitlines()) == 2 + len(shown)  # below two planes
        choice: Any = SimpleNamespace(frames=[(topic, 3)])
        (frame,) = _frames(finished, choice)
        assert {item.track for item in frame.objects} == shown


def test_frame_of_two_topics_needs_a_topic(tmp_path: Path) -> None:
    """Otherwise the scene of one of the cameras would be shown, whichever came first."""
    keys = [("/a", 3), ("/b", 3), ("/b", 4)]
    rows = [{"topic": topic, "frame": frame} for topic, frame in keys]
    pq.write_table(pa.Table.from_pylist(rows, FRAMES), tmp_path / "frames.parquet")

    with pytest.raises(OutputError) as error:
        _topic(tmp_path, 3, None)
    assert str(error.value) == f"{tmp_path}: frame 3 is on /a, /b; choose one with --topic"
    assert (_topic(tmp_path, 3, "/b"), _topic(tmp_path, 4, None)) == ("/b", "/b")


def test_points_of_coloured_cloud_have_their_own_colours() -> None:
    """The colours of a cloud are one per point, row by row."""
    rgb = np.arange(8, 8 + 8 * 18, 8).reshape(6, 3)
    image = ColourImage("/c", 5, 6, "laser", "rgb8", 3, 2, 9, rgb.astype(np.uint8).tobytes())
    cloud = Frame("/c", 0, 5, 6, "laser", points=np.zeros((6, 3), np.float32))
    chosen = np.array([5, 1, 2, 3], np.int32)
    palette, tones = np.full((1, 3), 255, np.uint8), np.zeros(4, np.uint16)

    found = true_colours(
        cloud, ColourView(image), np.zeros((4, 3), np.float32), chosen, 8, palette, tones
    )

    channels = np.stack([found >> 24, found >> 16 & 255, found >> 8 & 255], axis=1).astype(int)
    assert_allclose(channels, rgb[chosen] + 4)
    assert (found & 255).tolist() == [255] * 4


def test_report_does_not_draw_objects_on_another_recording() -> None:
    """If smaller images have replaced the recorded ones, pixels of objects lie outside them."""
    depth = np.ones((4, 6), np.float32)
    frame = Frame("/depth", 7, 5, 6, "cam", depth, Camera(6, 4, 5, 5, 3, 2))
    inside, outside = labelled_object(1, [3, 23]), labelled_object(2, [3, 24])

    _require_unchanged(labelled_frame(7, inside), frame)
    with pytest.raises(RecordingError, match="frame 7 of /depth has changed since it was"):
        _require_unchanged(labelled_frame(7, inside, outside), frame)


@pytest.mark.parametrize(
    ("category", "guess", "text"),
    [
        ("unknown", "tea <pot>", '<span class="guess">perhaps tea &lt;pot&gt;</span>'),
        ("unknown", "", ""),
        ("cup", "can", ""),
    ],
)
def test_card_names_the_guess_of_an_unknown_object_only(
    category: str, guess: str, text: str
) -> None:
    """A guess beside a decided category would contradict it."""
    row: Any = SimpleNamespace(category=category, cells={"guess": guess})

    assert _guess(row) == text


@pytest.mark.parametrize("kind", ["cloud", "image"])
def test_clouds_have_no_image_in_a_data_set(kind: str) -> None:
    """The colours of points are not an image: it would be one row high."""
    height = 1 if kind == "cloud" else 4
    image = ColourImage("/c", 5, 6, "l", "rgb8", 6, height, 18, bytes(18 * height))
    depth = None if kind == "cloud" else np.ones((4, 6), np.float32)
    points = np.zeros((6, 3), np.float32) if kind == "cloud" else None
    frame = Frame("/c", 0, 5, 6, "l", depth, Camera(6, 4, 5, 5, 3, 2), points=points)
    coloured = Coloured(ColourView(image), ())

    found = _colour_file(frame, coloured), _depth_file(labelled_frame(0), frame)

    assert [one is not None and one[2] for one in found] == [
        (4, 6) if kind == "image" else False
    ] * 2


def test_long_names_are_cut_between_characters_and_stay_different() -> None:
    """Names are cut to 120 bytes, of which a Chinese character takes three."""
    assert safe_name("厨" * 90) == "厨" * 40
    assert safe_name("a" + "厨" * 90) == "a" + "厨" * 39
    assert different_names(["厨" * 90, "厨" * 91, "b"]) == ["厨" * 40, "厨" * 40 + "-2", "b"]
