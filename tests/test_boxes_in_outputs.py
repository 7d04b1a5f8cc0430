"""Tests of the boxes in the outputs: full ones, or visible ones with `--boxes visible`."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import Result

from shapecat.runs.folder import read_run
from tests.conftest import Guesser
from tests.mcap_files import read_ros

Boxes = dict[tuple[int, str], list[float]]


def annotated(folder: Path) -> Boxes:
    """Return the sizes and centres in annotated.mcap by stamp and track."""
    found = {}
    for _, message in read_ros(folder / "annotated.mcap", "/shapecat/detections"):
        stamp = message.header.stamp
        for item in message.detections:
            size, center = item.bbox.size, item.bbox.center.position
            key = (stamp.sec * 10**9 + stamp.nanosec, item.id)
            found[key] = [size.x, size.y, size.z, center.x, center.y, center.z]
    return found


def tables(folder: Path, *, full: bool) -> Boxes:
    """Return sizes and centres of the full boxes of tracks, or the visible boxes of detections."""
    visible = {
        (row["frame"], row["detection"]): row["size"] + row["center"]
        for row in pq.read_table(folder / "detections.parquet").to_pylist()
    }
    return {
        (row["stamp_ns"], str(row["track"])): row["size_full"] + row["center_full"]
        if full
        else visible[row["frame"], row["detection"]]
        for row in pq.read_table(folder / "tracks.parquet").to_pylist()
        if row["detection"] is not None
    }


@pytest.mark.parametrize("options", [(), ("--boxes", "visible"), ("--boxes", "full")])
def test_annotations_have_requested_boxes(
    guessed_run: Path, tmp_path: Path, shapecat: Callable[..., Result], options: tuple[str, ...]
) -> None:
    """Annotating with other boxes must replace the earlier ones."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    result = shapecat("annotate", folder, *options)
    assert result.exit_code == 0, result.output

    found, expected = annotated(folder), tables(folder, full="visible" not in options)
    other = tables(folder, full="visible" in options)
    assert found.keys() == expected.keys()
    keys = sorted(found)
    assert np.allclose([found[k] for k in keys], [expected[k] for k in keys], atol=1e-6)
    assert not np.allclose([found[k] for k in keys], [other[k] for k in keys], atol=1e-3)
    if options == ("--boxes", "visible"):  # annotating again without the option keeps them
        assert shapecat("annotate", folder).exit_code == 0
        assert annotated(folder) == found


def test_boxes_chosen_for_process_are_kept_until_others_are_chosen(
    guessed_run: Path,
    tmp_path: Path,
    shapecat: Callable[..., Result],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Correcting labels must change no boxes; asking for other boxes must."""
    monkeypatch.setattr("shapecat.pipeline.load_model", lambda _path: Guesser())
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    source = read_run(folder)["input"]["path"]
    options = ("--out", tmp_path, "--overwrite", "--boxes", "visible", "--no-rrd")
    result = shapecat("process", source, *options)
    assert result.exit_code == 0, result.output
    visible = annotated(folder)

    found = []
    for chosen in ((), ("--boxes", "full"), ()):
        assert shapecat("annotate", folder, *chosen).exit_code == 0
        found.append(annotated(folder))

    assert found == [visible, annotated(guessed_run), annotated(guessed_run)]
    assert visible != annotated(guessed_run)


@pytest.mark.parametrize("options", [(), ("--boxes", "visible")])
def test_exports_have_requested_boxes(
    guessed_run: Path, tmp_path: Path, shapecat: Callable[..., Result], options: tuple[str, ...]
) -> None:
    """A model trained on visible boxes would not predict whole objects."""
    command = ("export", guessed_run, "--format", "labelcloud", "--out", tmp_path, "--every", 8)
    assert shapecat(*command, *options).exit_code == 0

    (cloud,) = (tmp_path / "table" / "pointclouds").iterdir()  # of eight frames
    content = json.loads((tmp_path / "table" / "labels" / f"{cloud.stem}.json").read_text())
    found = sorted(list(item["dimensions"].values()) for item in content["objects"])
    full, visible = (tables(guessed_run, full=full) for full in (True, False))
    first = min(stamp for stamp, _ in full)
    sizes, others = (
        sorted(box[:3] for (stamp, _), box in known.items() if stamp == first)
        for known in ((visible, full) if options else (full, visible))
    )
    assert np.allclose(found, sizes, atol=1e-6)
    assert not np.allclose(found, others, atol=1e-3)


def test_export_rejects_unknown_kind_of_boxes(
    guessed_run: Path, tmp_path: Path, shapecat: Callable[..., Result]
) -> None:
    result = shapecat(
        "export", guessed_run, "--format", "kitti", "--out", tmp_path, "--boxes", "whole"
    )

    assert result.exit_code == 2
    assert "visible" in result.output
