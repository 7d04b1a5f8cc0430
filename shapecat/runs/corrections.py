"""What a person says about the tracks of a run: tracks.csv with its column ``label`` filled in.

A label is a category, a new category, ``delete``, or ``merge with N``. The table may have passed
through a spreadsheet: separators, quotes, line ends, the order of columns and numbers such as
``1.0`` do not matter.
"""

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from shapecat.errors import OutputError
from shapecat.files import replacing
from shapecat.runs.folder import read_run
from shapecat.types import CATEGORIES

__all__ = [
    "TrackLabel",
    "TrackRow",
    "TrackTable",
    "adopt_labels",
    "read_labels",
    "read_track_table",
]

UNKNOWN = "unknown"
DELETE = "delete"
ORIGINAL = "tracks.original.csv"

_COLUMNS = ("track", "category", "confidence", "label")
_LARGEST_TABLE = 64 << 20
_MERGE = re.compile(r"merged? +(?:with|into) +#?(\d{1,9})(?:[.,]0*)?", re.IGNORECASE)
_NEW = re.compile(r"new +(.+)", re.IGNORECASE)
_NAME = re.compile(r"[^\W\d_][\w .+&'()-]{0,58}[\w)]|[^\W\d_]")


class TrackLabel(NamedTuple):
    """What a track is shown as.

    ``track`` is its own number, or that of the track it was merged with, whose category it has.
    """

    track: int
    category: str
    confidence: float


@dataclass(frozen=True)
class TrackRow:
    """A line of tracks.csv; ``cells`` are all its columns as written."""

    line: int
    track: int
    category: str
    confidence: float
    label: str
    topic: str
    cells: Mapping[str, str]


@dataclass(frozen=True)
class TrackTable:
    """The lines of a tracks.csv that could be read, and what is wrong with the others."""

    columns: tuple[str, ...]
    rows: tuple[TrackRow, ...]
    problems: tuple[str, ...]


