"""tracks.csv: one line per track, to read and correct, for example in a spreadsheet.

The table can be read as any spreadsheet saves it: with commas, semicolons or tabs, quotes, any line
ends and order of columns, and numbers such as ``1.0``. If all labels are ASCII, it need not be
Unicode.
"""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from shapecat.errors import OutputError, explained

__all__ = [
    "LABEL_SEEN",
    "ORIGINAL",
    "TrackRow",
    "TrackTable",
    "parse_number",
    "read_track_table",
    "with_label",
    "write_csv",
    "write_track_table",
]

ORIGINAL = "tracks.original.csv"
"""The table as the run wrote it. A person may edit its copy, tracks.csv."""
LABEL_SEEN = "label_seen"
"""A column that a report page adds to its table: the labels that the page read. Only these may be
replaced."""
_COLUMNS = ("track", "category", "label")
"""The columns that a table needs. ``category`` helps to detect tables of other runs."""
_LARGEST_TABLE = 64 << 20
"""Maximum size of a table, bytes."""


@dataclass(frozen=True)
class TrackRow:
    """A line of tracks.csv; ``line`` is its number in the file, from 1.

    ``confidence`` is NaN if its cell holds no number from 0 to 1. ``topic`` holds several names,
    joined by spaces, if the track is in several topics. ``cells`` holds all columns as text.
    """

    line: int
    track: int
    category: str
    confidence: float
    label: str
    topic: str
    cells: Mapping[str, str]


@dataclass(frozen=True)
class TrackTable:
    """The rows of a tracks.csv, and the problems of its invalid or perhaps misread lines."""

    columns: tuple[str, ...]
    rows: tuple[TrackRow, ...]
    problems: tuple[str, ...]

    @property
    def labels(self) -> dict[int, str]:
        """The label of each track, by number; empty if it has none."""
        return {row.track: row.label for row in self.rows}

    @property
    def wrong_numbers(self) -> tuple[str, ...]:
        """Problems of lines with a wrong confidence: a spreadsheet may turn 0.495 into 495."""
        wrong = (row for row in self.rows if math.isnan(row.confidence))
        return tuple(_wrong_numbers(row.line, row.cells) for row in wrong)

    @property
    def run(self) -> str:
        """The ``work`` id of the run that wrote the table; empty if unknown."""
        return next(iter(self.runs), "")

    @property
    def runs(self) -> tuple[str, ...]:
        """All ``work`` ids in the table: more than one if tables were mixed."""
        ids = (row.cells.get("run", "").strip() for row in self.rows)
        return tuple(dict.fromkeys(filter(None, ids)))


def read_track_table(path: Path) -> TrackTable:
    """Read a tracks.csv, even if a spreadsheet has saved it.

    Raises
    ------
    OutputError : the file is unreadable, or lacks columns of tracks.csv.
    """
    text, unicode = _text(path)
    lines = csv.reader(io.StringIO(text, newline=""), delimiter=_separator(text))
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
                continue
            if not (unicode or row.label.isascii()):
                problems.append(
                    f"line {row.line}: the label {row.label!r} may be misread; save the table as "
                    "CSV UTF-8"
                )
            if rows.setdefault(row.track, row) is not row:
                problems.append(f"line {row.line}: track #{row.track} is listed twice")
    except csv.Error as error:
        problems.append(f"line {lines.line_num}: {error}")
    if not columns:
        _header(path, [])
    return TrackTable(columns, tuple(rows.values()), tuple(problems))


def _text(path: Path) -> tuple[str, bool]:
    """Return the text of a table, and whether it is Unicode; if not, only ASCII is certain.

    Raises
    ------
    OutputError : the file is unreadable, too large or not text.
    """
    with explained(f"{path}: cannot be read", OutputError):
        if path.stat().st_size > _LARGEST_TABLE:
            msg = f"{path}: larger than {_LARGEST_TABLE >> 20} MB, too large for a tracks.csv"
            raise OutputError(msg)
        content = path.read_bytes()
    wide = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    for encoding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            return content.decode(encoding), encoding != "cp1252"
        except UnicodeDecodeError:
            continue
    msg = f"{path}: not a text file; save the table as CSV"
    raise OutputError(msg)


def _separator(text: str) -> str:
    """Return the separator in the header line: a comma, a semicolon or a tab."""
    lines = (line for line in text.splitlines() if "track" in line.lower())
    header = next(lines, "")
    return max(",;\t", key=header.count)


def _header(path: Path, cells: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the columns; repeated names, even empty ones, get a number.

    Raises
    ------
    OutputError : a column that a tracks.csv needs is missing, or is there twice.
    """
    header = [cell.strip().lower() for cell in cells]
    if twice := [name for name in _COLUMNS if header.count(name) > 1]:
        msg = f"{path}: several columns {', '.join(twice)}; keep one, or rename the others"
        raise OutputError(msg)
    names = tuple(
        n if n not in header[:k] else f"{n} {k + 1}".strip() for k, n in enumerate(header)
    )
    missing = [name for name in _COLUMNS if name not in names]
    if missing:
        msg = f"{path}: no column {', '.join(missing)}; expected a table like a run's tracks.csv"
        raise OutputError(msg)
    return names


def _row(line: int, cells: Mapping[str, str]) -> TrackRow | str:
    """Return the row in a line, or the problem of an invalid line."""
    track, confidence = (_number(cells.get(name, "")) for name in ("track", "confidence"))
    if not track.is_integer():
        return _wrong_numbers(line, cells)
    return TrackRow(
        line=line,
        track=int(track),
        category=cells.get("category", "").strip(),
        confidence=confidence if 0 <= confidence <= 1 else math.nan,
        label=" ".join(cells.get("label", "").split()),
        topic=cells.get("topic", "").strip(),
        cells=cells,
    )


def _wrong_numbers(line: int, cells: Mapping[str, str]) -> str:
    """Return the problem of a line with an invalid track number or confidence.

    ``cells`` holds the cells of the line by column.
    """
    text = f"track {cells.get('track', '')!r}, confidence {cells.get('confidence', '')!r}"
    return f"line {line}: expected a track number and a confidence from 0 to 1, got {text}"


def _number(cell: str) -> float:
    """Return the number in a cell; NaN if it holds none."""
    with suppress(ValueError):
        return parse_number(cell)
    return math.nan


def parse_number(cell: str) -> float:
    """Return the number in a cell of a spreadsheet, which may have a decimal comma.

    Raises
    ------
    ValueError : the cell holds no number.
    """
    return float(cell.strip().replace(",", "."))


def with_label(row: TrackRow, label: str) -> TrackRow:
    """Return a copy of a row with another label."""
    return replace(row, label=label, cells={**row.cells, "label": label})


def write_track_table(path: Path, table: TrackTable) -> None:
    """Write a table, with all its columns."""
    lines = ([row.cells.get(name, "") for name in table.columns] for row in table.rows)
    write_csv(path, [table.columns, *lines])


def write_csv(path: Path, lines: Iterable[Iterable[str]]) -> None:
    """Write lines of cells as CSV, with a byte order mark unless they are ASCII.

    Without the mark, Excel would read and save other letters in the wrong encoding.
    """
    file = io.StringIO(newline="")
    csv.writer(file, lineterminator="\n").writerows(lines)
    text = file.getvalue()
    path.write_bytes(text.encode("utf-8" if text.isascii() else "utf-8-sig"))
