"""The model card: the training data of the default model, its accuracy and its weaknesses."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shapecat.evaluation import Report

__all__ = ["PICTURE", "Table", "format_table", "write_card"]

PICTURE = "worst_mistakes.png"
"""File name of the picture beside the card."""
_HEAD = """# The default model

Model `{model}`, made by {command}
from the simulator alone: no real reading was used to learn or to calibrate it. Settings were
chosen on simulated objects; the figures on real readings below were seen while choosing, so they
flatter it a little.

It tells {categories} by shape, seen from one side by a depth camera 0.25 to 3 m away and 5 to
90 degrees above, standing, lying, or as physics lets it fall in piles, bins and shelves; anything
else should come out as *unknown* (novelty above 1). The threshold rejects 14 % of simulated views
that show an object of these in part.

## Known confusions

- A cup without a handle that stands upside down, or lies with its opening out of sight, cannot be
  told from a can.
- The lower the resolution, the worse: small objects beyond 1.4 m, and lying objects above all.
- Borders are definitions: plate / bowl / cup by depth / diameter (0.2, 0.65), bottle / can by a
  top clearly narrower than the body. Objects near a border are taken for either.
- Cartons with a gable or a screw cap lie between box and bottle.
- Objects of which much is hidden are categorized by the piece that is seen.

## The worst mistakes

Views of the test set whose wrong label the model is surest of. Color is the distance.

![Points of the worst mistakes, with what they are and what the model says]({picture})
"""
_ANEW = "`make model` (`python -m shapecat.models.training`)"
_AFTER = """`python -m shapecat.models.training --after`
on top of model `{after}`, whose trees it keeps (what each part of the method is worth
was measured on that one),"""


@dataclass(frozen=True)
class Table:
    """A table of the card, with its title and a note below it."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


def format_table(table: Table) -> str:
    """Return a table in Markdown."""
    lines = [
        f"## {table.title}",
        "",
        "| " + " | ".join(table.head) + " |",
        "|---" * len(table.head) + "|",
        *("| " + " | ".join(row) + " |" for row in table.rows),
        *(["", table.note] if table.note else []),
    ]
    return "\n".join(lines) + "\n"


def write_card(
    path: Path,
    *,
    model: str,
    after: str | None,
    categories: Sequence[str],
    tables: Sequence[Table],
    confusion: Report,
    settings: Mapping[str, object],
) -> None:
    """Write the model card.

    Parameters
    ----------
    model : id of the model.
    after : id of the model whose trees it keeps; None if it was trained from scratch.
    tables : results to print.
    confusion : report whose confusion matrix is printed.
    settings : settings of the training, by name.
    """
    head = _HEAD.format(
        model=model,
        command=_ANEW if after is None else _AFTER.format(after=after),
        categories=", ".join(categories),
        picture=PICTURE,
    )
    rows = tuple(
        (name, *map(str, row))
        for name, row in zip(confusion.categories, confusion.confusion, strict=True)
    )
    taken = Table(
        "Confusion on the test tables (true category in rows)", ("", *confusion.categories), rows
    )
    chosen = Table(
        "Settings",
        ("setting", "value"),
        tuple((name, str(value)) for name, value in settings.items()),
    )
    parts = [head, *map(format_table, (*tables, taken, chosen))]
    path.write_text("\n".join(parts), "utf-8")