def read_labels(path: Path, categories: Iterable[str] = ()) -> dict[int, TrackLabel]:
    """Read what each track is shown as; deleted tracks are missing.

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
    labels, problems = _resolve(table.rows, categories, one_frame=_one_frame(path.parent))
    _refuse(path, [*table.problems, *problems])
    return labels


def adopt_labels(corrected: Path, folder: Path) -> None:
    """Make the labels of a corrected table those of a run.

    Only the column ``label`` is taken over, and tracks that the table does not list keep their
    label. The first table is kept as tracks.original.csv. ``corrected`` may be the tracks.csv of
    the run itself.

    Raises
    ------
    OutputError : the table is unreadable, names tracks that the run does not have, or has labels
        that cannot be understood. All such lines are named, and nothing is written.
    """
    current, original = folder / "tracks.csv", folder / ORIGINAL
    in_place = current.exists() and corrected.exists() and corrected.samefile(current)
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
    _refuse(corrected, problems + misread)
    if not original.exists():
        with replacing(original) as path:
            if in_place:
                _write(path, replace(base, rows=tuple(_with_label(row, "") for row in base.rows)))
            else:
                path.write_bytes(current.read_bytes())
    with replacing(current) as path:
        _write(path, result)


def read_track_table(path: Path) -> TrackTable:
    """Read a tracks.csv, also one that a spreadsheet has saved.

    Raises
    ------
    OutputError : the file is not a table with the columns of tracks.csv.
    """
    lines = csv.reader(io.StringIO(_text(path), newline=""), delimiter=_separator(path))
    rows: dict[int, TrackRow] = {}
    problems: list[str] = []
    columns: tuple[str, ...] = ()
    try:
        for cells in lines:
            if not any(cell.strip() for cell in cells) or cells[0].lower().startswith("sep="):
                continue
            if not columns:
                columns = _header(path, cells)
                continue
            row = _row(lines.line_num, dict(zip(columns, cells, strict=False)))
            if isinstance(row, str):
                problems.append(row)
            elif row.track in rows:
                problems.append(f"line {row.line}: track {row.track} is listed twice")
            else:
                rows[row.track] = row
    except csv.Error as error:
        problems.append(f"line {lines.line_num}: {error}")
    if not columns:
        _header(path, [])
    return TrackTable(columns, tuple(rows.values()), tuple(problems))


def _text(path: Path) -> str:
    """Return the text of a table in whichever encoding a spreadsheet has saved it."""
    try:
        if path.stat().st_size > _LARGEST_TABLE:
            msg = f"{path}: larger than {_LARGEST_TABLE >> 20} MB, not a tracks.csv"
            raise OutputError(msg)
        content = path.read_bytes()
    except OSError as error:
        msg = f"{path}: cannot be read: {error.strerror or error}"
        raise OutputError(msg) from error
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            return content.decode(encoding)
        except UnicodeDecodeError:
            continue
    msg = f"{path}: not a text; save the table as CSV"
    raise OutputError(msg)


def _separator(path: Path) -> str:
    """Return the separator of the line that names the columns."""
    lines = (line for line in _text(path).splitlines() if "track" in line.lower())
    header = next(lines, "")
    return max(",;\t", key=header.count)


def _header(path: Path, cells: Sequence[str]) -> tuple[str, ...]:
    names = tuple(cell.strip().lower() for cell in cells)
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        msg = f"{path}: no column {', '.join(missing)}; expected a table like a run's tracks.csv"
        raise OutputError(msg)
    return names


def _row(line: int, cells: Mapping[str, str]) -> TrackRow | str:
    """Return a row, or what is wrong with it."""
    try:
        track = _number(cells["track"])
        confidence = _number(cells["confidence"])
        if track != int(track):
            raise ValueError  # noqa: TRY301  the same message for all that is not a number
    except (KeyError, ValueError, OverflowError):
        text = f"track {cells.get('track', '')!r}, confidence {cells.get('confidence', '')!r}"
        return f"line {line}: expected numbers, got {text}"
    return TrackRow(
        line=line,
        track=int(track),
        category=cells.get("category", "").strip(),
        confidence=confidence,
        label=" ".join(cells.get("label", "").split()),
        topic=cells.get("topic", "").strip(),
        cells=cells,
    )


def _number(text: str) -> float:
    return float(text.strip().replace(",", "."))


def _relabelled(base: TrackTable, rows: Iterable[TrackRow]) -> TrackTable:
    """Return a table with the labels of other rows, and the numbers of their lines."""
    given = {row.track: row for row in rows}
    changed = [
        replace(_with_label(row, given[row.track].label), line=given[row.track].line)
        if row.track in given
        else row
        for row in base.rows
    ]
    return replace(base, rows=tuple(changed))


def _with_label(row: TrackRow, label: str) -> TrackRow:
    return replace(row, label=label, cells={**row.cells, "label": label})


def _write(path: Path, table: TrackTable) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, table.columns, lineterminator="\n", restval="")
        writer.writeheader()
        writer.writerows(row.cells for row in table.rows)


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


def _resolve(
    rows: Sequence[TrackRow], categories: Iterable[str], *, one_frame: bool
) -> tuple[dict[int, TrackLabel], list[str]]:
    """Return what each track is shown as, and which lines cannot be understood."""
    known = {n.lower(): n for n in (UNKNOWN, *CATEGORIES, *categories, *(r.category for r in rows))}
    verdicts: dict[int, _Verdict] = {}
    problems = []
    for row in rows:
        try:
            verdicts[row.track] = _understand(row.label, known) if row.label else row.category
        except ValueError as error:
            problems.append(f"line {row.line}: {error}")
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
            problems.append(f"line {row.line}: {row.label!r}: {error}")
            continue
        category = verdicts[shown.track]
        if isinstance(category, str):
            confidence = 1.0 if shown.label else shown.confidence
            labels[row.track] = TrackLabel(shown.track, category, confidence)
    return labels, problems


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
    """Tell what a label means; a new category becomes known.

    Raises
    ------
    ValueError : it means nothing, or is nearly something known.
    """
    if label.lower() in known:
        return known[label.lower()]
    if label.lower() == DELETE:
        return None
    if merge := _MERGE.fullmatch(label):
        return int(merge[1])
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
