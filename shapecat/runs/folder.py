"""Build the folder of a run under a hidden name, and rename it when it is complete.

A marker shows that shapecat made a folder: run.json with the run's id, or the record of an export.
A folder without a marker is neither removed nor replaced. Other files in a run folder are kept.
"""

import json
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Literal

from shapecat.errors import OutputError, ShapecatError, explained
from shapecat.runs.run_info import RunIdentity, RunInfo, parse_identity, parse_run
from shapecat.system.files import BusyError, flush, holding, partial_path, replacing, require_utf8

__all__ = [
    "OUTPUTS",
    "OUTPUT_OPTIONS",
    "RUN_FILES",
    "Marker",
    "clear",
    "made_by_run",
    "outputs_pending",
    "previous_path",
    "read_identity",
    "read_run",
    "recover",
    "require_ours",
    "require_work",
    "staged",
    "sweep",
    "write_run",
    "writing_outputs",
]

OUTPUT_OPTIONS: Mapping[Literal["mcap", "rrd"], str] = {
    "mcap": "annotated.mcap",
    "rrd": "review.rrd",
}
"""The file of each option that asks for an output. The tables do not depend on these options."""
OUTPUTS = tuple(OUTPUT_OPTIONS.values())
RUN_FILES = (
    *(f"{name}.parquet" for name in ("frames", "detections", "planes", "tracks", "masks")),
    *("tracks.csv", "tracks.original.csv", "tracks.previous.csv", "report.html"),
    *OUTPUTS,
    "run.json",
)
"""The files that commands write to a run folder; run.json is last."""
_MADE = (
    "segments",
    "revisions",
    *(partial_path(Path(name)).name for name in RUN_FILES),
    *RUN_FILES,
)
"""The items that a run makes in its folder; the marker is last."""

_OUTPUTS_LOCK = "tracks.parquet"
"""A file that a process locks while it writes outputs. No command replaces it in a finished run.
The lock of the folder itself is for labels, which need not wait for outputs."""

_BEGUN = (".run.json.partial", ".export.json.partial")
"""Files that a killed command may leave in a folder without a marker."""

Marker = Callable[[Path], Collection[str] | None]
"""A function that returns the names of the items that shapecat makes in a folder, the marker last;
None if the folder has no marker."""


def made_by_run(folder: Path) -> Collection[str] | None:
    """Return the names of the items that a run makes in its folder; None if it holds no run."""
    with suppress(OutputError):
        if read_identity(folder)["id"]:
            return _MADE
    return None


def require_work(folder: Path, work: str) -> None:
    """Check that the run in a folder still has the id ``work``, and so the same tracks.

    Raises
    ------
    OutputError : the run has another id, or there is none.
    """
    if read_run(folder)["work"] != work:
        msg = f"{folder}: was processed again meanwhile; open it, or make its report, again"
        raise OutputError(msg)


@contextmanager
def staged(
    folder: Path,
    marker: Marker = made_by_run,
    *,
    worth_keeping: Callable[[Path], bool] = lambda _: False,
    finish: Callable[[], None] = lambda: None,
) -> Iterator[Path]:
    """Provide a hidden folder; rename it to ``folder`` when the block succeeds.

    An earlier ``folder`` is moved away first and removed afterwards. After a signal or a kill, the
    hidden folder is kept, so that the same command can resume. After an error, it is kept if
    ``worth_keeping`` returns True for it. ``marker`` recognises folders that shapecat made.
    ``finish`` is called before an earlier ``folder`` is moved away, when no other command can
    change its labels or outputs any more.

    Raises
    ------
    OutputError : the folder cannot be written, was not made by shapecat, or another process is
        writing to it.
    """
    hidden = partial_path(folder)
    with explained(f"{folder}: cannot be written", OutputError):  # its name may be too long
        for place in (folder, hidden):
            require_ours(place, marker)
    created = [parent for parent in folder.parents if not parent.exists()]
    try:
        hidden.mkdir(parents=True, exist_ok=True)
        with holding(hidden, wait=False):
            yield hidden
            _replace(folder, hidden, marker, finish)
    except BusyError as error:
        msg = f"{folder}: another process is writing to this folder"
        raise OutputError(msg) from error
    except Exception as error:
        resumable = worth_keeping(hidden)
        if not resumable:
            _discard(hidden, created)
        if not isinstance(error, OSError | OutputError):
            raise
        reason = f"{folder}: cannot write the results: {getattr(error, 'strerror', '') or error}"
        text = str(error) if isinstance(error, OutputError) else reason
        more = "; finished work is kept, and the same command resumes it" if resumable else ""
        raise OutputError(text + more) from error


def require_ours(folder: Path, marker: Marker = made_by_run) -> None:
    """Check that a folder is missing, empty, or made by shapecat according to ``marker``.

    Raises
    ------
    OutputError : shapecat did not make the folder.
    """
    if folder.is_dir() and not folder.is_symlink():
        begun = not any(_strangers(folder, _BEGUN))
        if begun or marker(folder) is not None:
            return
    elif not os.path.lexists(folder):  # a link may lead to a disk that is not mounted
        return
    is_unusable = (folder / "run.json").is_file() and made_by_run(folder) is None
    doubt = ", or its run.json is damaged or from another version" if is_unusable else ""
    msg = f"{folder}: shapecat did not make this{doubt}; choose another --out, or move it away"
    raise OutputError(msg)


