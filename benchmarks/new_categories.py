"""A new category, learned from one recording and added to the default model.

    python -m benchmarks.new_categories --first 1000 --tables 20

The new categories are the kinds of objects that the trees never saw. Each is learned from 20 views
in a recording of one table; the other objects of the recording are labelled, too. It is evaluated
on single views of other tables, each with three new objects of that kind and one object of each
category. Views of the other kinds should not be taken for the new category.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import click
import numpy as np

from benchmarks.measure import markdown
from benchmarks.scenes import SEEN_PIXELS, Array
from shapecat.config import Settings
from shapecat.evaluation.comparison.overlap import MATCHED_F, match_masks
from shapecat.learning import Categorizer, load_model
from shapecat.learning.incremental import add_categories
from shapecat.models.sets import options_of
from shapecat.perception import perceive
from shapecat.simulation import World, render_frame
from shapecat.simulation.camera.presets import PRESETS
from shapecat.simulation.scenes.furniture import make_table
from shapecat.simulation.scenes.layout import Layout, Piece
from shapecat.simulation.scenes.paths import Filming, arc_orbit
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.distractors import make_distractor
from shapecat.simulation.shapes.stable_poses import StablePose
from shapecat.types import CATEGORIES, UNKNOWN, Pose

OBJECTS = 3
"""Number of objects of the new category on each table."""
LEARNED = 20
"""Number of views from which the category is learned."""
RECORDED, TESTED, RATE_HZ = 8, 2, 1.0
"""Frames of the recording, frames of each other table, and the rate of both."""
HALF_M = np.array([0.36, 0.26])
"""Half the size of the area in which objects are placed, metres."""
TRIES = 10
"""Maximum number of calls that try to place an object."""
UPRIGHT = StablePose(Pose(np.eye(3), np.zeros(3)), "upright")
COLUMNS = (
    "new category", "views", "recognized", "old views", "right before", "right after",
    "others", "taken",
)  # fmt: skip


class Views(NamedTuple):
    """Descriptors (n, d) of found objects, and their true categories (n,)."""

    descriptors: Array
    truth: Array


@click.command(help=__doc__)
@click.option("--first", default=1000, show_default=True, help="Seed of all tables.")
@click.option("--tables", default=20, show_default=True, help="Test tables for each category.")
@click.option("--sensor", default="kinect", show_default=True, type=click.Choice(list(PRESETS)))
def main(*, first: int, tables: int, sensor: str) -> None:
    """Learn and evaluate each new category, and print a table."""
    kinds = options_of("test").kinds
    tested = {kind: _see(kind, (first, 1), tables, TESTED, sensor) for kind in kinds}
    rows = [_evaluate(kind, _see(kind, (first, 0), 1, RECORDED, sensor), tested) for kind in kinds]
    cells = [_cells(row) for row in [*rows, _mean(rows)]]
    print(markdown(f"New categories, {sensor}, seed {first}", COLUMNS, cells))


def _mean(rows: Sequence[tuple[Any, ...]]) -> tuple[Any, ...]:
    """Return the row of all categories: the sums of the counts, and the means of the fractions."""
    columns = list(zip(*rows, strict=True))[1:]
    return ("all", *(sum(c) if isinstance(c[0], int) else float(np.mean(c)) for c in columns))


def _cells(row: tuple[Any, ...]) -> list[str]:
    return [f"{value:.3f}" if isinstance(value, float) else str(value) for value in row]


def _evaluate(
    kind: str, recorded: Views, tested: dict[str, Views]
) -> tuple[str, *tuple[float, ...]]:
    """Learn a category from the views of a recording; return the row of the table."""
    base = load_model(None)
    own = np.flatnonzero(recorded.truth == kind)[:LEARNED]
    chosen = np.concatenate([own, np.flatnonzero(recorded.truth != kind)])
    learned = add_categories(
        base,
        recorded.descriptors[chosen],
        recorded.truth[chosen].tolist(),
        rng=np.random.default_rng(0),
    )
    new, old = (tested[kind].truth == kind), (tested[kind].truth != kind)
    others = [
        views.descriptors[views.truth == name] for name, views in tested.items() if name != kind
    ]
    truth = tested[kind].truth
    before, after = (_categories(m, tested[kind].descriptors) for m in (base, learned))
    taken = _categories(learned, np.concatenate(others))
    return (
        kind,
        int(new.sum()),
        float(np.mean(after[new] == kind)),
        int(old.sum()),
        float(np.mean(before[old] == truth[old])),
        float(np.mean(after[old] == truth[old])),
        len(taken),
        float(np.mean(taken == kind)),
    )


def _categories(model: Categorizer, descriptors: Array) -> Array:
    found = model.predict(descriptors)
    names = np.array(model.categories)[found.posteriors.argmax(axis=1)]
    return np.where(found.novelty > 1, UNKNOWN, names)


def _see(kind: str, seed: Sequence[int], tables: int, frames: int, sensor: str) -> Views:
    """Return the found objects in all frames of tables with objects of ``kind``."""
    model, settings = load_model(None), Settings()
    rng = np.random.default_rng([*seed, *kind.encode()])
    descriptors, truth = [], []
    for _ in range(tables):
        world = _table(kind, rng, frames)
        for k in range(frames):
            frame, labels = render_frame(world, k, rng=rng, sensor=PRESETS[sensor])
            seen = perceive(frame, up=None, categorizer=model, settings=settings).detections
            flat = labels.reshape(-1)
            masks = [(item, np.flatnonzero(flat == item.label)) for item in world.objects]
            masks = [(item, mask) for item, mask in masks if len(mask) >= SEEN_PIXELS]
            matches = match_masks([d.candidate.indices for d in seen], [mask for _, mask in masks])
            for row, column in matches.pairs.items():
                if matches.f[row, column] >= MATCHED_F:
                    descriptors.append(seen[row].descriptor)
                    truth.append(masks[column][0].category)
    return Views(np.array(descriptors, np.float32), np.array(truth))


def _table(kind: str, rng: np.random.Generator, frames: int) -> World:
    """Place three objects of a kind and one of each category, all upright, on a table."""
    table, layout = make_table(rng), Layout(rng, gap=0.03)
    pieces = [Piece(kind, *make_distractor(rng, [kind]), UPRIGHT) for _ in range(OBJECTS)]
    pieces += [Piece(name, name, make_object(name, rng), UPRIGHT) for name in CATEGORIES]
    for piece in pieces:
        any(layout.put_piece(piece, table, HALF_M) for _ in range(TRIES))
    path = arc_orbit(
        rng,
        np.array([0, 0, table.height + 0.05]),
        Filming(frames, RATE_HZ),
        distance=(0.7, 1.4),
        elevation=(20, 60),
        sweep=(30, 90),
    )
    return World("tabletop", (table,), tuple(layout.objects), path)


if __name__ == "__main__":
    main()
