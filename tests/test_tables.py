"""Tests of the tables of a run: columns, order, and damage that is refused."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose

from shapecat.config import Settings
from shapecat.errors import OutputError
from shapecat.outputs.opened_run import Table
from shapecat.runs import labelled_tracks
from shapecat.runs.folder import read_run
from shapecat.runs.labelled_frames import read_labelled_frames
from shapecat.runs.labelled_tracks import LabelledTracks, read_annotation_frames
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.perceive.perceived import _SEGMENT_FRAMES, FrameRow, PerceptionTables
from shapecat.runs.run_info import (
    Counts,
    InputInfo,
    ModelInfo,
    Options,
    OriginInfo,
    RunInfo,
)
from shapecat.runs.tables.masks import mask_columns, read_nearest_masks
from shapecat.runs.tables.reading import (
    keys_of,
    opened,
    read_row_groups,
    read_rows,
    read_together,
    with_fixed_lists,
)
from shapecat.runs.tables.schemas import DETECTIONS, FRAMES, MASKS, PLANES, TABLES, TRACKS
from shapecat.runs.tables.segments import SEGMENTS, list_segments
from shapecat.runs.tables.writing import arrow_table, lists, open_writer, write_table
from shapecat.types import (
    Box,
    Candidate,
    Detection,
    ImageMasks,
    NeuralGas,
    Perception,
    Plane,
    Pose,
    Scene,
)
from tests.track_tables import read_masks, write_tracks

CATEGORIES = ("cup", "can")


def plane(height: float) -> Plane:
    outline = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1]])
    return Plane(np.array([0, -1, 0]), -0.5 + height, outline, 0.5, height)


def detection(k: int, *, points: int = 4) -> Detection:
    candidate = Candidate(
        indices=np.arange(k, k + points),
        box=Box(np.array([0.1 * k, 0, 1]), np.array([0.1, 0.1, 0.2]), np.array([0, 0, 0, 1])),
        plane=None if k == 2 else 1,
        on_candidate=0 if k == 1 else None,
        support_m=0.1 if k == 1 else 0.0,
        touches_border=k == 0,
        occluded=k == 1,
    )
    gas = NeuralGas(np.full((k + 2, 3), k), np.array([[0, 1]]))
    posterior = np.array([0.9, 0.1] if k % 2 else [0.2, 0.8])
    return Detection(candidate, gas, np.arange(5.0) + k, posterior, 0.5 + k, 0.001)


def perception(index: int, count: int, topic: str = "/depth") -> Perception:
    scene = Scene(np.array([0, -1, 0]), (plane(0), plane(0.3)), ())
    found = tuple(detection(k) for k in range(count))
    seconds = {"detect": 0.01, "describe": 0.002}
    return Perception(topic, index, 1000 + index, "cam", scene, found, seconds)


def write_run_tables(folder: Path, counts: list[int], pose: Pose | None = None) -> None:
    with PerceptionTables(folder, categories=CATEGORIES, model_id="m1") as tables:
        for index, count in enumerate(counts):
            tables.write([perception(index, count)], [FrameRow(2000 + index, pose)])


def test_tables_have_documented_columns(tmp_path: Path) -> None:
    """Users' programs read these files."""
    write_run_tables(tmp_path, [3, 0, 2], Pose(np.eye(3), np.array([0, 0, 10])))

    table = pq.read_table(tmp_path / "detections.parquet")
    row = table.to_pylist()[1]

    assert with_fixed_lists(table).schema.equals(DETECTIONS)
    assert table.num_rows == 5
    assert table.schema.metadata[b"categories"] == b"cup,can"
    assert table.schema.metadata[b"model"] == b"m1"
    assert (row["plane"], row["on_detection"], row["touches_border"]) == (1, 0, False)
    assert row["indices"] == [1, 2, 3, 4]
    assert row["category"] == "unknown"
    assert_allclose(row["center_fixed"], [0.1, 0, 11])
    assert_allclose(row["height_m"], 0.1, atol=1e-6)
    assert pq.read_table(tmp_path / "planes.parquet").schema.equals(PLANES)
    frames = with_fixed_lists(pq.read_table(tmp_path / "frames.parquet"))
    assert frames.schema.equals(FRAMES)
    assert pq.read_table(tmp_path / "frames.parquet")["frame"].to_pylist() == [0, 1, 2]