def _strangers(folder: Path, names: Collection[str]) -> Iterator[Path]:
    """Yield the items of a folder that are not in ``names``."""
    return (item for item in folder.iterdir() if item.name not in names)


def _replace(folder: Path, hidden: Path, marker: Marker, finish: Callable[[], None]) -> None:
    """Replace ``folder`` by ``hidden``; a complete folder always exists, if need be a hidden one.

    First wait for a command that writes outputs in the old folder: it would go on writing in the
    new one.
    """
    flush(hidden)
    if folder.exists():
        require_ours(folder, marker)
        outputs = folder / _OUTPUTS_LOCK
        with holding(outputs) if outputs.exists() else nullcontext(), holding(folder):
            finish()
            folder.rename(previous_path(folder))
    hidden.rename(folder)
    flush(folder.parent)
    _retire(folder, marker)


def previous_path(folder: Path) -> Path:
    """Return the hidden path to which a folder is moved while a new one replaces it."""
    return folder.with_name(f".{folder.name}.old")


def _retire(folder: Path, marker: Marker) -> None:
    """Remove our files from the replaced folder; move other files to the new one."""
    previous = previous_path(folder)
    if not previous.is_dir():
        return
    names = marker(previous) or ()
    for item in _strangers(previous, names):
        if names and not (folder / item.name).exists():
            item.rename(folder / item.name)
    clear(previous, names)
    with suppress(OSError):  # not empty
        previous.rmdir()


def recover(folder: Path, marker: Marker = made_by_run) -> None:
    """Complete or undo the replacement of a folder that a killed run began.

    The earlier folder is restored if there is no new one, else removed. ``marker`` recognises
    folders that shapecat made; see `Marker`.

    Raises
    ------
    OutputError : the folder cannot be written.
    """
    hidden, previous = partial_path(folder), previous_path(folder)
    with explained(f"{folder}: cannot be written", OutputError):
        if not previous.is_dir():
            return
        with (
            suppress(BusyError),  # the other run does it
            holding(hidden if hidden.is_dir() else previous, wait=False),
        ):
            if not folder.exists() and marker(previous) is not None:
                previous.rename(folder)
            elif folder.exists() and marker(folder) is not None:
                _retire(folder, marker)


def clear(folder: Path, names: Collection[str] = _MADE) -> None:
    """Remove the items ``names`` from a folder, in this order; by default all that a run makes."""
    for item in (folder / name for name in names):
        if item.is_dir() and not item.is_symlink():
            shutil.rmtree(item)
        else:
            item.unlink(missing_ok=True)


def sweep(folder: Path) -> None:
    """Remove incomplete files that a killed command left in a complete folder."""
    with suppress(OSError):
        clear(folder, [partial_path(Path(name)).name for name in RUN_FILES])


@contextmanager
def writing_outputs(folder: Path) -> Iterator[None]:
    """Lock the outputs of a finished run during the block, against other processes.

    Raises
    ------
    OutputError : another process is writing them, or the folder is not a finished run.
    """
    try:
        with holding(folder / _OUTPUTS_LOCK, wait=False):
            yield
    except BusyError as error:
        msg = f"{folder}: another command is writing its outputs; wait for it and run this again"
        raise OutputError(msg) from error


@contextmanager
def outputs_pending(folder: Path) -> Iterator[None]:
    """Mark the outputs of a finished run as missing while the block changes its labels.

    After the block, the caller writes the outputs; after a kill, processing the recording again
    writes them. If the block raises a `ShapecatError`, it has changed nothing, and the outputs
    count as written again.
    """
    run = read_run(folder)
    kept = {phase: s for phase, s in run["seconds"].items() if phase not in OUTPUTS}
    write_run(folder, {**run, "seconds": kept})
    try:
        yield
    except ShapecatError:
        write_run(folder, run)
        raise


def _discard(hidden: Path, created: list[Path]) -> None:
    """Remove a hidden folder, and the parent folders ``created`` for it if they are empty."""
    shutil.rmtree(hidden, ignore_errors=True)
    for parent in created:
        with suppress(OSError):  # not empty: something was written there
            parent.rmdir()


def write_run(folder: Path, run: RunInfo) -> None:
    """Write run.json.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    with replacing(folder / "run.json") as path:
        path.write_text(json.dumps(run, indent=1) + "\n", "utf-8")


def read_run(folder: Path) -> RunInfo:
    """Read run.json.

    Raises
    ------
    OutputError : the folder has no run.json, or one with missing or wrong entries, or its path is
        not valid UTF-8.
    """
    require_utf8(folder)
    return parse_run(_content_of(folder), str(folder))


def read_identity(folder: Path) -> RunIdentity:
    """Read the entries of run.json that every version writes.

    Raises
    ------
    OutputError : as for `read_run`, for these entries.
    """
    return parse_identity(_content_of(folder), str(folder))


def _content_of(folder: Path) -> bytes:
    with explained(f"{folder}/run.json: cannot be read", OutputError):
        try:
            return (folder / "run.json").read_bytes()
        except (FileNotFoundError, NotADirectoryError) as error:
            runs = (path.parent for path in folder.glob("[!.]*/run.json"))
            example = f", such as {run}" if (run := min(runs, default=None)) else ""
            if folder.name and partial_path(folder).exists():
                example = "; this one is unfinished: repeat the command that makes it"
            expected = "expected a folder made by `shapecat process`"
            msg = f"{folder}: no run.json there; {expected}{example}"
            raise OutputError(msg) from error
