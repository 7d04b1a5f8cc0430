"""IoU of found and true masks on the colour image, for simulated recordings.

    python -m benchmarks.masks --first 1000 --count 20

Recordings of tables and clutter, by a Kinect or a RealSense with a colour camera beside it, are
processed as by `shapecat process`. Two masks of each object are compared with the truth: the mask
in masks.parquet, which comes from depth alone, and the exported mask, whose outline follows the
colour edges. Only objects with at least `SEEN_PIXELS` pixels on the depth image and `SEEN_ON_IMAGE`
on the colour image count.
"""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from benchmarks.boxes import by_frame, matches
from benchmarks.measure import markdown
from benchmarks.scenes import SEEN_PIXELS, make_run
from shapecat.outputs.colouring import with_colour
from shapecat.outputs.exports.dataset_frames import snapped_masks
from shapecat.recordings import open_recording
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.runs.folder import read_run
from shapecat.runs.labelled_frames import read_labelled_frames
from shapecat.runs.labels.corrections import read_labels
from shapecat.simulation.scenes.kinds import SceneKind

SEEN_ON_IMAGE = 300
KINDS: tuple[SceneKind, ...] = ("tabletop", "clutter")
SENSORS = ("kinect", "realsense")
FRAMES, RATE_HZ = 2, 4.0
COLUMNS = ("", "objects", "found", "of depth", "exported", "exported, missed ones are 0")


class ScoredObject(NamedTuple):
    """The IoU of an object's two masks in one frame: from depth, and as exported; 0 if missed."""

    sensor: str
    found: bool
    overlaps: tuple[float, float]


@click.command(help=__doc__)
@click.option("--first", default=1000, show_default=True, help="Seed of the first recording.")
@click.option("--count", default=20, show_default=True, help="Number of recordings.")
def main(*, first: int, count: int) -> None:
    """Evaluate recordings and print a table."""
    scored = [item for number in range(count) for item in _evaluate(number, first + number)]
    by_sensor = {name: [item for item in scored if item.sensor == name] for name in SENSORS}
    rows = [_row(name, some) for name, some in by_sensor.items() if some]
    rows.append(_row("both", scored))
    print(markdown(f"Masks, seeds {first} to {first + count - 1}", COLUMNS, rows))


def _row(name: str, some: list[ScoredObject]) -> list[Any]:
    of_found = np.mean([item.overlaps for item in some if item.found], axis=0)
    of_all = np.mean([item.overlaps[1] for item in some])
    shares = (round(float(share), 3) for share in (*of_found, of_all))
    return [name, len(some), sum(item.found for item in some), *shares]


def _evaluate(number: int, seed: int) -> Iterator[ScoredObject]:
    kind, sensor = KINDS[number % 2], SENSORS[number // 2 % 2]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_run(
            folder, scene=kind, sensor=sensor, color=True, frames=FRAMES, seed=seed, rate_hz=RATE_HZ
        )
        for found, overlaps in _evaluate_run(folder):
            yield ScoredObject(sensor, found, overlaps)


def _evaluate_run(folder: Path) -> Iterator[tuple[bool, tuple[float, float]]]:
    truth = {
        frame["frame"]: frame["objects"]
        for frame in json.loads((folder / "recording.truth.json").read_text("utf-8"))
    }
    on_depth = np.load(folder / "recording.labels.npz")["labels"]
    on_image = np.load(folder / "recording.color_labels.npz")["labels"]
    rows = by_frame(folder / "run" / "detections.parquet")
    for number, masks in _masks(folder):
        seen, objects = on_image[number], truth[number]
        pairs = matches(objects, rows.get(number, []), on_depth[number])
        found = {item["label"]: row["detection"] for item, row in pairs}
        for item in objects:
            mask = seen == item["label"]
            if item["pixels"] >= SEEN_PIXELS and np.count_nonzero(mask) >= SEEN_ON_IMAGE:
                own = masks.get(found.get(item["label"], -1))
                yield own is not None, _overlaps(own, mask) if own else (0.0, 0.0)


def _masks(folder: Path) -> Iterator[tuple[int, dict[int, tuple[Any, Any]]]]:
    """Yield each frame's number, and the two masks of each object by its detection number."""
    run = read_run(folder / "run")
    labels = read_labels(folder / "run" / "tracks.csv", run["model"]["categories"])
    labelled = read_labelled_frames(folder / "run", labels)
    with open_recording(folder / "recording.mcap") as recording:
        for label, frame, coloured in with_colour(labelled, recording, run):
            if coloured is not None:
                snapped = snapped_masks(frame, coloured, pixels_of(coloured.view.image))
                pairs = zip(coloured.masks, snapped, strict=True)
                names = (item.detections[0] for item in label.objects)
                yield label.index, dict(zip(names, pairs, strict=True))


def _overlaps(masks: tuple[Any, Any], true: Any) -> tuple[float, float]:
    full = [mask.full(*true.shape) for mask in masks]
    of_depth, exported = (float((m & true).sum() / (m | true).sum()) for m in full)
    return of_depth, exported


if __name__ == "__main__":
    main()
