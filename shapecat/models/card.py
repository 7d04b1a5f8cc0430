"""The model card: the training data of the default model, its accuracy and its weaknesses."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from shapecat.evaluation import Report

__all__ = ["PICTURE", "markdown", "write_card"]

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


def markdown(title: str, head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table as Markdown: the heading ``title``, a header row ``head``, and the rows."""
    lines = [f"## {title}", "", f"| {' | '.join(head)} |", f"|{'---|' * len(head)}"]
    lines += [f"| {' | '.join(map(str, row))} |" for row in rows]
    return "\n".join([*lines, ""])


def write_card(
    path: Path, *, tables: Sequence[str], confusion: Report, settings: Mapping[str, object]
) -> None:
    """Write the model card.

    Parameters
    ----------
    tables : results, as Markdown.
    confusion : report on the model, whose confusion matrix is printed.
    settings : settings of the training, by name.
    """
    categories = ", ".join(confusion.categories)
    head = _HEAD.format(model=confusion.model, categories=categories, picture=PICTURE)
    confusion_table = markdown(
        "Confusion on clear views of the test set (true category in rows)",
        ("", *confusion.categories),
        [(name, *row) for name, row in zip(confusion.categories, confusion.confusion, strict=True)],
    )
    settings_table = markdown("Settings", ("setting", "value"), list(settings.items()))
    path.write_text("\n".join([head, *tables, confusion_table, settings_table]), "utf-8")