def test_pixel_indices_are_delta_encoded(tmp_path: Path) -> None:
    """Pixel indices are most of a table; as plain numbers, they would take ten times the space."""
    write_run_tables(tmp_path, [2])
    group = pq.read_metadata(tmp_path / "detections.parquet").row_group(0)
    columns = [group.column(k) for k in range(group.num_columns)]
    (indices,) = (one for one in columns if one.path_in_schema == "indices.list.element")

    assert "DELTA_BINARY_PACKED" in indices.encodings


@pytest.mark.parametrize("empty", [0, 40, 150])
def test_row_groups_of_all_tables_cover_same_frames(tmp_path: Path, empty: int) -> None:
    """Tables are read side by side; frames without detections must not shift their row groups."""
    counts = [0 if k < empty else k % 3 for k in range(150)]
    write_run_tables(tmp_path, counts)
    names = ("frames", "detections", "planes")
    groups = [list(read_row_groups(tmp_path / f"{name}.parquet")) for name in names]

    assert [len(g) for g in groups] == [5, 5, 5]
    for frames, detections, planes in zip(*groups, strict=True):
        known = set(frames["frame"].to_pylist())
        assert set(detections["frame"].to_pylist()) <= known
        assert set(planes["frame"].to_pylist()) <= known
    assert sum(detections.num_rows for detections in groups[1]) == sum(counts)


