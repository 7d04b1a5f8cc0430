"""Corrections of a run: the column ``label`` of tracks.csv.

A label is a category, a new category, ``delete``, or ``merge with N``. The table may have passed
through a spreadsheet: separators, quotes, line ends, the order of columns and numbers such as
``1.0`` do not matter.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from shapecat.errors import OutputError
from shapecat.runs.folder import read_run
from shapecat.runs.track_table import (
    TrackRow,
    TrackTable,
    read_track_table,
    unlabelled,
    with_label,
    write_track_table,
)
from shapecat.system.files import holding, replacing
from shapecat.types import CATEGORIES, UNKNOWN

__all__ = [
    "PREVIOUS",
    "TrackLabel",
    "adopt_labels",
    "correct_label",
    "find_misread",
    "has_labels",
    "merged_with",
    "merging_with",
    "read_labels",
    "relabel",
]

DELETE = "delete"
ORIGINAL = "tracks.original.csv"
PREVIOUS = "tracks.previous.csv"

_MERGE = re.compile(r"merged? +(?:with|into) +#?(\d{1,9})(?:[.,]0*)?", re.IGNORECASE)
_NEW = re.compile(r"new +(.+)", re.IGNORECASE)
_NAME = re.compile(r"[^\W\d_][\w .+&'()-]{0,58}[\w)]|[^\W\d_]")


class TrackLabel(NamedTuple):
    """The number, category and confidence that a track is shown with.

    ``track`` is its own number, or that of the track it was merged with, whose category it has.
    """

    track: int
    category: str
    confidence: float


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
    labels, misread = _resolve(table.rows, categories, one_frame=_one_frame(path.parent))
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
    _, misread = _resolve(result.rows, known_categories, one_frame=_one_frame(folder))
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


def merged_with(label: str) -> int | None:
    """Return the number of the track that a label merges with; None for any other label.

    Examples
    --------
    >>> merged_with("merge with 7"), merged_with("cup")
    (7, None)
    """
    merge = _MERGE.fullmatch(label)
    return int(merge[1]) if merge else None


def merging_with(track: int) -> str:
    """Return the label that merges with a track.

    Examples
    --------
    >>> merging_with(7)
    'merge with 7'
    """
    return f"merge with {track}"


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


_Verdict = str | int | None
"""A category, the number of the track to merge with, or None to delete."""


def _one_frame(folder: Path) -> bool:
    """Return whether the sensors of a run have places in one frame."""
    return (folder / "run.json").exists() and read_run(folder).get("fixed_frame") is not None


def find_misread(
    rows: Sequence[TrackRow], categories: Iterable[str] = (), *, one_frame: bool = True
) -> dict[int, str]:
    """Return by track why its label cannot be understood, or contradicts others."""
    return _resolve(rows, categories, one_frame=one_frame)[1]


def _lines(rows: Iterable[TrackRow], misread: Mapping[int, str]) -> list[str]:
    return [f"line {row.line}: {misread[row.track]}" for row in rows if row.track in misread]


def _resolve(
    rows: Sequence[TrackRow], categories: Iterable[str], *, one_frame: bool
) -> tuple[dict[int, TrackLabel], dict[int, str]]:
    """Return the final label of each track, and the problem of each label that makes no sense."""
    known = {n.lower(): n for n in (UNKNOWN, *CATEGORIES, *categories, *(r.category for r in rows))}
    verdicts: dict[int, _Verdict] = {}
    misread = {}
    for row in rows:
        try:
            verdicts[row.track] = _understand(row.label, known) if row.label else row.category
        except ValueError as error:
            misread[row.track] = str(error)
            verdicts[row.track] = row.category
    by_track = {row.track: row for row in rows}
    labels = {}
    for row in rows:
        try:
            shown = by_track[_follow(row.track, verdicts)]
            if not (one_frame or _share_a_topic(shown, row)):
                msg = f"track {shown.track} is of another topic, {shown.topic or 'none'}"
                raise ValueError(msg)  # noqa: TRY301  collected with those of the calls
        except ValueError as error:
            misread[row.track] = f"{row.label!r}: {error}"
            continue
        category = verdicts[shown.track]
        if isinstance(category, str):
            confidence = 1.0 if shown.label else shown.confidence
            labels[row.track] = TrackLabel(shown.track, category, confidence)
    return labels, misread


def _share_a_topic(a: TrackRow, b: TrackRow) -> bool:
    return a.topic == b.topic or bool(set(a.topic.split()) & set(b.topic.split()))


def _follow(track: int, verdicts: Mapping[int, _Verdict]) -> int:
    """Return the track that a track ends in after all merges."""
    seen = [track]
    while isinstance(target := verdicts[seen[-1]], int):
        if target not in verdicts:
            msg = f"there is no track {target}"
            raise ValueError(msg)
        if target in seen:
            msg = f"leads in a circle: {' -> '.join(map(str, [*seen, target]))}"
            raise ValueError(msg)
        seen.append(target)
        if verdicts[target] is None:
            msg = f"track {target} is deleted"
            raise ValueError(msg)
    return seen[-1]


def _understand(label: str, known: dict[str, str]) -> _Verdict:
    """Interpret a label; a new category becomes known.

    Raises
    ------
    ValueError : it means nothing, or is nearly something known.
    """
    if label.lower() in known:
        return known[label.lower()]
    if label.lower() == DELETE:
        return None
    merge = merged_with(label)
    if merge is not None:
        return merge
    new = _NEW.fullmatch(label)
    name = new[1] if new else label
    if re.match(r"merged? ", label, re.IGNORECASE) or not _NAME.fullmatch(name):
        msg = f"{label!r} is not a category, `{DELETE}` or `merge with N`"
        raise ValueError(msg)
    near = _nearest(name.lower(), [*known, DELETE])
    if near and not new:
        meant = known.get(near, near)
        msg = f"{label!r}: did you mean {meant}? For a category of its own write `new {name}`"
        raise ValueError(msg)
    return known.setdefault(name.lower(), name)


def _nearest(name: str, known: Sequence[str]) -> str | None:
    """Return the known name that differs by a slip: one of a short name, two of a longer one."""
    distances = [(_slips(name, other), other) for other in known]
    slips, other = min(distances)
    return other if slips <= (1 if min(len(name), len(other)) < 5 else 2) else None


def _slips(a: str, b: str) -> int:
    """Count letters to add, drop, change or swap with their neighbour (Damerau 1964)."""
    before, last = list[int](), list(range(len(b) + 1))
    for i, x in enumerate(a, start=1):
        row = [i]
        for j, y in enumerate(b, start=1):
            row.append(min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (x != y)))
            if i > 1 and j > 1 and x == b[j - 2] and a[i - 2] == y:
                row[j] = min(row[j], before[j - 2] + 1)
        before, last = last, row
    return last[-1]
