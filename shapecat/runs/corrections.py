"""Corrections of a run: the column ``label`` of tracks.csv, checked and applied.

The table may have passed through a spreadsheet: separators, quotes, line ends, the order of
columns and numbers such as ``1.0`` do not matter.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from shapecat.errors import OutputError
from shapecat.runs.folder import read_run
from shapecat.runs.label_meaning import (
    TrackLabel,
    find_misread,
    merged_with,
    resolve_labels,
)
from shapecat.runs.track_table import (
    TrackRow,
    TrackTable,
    read_track_table,
    unlabelled,
    with_label,
    write_track_table,
)
from shapecat.system.files import holding, replacing

__all__ = [
    "PREVIOUS",
    "adopt_labels",
    "correct_label",
    "has_labels",
    "read_labels",
    "relabel",
]

ORIGINAL = "tracks.original.csv"
PREVIOUS = "tracks.previous.csv"


def read_labels(path: Path, categories: Iterable[str] = ()) -> dict[int, TrackLabel]:
    """Read the final label of each track; deleted tracks are missing.

    A label a person filled in wins over the category, at confidence 1. Tracks of different topics
    can be merged if a sensor has seen both, or if the run.json beside the table tells of a fixed
    frame that they share.

    Parameters
    ----------
    categories : those of the model; the categories in the table are known as well.

    Raises
    ------
    OutputError : the table is unreadable, or lines of it cannot be understood: each is named.
    """
    table = read_track_table(path)
    _require_same_run(path, table, path.parent)
    labels, misread = resolve_labels(table.rows, categories, one_frame=_one_frame(path.parent))
    _refuse(path, [*table.problems, *_lines(table.rows, misread)])
    return labels


def adopt_labels(corrected: Path, folder: Path) -> None:
    """Make the labels of a corrected table those of a run.

    Only the column ``label`` is taken over, and tracks that the table does not list keep their
    label. The first table is kept as tracks.original.csv. ``corrected`` may be the tracks.csv of
    the run itself.

    Raises
    ------
    OutputError : the table is unreadable, is another run's, names tracks that the run does not
        have, or has labels that cannot be understood. All such lines are named, and nothing is
        written.
    """
    with holding(folder):
        _adopt(corrected, folder)


def _adopt(corrected: Path, folder: Path) -> None:
    current, original = folder / "tracks.csv", folder / ORIGINAL
    in_place = current.exists() and corrected.exists() and corrected.samefile(current)
    _require_same_run(corrected, read_track_table(corrected), folder, known=in_place)
    base = read_track_table(original if original.exists() else current)
    if not in_place:
        base = _relabelled(base, read_track_table(current).rows)
    table = read_track_table(corrected)
    known = {row.track for row in base.rows}
    problems = [
        *table.problems,
        *(
            f"line {row.line}: there is no track {row.track}"
            for row in table.rows
            if row.track not in known
        ),
    ]
    result = _relabelled(base, table.rows)
    known_categories = read_run(folder)["model"]["categories"]
    _, misread = resolve_labels(result.rows, known_categories, one_frame=_one_frame(folder))
    _refuse(corrected, problems + _lines(result.rows, misread))
    if not original.exists():
        with replacing(original) as path:
            if in_place:
                write_track_table(path, unlabelled(base))
            else:
                path.write_bytes(current.read_bytes())
    with replacing(current) as path:
        write_track_table(path, result)


def relabel(folder: Path, labels: Mapping[int, str]) -> dict[int, str]:
    """Set labels of some tracks of a run; keep the other labels and the first table.

    Returns
    -------
    By track, why a label was not given: it cannot be understood, or contradicts those there.

    Raises
    ------
    OutputError : the table of the run cannot be read or is another run's, or the disk is full.
    """
    current, original = folder / "tracks.csv", folder / ORIGINAL
    base = read_track_table(current)
    _require_same_run(current, base, folder)
    categories, one_frame = read_run(folder)["model"]["categories"], _one_frame(folder)
    before = find_misread(base.rows, categories, one_frame=one_frame)
    _refuse(current, [*base.problems, *_lines(base.rows, before)])
    rows, refused = _given(base.rows, labels, categories, one_frame=one_frame)
    if not original.exists():
        with replacing(original) as path:
            write_track_table(path, unlabelled(base))
    with replacing(current) as path:
        write_track_table(path, replace(base, rows=rows))
    return refused


def correct_label(folder: Path, track: int, label: str, *, seen: str) -> str:
    """Give a track of a run a label, unless another one than ``seen`` was written meanwhile.

    Returns
    -------
    Why it was not given; empty if it was.

    Raises
    ------
    OutputError : as `relabel`.
    """
    with holding(folder):
        rows = {row.track: row for row in read_track_table(folder / "tracks.csv").rows}
        if track not in rows:
            return f"there is no #{track}"
        if rows[track].label != seen:
            return f"its label is {rows[track].label!r} by now"
        return relabel(folder, {track: label}).get(track, "")


def _given(
    rows: tuple[TrackRow, ...],
    labels: Mapping[int, str],
    categories: Iterable[str],
    *,
    one_frame: bool,
) -> tuple[tuple[TrackRow, ...], dict[int, str]]:
    """Return rows with labels, and why some were not given; one by one if not all can be."""
    given = _labelled(rows, labels)
    if not find_misread(given, categories, one_frame=one_frame):
        return given, {}
    refused = {}
    for track in sorted(labels, key=lambda track: merged_with(labels[track]) is not None):
        given = _labelled(rows, {track: labels[track]})
        if misread := find_misread(given, categories, one_frame=one_frame):
            refused[track] = misread.get(track) or next(iter(misread.values()))
        else:
            rows = given
    return rows, refused


def _labelled(rows: Iterable[TrackRow], labels: Mapping[int, str]) -> tuple[TrackRow, ...]:
    return tuple(with_label(row, labels.get(row.track, row.label)) for row in rows)


def has_labels(path: Path) -> bool:
    """Return whether a table exists and has labels.

    Raises
    ------
    OutputError : it cannot be read.
    """
    return path.exists() and any(row.label for row in read_track_table(path).rows)


def _require_same_run(path: Path, table: TrackTable, folder: Path, *, known: bool = True) -> None:
    """Refuse a table of another run than that in ``folder``.

    ``known`` is a table that lies in the folder: it need not say whose it is. One without the
    column, made by hand, goes by its places, if it has any.

    Raises
    ------
    OutputError : it is another run's, of several runs, or of nobody knows which.
    """
    own = read_run(folder).get("work", "") if (folder / "run.json").exists() else ""
    if not own or set(table.runs) == {own}:
        return
    if not table.runs and (known or _places_agree(table, folder)):
        return
    if len(table.runs) > 1:
        found = f"holds tracks of several runs ({', '.join(table.runs)})"
    elif table.runs:
        found = f"holds the tracks of {_described(path.parent, table.run)}"
    else:
        found = "has tracks in other places (and no column `run`)"
    msg = (
        f"{path}: {found}, not those of {_described(folder, own)}; to find the same objects by "
        "their places use --by-place"
    )
    raise OutputError(msg)


def _places_agree(table: TrackTable, folder: Path) -> bool:
    """Return whether no track of a table is elsewhere than that of the run."""
    own = {row.track: row for row in read_track_table(folder / "tracks.csv").rows}
    return all(
        _number(row.cells.get(axis)) in {None, _number(own[row.track].cells.get(axis))}
        for row in table.rows
        if row.track in own
        for axis in "xyz"
    )


def _number(cell: str | None) -> float | None:
    """Return the number in a cell, as a spreadsheet may write it."""
    with suppress(ValueError, AttributeError):
        return float((cell or "").strip().replace(",", "."))
    return None


def _described(folder: Path, work: str) -> str:
    """Name a run, by its folder and recording if it is the one that lies there."""
    with suppress(OutputError, KeyError):
        run = read_run(folder)
        if run["work"] == work:
            return f"run {work} ({folder}, of {run['input']['path']})"
    return f"run {work}"


def _relabelled(base: TrackTable, rows: Iterable[TrackRow]) -> TrackTable:
    """Return a table with the labels of other rows, and the numbers of their lines."""
    given = {row.track: row for row in rows}
    changed = [
        replace(with_label(row, given[row.track].label), line=given[row.track].line)
        if row.track in given
        else row
        for row in base.rows
    ]
    return replace(base, rows=tuple(changed))


def _refuse(path: Path, problems: Sequence[str]) -> None:
    if problems:
        listed = "\n  ".join(sorted(problems, key=lambda text: int(text.split()[1].rstrip(":"))))
        msg = f"{path}: nothing was written, because of\n  {listed}"
        raise OutputError(msg)


def _one_frame(folder: Path) -> bool:
    """Return whether the sensors of a run have places in one frame."""
    return (folder / "run.json").exists() and read_run(folder).get("fixed_frame") is not None


def _lines(rows: Iterable[TrackRow], misread: Mapping[int, str]) -> list[str]:
    return [f"line {row.line}: {misread[row.track]}" for row in rows if row.track in misread]
