"""3D overlap of estimated and true boxes, by category, for simulated recordings.

    python -m benchmarks.boxes --first 1000 --count 20

Recordings of a camera that moves past a table or a pile are processed as by `shapecat process`. In
every frame, three boxes of each found object with at least `SEEN_PIXELS` depth pixels are compared
with the true box: the visible box, the full box of the single view, and the full box of the track.
Objects that are round about the vertical have no yaw; their true boxes take the orientation of the
estimated box.
"""

import json
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
import pyarrow.parquet as pq
from scipy.optimize import linear_sum_assignment

from benchmarks.measure import markdown
from benchmarks.scenes import SEEN_PIXELS, Array, make_run
from shapecat.evaluation.comparison.overlap import box_iou
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.types import Box

SAME = 0.5
"""Minimum IoU of the masks of a detection and the object that it matches."""
ROUND = ("cup", "can", "bottle", "bowl", "plate", "ball")
"""Categories whose objects are solids of revolution; most have nearly equal length and width."""
ALIKE = 0.05
"""Maximum relative difference of length and width of a round object without a yaw."""
SCORED = ("cup", "can", "box", "bottle", "bowl", "ball")
"""Categories whose mean overlap is printed for each group."""
KINDS: tuple[SceneKind, ...] = ("tabletop", "pile")
GROUPS = ("tabletop, upright", "tabletop, lying", "pile, upright", "pile, tilted")
_HOW: dict[SceneKind, str] = {"tabletop": "lying", "pile": "tilted"}
"""How objects that do not stand upright lie, by kind of scene."""
FRAMES, RATE_HZ = 24, 8.0
COLUMNS = ("objects", "views", "visible", "full, single view", "full, track")


class ScoredObject(NamedTuple):
    """The IoU of three boxes of an object in one frame.

    ``overlaps`` (3,) belong to the visible box, the full box of the view, and the full box of the
    track (NaN without a track); ``object_id`` is the seed of the scene and the object's number.
    """

    group: str
    category: str
    object_id: tuple[int, int]
    overlaps: Array


@click.command(help=__doc__)
@click.option("--first", default=1000, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=20, show_default=True, help="Scenes of each kind.")
def main(*, first: int, count: int) -> None:
    """Evaluate scenes and print a table."""
    found = [item for kind in KINDS for item in _evaluate_kind(kind, first, count)]
    rows = [row for group in GROUPS for row in _rows(found, group)]
    print(markdown(f"3D overlap, seeds {first} to {first + count - 1}", ("", *COLUMNS), rows))


def _rows(found: Sequence[ScoredObject], group: str) -> Iterator[list[Any]]:
    """Yield the mean overlaps of each category, and of the categories in `SCORED` together."""
    some = [item for item in found if item.group == group]
    for category in sorted({item.category for item in some}):
        yield _row(f"{group}, {category}", [item for item in some if item.category == category])
    yield _row(f"{group}, {', '.join(SCORED)}", [item for item in some if item.category in SCORED])


def _row(name: str, some: Sequence[ScoredObject]) -> list[Any]:
    overlaps = np.reshape([item.overlaps for item in some], (-1, 3))
    means = [round(float(np.nanmean(column)), 3) if len(some) else None for column in overlaps.T]
    return [name, len({item.object_id for item in some}), len(some), *means]


def _evaluate_kind(kind: SceneKind, first: int, count: int) -> Iterator[ScoredObject]:
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            make_run(folder, scene=kind, frames=FRAMES, seed=seed, rate_hz=RATE_HZ)
            for item in _evaluate_run(folder, seed):
                yield item._replace(group=f"{kind}, {_HOW[kind] if item.group else 'upright'}")


def _evaluate_run(folder: Path, seed: int) -> Iterator[ScoredObject]:
    truth = json.loads((folder / "recording.truth.json").read_text("utf-8"))
    labels = np.load(folder / "recording.labels.npz")["labels"]
    detections = by_frame(folder / "run" / "detections.parquet")
    tracked = {
        (row["frame"], row["detection"]): row
        for rows in by_frame(folder / "run" / "tracks.parquet").values()
        for row in rows
    }
    for frame in truth:
        number = frame["frame"]
        for item, row in matches(frame["objects"], detections.get(number, []), labels[number]):
            track = tracked.get((number, row["detection"]))
            boxes = (_box(row, ""), _box(row, "_full"), _box(track, "_full") if track else None)
            yield ScoredObject(
                "tilted" if item["tilted"] or item["lying"] else "",
                item["category"],
                (seed, item["track"]),
                np.array([_overlap(item, box) for box in boxes]),
            )


def by_frame(path: Path) -> dict[int, list[dict[str, Any]]]:
    """Return the rows of a Parquet table by frame number."""
    grouped: dict[int, list[dict[str, Any]]] = {}
    for row in pq.read_table(path).to_pylist():
        grouped.setdefault(row["frame"], []).append(row)
    return grouped


def matches(
    objects: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]], labels: Array
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Match true and found objects one to one by their pixels; yield the pairs.

    ``objects`` are from the truth and ``rows`` from the detections of one frame; ``labels`` (h, w)
    are its true pixel labels. Pairs need an IoU of at least `SAME`, and `SEEN_PIXELS` true pixels.
    """
    inside = [np.bincount(labels.reshape(-1)[r["indices"]], minlength=256) for r in rows]
    iou = np.zeros((len(objects), len(rows)))
    for i, item in enumerate(objects):
        for j, row in enumerate(rows):
            common = inside[j][item["label"]]
            iou[i, j] = common / (item["pixels"] + len(row["indices"]) - common)
    for i, j in zip(*linear_sum_assignment(-iou), strict=True):
        if iou[i, j] >= SAME and objects[i]["pixels"] >= SEEN_PIXELS:
            yield objects[i], rows[j]


def _box(row: dict[str, Any], which: str) -> Box:
    return Box(*(row[f"{name}{which}"] for name in ("center", "size", "orientation")))


def _overlap(item: dict[str, Any], box: Box | None) -> float:
    if box is None:
        return float("nan")
    true = Box(**item["box"])
    square = abs(true.size[0] - true.size[1]) < ALIKE * true.size[:2].max()
    if item["category"] in ROUND and square and not (item["tilted"] or item["lying"]):
        across = float(true.size[:2].mean())
        true = Box(true.center, np.array([across, across, true.size[2]]), box.orientation)
    return box_iou(true, box)


if __name__ == "__main__":
    main()
