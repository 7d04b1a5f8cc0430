"""False detections in rooms full of background equipment.

    python -m benchmarks.rooms --first 790000 --count 40

One frame of each simulated room; the sensors take turns. Detections on robots, people, screens,
chairs, plants on the floor, cables, curtains and walls are surplus; so are all detections of an
object except the best one. A laptop, keyboard or plant on the table is an unknown object.
"""

from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from benchmarks.measure import markdown
from benchmarks.scenes import SEEN_PIXELS, Array, object_masks, simulated_frame
from shapecat.config import Settings
from shapecat.evaluation.comparison.overlap import MATCHED_F, match_masks
from shapecat.learning import Categorizer, load_model
from shapecat.perception import perceive
from shapecat.simulation.camera.presets import PRESETS
from shapecat.simulation.scenes.worlds import FIRST_OBJECT_LABEL

HEAD = ("sensor", "frames", "detections", "surplus", "of these pieces", "found", "surplus a frame")


class Counts(NamedTuple):
    """Counts over several frames.

    Attributes
    ----------
    elsewhere : number of detections on no object.
    pieces : number of detections of an object in addition to its best one.
    objects, found : number of true objects with at least `SEEN_PIXELS` pixels, and of those found.
    f : sum of the overlap F of these objects, 0 for missed ones.
    """

    frames: int = 0
    detections: int = 0
    elsewhere: int = 0
    pieces: int = 0
    objects: int = 0
    found: int = 0
    f: float = 0.0

    def __add__(self, other: Any) -> "Counts":
        """Return the sums."""
        return Counts(*(a + b for a, b in zip(self, other, strict=True)))

    def row(self, name: str) -> tuple[Any, ...]:
        """Return the row of the table: the counts, the fraction found, and surplus per frame."""
        surplus = self.elsewhere + self.pieces
        found = f"{self.found / max(self.objects, 1):.3f}"
        share = f"{surplus / max(self.frames, 1):.2f}"
        return (name, self.frames, self.detections, surplus, self.pieces, found, share)


def evaluate(sensor: str, seed: int, model: Categorizer) -> Counts:
    """Perceive a frame of a room and count its detections."""
    _, frame, labels = simulated_frame("room", seed, PRESETS[sensor])
    seen = perceive(frame, up=None, categorizer=model, settings=Settings()).detections
    return count([d.candidate.indices for d in seen], labels)


def count(detections: list[Array], labels: Array) -> Counts:
    """Compare detections, given as pixel indices (k,), with the true pixel labels (h * w,)."""
    on_objects = [float(np.mean(labels[d] >= FIRST_OBJECT_LABEL)) > 0.5 for d in detections]
    seen = object_masks(labels)
    matches = match_masks(detections, seen)
    # The best matching also pairs masks that have no pixel in common.
    kept = {row for row, k in matches.pairs.items() if on_objects[row] and matches.f[row, k] > 0}
    listed = [k for k, mask in enumerate(seen) if len(mask) >= SEEN_PIXELS]
    f = [float(matches.f[row, k]) for row, k in matches.pairs.items() if k in listed]
    found = sum(value >= MATCHED_F for value in f)
    pieces = sum(on_objects) - len(kept)
    elsewhere = len(detections) - sum(on_objects)
    return Counts(1, len(detections), elsewhere, pieces, len(listed), found, sum(f))


@click.command()
@click.option("--first", default=3000, show_default=True, help="Seed of the first room.")
@click.option("--count", "rooms", default=40, show_default=True, help="Number of rooms.")
@click.option(
    "--model", type=click.Path(path_type=Path), help="Model file, else the default model."
)
def main(first: int, rooms: int, model: Path | None) -> None:
    """Count surplus detections in rooms, and print a table."""
    categorizer = load_model(model)
    found = dict.fromkeys(PRESETS, Counts())
    for k in range(rooms):
        name = list(PRESETS)[k % len(PRESETS)]
        found[name] += evaluate(name, first + k, categorizer)
    rows = [counts.row(name) for name, counts in found.items() if counts.frames]
    click.echo(markdown("Rooms", HEAD, [*rows, sum(found.values(), Counts()).row("all")]))


if __name__ == "__main__":
    main()
