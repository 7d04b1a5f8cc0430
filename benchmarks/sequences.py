"""Tracking of whole simulated sequences: identities, labels, calibration.

    python -m benchmarks.sequences --seeds 10

Each sequence is written as a recording and processed as by `shapecat process`; its tables are
compared with the ground truth.
"""

import json
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import pyarrow.parquet as pq
from scipy.optimize import linear_sum_assignment

from benchmarks.measure import markdown
from benchmarks.scenes import make_run
from shapecat.arrays import F8, U1
from shapecat.evaluation.comparison.identities import FrameIdentities, compute_tracking_metrics
from shapecat.evaluation.metrics import expected_calibration_error
from shapecat.runs.labels.track_table import read_track_table
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.simulation.truth import AMBIGUOUS_PIXELS, AMBIGUOUS_SHARE
from shapecat.tracking.fusion import fuse, view_weights
from shapecat.types import CATEGORIES

KINDS: tuple[SceneKind, ...] = ("turntable", "walking", "crossing", "rearranged")
FRAMES, RATE_HZ = 60, 10.0
NEAR_M = 0.1
"""A track matches an object if their centres are within this distance, metres, or within half the
object's length."""
RANGE_M = 2.0
"""Objects and tracks farther from the sensor are ignored."""
SAME = 0.5
"""Minimum IoU of the masks of a detection and the object that it matches."""
VIEWS = (1, 3, 10, 30)
"""Numbers of views to fuse."""


@dataclass(frozen=True)
class Object:
    """A true object in a frame.

    Attributes
    ----------
    center : (3,) metres, fixed frame.
    reach : largest distance of a matching track's centre, metres.
    undecidable : whether its category is ambiguous in this view.
    spared : whether it is ignored, as too little of it is visible or it is too far away.
    """

    track: int
    category: str
    center: F8
    reach: float
    undecidable: bool
    spared: bool


@dataclass(frozen=True)
class View:
    """A tracked detection of a known object.

    Attributes
    ----------
    track : kind of the sequence, seed, and number of the track.
    truth : true category.
    undecidable : as in `Object`.
    partial : whether the image border or another object cuts off the view.
    posterior : (c,) of the single view.
    single, final : category of the single view, and final category of the track.
    """

    track: tuple[str, int, int]
    truth: str
    undecidable: bool
    partial: bool
    posterior: F8
    single: str
    final: str


def read_truth(folder: Path) -> list[list[Object]]:
    """Return the objects of each frame, including hidden ones."""
    frames = json.loads((folder / "recording.truth.json").read_text("utf-8"))
    return [
        [_object(item, listed=True) for item in frame["objects"]]
        + [_object(item, listed=False) for item in frame["hidden"]]
        for frame in frames
    ]


def _object(item: dict[str, Any], *, listed: bool) -> Object:
    few = not listed or item["pixels"] < AMBIGUOUS_PIXELS or item["visible"] < AMBIGUOUS_SHARE
    return Object(
        item["track"],
        item["category"],
        np.array(item["center"]),
        max(NEAR_M, 0.5 * max(item["box"]["size"][:2])),
        undecidable=bool(item["ambiguous"] and not few),
        spared=bool(few or np.linalg.norm(item["box"]["center"]) > RANGE_M),
    )


def frame_identities(folder: Path, truth: Sequence[Sequence[Object]]) -> Iterator[FrameIdentities]:
    """Yield the objects and tracks of each frame with their similarity.

    Tracks that match a spared object are ignored. The similarity falls with the distance, from 1
    to `SAME` at the largest reach of all objects; it is 0 beyond the reach of the object.
    """
    table = _within_range(folder / "run")
    sequence = str(folder)
    largest = max((o.reach for objects in truth for o in objects), default=NEAR_M)
    for k, objects in enumerate(truth):
        rows = [row for row in table if row["frame"] == k]
        gaps = np.array(
            [[np.linalg.norm(o.center - row["center_fixed"]) for row in rows] for o in objects]
        ).reshape(len(objects), len(rows))
        spared = np.array([o.spared for o in objects], bool)
        reach = np.array([o.reach for o in objects])[:, None]
        similarity = np.where(gaps <= reach, 1 - SAME * gaps / largest, 0)
        pairs = zip(*linear_sum_assignment(-similarity), strict=True)
        drop = {int(j) for i, j in pairs if spared[i] and similarity[i, j] > 0}
        keep = [j for j in range(len(rows)) if j not in drop]
        asked = np.flatnonzero(~spared).tolist()
        yield FrameIdentities(
            [(sequence, objects[i].track) for i in asked],
            [(sequence, rows[j]["track"]) for j in keep],
            similarity[asked][:, keep],
        )


def _within_range(run: Path) -> list[dict[str, Any]]:
    """Return the rows of tracks.parquet within `RANGE_M` of the sensor."""
    columns = ["frame", "fixed_translation"]
    frames = pq.read_table(run / "frames.parquet", columns=columns).to_pylist()
    sensor = {row["frame"]: row["fixed_translation"] for row in frames}
    return [
        row
        for row in pq.read_table(run / "tracks.parquet").to_pylist()
        if np.linalg.norm(np.subtract(row["center_fixed"], sensor[row["frame"]])) <= RANGE_M
    ]


