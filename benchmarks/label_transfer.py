"""Accuracy of the transfer of corrected labels to another run.

    python -m benchmarks.label_transfer            20 recordings, ten minutes

Each recording is processed, and its tracks are labelled with unique names of their true objects;
false tracks are deleted, and tracks of the same object are merged. The labels are transferred to
the same recording processed with another model and other settings, and to a second recording of the
same table from another camera path. The simulator knows the object of each track in each run.
"""

import json
import string
import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np

from benchmarks.measure import markdown
from shapecat.config import DetectionSettings, Settings, SurfaceSettings
from shapecat.learning import Categorizer, load_model, save_model
from shapecat.pipeline import process
from shapecat.runs.jobs import Job
from shapecat.runs.labels.corrections import relabel
from shapecat.runs.labels.meaning import merged_with
from shapecat.runs.labels.track_table import read_track_table
from shapecat.runs.labels.transfer import match_labels
from shapecat.runs.tables.reading import read_row_groups
from shapecat.simulation import KINECT, make_scene
from shapecat.simulation.recorder import record
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.simulation.scenes.paths import Filming, arc_orbit
from shapecat.simulation.scenes.worlds import FIRST_OBJECT_LABEL, World

SCENES: tuple[SceneKind, ...] = ("tabletop", "clutter", "walking", "rearranged")
OTHER = Settings(
    seed=5,
    detection=DetectionSettings(max_range_m=1.8),
    surface=SurfaceSettings(smooth_radius_m=0.008),
)


@dataclass(frozen=True)
class Score:
    """Numbers of labels.

    Attributes
    ----------
    given : labels whose object the other run shows.
    right : labels transferred to the right object.
    wrong : labels transferred to a wrong object, or lost without a message.
    told : labels reported as not transferred.
    """

    given: int
    right: int
    wrong: int
    told: int


def name_of(truth: int) -> str:
    """Return a unique label for an object number."""
    tens, ones = divmod(truth, len(string.ascii_lowercase))
    return f"new thing {string.ascii_lowercase[tens]}{string.ascii_lowercase[ones]}"


def objects_of(run: Path, recording: Path) -> dict[int, int]:
    """Return the simulated object that each track shows, -1 for none.

    It is the object with most of the track's points, if at least a third of all its points belong
    to objects.
    """
    with np.load(recording.with_suffix(".labels.npz")) as file:
        labels = file["labels"].reshape(len(file["labels"]), -1)
    truth = json.loads(recording.with_suffix(".truth.json").read_text("utf-8"))
    image = {frame["stamp_ns"]: k for k, frame in enumerate(truth)}
    owner: dict[tuple[str, int, int], Counter[int]] = {}
    wanted = ["topic", "frame", "stamp_ns", "detection", "indices"]
    for group in read_row_groups(run / "detections.parquet", wanted):
        for row in group.to_pylist():
            seen = labels[image[row["stamp_ns"]]][row["indices"]]
            owner[row["topic"], row["frame"], row["detection"]] = Counter(seen.tolist())
    votes: dict[int, Counter[int]] = {}
    for group in read_row_groups(run / "tracks.parquet", ["track", *wanted[:2], "detection"]):
        for row in group.to_pylist():
            if row["detection"] is not None:
                key = row["topic"], row["frame"], row["detection"]
                votes.setdefault(row["track"], Counter()).update(owner[key])
    return {track: _owner(count) for track, count in votes.items()}


def _owner(count: Counter[int]) -> int:
    objects = Counter({label: n for label, n in count.items() if label >= FIRST_OBJECT_LABEL})
    if 3 * objects.total() < count.total():
        return -1
    return objects.most_common(1)[0][0] - FIRST_OBJECT_LABEL


def correct(run: Path, objects: dict[int, int]) -> None:
    """Label all tracks of a run: by object, as merged with its first track, or as deleted."""
    first: dict[int, int] = {}
    labels = {}
    for track, number in sorted(objects.items()):
        if number < 0:
            labels[track] = "delete"
        elif number in first:
            labels[track] = f"merge with {first[number]}"
        else:
            first[number] = track
            labels[track] = name_of(number)
    relabel(run, labels)


