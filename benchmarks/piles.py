"""Detection and categorization of objects arranged by physics: piles, bins, compartments.

    python -m benchmarks.piles --first 740000 --count 60
    python -m benchmarks.piles --kind pile --sensor all --count 40

Each scene has twelve objects. One frame of it is simulated for each of the sensors: a Kinect and a
RealSense by default.
"""

from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from benchmarks.measure import markdown
from benchmarks.scenes import SEEN_PIXELS, Array
from shapecat.config import Settings
from shapecat.evaluation.comparison.overlap import MATCHED_F, Overlap, match_masks
from shapecat.evaluation.metrics import auroc, expected_calibration_error
from shapecat.learning import Categorizer, load_model
from shapecat.perception import perceive
from shapecat.simulation import PlacedObject, render_frame
from shapecat.simulation.camera.presets import PRESETS
from shapecat.simulation.scenes.paths import Filming
from shapecat.simulation.scenes.piles import bin_picking, pile, shelf_bin
from shapecat.types import CATEGORIES, Detection

SCENES = {"pile": pile, "bin": bin_picking, "shelf bin": shelf_bin}
OBJECTS, UNKNOWN = 12, 1 / 6
"""Number of dropped objects, and the fraction of them outside the categories."""


class ScoredObject(NamedTuple):
    """A found object and its detection."""

    placed: PlacedObject
    detection: Detection


def evaluate(
    kind: str, sensor: str, first: int, count: int, model: Categorizer
) -> tuple[list[ScoredObject], Overlap]:
    """Perceive one frame of each scene; return the found objects, and the overlap of all masks."""
    found: list[ScoredObject] = []
    overlap = Overlap()
    for seed in range(first, first + count):
        rng = np.random.default_rng(seed)
        names = np.where(rng.random(OBJECTS) < UNKNOWN, "unknown", rng.choice(CATEGORIES, OBJECTS))
        world = SCENES[kind](rng, names.tolist(), Filming(1, 30.0))
        frame, labels = render_frame(world, 0, rng=rng, sensor=PRESETS[sensor])
        seen = perceive(frame, up=None, categorizer=model, settings=Settings()).detections
        flat = labels.reshape(-1)
        masks = [(item, np.flatnonzero(flat == item.label)) for item in world.objects]
        masks = [(item, mask) for item, mask in masks if len(mask) >= SEEN_PIXELS]
        lists = [d.candidate.indices[flat[d.candidate.indices] > 0] for d in seen]
        matches = match_masks(lists, [mask for _, mask in masks])
        overlap += matches.overlap
        found += [
            ScoredObject(masks[k][0], seen[row])
            for row, k in matches.pairs.items()
            if matches.f[row, k] >= MATCHED_F
        ]
    return found, overlap


def figures(found: list[ScoredObject], overlap: Overlap, model: Categorizer) -> dict[str, float]:
    """Return F, the fraction of objects found, and metrics of their categories."""
    known = [o for o in found if o.placed.category != "unknown" and not o.placed.indistinct]
    strange = [o for o in found if o.placed.category == "unknown"]
    tilted = [o for o in known if o.placed.tilted]
    return {
        "objects": overlap.objects,
        "F": overlap.f,
        "found": overlap.share_found,
        "detections": overlap.detections,
        "category": _right(known, model),
        "upright or lying": _right([o for o in known if not o.placed.tilted], model),
        "tilted": _right(tilted, model),
        "tilted objects": len(tilted),
        "AUROC": auroc(_novelty(strange), _novelty(known)),
        "ECE": _calibration(known, model),
    }


def _right(objects: list[ScoredObject], model: Categorizer) -> float:
    """Return the fraction of objects with the right category; *unknown* counts as wrong."""
    right = [_category(o, model) == o.placed.category for o in objects]
    return float(np.mean(right)) if right else float("nan")


def _category(scored: ScoredObject, model: Categorizer) -> str:
    if scored.detection.novelty > 1:
        return "unknown"
    return str(model.categories[int(np.argmax(scored.detection.posterior))])


def _novelty(objects: list[ScoredObject]) -> Array:
    return np.array([o.detection.novelty for o in objects], np.float32)


def _calibration(objects: list[ScoredObject], model: Categorizer) -> float:
    truth = np.array([model.categories.index(o.placed.category) for o in objects], np.int64)
    posteriors = np.array([o.detection.posterior for o in objects], np.float32)
    return expected_calibration_error(truth, posteriors) if len(objects) else float("nan")


@click.command()
@click.option("--first", default=3000, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=60, show_default=True, help="Scenes of each kind.")
@click.option(
    "--kind", "kinds", multiple=True, type=click.Choice(list(SCENES)), help="[default: all]"
)
@click.option(
    "--sensor",
    "sensors",
    multiple=True,
    type=click.Choice([*PRESETS, "all"]),
    default=("kinect", "realsense"),
    show_default=True,
)
@click.option(
    "--model", type=click.Path(path_type=Path), help="Model file, else the default model."
)
def main(
    first: int, count: int, kinds: tuple[str, ...], sensors: tuple[str, ...], model: Path | None
) -> None:
    """Evaluate piles, bins and compartments, and print a table."""
    categorizer, rows = load_model(model), []
    for kind in kinds or SCENES:
        for sensor in PRESETS if "all" in sensors else sensors:
            scored = evaluate(kind, sensor, first, count, categorizer)
            found = figures(*scored, categorizer)
            cells = (f"{v:.3f}" if v % 1 else f"{v:g}" for v in found.values())
            rows.append((f"{kind}, {sensor}", *cells))
    click.echo(markdown("Physics", ("scenes", *found), rows))


if __name__ == "__main__":
    main()
