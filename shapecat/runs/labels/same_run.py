"""Check that a table of tracks belongs to a run, since each run numbers its tracks differently."""

from contextlib import suppress
from pathlib import Path

from shapecat.errors import OutputError
from shapecat.runs.folder import read_run
from shapecat.runs.labels.track_table import TrackTable, parse_number, read_track_table

__all__ = ["require_same_run"]


def require_same_run(path: Path, table: TrackTable, folder: Path, *, own: bool = True) -> None:
    """Check that a table belongs to the run in ``folder``; without run.json there, accept any.

    Parameters
    ----------
    own : whether the table is in the folder itself, so that it needs no column ``run``. A table
        from elsewhere without this column must have its tracks at the same positions as the run.

    Raises
    ------
    OutputError : the table belongs to another run or to several, or has other positions.
    """
    work_id = read_run(folder)["work"] if (folder / "run.json").exists() else ""
    if not work_id or set(table.runs) == {work_id}:
        return
    if not table.runs and (own or _positions_agree(table, folder)):
        return
    if len(table.runs) > 1:
        description = f"holds tracks of several runs ({', '.join(table.runs)})"
    elif table.runs:
        description = f"holds the tracks of {_described(path.parent, table.run)}"
    else:
        description = "has tracks at other positions (and no column `run`)"
    msg = (
        f"{path}: {description}, not those of {_described(folder, work_id)}; to match objects by "
        "place, use --by-place"
    )
    raise OutputError(msg)


def _positions_agree(table: TrackTable, folder: Path) -> bool:
    """Return whether the tracks of a table have no positions, or the same as in the run."""
    original = {row.track: row for row in read_track_table(folder / "tracks.csv").rows}
    return all(
        _number(row.cells.get(axis)) in {None, _number(original[row.track].cells.get(axis))}
        for row in table.rows
        if row.track in original
        for axis in "xyz"
    )


def _number(cell: str | None) -> float | None:
    """Return the number in a cell; None if it is not a number."""
    with suppress(ValueError):
        return parse_number(cell or "")
    return None


def _described(folder: Path, work: str) -> str:
    """Describe the run with the work id ``work``.

    If it is the run in ``folder``, also name the folder and the recording.
    """
    with suppress(OutputError, KeyError):
        run = read_run(folder)
        if run["work"] == work:
            return f"run {work} ({folder}, of {run['input']['path']})"
    return f"run {work}"
