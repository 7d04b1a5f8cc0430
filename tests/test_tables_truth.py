"""Tests of the tables of a run against its points and the simulator's truth."""

import json
import shutil
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from shapecat.pipeline import annotate_again
from shapecat.runs.finished import open_source
from shapecat.runs.folder import read_run
from shapecat.runs.selection import read_frames
from tests.track_tables import lines, rows


def test_neurons_lie_on_points_of_their_object(guessed_run: Path) -> None:
    """Neurons in another coordinate frame would lie beside the object."""
    run = read_run(guessed_run)
    found = rows(guessed_run, "detections")
    count = 0
    with open_source(run) as recording:
        for frame, _ in read_frames(recording, run["options"]):
            for row in (row for row in found if row["frame"] == frame.index):
                points = frame.xyz(np.array(row["indices"], np.uint32))
                points = points[np.isfinite(points).all(axis=1)]
                neurons = np.reshape(row["neurons"], (-1, 3))
                if len(neurons):
                    distance, _ = cKDTree(points).query(neurons)
                    assert np.median(distance) < 0.005
                    assert np.quantile(distance, 0.95) < 0.02
                    count += 1
                low, high = points.min(axis=0) - 0.01, points.max(axis=0) + 0.01
                assert (low < row["center"]).all()
                assert (row["center"] < high).all()
    assert count > 50


def test_track_positions_match_simulated_truth(guessed_run: Path) -> None:
    """Guards the unit, the fixed frame, and the order of the axes."""
    source = Path(read_run(guessed_run)["input"]["path"])
    truth = json.loads(source.with_suffix(".truth.json").read_text())
    objects = {item["track"]: item["center"] for frame in truth for item in frame["objects"]}
    centers = np.array(list(objects.values()))
    positions = np.array([[float(row[axis]) for axis in "xyz"] for row in lines(guessed_run)])
    distance, nearest = cKDTree(centers).query(positions)

    assert len(positions) >= 0.8 * len(centers)
    assert len(set(nearest.tolist())) >= 0.8 * len(positions)
    assert np.median(distance) < 0.03


def test_corrected_label_reaches_annotated_mcap_and_review(
    coloured_run: Path, tmp_path: Path
) -> None:
    """An output with old labels would teach the corrected mistake."""
    folder = tmp_path / "table"
    shutil.copytree(coloured_run, folder)
    number = int(lines(folder)[0]["track"])
    corrected = tmp_path / "mine.csv"
    corrected.write_text(f"track,category,confidence,label\n{number},cup,0,wine glass\n")

    annotate_again(folder, corrected)

    assert b"wine glass" in added_messages(folder / "annotated.mcap")
    from rerun.chunk import RrdReader  # noqa: PLC0415  heavy

    labels = {
        label
        for chunk in RrdReader(str(folder / "review.rrd")).stream().to_chunks()
        for name, column in zip(
            chunk.to_record_batch().schema.names, chunk.to_record_batch().columns, strict=True
        )
        if name.endswith(":labels")
        for group in column.to_pylist()
        for label in group or ()
    }
    assert any("wine glass" in label for label in labels), labels


def added_messages(path: Path) -> bytes:
    """Return the data of all messages on topics of shapecat in an annotated.mcap, joined."""
    from mcap.reader import make_reader  # noqa: PLC0415  beside its only use

    with path.open("rb") as file:
        messages = make_reader(file).iter_messages()
        return b"".join(m.data for _, c, m in messages if c.topic.startswith("/shapecat/"))
