"""``report.html`` of each run, and ``index.html`` over many."""

import os
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from urllib.parse import quote

from shapecat.outputs.colours import colour_of
from shapecat.outputs.report_drawing import draw
from shapecat.outputs.report_page import Card, Listed, index_page, is_unsure, run_page
from shapecat.outputs.report_tracks import read_courses, read_portraits, read_stage_seconds
from shapecat.outputs.rereading import find_runs, read_finished
from shapecat.runs.track_table import read_track_table
from shapecat.system.files import replacing

__all__ = ["write_report", "write_reports"]

Observer = Callable[[str, int, int | None], None]

_PAGE = "report.html"
_FACES = 6


def _ignore(_phase: str, _done: int, _total: int | None) -> None:
    """Observe nothing."""


def write_reports(folders: Sequence[Path], observe: Observer = _ignore) -> list[Path]:
    """Write report.html into each run, and an index.html above them.

    Parameters
    ----------
    folders : runs, or folders of runs. The index lies in the folder that holds all of them; a
        single run gets none.

    Returns
    -------
    The pages, the index last.

    Raises
    ------
    OutputError : a folder holds no run, or a page cannot be written.
    """
    unique = find_runs(folders)
    many = len(unique) > 1 or any(folder not in unique for folder in folders)
    above = Path(os.path.commonpath([run.resolve().parent for run in unique]))
    index = above / "index.html" if many else None
    pages, listed = [], []
    for done, run in enumerate(unique, start=1):
        item = write_report(run, index=index)
        pages.append(run / _PAGE)
        listed.append(item)
        observe("report", done, len(unique))
    if index:
        title = above.name
        with replacing(index) as path:
            path.write_text(index_page(title, listed), "utf-8")
        pages.append(index)
    return pages


def write_report(folder: Path, *, index: Path | None = None) -> Listed:
    """Write the report.html of one run; return how an index lists it.

    Clouds come from the recording; where that is gone, objects are drawn from their graphs.

    Raises
    ------
    OutputError : not a finished run, a tracks.csv that cannot be understood, or a full disk.
    """
    finished = read_finished(folder)
    table = read_track_table(folder / "tracks.csv")
    courses = read_courses(folder)
    rows = [row for row in table.rows if row.track in courses]
    portraits, reason = read_portraits(finished, courses, rows)
    cards = []
    for row in rows:
        portrait = portraits.get(row.track)
        pictures = draw(portrait.shot, colour_of(row.category)) if portrait else ()
        cards.append(Card(row, courses[row.track], pictures, portrait.size if portrait else None))
    notes = [f"objects are drawn from their graphs, without points: {reason}"] if reason else []
    page = run_page(
        finished,
        table,
        cards,
        read_stage_seconds(folder),
        notes=notes,
        index=_link(folder, index) if index else None,
    )
    with replacing(folder / _PAGE) as path:
        path.write_text(page, "utf-8")
    return Listed(
        link=_link(index.parent if index else folder, folder / _PAGE),
        name=finished.name,
        run=finished.run,
        categories=Counter(label.category for label in finished.labels.values()),
        unsure=sum(row.label == "" and is_unsure(row) for row in rows),
        checked=sum(row.label != "" for row in rows),
        faces=_faces(cards),
    )


def _link(start: Path, target: Path) -> str:
    return quote(Path(os.path.relpath(target.resolve(), start.resolve())).as_posix())


def _faces(cards: Sequence[Card]) -> tuple[str, ...]:
    """Return a picture of the surest track of each category, then of others."""
    sure = sorted(cards, key=lambda card: -card.row.confidence)
    first = {card.row.category: card for card in reversed(sure)}
    chosen = [*first.values(), *(card for card in sure if card not in first.values())]
    return tuple(card.pictures[0].image for card in chosen[:_FACES] if card.pictures)
