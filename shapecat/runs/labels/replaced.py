"""Keep the labels of a run when a new run replaces it."""

from pathlib import Path

import xxhash

from shapecat.errors import OutputError
from shapecat.runs.folder import OUTPUTS, read_identity, write_run
from shapecat.runs.jobs import Job
from shapecat.runs.labels.corrections import LOST, PREVIOUS, has_labels
from shapecat.runs.labels.track_table import ORIGINAL
from shapecat.runs.labels.transfer import lost_labels, transfer_labels
from shapecat.runs.run_info import RunInfo
from shapecat.runs.tables.reading import PROCESS_AGAIN
from shapecat.system.files import replacing

__all__ = ["forget_old_labels", "keep_labels", "keep_last_labels", "require_labels"]

_OTHER = f"the recording is another one; `annotate --by-place --labels {PREVIOUS}` transfers labels"


def require_labels(job: Job) -> None:
    """Check, before hours of work, that the labels of the results to be replaced are readable.

    Raises
    ------
    OutputError : their table is unreadable.
    """
    _labelled_table(job)


def keep_labels(folder: Path, run: RunInfo, job: Job) -> None:
    """Transfer the corrected labels of the replaced results to the new ones.

    Labels of another recording are not transferred, since other objects may be at the same places.

    The replaced table is kept as tracks.previous.csv. If some labels cannot be transferred, a copy
    with a unique name is put in the replaced folder, since later results keep such files.

    Parameters
    ----------
    folder : hidden folder of the new run.
    run : run.json of the new run; its entry ``corrections`` is set.

    Raises
    ------
    OutputError : the table of the replaced results is unreadable, or a file cannot be written.
    """
    table = _labelled_table(job)
    if not table:
        return
    with replacing(folder / PREVIOUS) as path:
        path.write_bytes(table)
    try:
        other = read_identity(job.folder)["input"]["digest"] != run["input"]["digest"]
        transfer = lost_labels(job.folder, _OTHER) if other else transfer_labels(job.folder, folder)
    except OutputError as error:
        reason = str(error).partition(f"; {PROCESS_AGAIN}")[0]  # which has just been done
        transfer = lost_labels(job.folder, reason)
    if transfer.missed:
        copy = LOST.replace("*", xxhash.xxh3_64_hexdigest(table)[:8])
        with replacing(job.folder / copy) as path:
            path.write_bytes(table)
    run["corrections"] = transfer.as_dict()


def forget_old_labels(folder: Path, run: RunInfo, job: Job) -> None:
    """Undo `keep_labels` if the replaced results have been given other labels since.

    ``run`` then lists the phases of labels and outputs as not done, so that they are repeated.

    Raises
    ------
    OutputError : as for `keep_labels`.
    """
    previous = folder / PREVIOUS
    previous_table = previous.read_bytes() if previous.exists() else b""
    if "labels" not in run["seconds"] or previous_table == _labelled_table(job):
        return
    with replacing(folder / "tracks.csv") as path:
        path.write_bytes((folder / ORIGINAL).read_bytes())
    run.pop("corrections", None)
    for phase in ("labels", *OUTPUTS):
        run["seconds"].pop(phase, None)
    write_run(folder, run)
    previous.unlink(missing_ok=True)


def keep_last_labels(folder: Path, run: RunInfo, job: Job) -> None:
    """Transfer labels that the replaced results have been given since `keep_labels`, if any.

    The outputs do not show them yet, as with labels from a report page.

    Raises
    ------
    OutputError : as for `keep_labels`.
    """
    seconds = run["seconds"].get("labels", 0.0)
    forget_old_labels(folder, run, job)
    if "labels" not in run["seconds"]:
        keep_labels(folder, run, job)
        run["seconds"]["labels"] = seconds
        write_run(folder, run)


def _labelled_table(job: Job) -> bytes:
    """Return the tracks.csv of the results to be replaced; empty if it has no labels to keep."""
    table = job.folder / "tracks.csv"
    return b"" if job.discard_labels or not has_labels(table) else table.read_bytes()