def test_segments_are_written_when_full_or_old(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill may cost only two seconds of work, and many quick frames must not fill the memory."""
    clock = [7.0]
    place = "shapecat.runs.perceive.perceived"
    monkeypatch.setattr(f"{place}.time", SimpleNamespace(monotonic=lambda: clock[0]))
    stored = []
    with PerceptionTables(tmp_path, categories=CATEGORIES, model_id="m1") as tables:
        for index in range(_SEGMENT_FRAMES + 6):
            clock[0] += {1: 1.9, 2: 0.2}.get(index - _SEGMENT_FRAMES, 0)
            tables.write([perception(index, 1)], [FrameRow(2000 + index, None)])
            stored.append(len(list_segments(tmp_path / SEGMENTS)))

    assert stored == [0] * (_SEGMENT_FRAMES - 1) + [1] * 3 + [2] * 4  # the next one begins


@pytest.mark.parametrize("written", [999, 99_999])
def test_long_run_stays_in_the_order_of_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """After half an hour there are a thousand segments; exports fail if they are out of order."""
    monkeypatch.setattr("shapecat.runs.perceive.perceived._SEGMENT_FRAMES", 1)
    with PerceptionTables(tmp_path, categories=CATEGORIES, model_id="m1") as tables:
        for index in range(4):
            tables.write([perception(index, 1)], [FrameRow(2000 + index, None)])
            if index == 0:
                tables._segments *= written  # as if it had written so many

    for name in ("frames", "detections"):
        assert pq.read_table(tmp_path / f"{name}.parquet")["frame"].to_pylist() == [0, 1, 2, 3]


def test_second_look_without_result_does_not_replace_frame(
    tmp_path: Path,
) -> None:
    """With another up direction, nothing may be found; the first result is then better."""
    write_run_tables(tmp_path, [2, 1, 0, 2])
    nothing = replace(perception(3, 0), scene=Scene(np.array([0, -1, 0]), (), ()))
    again = PerceptionTables(tmp_path, categories=CATEGORIES, model_id="m1", again=True)
    with again as tables:
        rows = [FrameRow(2001, None), FrameRow(2003, None)]
        tables.write([perception(1, 3), nothing], rows)

    read = {n: pq.read_table(tmp_path / f"{n}.parquet") for n in ("frames", "detections", "planes")}

    assert read["frames"]["revised"].to_pylist() == [False, True, False, False]
    assert read["detections"]["frame"].to_pylist() == [0, 0, 1, 1, 1, 3, 3]
    assert read["planes"]["frame"].to_pylist() == [0, 0, 1, 1, 2, 2, 3, 3]


@pytest.mark.parametrize("segment_frames", [1, 9])
def test_second_look_replaces_frame_of_its_own_sensor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, segment_frames: int
) -> None:
    """Sensors share frame numbers, and these have gaps with --every or after skipped frames."""
    monkeypatch.setattr("shapecat.runs.perceive.perceived._SEGMENT_FRAMES", segment_frames)
    counts = {("/a", 2): 2, ("/b", 2): 1, ("/a", 5): 1, ("/b", 5): 0, ("/a", 8): 2, ("/b", 8): 1}
    again = {("/b", 2): 3, ("/a", 8): 1, ("/b", 8): 2}
    for found in (counts, again):
        is_second = found is again
        with PerceptionTables(
            tmp_path, categories=CATEGORIES, model_id="m1", again=is_second
        ) as tables:
            for (topic, index), count in found.items():
                row = FrameRow(2000 + index, None)
                tables.write([perception(index, count, topic)], [row])

    frames, detections, planes = (
        pq.read_table(tmp_path / f"{name}.parquet") for name in ("frames", "detections", "planes")
    )
    assert dict(zip(keys_of(frames), frames["revised"].to_pylist(), strict=True)) == {
        key: key in again for key in counts
    }
    expected = [key for key, count in (counts | again).items() for _ in range(count)]
    assert keys_of(detections) == expected
    assert keys_of(planes) == [key for key in counts for _ in range(2)]


def test_second_look_replaces_masks(tmp_path: Path) -> None:
    """Detections of a revised frame have other numbers: older masks would be of other objects."""

    def masked(index: int, boxes: dict[int, tuple[int, int, int, int]]) -> Perception:
        counts = {n: np.array([24 - 2 * n, 2 * n], np.uint32) for n in boxes}
        masks = ImageMasks("/color", 5 + index, 7, "cam", 6, 4, boxes, counts)
        return replace(perception(index, 3), masks=masks)

    options: Any = {"categories": CATEGORIES, "model_id": "m1", "colour": True}
    with PerceptionTables(tmp_path, **options) as tables:
        for k in range(4):
            tables.write([masked(k, {1: (k, 0, 2, 1)})], [FrameRow(k, None)])
    with PerceptionTables(tmp_path, **options, again=True) as tables:
        boxes = {0: (3, 1, 1, 2), 2: (4, 2, 2, 2)}
        tables.write([masked(2, boxes)], [FrameRow(2, None)])

    found = [(key[1], masks.boxes) for key, masks in read_masks(tmp_path)]
    assert found == [
        (0, {1: (0, 0, 2, 1)}),
        (1, {1: (1, 0, 2, 1)}),
        (2, boxes),
        (3, {1: (3, 0, 2, 1)}),
    ]


@pytest.mark.parametrize("count", [0, 2])
def test_frames_without_tracks_have_no_objects(tmp_path: Path, count: int) -> None:
    """Empty tables and unconfirmed detections are valid results."""
    write_run_tables(tmp_path, [count, 0])
    write_tracks(tmp_path, [])

    assert [
        (f.index, tuple(f.objects))
        for f in read_annotation_frames(tmp_path, LabelledTracks.read(tmp_path, {}))
    ] == [
        (0, ()),
        (1, ()),
    ]
    assert [f.objects for f in read_labelled_frames(tmp_path, {})] == [(), ()]


def test_labelled_frames_join_tracks_and_labels(tmp_path: Path) -> None:
    pose = Pose(np.eye(3), np.array([1, 2, 3]))
    write_run_tables(tmp_path, [2, 1, 0, 2], pose)
    write_tracks(tmp_path, [(5, 0, 0), (6, 0, 1), (5, 1, 0), (6, 1, None), (6, 3, 1), (9, 3, 0)])
    labels = {5: TrackLabel(5, "cup", 0.7), 6: TrackLabel(6, "vase", 1.0)}

    frames = list(read_labelled_frames(tmp_path, labels))

    assert [[o.track for o in f.objects] for f in frames] == [[5, 6], [5], [], [6]]
    assert [f.ended for f in frames] == [(), (), (5,), ()]
    assert frames[0].objects[1].category == "vase"
    assert frames[0].objects[1].gas.neurons.shape == (3, 3)
    assert frames[0].objects[1].indices.tolist() == [1, 2, 3, 4]
    assert frames[3].objects[0].box.center[0] == pytest.approx(0.1)
    assert frames[1].log_time_ns == 2001
    assert len(frames[2].planes) == 2
    assert frames[0].fixed_from_sensor is not None
    assert_allclose(frames[0].fixed_from_sensor.translation, [1, 2, 3])


def test_objects_of_two_sensors_are_kept_apart(tmp_path: Path) -> None:
    """Two sensors share frame numbers: one would get the tracks or masks of the other."""
    counts = {("/a", 2): 2, ("/b", 2): 3, ("/a", 5): 1, ("/b", 5): 2}
    masked = {("/b", 2): {1: (3, 4, 7, 9)}, ("/a", 5): {0: (1, 2, 5, 6)}}
    with PerceptionTables(tmp_path, categories=CATEGORIES, model_id="m1", colour=True) as tables:
        for key, count in counts.items():
            found = perception(key[1], count, key[0])
            if boxes := masked.get(key):
                runs = dict.fromkeys(boxes, np.array([7]))
                masks = ImageMasks("/rgb", 1000, 2000, "c", 40, 30, boxes, runs)
                found = replace(found, masks=masks)
            tables.write([found], [FrameRow(2000, None)])
    rows = [(5, 2, 0), (5, 5, 0), (6, 2, 1), (7, 2, 0), (7, 5, 1), (8, 2, 2), (8, 5, 0)]
    write_tracks(tmp_path, rows, topics=["/a"] * 3 + ["/b"] * 4)
    labels = {track: TrackLabel(track, "cup", 1.0) for track in (5, 6, 7, 8)}

    frames = list(read_labelled_frames(tmp_path, labels))

    assert [
        (f.topic, f.index, {o.track: round(10 * float(o.box.center[0])) for o in f.objects})
        for f in frames
    ] == [
        ("/a", 2, {5: 0, 6: 1}), ("/b", 2, {7: 0, 8: 2}),
        ("/a", 5, {5: 0}), ("/b", 5, {8: 0, 7: 1}),
    ]  # fmt: skip
    assert {(f.topic, f.index): f.masks.boxes for f in frames if f.masks} == masked


def test_ended_tracks_are_reported_in_next_frame_of_sensor() -> None:
    """A viewer would not look for the end of a track in a frame of another sensor."""
    no_rows, last_in = (
        np.zeros(0, np.int64),
        {("/a", 0): (1, 4), ("/a", 30): (2,), ("/b", 20): (3,)},
    )
    tracks = LabelledTracks(
        {},
        no_rows,
        no_rows,
        {},
        last_in,
        np.zeros((0, 0), np.float32),
        np.zeros((0, 10), np.float32),
    )
    ended = tracks.endings()

    frames = [("/a", 0), ("/b", 10), ("/b", 20), ("/a", 30), ("/b", 40)]
    assert [ended(key) for key in frames] == [(), (), (), (1, 4), (3,)]


def test_detections_keep_tracks_when_rows_are_read_in_parts(tmp_path: Path) -> None:
    """Rows are sorted by track but shown by frame; some boxes are missing."""
    write_run_tables(tmp_path, [2, 2, 1])
    rows = [(5, 0, 1), (5, 1, 0), (5, 2, None), (6, 0, 0), (6, 2, 0), (7, 1, 1)]
    write_tracks(tmp_path, rows)
    table = pq.read_table(tmp_path / "tracks.parquet").to_pydict()
    table["posterior"] = [[0.1 * k, 1 - 0.1 * k] for k in range(6)]
    for name, width in (("center_full", 3), ("size_full", 3), ("orientation_full", 4)):
        table[name] = [None if k in {1, 3} else [0.5 + k] * width for k in range(6)]
    path = tmp_path / "tracks.parquet"
    pq.write_table(arrow_table(table, TRACKS), path, row_group_size=2)
    labels = {track: TrackLabel(track, "cup", 0.7) for track in (5, 6)}

    found = labelled_tracks.LabelledTracks.read(tmp_path, labels, causal=True)

    order = [3, 0, 1, 4]  # by frame and detection; 7 was deleted
    assert found.tracks.tolist() == [rows[k][0] for k in order]
    assert found.detections.tolist() == [rows[k][2] for k in order]
    assert_allclose(found.causal, [table["posterior"][k] for k in order], rtol=1e-6)
    assert_allclose(found.full[:, 0], [np.nan, 0.5, np.nan, 4.5])
    assert_allclose(found.full[3], np.full(10, 4.5))


@pytest.mark.parametrize(
    "change", [lambda rows: rows[1:], lambda rows: rows[::-1], lambda rows: rows[:0]]
)
def test_edited_detections_are_refused(tmp_path: Path, change: Callable[[Any], Any]) -> None:
    """Boxes are found by row: a filtered or sorted table gave tracks the boxes of other tracks."""
    write_run_tables(tmp_path, [2, 1])
    write_tracks(tmp_path, [(5, 0, 0), (6, 0, 1)])
    path = tmp_path / "detections.parquet"
    pq.write_table(pa.Table.from_pylist(change(pq.read_table(path).to_pylist()), DETECTIONS), path)
    labels = {5: TrackLabel(5, "cup", 0.7), 6: TrackLabel(6, "cup", 0.7)}

    with pytest.raises(OutputError, match="tables are inconsistent"):
        list(read_annotation_frames(tmp_path, LabelledTracks.read(tmp_path, labels)))


def test_track_of_missing_detection_is_refused(tmp_path: Path) -> None:
    """Such a track ended the command with a KeyError."""
    write_run_tables(tmp_path, [2])
    write_tracks(tmp_path, [(5, 0, 2)])

    labels = {5: TrackLabel(5, "cup", 0.7)}
    boxes = read_annotation_frames(tmp_path, LabelledTracks.read(tmp_path, labels))
    for frames in (boxes, read_labelled_frames(tmp_path, labels)):
        with pytest.raises(OutputError, match="tables are inconsistent"):
            list(frames)


def test_masks_of_missing_frame_are_refused(tmp_path: Path) -> None:
    """Such masks caused a RuntimeError, or an export wrote all later frames without masks."""
    write_run_tables(tmp_path, [1, 1])
    write_tracks(tmp_path, [(5, 0, 0)])
    masks = ImageMasks("/rgb", 1000, 2000, "c", 40, 30, {0: (3, 4, 7, 9)}, {0: np.array([7])})
    perceived = [replace(perception(index, 1), masks=masks) for index in (0, 5, 1)]
    write_table(tmp_path / "masks.parquet", mask_columns(perceived), MASKS)

    labels = {5: TrackLabel(5, "cup", 0.7)}
    for found in (read_nearest_masks(tmp_path), read_labelled_frames(tmp_path, labels)):
        with pytest.raises(OutputError, match="tables are inconsistent"):
            list(found)


def test_masks_stay_with_their_frames_if_many_have_none(tmp_path: Path) -> None:
    """Masks are read beside other tables: row groups without any must not shift later ones."""
    masked = range(45, 100, 7)
    options: Any = {"categories": CATEGORIES, "model_id": "m1", "colour": True}
    with PerceptionTables(tmp_path, **options) as tables:
        for k in range(100):
            runs = np.array([k, 7, 1193 - k], np.uint32)
            masks = ImageMasks("/rgb", 1000 + k, 2000, "c", 40, 30, {0: (3, 4, 7, 9)}, {0: runs})
            found = replace(perception(k, 1), masks=masks if k in masked else None)
            tables.write([found], [FrameRow(2000 + k, None)])
    write_tracks(tmp_path, [(5, k, 0) for k in range(100)])

    frames = list(read_labelled_frames(tmp_path, {5: TrackLabel(5, "cup", 0.7)}))
    runs_of = {frame.index: frame.masks.counts[0][0] for frame in frames if frame.masks}
    assert runs_of == {k: k for k in masked}
    images = {masks.stamp_ns: key[1] for key, masks in read_nearest_masks(tmp_path)}
    assert images == {1000 + k: k for k in masked}


def test_rewritten_table_with_other_row_groups_is_refused(tmp_path: Path) -> None:
    """Data frame libraries write all rows as one group."""
    path = tmp_path / "detections.parquet"
    write_run_tables(tmp_path, [1] * (_SEGMENT_FRAMES + 1))
    pq.write_table(pq.read_table(path), path)

    with pytest.raises(OutputError, match="frames, detections have different row groups"):
        list(read_together(tmp_path, {"frames": ["topic"], "detections": ["topic"]}))


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("posterior", [np.nan, 0.5]),
        ("center", [0, np.inf, 1]),
        ("size", [0.1, -0.1, 0.2]),
        ("neurons", [0.1, 0.2, 0.3, 0.4]),
        ("edges", [0, 1, 2]),
    ],
)
def test_values_that_no_run_writes_are_refused(tmp_path: Path, column: str, value: Any) -> None:
    """NaN reached pictures and data sets, or ended in a traceback far from its table."""
    write_run_tables(tmp_path, [2])
    path = tmp_path / "detections.parquet"
    rows = pq.read_table(path).to_pylist()
    rows[1][column] = value
    pq.write_table(pa.Table.from_pylist(rows, DETECTIONS), path)

    with pytest.raises(OutputError, match=f"detections.parquet: .*column {column} holds"):
        list(read_row_groups(path, ["frame", column]))


@pytest.mark.parametrize("name", TABLES)
def test_older_readers_open_tables_with_nulls(tmp_path: Path, name: str) -> None:
    """Arrow before version 26, and pandas with it, refuses nulls among lists of fixed size."""
    path = tmp_path / f"{name}.parquet"
    schema = TABLES[name].with_metadata({"model": "m"})
    write_table(path, {field.name: [None] for field in schema}, schema)

    for field in pq.read_schema(path):
        never_null = {"center", "size", "orientation", "normal", "up"}
        assert not pa.types.is_fixed_size_list(field.type) or field.name in never_null
    for table in (*read_row_groups(path), Table(path).arrow()):
        assert (table.schema, table.schema.metadata) == (schema, schema.metadata)


@pytest.mark.parametrize("name", TABLES)
def test_changed_byte_in_any_column_is_found(tmp_path: Path, name: str) -> None:
    """A disk error would move a box or change a label silently, or end in a traceback."""
    path = tmp_path / f"{name}.parquet"
    schema = TABLES[name].with_metadata({"model": "m"})
    write_table(path, {field.name: [None] for field in schema}, schema)
    content = path.read_bytes()
    group = pq.read_metadata(path).row_group(0)

    for column in map(group.column, range(group.num_columns)):
        last = column.data_page_offset + column.total_compressed_size - 1
        if column.has_dictionary_page:
            last = column.dictionary_page_offset + column.total_compressed_size - 1
        damaged = bytearray(content)
        damaged[last] ^= 1
        path.write_bytes(damaged)
        for read in (lambda: list(read_row_groups(path)), Table(path).arrow):
            with pytest.raises(OutputError, match="could not verify page integrity"):
                read()


def test_list_of_wrong_size_is_refused(tmp_path: Path) -> None:
    write_run_tables(tmp_path, [2], Pose(np.eye(3), np.zeros(3)))
    path = tmp_path / "frames.parquet"
    rows = pq.read_table(path).to_pylist()
    rows[0]["fixed_translation"] = [0.0, 1.0]
    pq.write_table(pa.Table.from_pylist(rows, pq.read_schema(path)), path)

    with pytest.raises(OutputError, match=r"frames.parquet: .* all the expected size"):
        list(read_row_groups(path, ["fixed_translation"]))


def test_no_lists_give_empty_column() -> None:
    assert lists([], DETECTIONS.field("indices").type.value_type).to_pylist() == []


def test_damaged_name_of_a_column_is_reported(tmp_path: Path) -> None:
    """Only pages have checksums; Arrow cannot decode the name."""
    write_run_tables(tmp_path, [2])
    path = tmp_path / "frames.parquet"
    path.write_bytes(path.read_bytes().replace(b"stamp_ns", b"sta\xffp_ns"))

    for read in (lambda: list(read_row_groups(path)), Table(path).arrow):
        with pytest.raises(OutputError, match=r"frames.parquet: not a readable table"):
            read()


def test_foreign_file_is_rejected_as_table(tmp_path: Path) -> None:
    (tmp_path / "frames.parquet").write_bytes(b"hello")
    with pytest.raises(OutputError, match="process the recording again"):
        list(read_row_groups(tmp_path / "frames.parquet"))


@pytest.mark.parametrize("at_once", [1, 2, 3, 8])
def test_chosen_rows_are_read_from_all_row_groups(tmp_path: Path, at_once: int) -> None:
    """Otherwise the row of another track, or of another object, would be shown."""
    path, sizes = tmp_path / "tracks.parquet", (7, 100, 1, 0, 50, 2)
    with open_writer(path, TRACKS) as writer:
        for first, size in zip(np.cumsum([0, *sizes]).tolist(), sizes, strict=False):
            group = [{"track": first + k} for k in range(size)]
            writer.write_table(pa.Table.from_pylist(group, TRACKS))
    rng = np.random.default_rng(4)
    for count in (0, 1, 5, 90, 160):
        rows = rng.choice(sum(sizes), count, replace=False)
        found = np.full(count, -1)
        with opened(path) as file:
            for at, table in read_rows(file, ["track"], rows, at_once=at_once):
                found[at] = table["track"].to_numpy()
        np.testing.assert_array_equal(found, rows)


@pytest.mark.parametrize("table", TABLES)
def test_table_with_other_columns_is_rejected(tmp_path: Path, table: str) -> None:
    """A table of another version, or rewritten by a data frame library, gave a traceback later."""
    path = tmp_path / f"{table}.parquet"
    empty = TABLES[table].empty_table()
    for k, field in enumerate(TABLES[table]):
        other = empty.set_column(k, field.name, pa.array([], pa.float64()))
        for damaged in (empty.drop_columns([field.name]), other):
            pq.write_table(damaged, path)
            with pytest.raises(OutputError, match=rf"column {field.name}\b.*process the recording"):
                next(read_row_groups(path))

    pq.write_table(empty.drop_columns(["topic"]), path)
    with (
        pytest.raises(OutputError, match="no column topic"),
        opened(path, read_dictionary=["topic"]),
    ):
        pass
    pq.write_table(empty.append_column("new", pa.array([], pa.int8())), path)
    assert [len(group) for group in read_row_groups(path)] == [0]


def test_run_json_matches_its_schema(guessed_run: Path, coloured_run: Path) -> None:
    """The schema is the documentation: it has every entry, and no other."""
    jsonschema = pytest.importorskip("jsonschema")
    schema = json.loads(files("shapecat.schemas").joinpath("run.json").read_text("utf-8"))
    jsonschema.Draft202012Validator.check_schema(schema)

    for folder in (guessed_run, coloured_run):
        jsonschema.validate(read_run(folder), schema)


@pytest.mark.parametrize(
    ("entry", "kind"),
    [
        ("", RunInfo),
        ("input", InputInfo),
        ("options", Options),
        ("model", ModelInfo),
        ("counts", Counts),
        ("origin", OriginInfo),
    ],
)
def test_schema_requires_what_the_reader_requires(entry: str, kind: Any) -> None:
    """A file that the published schema accepts would be refused."""
    schema = json.loads(files("shapecat.schemas").joinpath("run.json").read_text("utf-8"))
    part = schema["properties"][entry] if entry else schema
    assert set(part["required"]) == kind.__required_keys__
    assert part["properties"].keys() == get_type_hints(kind).keys()


@pytest.mark.parametrize(
    ("change", "wrong"),
    [
        (lambda info: info.pop("counts"), ": counts"),
        (lambda info: info.pop("color"), ": color"),
        (lambda info: info["counts"].pop("skipped"), ": counts.skipped"),
        (lambda info: info["counts"].update(frames="4"), ": counts.frames"),
        (lambda info: info["seconds"].update(perceive=True), ": seconds.perceive"),
        (lambda info: info["input"].pop("digest"), ": input.digest"),
        (lambda info: info["model"].update(categories=None), ": model.categories"),
        (lambda info: info["options"].update(start_s=math.nan), ": options.start_s"),
        (lambda info: info["options"].update(start_s=10**400), ": options.start_s"),
        (lambda info: info["options"].update(topics=["/depth", 3]), ": options.topics"),
        (lambda info: info.update(options=[]), ": options"),
        (lambda info: info["settings"].pop("outputs"), ": settings.outputs"),
        (lambda info: info["settings"].update(tracking=None), ": settings.tracking"),
        (lambda info: info["settings"]["outputs"].pop("boxes"), ": settings.outputs.boxes"),
        (lambda info: info.update(boxes=3), ": boxes"),
        (lambda info: info.clear(), ": id"),
    ],
)
def test_incomplete_run_json_is_refused(
    guessed_run: Path, tmp_path: Path, change: Callable[[dict[str, Any]], object], wrong: str
) -> None:
    """Another program's run.json, or one edited by hand, must not end in a traceback."""
    info = json.loads((guessed_run / "run.json").read_text())
    change(info)
    (tmp_path / "run.json").write_text(json.dumps(info))

    with pytest.raises(OutputError, match=f"run.json: not a description of a run{wrong} is"):
        read_run(tmp_path)


def test_schema_has_every_setting() -> None:
    schema = json.loads(files("shapecat.schemas").joinpath("run.json").read_text("utf-8"))
    known = schema["$defs"]["settings"]["properties"]
    values = Settings().as_dict()

    assert set(known) == set(values)
    for group in set(values) - {"seed", "reuse_frames"}:
        assert set(known[group]["properties"]) == set(values[group])
