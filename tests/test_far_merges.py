"""Tests of the warning about merged tracks that cannot be one object."""

import re
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import Result
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapecat.runs.labels import far_merges as module
from shapecat.runs.labels.corrections import relabel
from shapecat.runs.labels.far_merges import Gap, _distances, far_merges
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.types import AnnotationBox
from tests.mcap_files import read_ros

Shapecat = Callable[..., Result]


def surface(row: dict[str, Any]) -> Any:
    """Return points (n, 3) on the full box of a row of tracks.parquet, 1/20 of its sides apart."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 21)] * 3), axis=-1).reshape(-1, 3)
    grid = grid[np.abs(grid).max(axis=1) == 0.5]
    turn = Rotation.from_quat(row["orientation_full"])
    return turn.apply(grid * row["size_full"]) + row["center_full"]


def true_gaps(run: Path) -> dict[tuple[int, int], list[float]]:
    """Return the distance between the full boxes of each pair of tracks, in each common frame."""
    rows = pq.read_table(run / "tracks.parquet").to_pylist()
    gaps: dict[tuple[int, int], list[float]] = {}
    frames: dict[int, list[dict[str, Any]]] = {}
    for row in rows:
        if row["detection"] is not None:
            frames.setdefault(row["frame"], []).append(row)
    for frame in frames.values():
        for a, b in combinations(sorted(frame, key=lambda row: row["track"]), 2):
            apart = cKDTree(surface(a)).query(surface(b))[0].min()
            gaps.setdefault((a["track"], b["track"]), []).append(float(apart))
    return gaps


def test_annotate_warns_of_merged_objects_in_different_places(
    run: Path, shapecat: Shapecat
) -> None:
    """A typo in a number silently joined two objects in one box, over half of the table."""
    distances = true_gaps(run)
    gaps = {pair: np.mean(values) for pair, values in distances.items()}
    counts = {pair: len(values) for pair, values in distances.items()}
    a, b = max(gaps, key=lambda pair: gaps[pair])
    assert gaps[a, b] > 0.2

    result = shapecat("annotate", run)
    assert "Warning" not in result.stderr
    relabel(run, {a: f"merge with {b}"})
    result = shapecat("annotate", run)

    assert result.exit_code == 0
    (pair,) = re.findall(r"#(\d+) and #(\d+) \((\d+) cm apart in (\d+) frames\)", result.stderr)
    assert (int(pair[0]), int(pair[1]), int(pair[3])) == (a, b, counts[a, b])
    assert 0.7 * gaps[a, b] < int(pair[2]) / 100 < gaps[a, b] + 0.01  # a lower bound
    ids = Counter(
        item.id
        for _, message in read_ros(run / "annotated.mcap", "/shapecat/detections")
        for item in message.detections
    )
    assert ids[str(b)] >= counts[a, b]  # merged nevertheless
    assert str(a) not in ids


def test_distance_is_that_of_faces_and_not_of_centres() -> None:
    """Worked by hand: a bar of 60 cm and a cube of 10 cm beside it, both turned by 30°."""
    yaw = Rotation.from_euler("z", 30, degrees=True)
    tilt = Rotation.from_euler("xyz", [110, 20, -40], degrees=True)

    def box(
        track: int, center: list[float], size: tuple[float, float, float], more: float = 0
    ) -> AnnotationBox:
        turn = tilt * yaw * Rotation.from_euler("z", more, degrees=True)
        place = (tilt * yaw).apply(center) + np.array([0.3, -0.2, 1.1])
        return AnnotationBox(track, "", 0.0, tuple(place), size, tuple(turn.as_quat()))

    bar = box(1, [0, 0, 0], (0.6, 0.1, 0.2))
    beside = box(2, [0.2, 0.17, 0.0], (0.1, 0.1, 0.1))
    inside = box(3, [0.32, 0.0, 0.1], (0.1, 0.1, 0.1))
    turned = box(4, [0.0, -0.3, 0.0], (0.1, 0.1, 0.1), 45)

    found = _distances([bar, beside, inside, turned])
    assert found == pytest.approx(found.T)
    assert found[0, 1] == pytest.approx(0.07)  # 0.17 - 0.05 - 0.05
    assert found[0, 2] == 0
    assert found[0, 3] == pytest.approx(0.25 - 0.1 * 0.5**0.5)  # its edge points to the bar
    assert np.diag(found).tolist() == [0, 0, 0, 0]


def test_parts_of_one_object_are_merged_without_a_warning(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """#6 and #9 are the ends of one object, with #7 between them; #2 is another one."""
    gaps = [((2, 6), 0.31), ((2, 9), 0.46), ((6, 7), 0.0), ((6, 9), 0.145), ((7, 9), 0.02)]
    found = [Gap(pair, 5, distance) for pair, distance in gaps]

    def read_gaps(_: Path, objects: Mapping[int, int]) -> list[Gap]:
        pairs = [[objects.get(track) for track in gap.tracks] for gap in found]
        return [gap for gap, (a, b) in zip(found, pairs, strict=True) if a == b is not None]

    monkeypatch.setattr(module, "_read_gaps", read_gaps)

    def merged(**numbers: int) -> dict[int, TrackLabel]:
        return {int(name[1:]): TrackLabel(number, "can", 1.0) for name, number in numbers.items()}

    assert far_merges(tmp_path, merged(t2=2, t6=6, t7=7, t9=9)) == []
    assert far_merges(tmp_path, merged(t2=2, t6=7, t7=7, t9=7)) == []
    assert far_merges(tmp_path, merged(t2=2, t6=9, t7=7, t9=9)) == [found[3]]
    assert far_merges(tmp_path, merged(t2=7, t6=7, t7=7, t9=7)) == found[:2]
