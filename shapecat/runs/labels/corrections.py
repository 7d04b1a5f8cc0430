"""Check and apply the corrections of a run: the column ``label`` of tracks.csv."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from shapecat.errors import OutputError, explained, listed
from shapecat.runs.folder import read_run, require_work
from shapecat.runs.labels.meaning import (
    DELETE,
    TrackLabel,
    find_misread,
    merged_with,
    resolve_labels,
)
from shapecat.runs.labels.same_run import require_same_run
from shapecat.runs.labels.track_table import (
    LABEL_SEEN,
    ORIGINAL,
    TrackRow,
    TrackTable,
    read_track_table,
    with_label,
    write_track_table,
)
from shapecat.system.files import holding, replacing

__all__ = [
    "LOST",
    "PREVIOUS",
    "adopt_labels",
    "correct_label",
    "has_labels",
    "read_labelled_table",
    "read_labels",
    "relabel",
]

PREVIOUS = "tracks.previous.csv"
"""Name under which the last replaced table with labels is kept."""
LOST = "tracks.previous-*.csv"
"""Pattern for the names of replaced tables with labels that could not be transferred. Later runs
keep these tables."""
_MOST_PROBLEMS = 20
"""Maximum number of problems of a table in an error message."""


def read_labels(path: Path, categories: Iterable[str] = ()) -> dict[int, TrackLabel]:
    """Read the final label of each track, as `read_labelled_table` does."""
    return read_labelled_table(path, categories)[1]


def read_labelled_table(
    path: Path, categories: Iterable[str] = ()
) -> tuple[TrackTable, dict[int, TrackLabel]]:
    """Read the tracks.csv of a run, and the final label of each track; deleted tracks have none.

    A label that a person filled in replaces the category and has confidence 1. Two tracks can be
    merged if they have a topic in common, or if run.json beside the table has a fixed frame.

    Parameters
    ----------
    categories : the model's categories; the categories in the table are known as well.

    Raises
    ------
    OutputError : the table is unreadable, belongs to another run, or has invalid lines, which the
        error message lists.
    """
    table, problems = _restored(path)
    labels, misread = resolve_labels(table.rows, categories, one_frame=_one_frame(path.parent))
    _refuse(path, [*problems, *_lines(table.rows, misread)], "the table cannot be used")
    return table, labels


def _restored(path: Path) -> tuple[TrackTable, list[str]]:
    """Read the tracks.csv of a run, and restore what a person must not change.

    Labels and added columns are from tracks.csv, other cells and the order from
    tracks.original.csv.

    Returns
    -------
    The table, and the problems of lines, including missing tracks.

    Raises
    ------
    OutputError : the table is unreadable, or belongs to another run.
    """
    _require_content(path)
    table = read_track_table(path)
    require_same_run(path, table, path.parent)
    original = read_track_table(path.with_name(ORIGINAL))
    edited = {row.track: row for row in table.rows}
    missing = [f"#{row.track}" for row in original.rows if row.track not in edited]
    problems = [*table.problems, *_contradictions(table, original)]
    problems += [f"{ORIGINAL}, {text}" for text in (*original.problems, *original.wrong_numbers)]
    if missing:
        problems.append(
            f"missing tracks: {listed(missing)}; restore the lines from "
            f"{ORIGINAL}, or write `{DELETE}` in the column label to remove objects"
        )
    rows = tuple(
        replace(row, cells={**edited[row.track].cells, **row.cells})
        for row in original.rows
        if row.track in edited
    )
    # `LABEL_SEEN` means something only in a table that a page wrote, not in the run's own.
    columns = tuple(
        n for n in dict.fromkeys((*original.columns, *table.columns)) if n != LABEL_SEEN
    )
    restored = _relabelled(TrackTable(columns, rows, ()), table.rows)
    return restored, problems


def _require_content(path: Path) -> None:
    """Check that a tracks.csv has not been lost: it must exist if its tracks.original.csv does.

    Raises
    ------
    OutputError : it is missing or empty.
    """
    with explained(f"{path}: cannot be read", OutputError):
        is_lost = not (path.exists() and path.stat().st_size)
        if is_lost and path.with_name(ORIGINAL).exists():
            msg = f"{path}: missing or empty; restore it from {ORIGINAL}"
            raise OutputError(msg)


def _contradictions(table: TrackTable, original: TrackTable) -> list[str]:
    """Return the problems of lines whose track or category contradicts the original table."""
    stored = {row.track: row.category for row in original.rows}
    problems = []
    for row in table.rows:
        if row.track not in stored:
            problems.append(f"line {row.line}: there is no track #{row.track}")
        elif row.category.lower() != stored[row.track].lower():
            problems.append(
                f"line {row.line}: the category of track #{row.track} is {stored[row.track]!r}, "
                f"not {row.category!r}; write corrections into the column label"
            )
    return problems


def adopt_labels(corrected: Path, folder: Path) -> None:
    """Apply the labels of a corrected table to a run.

    Only the column ``label`` is applied. A table from a report page also has a column
    ``label_seen`` with the labels that the page read; a label that was not changed on the page is
    not applied, since other corrections may be newer. If labels are replaced, the previous table is
    kept as tracks.previous.csv.

    Parameters
    ----------
    corrected : the run's own tracks.csv, which must list all tracks; or another table, in which
        missing tracks keep their labels.
    folder : the run folder.

    Raises
    ------
    OutputError : the table is unreadable, belongs to another run, or has invalid lines: an unknown
        track, a changed category, or an invalid label. The error message lists these lines, and
        nothing is written.
    """
    with holding(folder):
        _adopt(corrected, folder)


def _adopt(corrected: Path, folder: Path) -> None:
    current = folder / "tracks.csv"
    before, problems = _restored(current)
    result = before
    if not (corrected.exists() and corrected.samefile(current)):
        _refuse(current, problems)
        table = read_track_table(corrected)
        require_same_run(corrected, table, folder, own=False)
        changed = (row for row in table.rows if row.cells.get(LABEL_SEEN) != row.label)
        result, problems = (
            _relabelled(before, changed),
            [*table.problems, *_contradictions(table, before)],
        )
    known_categories = read_run(folder)["model"]["categories"]
    _, misread = resolve_labels(result.rows, known_categories, one_frame=_one_frame(folder))
    _refuse(corrected, problems + _lines(result.rows, misread))
    if any(a.label not in {"", b.label} for a, b in zip(before.rows, result.rows, strict=True)):
        with replacing(folder / PREVIOUS) as path:
            write_track_table(path, before)
    with replacing(current.resolve()) as path:  # it may be a symbolic link
        write_track_table(path, result)


def relabel(folder: Path, labels: Mapping[int, str]) -> dict[int, str]:
    """Set the labels of some tracks of a run; keep the other labels.

    Returns
    -------
    The reason for each rejected label, by track: it is invalid, or contradicts other labels.

    Raises
    ------
    OutputError : the run's table is unreadable or invalid, belongs to another run, or cannot be
        written.
    """
    current = folder / "tracks.csv"
    base, problems = _restored(current)
    categories, one_frame = read_run(folder)["model"]["categories"], _one_frame(folder)
    before = find_misread(base.rows, categories, one_frame=one_frame)
    _refuse(current, [*problems, *_lines(base.rows, before)])
    rows, refused = _valid_labels(base.rows, labels, categories, one_frame=one_frame)
    with replacing(current.resolve()) as path:
        write_track_table(path, replace(base, rows=rows))
    return refused


def correct_label(folder: Path, track: int, label: str, *, previous: str, work: str) -> str:
    """Set the label of a track of a run, unless the label has changed since the caller read it.

    Parameters
    ----------
    previous : the label that the caller read.
    work : the ``work`` id in the run.json that the caller read.

    Returns
    -------
    The reason why the label was rejected; empty if it was set.

    Raises
    ------
    OutputError : as for `relabel`, or the run has been replaced.
    """
    with holding(folder):
        require_work(folder, work)
        labels = read_track_table(folder / "tracks.csv").labels
        if track not in labels:
            return f"there is no track #{track}"
        if labels[track] != previous:
            return f"its label is now {labels[track]!r}"
        return relabel(folder, {track: label}).get(track, "")


def _valid_labels(
    rows: tuple[TrackRow, ...],
    labels: Mapping[int, str],
    categories: Iterable[str],
    *,
    one_frame: bool,
) -> tuple[tuple[TrackRow, ...], dict[int, str]]:
    """Return the rows with their new labels, and the reason for each rejected label, by track.

    If the labels are not valid together, they are set one by one, merges last.
    """
    labelled = _labelled(rows, labels)
    if not find_misread(labelled, categories, one_frame=one_frame):
        return labelled, {}
    refused = {}
    for track in sorted(labels, key=lambda track: merged_with(labels[track]) is not None):
        labelled = _labelled(rows, {track: labels[track]})
        if misread := find_misread(labelled, categories, one_frame=one_frame):
            refused[track] = misread.get(track) or next(iter(misread.values()))
        else:
            rows = labelled
    return rows, refused


def _labelled(rows: Iterable[TrackRow], labels: Mapping[int, str]) -> tuple[TrackRow, ...]:
    """Return the rows with the labels of ``labels``, by track; the others keep theirs."""
    return tuple(with_label(row, labels.get(row.track, row.label)) for row in rows)


def has_labels(path: Path) -> bool:
    """Return whether a table may have labels: it has some, or has invalid lines.

    A missing table has none.

    Raises
    ------
    OutputError : the table is unreadable.
    """
    if not path.exists():
        return False
    table = read_track_table(path)
    return bool(table.problems) or any(table.labels.values())


def _relabelled(base: TrackTable, rows: Iterable[TrackRow]) -> TrackTable:
    """Return ``base`` with the labels and line numbers of ``rows``; other tracks keep theirs."""
    edited = {row.track: row for row in rows}
    changed = [
        replace(with_label(row, edited[row.track].label), line=edited[row.track].line)
        if row.track in edited
        else row
        for row in base.rows
    ]
    return replace(base, rows=tuple(changed))


def _refuse(path: Path, problems: Sequence[str], effect: str = "nothing was written") -> None:
    """Raise an `OutputError` that lists ``problems``, if any; ``effect`` says what follows."""
    if problems:
        lines = sorted(problems, key=_line_of)
        if len(lines) > _MOST_PROBLEMS:
            lines[_MOST_PROBLEMS:] = [f"and {len(lines) - _MOST_PROBLEMS} more problems"]
        msg = "\n  ".join((f"{path}: {effect}:", *lines))
        raise OutputError(msg)


def _line_of(problem: str) -> int:
    """Return the number of the line that a problem names; 0 if it names none."""
    line = re.match(r"line (\d+)", problem)
    return int(line[1]) if line else 0


def _one_frame(folder: Path) -> bool:
    """Return whether a run has a fixed frame for all sensors; False without run.json."""
    return (folder / "run.json").exists() and read_run(folder)["fixed_frame"] is not None


def _lines(rows: Iterable[TrackRow], misread: Mapping[int, str]) -> list[str]:
    return [f"line {row.line}: {misread[row.track]}" for row in rows if row.track in misread]
