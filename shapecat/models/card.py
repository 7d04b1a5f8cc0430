"""The model card: what the default model was made from, and what it can and cannot do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from shapecat.evaluation import Report

__all__ = ["Table", "format_table", "write_card"]

_HEAD = """# The default model

Model `{model}`, made by `make model` (`python -m shapecat.models.training`) from the simulator
alone: no real reading was used to learn or to calibrate it. Settings were chosen on
simulated objects; the figures on real readings below were seen while choosing, so they flatter
it a little.

It tells {categories} by shape, seen from one side by a depth camera 0.35 to 2.2 m away and 5 to
88 degrees above, standing, lying, or as physics lets it fall in piles, bins and shelves; anything
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
"""


@dataclass(frozen=True)
class Table:
    """A titled table of the card, and what to read from it."""

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
    categories: Sequence[str],
    tables: Sequence[Table],
    confusion: Report,
    settings: Mapping[str, object],
) -> None:
    """Write the card beside the model."""
    head = _HEAD.format(model=model, categories=", ".join(categories))
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
