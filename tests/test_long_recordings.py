"""Tests that the tracks of long recordings do not depend on the batches that save memory."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks.hours import make_tables
from shapecat.arrays import F8
from shapecat.completion import BoxViews, FusedBox, fuse_boxes
from shapecat.config import TrackingSettings
from shapecat.runs import full_boxes, tracks
from shapecat.runs.tables.segments import group_frames
from shapecat.tracking import detection_table, fusion
from shapecat.types import CATEGORIES

FRAMES = 180


def tracked(folder: Path) -> tuple[pa.Table, str]:
    tracks.track_run(folder, TrackingSettings(), CATEGORIES)
    return pq.read_table(folder / "tracks.parquet"), (folder / "tracks.csv").read_text("utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("hours")
    make_tables(folder, FRAMES)
    return folder


@pytest.fixture(scope="module")
def usual(folder: Path) -> tuple[pa.Table, str]:
    """Return tracks.parquet and tracks.csv, written with the usual sizes of batches."""
    return tracked(folder)


def test_batch_sizes_do_not_change_tracks(
    folder: Path, usual: tuple[pa.Table, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Batches may end within a frame, a track or a row group; a track may span several."""
    whole, lines = usual
    sizes = {(tracks, "_BATCH"): 100, (full_boxes, "_BLOCK"): 7}
    sizes |= {(detection_table, "_BLOCK"): 50, (fusion, "_BLOCK"): 33}
    for (module, name), size in sizes.items():
        monkeypatch.setattr(module, name, size)

    batched, batched_lines = tracked(folder)

    assert whole.num_rows > 7 * FRAMES
    assert batched.equals(whole)
    assert batched_lines == lines


def test_full_box_from_sample_matches_all_views(
    folder: Path, usual: tuple[pa.Table, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boxes agree in every row, within the noise of the outlines."""
    whole, _ = usual
    monkeypatch.setattr(full_boxes, "_MOST_VIEWS", 60)

    few, _ = tracked(folder)

    known = whole["size_full"].is_valid()
    assert few["size_full"].is_valid().equals(known)
    sizes = [
        np.array(table["size_full"].filter(known).to_pylist(), np.float64) for table in (whole, few)
    ]
    assert np.abs(sizes[0] - sizes[1]).max() < 0.003
    assert few.drop([n for n in few.column_names if n.endswith(("full", "full_std"))]).equals(
        whole.drop([n for n in whole.column_names if n.endswith(("full", "full_std"))])
    )


@pytest.mark.parametrize(
    ("frames", "length"), [(0, 32), (3000, 32), (10_000, 32), (10**5, 128), (10**6, 480)]
)
def test_row_groups_grow_with_number_of_frames(frames: int, length: int) -> None:
    assert group_frames(frames) == length


@pytest.fixture
def occluded(folder: Path, tmp_path: Path) -> Path:
    """Return a copy of the tables in which every third detection is occluded."""
    shutil.copytree(folder, tmp_path / "run")
    path = tmp_path / "run" / "detections.parquet"
    old = pq.ParquetFile(folder / path.name)
    with old, pq.ParquetWriter(path, old.schema_arrow) as new:
        for k in range(old.num_row_groups):
            group = old.read_row_group(k)
            at = group.schema.get_field_index("occluded")
            third = pa.array(np.arange(len(group)) % 3 == 0)
            new.write_table(group.set_column(at, group.schema.field(at), third))
    return path.parent


def test_sampled_views_keep_their_own_weights(
    occluded: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With weights of other views, an occluder at the start would spoil a whole track's box."""
    weights = list[F8]()

    def fuse_and_note(views: BoxViews, of_views: F8, *others: Any) -> FusedBox:
        weights.append(of_views)
        return fuse_boxes(views, of_views, *others)

    monkeypatch.setattr(full_boxes, "fuse_boxes", fuse_and_note)
    tracked(occluded)
    whole, weights = weights, []
    monkeypatch.setattr(full_boxes, "_MOST_VIEWS", 60)
    tracked(occluded)

    assert max(np.ptp(each) for each in whole) > 0
    for few, each in zip(weights, whole, strict=True):
        np.testing.assert_array_equal(few, each[full_boxes._spread(len(each))])
