"""The model card: the training data of the default model, its accuracy and its weaknesses."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from shapecat.evaluation import Report

__all__ = ["PICTURE", "Table", "format_table", "write_card"]

PICTURE = "worst_mistakes.png"
"""File name of the picture beside the card."""
_HEAD = """# The default model

Model `{model}`, made by `make model` (`python -m shapecat.models.training`)
from the simulator alone: no real data were used for training or calibration. Settings were chosen
on simulated objects; the results on real data below were known during this choice, so they are
slightly optimistic.

It distinguishes {categories} by shape, seen by a depth camera from 0.25 to 3 m away and 5 to
90 degrees above the horizontal. Objects may stand, lie, or rest in any pose in piles, bins, shelves
and rooms. All other shapes should be *unknown* (novelty above 1), and so should noise and thin
remains of tables that detection mistakes for objects. The threshold rejects 14 % of the simulated
partial views of known categories.

## Known confusions

- A cup without a handle looks like a can if it stands upside down, or lies with its opening out of
  sight.
- Accuracy falls with the resolution, most of all for small objects beyond 1.4 m and lying objects.
- Some categories differ by a definition: plate, bowl and cup by depth / diameter (limits 0.2 and
  0.65), bottle and can by a neck clearly narrower than the body. A ball may be a round fruit, 0.75
  to 1.4 times as long as wide: an apple, a lemon. Objects near such a limit may get either
  category.
- Cartons with a gable or a screw cap are between box and bottle.
- Mostly hidden objects are categorized by their visible part.

## Confidence

On simulated objects the confidence is calibrated: of the objects with a confidence of 0.8, about
80 % have the right category. In real clutter it is too high, mostly for shapes of no category.
In real recordings with labels, 43 detections of a known category had a confidence of at least 0.9:
29 were right, and the 14 others were *unknown* shapes.

## The worst mistakes

The views of the test set with the most confident wrong labels. Colour shows the distance.

![Points of the worst mistakes, with their true and predicted labels]({picture})
"""


class Table(NamedTuple):
    """A table of the card, with its title."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


def format_table(table: Table) -> str:
    """Return a table in Markdown."""
    lines = [
        f"## {table.title}",
        "",
        "| " + " | ".join(table.head) + " |",
        "|---" * len(table.head) + "|",
        *("| " + " | ".join(row) + " |" for row in table.rows),
    ]
    return "\n".join(lines) + "\n"


def write_card(
    path: Path, *, tables: Sequence[Table], confusion: Report, settings: Mapping[str, object]
) -> None:
    """Write the model card.

    Parameters
    ----------
    tables : results to print.
    confusion : report on the model, whose confusion matrix is printed.
    settings : settings of the training, by name.
    """
    categories = ", ".join(confusion.categories)
    head = _HEAD.format(model=confusion.model, categories=categories, picture=PICTURE)
    confusion_table = Table(
        "Confusion on clear views of the test set (true category in rows)",
        ("", *confusion.categories),
        [
            (name, *map(str, row))
            for name, row in zip(confusion.categories, confusion.confusion, strict=True)
        ],
    )
    rows = [(name, str(value)) for name, value in settings.items()]
    settings_table = Table("Settings", ("setting", "value"), rows)
    parts = [head, *map(format_table, (*tables, confusion_table, settings_table))]
    path.write_text("\n".join(parts), "utf-8")
