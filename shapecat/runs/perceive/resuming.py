"""Continue earlier work: an interrupted run, or a finished one whose frames need not change."""

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from shapecat.errors import OutputError
from shapecat.runs.folder import OUTPUT_OPTIONS, clear, read_run, write_run
from shapecat.runs.identity import same_content, unchanged
from shapecat.runs.jobs import Job, describe_differences, differences
from shapecat.runs.run_info import RunInfo
from shapecat.runs.tables.reading import count_rows
from shapecat.runs.tables.schemas import PERCEIVED, TABLES
from shapecat.runs.tables.segments import SEGMENTS, list_segments, require_complete
from shapecat.system.files import partial_path

__all__ = ["has_work", "require_resumable", "resume", "take_over_frames"]

_LATER = ("tracking.", "outputs.")
"""Prefixes of settings that do not affect the perceived frames."""


def require_resumable(job: Job, planned: RunInfo, digest: Callable[[], str]) -> None:
    """Refuse a job that would discard an interrupted run of other input, model or settings.

    Runs of other versions, or of a recording that has changed since, may be discarded; so may any
    run if the job is to overwrite results.

    Parameters
    ----------
    planned, digest : as in `resume`.

    Raises
    ------
    OutputError : the folder has frames of another input, model or settings.
    """
    folder = partial_path(job.folder)
    if job.overwrite or not has_work(folder):
        return
    try:
        run = read_run(folder)
    except OutputError:  # nothing can continue it
        return
    differing, place = _perception_differences(run, planned), run["input"]["path"]
    if place != planned["input"]["path"] and not same_content(run["input"], job.source, digest):
        differing["input"] = f"{place} in the old run"
    if not differing:
        return
    msg = (
        f"{folder}: has finished work of an interrupted run of {describe_differences(differing)}; "
        "repeat its command to continue it, choose another --out, or --overwrite it"
    )
    raise OutputError(msg)


def resume(folder: Path, planned: RunInfo, source: Path, digest: Callable[[], str]) -> RunInfo:
    """Continue the interrupted run in a folder, or clear the folder to begin anew.

    The run is continued if its files are complete, and its settings, options (except the requested
    outputs), model, versions and recording are those of ``planned``. If only settings of tracking
    or of outputs differ, just its frames are kept.

    Parameters
    ----------
    planned : run.json of the planned run.
    source : path of the recording.
    digest : returns the digest of the recording; called only if names, sizes or times of its files
        differ.

    Returns
    -------
    The run.json of the continued run; or ``planned``, which is then written to the folder.

    Raises
    ------
    OutputError : the folder cannot be written.
    """
    with suppress(OutputError):
        run = read_run(folder)
        if not _perception_differences(run, planned) and _same_recording_and_versions(
            run, planned, source, digest
        ):
            _require_complete(folder)
            if _result_differences(run, planned):
                run = _with_perceived(planned, run)
                write_run(folder, run)
            elif "perceive" in run["seconds"]:
                run["counts"]["resumed"] = run["counts"]["frames"]
            return {**run, "input": planned["input"], "options": planned["options"]}
    clear(folder)
    write_run(folder, planned)
    return planned


def take_over_frames(
    finished: Path, folder: Path, planned: RunInfo, source: Path, digest: Callable[[], str]
) -> RunInfo:
    """Take over the perceived frames of a finished run that differs only in later phases.

    Its tables are linked or copied only if nothing but settings of tracking or outputs differs. If
    none of these settings differs, ``planned`` is returned: the user wants everything computed
    again.

    Parameters
    ----------
    finished : the folder of the finished run, which need not exist.
    folder : the folder of the new run, whose run.json has the content ``planned``.
    source, digest : as for `resume`.

    Returns
    -------
    The content of the new run.json; ``planned`` if the frames must be perceived.

    Raises
    ------
    OutputError : the folder cannot be written.
    """
    try:
        run = read_run(finished)
        later = bool(_result_differences(run, planned)) and not _perception_differences(
            run, planned
        )
        alike = later and _same_recording_and_versions(run, planned, source, digest)
        if not (alike and _is_complete(finished, run)):
            return planned
    except OutputError:
        return planned
    for table in PERCEIVED:
        _link(finished / f"{table}.parquet", folder)
    new = _with_perceived(planned, run)
    write_run(folder, new)
    return new


def has_work(folder: Path) -> bool:
    """Return whether the folder of an interrupted run holds perceived frames."""
    with suppress(OutputError):
        return bool(list_segments(folder / SEGMENTS)) or "perceive" in read_run(folder)["seconds"]
    return False


def _perception_differences(run: RunInfo, planned: RunInfo) -> dict[str, str]:
    """Return the `differences` of two runs that affect the perceived frames."""
    found = _result_differences(run, planned).items()
    return {name: text for name, text in found if not name.startswith(_LATER)}


def _result_differences(run: RunInfo, planned: RunInfo) -> dict[str, str]:
    """Return the `differences` of two runs, apart from those in the requested outputs."""
    found = differences(run, planned).items()
    return {name: text for name, text in found if name not in OUTPUT_OPTIONS}


def _with_perceived(planned: RunInfo, run: RunInfo) -> RunInfo:
    """Return ``planned`` with the entries of ``run`` that *perceive* and *revise* set."""
    new, counts, seconds = planned.copy(), run["counts"].copy(), run["seconds"]
    counts.pop("tracks", None)
    if "perceive" in seconds:
        counts["resumed"] = counts["frames"]
    new["counts"] = counts
    new["seconds"] = {name: seconds[name] for name in ("perceive", "revise") if name in seconds}
    new["fixed_frame"], new["up"], new["warnings"] = run["fixed_frame"], run["up"], run["warnings"]
    if run.get("damaged"):
        new["damaged"] = True
    return new


def _require_complete(folder: Path) -> None:
    """Check that all segments and tables can be opened: a power cut may have truncated them.

    Raises
    ------
    OutputError : a file is unreadable.
    """
    require_complete(folder)
    for table in TABLES:
        if (folder / f"{table}.parquet").exists():
            count_rows(folder, table)


def _same_recording_and_versions(
    run: RunInfo, planned: RunInfo, source: Path, digest: Callable[[], str]
) -> bool:
    """Return whether ``run`` was made from ``source`` by the versions in ``planned``.

    ``digest`` is as in `resume`.
    """
    if run["versions"] != planned["versions"]:
        return False
    recorded = run["input"]
    return unchanged(recorded["files"], source) or same_content(recorded, source, digest)


def _is_complete(folder: Path, run: RunInfo) -> bool:
    """Return whether *perceive* and *revise* are done, and the tables have as many rows as counted.

    ``run`` is the run.json with the counts.

    Raises
    ------
    OutputError : a table is missing or unreadable.
    """
    counts = run["counts"]
    return (
        {"perceive", "revise"} <= run["seconds"].keys()
        and count_rows(folder, "frames") == counts["frames"]
        and count_rows(folder, "detections") == counts["detections"]
        and ("color" not in counts or count_rows(folder, "masks") == counts["color"])
    )


def _link(file: Path, folder: Path) -> None:
    """Link a table, if it exists, into a folder; copy it where links are impossible."""
    target = folder / file.name
    target.unlink(missing_ok=True)
    try:
        os.link(file, target)  # tables are replaced, never edited
    except FileNotFoundError:
        return
    except OSError:
        shutil.copyfile(file, target)
