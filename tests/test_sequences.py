"""Tests of the benchmark of whole sequences: required, ignored and counted objects."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from benchmarks import sequences


def item(track: int, x: float, *, visible: float = 1.0, size: float = 0.1) -> dict[str, Any]:
    """Return the truth of a cup in a frame; ``visible`` is a fraction, lengths are in metres."""
    box = {"center": [x, 0.0, 1.0], "size": [size, size, size]}
    return {
        "track": track,
        "label": 20 + track,
        "category": "cup",
        "center": [x, 0.0, 0.8],
        "box": box,
        "pixels": 900,
        "visible": visible,
        "ambiguous": visible < 0.4,
    }


def metrics_of(folder: Path, objects: list[dict[str, Any]], tracks: list[list[float]]) -> Any:
    """Return the metrics of ten frames; frame k has tracks at the x in tracks[k % len(tracks)]."""
    truth = [{"objects": objects, "hidden": []}] * 10
    (folder / "recording.truth.json").write_text(json.dumps(truth))
    rows = [
        {"frame": k, "track": track, "center_fixed": [x, 0.0, 0.8]}
        for k in range(10)
        for track, x in enumerate(tracks[k % len(tracks)])
    ]
    (folder / "run").mkdir()
    pq.write_table(pa.Table.from_pylist(rows), folder / "run" / "tracks.parquet")
    poses = [{"frame": k, "fixed_translation": [0.0, 0.0, 0.0]} for k in range(10)]
    pq.write_table(pa.Table.from_pylist(poses), folder / "run" / "frames.parquet")
    pairs = list(sequences.frame_identities(folder, sequences.read_truth(folder)))
    return sequences.identities({"a": pairs})["a"]


def test_false_track_lowers_mota_of_perfect_tracks(tmp_path: Path) -> None:
    objects = [item(0, 0.0), item(1, 0.5)]
    for name, tracks, mota in (("good", [[0.02, 0.5]], 1.0), ("more", [[0.0, 0.5, 0.9]], 0.5)):
        (tmp_path / name).mkdir()
        assert metrics_of(tmp_path / name, objects, tracks)["mota"] == mota


def test_hidden_objects_are_ignored(tmp_path: Path) -> None:
    objects = [item(0, 0.0), item(1, 0.5, visible=0.2)]
    for name, tracks in (("kept", [[0.0, 0.5]]), ("left", [[0.0]])):
        (tmp_path / name).mkdir()
        figures = metrics_of(tmp_path / name, objects, tracks)
        assert (figures["mota"], figures["idf1"], figures["objects"]) == (1.0, 1.0, 10)


def test_objects_and_tracks_out_of_range_are_ignored(tmp_path: Path) -> None:
    objects = [item(0, 0.0), item(1, 2.5)]
    for name, tracks in (("found", [[0.0, 2.5]]), ("left", [[0.0]]), ("invented", [[0.0, 3.5]])):
        (tmp_path / name).mkdir()
        assert metrics_of(tmp_path / name, objects, tracks)["mota"] == 1.0


def test_large_object_matches_track_near_its_edge(tmp_path: Path) -> None:
    """Only the near part of a tray may be visible."""
    for name, size, mota in (("tray", 0.4, 1.0), ("cup", 0.1, -1.0)):
        (tmp_path / name).mkdir()
        assert metrics_of(tmp_path / name, [item(0, 0.0, size=size)], [[0.18]])["mota"] == mota


def test_swapped_identities_count_as_switches(tmp_path: Path) -> None:
    figures = metrics_of(tmp_path, [item(0, 0.0), item(1, 0.5)], [[0.0, 0.5], [0.5, 0.0]])
    assert figures["switches"] == 18
    assert figures["idf1"] == 0.5


def test_short_sequence_is_evaluated_from_recording_to_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sequences, "FRAMES", 8)
    monkeypatch.setattr(sequences, "KINDS", ("rearranged",))

    figures = sequences.evaluate(tmp_path, [4])  # no object is lost or confused

    assert figures["identities"]["rearranged"]["idf1"] > 0.95
    assert figures["labels"]["all"]["views"] > 40
    assert figures["labels"]["all"]["final"] < 0.05
    assert np.isfinite([row["ece"] for row in figures["calibration"].values()]).any()
    assert "| rearranged |" in sequences.format_tables(figures)