def judge(source: Path, objects: dict[int, int], target: Path, there: dict[int, int]) -> Score:
    """Transfer the labels of one run to another and compare the result with the ground truth.

    Labels of objects that the other run does not show only count if they were transferred.
    """
    transfer = match_labels(source, target)
    shown = set(there.values())
    rows = [row for row in read_track_table(source / "tracks.csv").rows if row.label]
    landed: dict[int, list[bool]] = {}
    whole = {row.track: merged_with(row.label) for row in rows}
    for item in transfer.transferred:
        good = objects[item.old_track] == there[item.track]
        landed.setdefault(item.old_track, []).append(good)
    told = {item.old_track for item in transfer.missed}
    right = wrong = given = silent = 0
    for row in rows:
        at = landed.get(row.track) or landed.get(whole[row.track] or -1, [])
        if not at and (objects[row.track] not in shown or objects[row.track] < 0):
            continue
        given += 1
        wrong += not all(at)
        right += bool(at) and all(at)
        silent += not at and row.track not in told
    return Score(given, right, wrong + silent, sum(row.track in told for row in rows))


def second_pass(world: World, seed: int, frames: int) -> World:
    """Return the same objects with another camera path."""
    rng = np.random.default_rng((seed, 2))
    height = next(s.height for s in world.supports if s.holds_objects and s.name != "floor")
    target = np.array([0, 0, height + 0.05])
    elsewhere = arc_orbit(
        rng, target, Filming(frames, 30.0), distance=(0.8, 1.3), elevation=(28, 52), sweep=(25, 60)
    )
    return replace(world, path=elsewhere)


def other_model(folder: Path) -> Path:
    """Write a model with lower confidences that rejects more objects as unknown."""
    model: Categorizer = load_model(None)
    path = folder / "other.npz"
    save_model(
        path, replace(model, temperature=3 * model.temperature, threshold=model.threshold - 1)
    )
    return path


@click.command()
@click.option("--first", default=710000, help="Seed of the first recording.")
@click.option("--count", default=20, help="Number of recordings.")
@click.option("--frames", default=60, help="Frames of each recording.")
def main(*, first: int, count: int, frames: int) -> None:
    """Measure the transfers and print a table."""
    total: dict[str, list[Score]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        model = other_model(folder)
        for seed in range(first, first + count):
            scene = SCENES[seed % len(SCENES)]
            world = make_scene(scene, np.random.default_rng(seed), frames=frames)
            one = record(world, folder / "one.mcap", seed=seed, sensor=KINECT)
            base, again = folder / f"{seed}" / "one", folder / f"{seed}" / "again"
            process(Job(one, base, mcap=False, rrd=False))
            objects = objects_of(base, one)
            correct(base, objects)
            process(Job(one, again, OTHER, model=model, every=2, mcap=False, rrd=False))
            scores = {"another model, other settings": (again, one)}
            if scene in SCENES[:2]:
                world = second_pass(world, seed, frames)
                two = record(world, folder / "two.mcap", seed=seed + 1, sensor=KINECT)
                other = folder / f"{seed}" / "two"
                process(Job(two, other, mcap=False, rrd=False))
                scores["a second recording"] = (other, two)
            for kind, (run, recording) in scores.items():
                score = judge(base, objects, run, objects_of(run, recording))
                total.setdefault(kind, []).append(score)
                print(seed, scene, kind, score, flush=True)
    rows = []
    for kind, found in total.items():
        names = ("given", "right", "wrong", "told")
        given, right, wrong, told = (sum(getattr(s, name) for s in found) for name in names)
        rows.append((kind, len(found), given, f"{100 * right / given:.1f} %", wrong, told))
    columns = ("carried over to", "recordings", "labels", "right", "wrong or silent", "told")
    print(markdown("Corrected labels in another run", columns, rows))


if __name__ == "__main__":
    main()