def read_views(folder: Path, kind: str, seed: int) -> list[View]:
    """Return the tracked detections whose mask matches an object."""
    frames = json.loads((folder / "recording.truth.json").read_text("utf-8"))
    with np.load(folder / "recording.labels.npz") as archive:
        labels: U1 = archive["labels"]
    final = {r.track: r.category for r in read_track_table(folder / "run" / "tracks.csv").rows}
    tracks = pq.read_table(folder / "run" / "tracks.parquet").to_pylist()
    track_of = {(row["frame"], row["detection"]): row["track"] for row in tracks}
    columns = ["frame", "detection", "indices", "posterior", "category", "touches_border"]
    found = []
    table = pq.read_table(folder / "run" / "detections.parquet", columns=[*columns, "occluded"])
    for row in table.to_pylist():
        track = track_of.get((row["frame"], row["detection"]))
        true_object = _seen(row["indices"], labels[row["frame"]], frames[row["frame"]]["objects"])
        if track is None or true_object is None:
            continue
        found.append(
            View(
                (kind, seed, track),
                true_object["category"],
                _object(true_object, listed=True).undecidable,
                row["touches_border"] or row["occluded"],
                np.array(row["posterior"]),
                row["category"],
                final[track],
            )
        )
    return found


def _seen(
    indices: Sequence[int], labels: U1, objects: Sequence[dict[str, Any]]
) -> dict[str, Any] | None:
    """Return the object whose mask a detection matches; None if there is none.

    ``indices`` (k,) are the pixels of the detection, ``labels`` (h, w) the true pixel labels.
    """
    own = np.bincount(labels.reshape(-1)[indices], minlength=256)
    label = int(own.argmax())
    union = len(indices) + int((labels == label).sum()) - own[label]
    best = next((item for item in objects if item["label"] == label), None)
    return best if own[label] >= SAME * union else None


def identities(seen: dict[str, list[FrameIdentities]]) -> dict[str, dict[str, float]]:
    """Return the tracking metrics of each kind of sequence over all its frames."""
    names = ("idf1", "mota", "hota", "switches", "misses", "false_positives", "objects")
    result = {}
    for kind, frames in seen.items():
        figures = compute_tracking_metrics(frames, threshold=SAME)._asdict()
        result[kind] = {name: round(float(figures[name]), 4) for name in names}
    return result


def label_errors(views: Iterable[View]) -> dict[str, float]:
    """Return the number of views, the error rates of single views and final labels, their ratio."""
    pairs = np.array([(v.single != v.truth, v.final != v.truth) for v in views]).reshape(-1, 2)
    single, final = pairs.sum(axis=0).tolist()
    return {
        "views": len(pairs),
        "single": round(single / max(len(pairs), 1), 4),
        "final": round(final / max(len(pairs), 1), 4),
        "ratio": round(final / single, 3) if single else 0.0,
    }


def calibration(views: Iterable[View]) -> dict[int, dict[str, float]]:
    """Return accuracy and calibration error after fusing consecutive views, by number of views."""
    tracks: dict[tuple[str, int, int], list[View]] = {}
    for view in views:
        tracks.setdefault(view.track, []).append(view)
    result = {}
    for count in VIEWS:
        truth, posteriors = [], []
        for seen in tracks.values():
            for i in range(0, len(seen) - count + 1, max(1, count // 2)):
                some = seen[i : i + count]
                weights = view_weights(np.array([v.partial for v in some]))
                posteriors.append(fuse([v.posterior for v in some], weights=weights))
                truth.append(CATEGORIES.index(some[0].truth))
        if not truth:
            continue
        right = np.argmax(posteriors, axis=1) == truth
        error = expected_calibration_error(np.array(truth), np.array(posteriors))
        result[count] = {
            "n": len(truth),
            "accuracy": round(float(right.mean()), 4),
            "ece": round(error, 4),
        }
    return result


def evaluate(folder: Path, seeds: Iterable[int]) -> dict[str, Any]:
    """Make, process and evaluate sequences of all kinds; return the rows of each table by name."""
    seen: dict[str, list[FrameIdentities]] = {}
    views: list[View] = []
    for seed in seeds:
        for kind in KINDS:
            place = folder / kind / str(seed)
            make_run(place, scene=kind, frames=FRAMES, seed=seed, rate_hz=RATE_HZ)
            seen.setdefault(kind, []).extend(frame_identities(place, read_truth(place)))
            views += read_views(place, kind, seed)
            click.echo(f"{kind} {seed}", err=True)
    decidable = [view for view in views if not view.undecidable]
    per_kind = {
        kind: label_errors(v for v in decidable if v.track[0] == kind) for kind in sorted(seen)
    }
    return {
        "identities": identities(seen),
        "labels": {
            **per_kind,
            "all": label_errors(decidable),
            "undecidable": label_errors(view for view in views if view.undecidable),
        },
        "calibration": calibration(decidable),
    }


def format_tables(figures: dict[str, Any]) -> str:
    """Return the results of `evaluate` as Markdown tables."""
    return "\n".join(
        markdown(title, [first, *next(iter(figures[key].values()))], rows)
        for title, key, first in (
            ("Identities", "identities", "sequences"),
            ("Error rates of labels", "labels", "sequences"),
            ("Fusion of several views", "calibration", "views"),
        )
        if (rows := [(name, *values.values()) for name, values in figures[key].items()])
    )


@click.command()
@click.option("--seeds", default=10, show_default=True, help="Sequences of each kind.")
@click.option("--first", default=100, show_default=True, help="The first seed.")
def main(*, seeds: int, first: int) -> None:
    """Evaluate tracking on simulated sequences: turntable, moving camera, moving objects."""
    with tempfile.TemporaryDirectory() as temporary:
        figures = evaluate(Path(temporary), range(first, first + seeds))
    click.echo(format_tables(figures))


if __name__ == "__main__":
    main()
