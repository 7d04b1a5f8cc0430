"""Process a recording in a temporary folder if it, or its run folder, is at a URL.

Object stores cannot rename. A run folder at a URL is complete if it holds run.json, which is
uploaded last; without run.json, its files do not count as a run.
"""

import dataclasses
import errno
from contextlib import nullcontext, suppress
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import gettempdir

from shapecat.batch.claims import Claim, claimed
from shapecat.batch.storage import Location, names_in
from shapecat.errors import OutputError, RecordingError, ShapecatError
from shapecat.pipeline import process
from shapecat.runs.folder import OUTPUTS, RUN_FILES, read_run, write_run
from shapecat.runs.jobs import Job, Summary, summarize
from shapecat.runs.labels.corrections import LOST
from shapecat.runs.run_info import RunInfo, parse_run
from shapecat.system.files import scratch_folder
from shapecat.system.progress import Observer

__all__ = ["process_remote", "upload"]

_PREVIOUS = tuple(name for name in RUN_FILES if name not in {*OUTPUTS, "report.html"})
"""Files of the previous run from which labels are transferred to a new run; run.json last."""


def process_remote(job: Job, observe: Observer, *, cores: int, batch: str) -> Summary:
    """Download the recording of a job, process it, and upload the results.

    ``batch`` identifies the command that sent the job. If a run at the target has the keys of the
    job, and the job does not overwrite it, its summary is returned, and nothing is processed.

    Raises
    ------
    RecordingError, NoStreamError, ModelError : as for `process`.
    OutputError : the storage is not writable, or another process works on the run folder.
    """
    claiming = claimed(job.target, batch) if job.target else nullcontext()
    with scratch_folder() as folder, claiming as claim:
        local = job
        if job.target:
            local, run = _fetch_run(
                dataclasses.replace(job, folder=folder / "output" / job.folder.name)
            )
            if run is not None and job.made(run):
                return summarize(run, processed=False)
        if job.origin:
            (folder / "input").mkdir()
            local = dataclasses.replace(local, source=_download(job.origin, folder / "input"))
        summary = _process(job, local, observe, cores)
        if claim is not None and summary.processed:
            _write_keys(job, local.folder)
            upload(local.folder, job.target, claim)
        elif claim is not None and all(job.keys.values()):
            # The run was complete already. With the keys, its recording is not downloaded again.
            _write_keys(job, local.folder)
            claim.require()
            (Location(job.target, OutputError) / "run.json").upload(local.folder / "run.json")
    return summary


def _write_keys(job: Job, folder: Path) -> None:
    """Add the keys of a job to the run.json in a folder, as its ``origin``.

    Raises
    ------
    OutputError : run.json is unreadable, or cannot be written.
    """
    run = read_run(folder)
    run["origin"] = job.keys
    write_run(folder, run)


def _process(job: Job, local: Job, observe: Observer, cores: int) -> Summary:
    """Process ``local``, a job in the temporary folder; error messages name the URLs of ``job``."""
    try:
        return process(local, observe, cores=cores)
    except ShapecatError as error:
        text = str(error).replace(str(local.source), job.name)
        text = text.replace(str(local.folder), job.target or str(local.folder))
        if job.target and _is_disk_full(error):
            text += f"; it is the scratch space {gettempdir()} that is full: set TMPDIR"
        raise type(error)(text) from error


def _is_disk_full(error: BaseException | None) -> bool:
    """Return whether an error, or one that caused it, reports a full disk."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in {errno.ENOSPC, errno.EDQUOT}:
            return True
        error = error.__cause__
    return False


def _download(url: str, folder: Path) -> Path:
    target = folder / names_in(url)[1]
    Location(url).download(target)
    if target.suffix.lower() == ".db3" and target.is_file() and "?" not in url:
        log, info = Location(f"{url}-wal"), None  # of a recorder that was killed
        with suppress(RecordingError):  # a missing file is an error if listing is forbidden
            info = log.info()
        if info is not None:
            log.download(target.with_name(f"{target.name}-wal"))
    return target


def _fetch_run(job: Job) -> tuple[Job, RunInfo | None]:
    """Download run.json of an earlier run at the target, and its labels if it is overwritten.

    Returns
    -------
    The job, and the content of run.json, or None if there is no run or the job overwrites it. If
    run.json is missing at the target, ``overwrite`` is set in the job, since the replacement of an
    earlier run may have been interrupted.

    Raises
    ------
    OutputError : the target holds files that shapecat did not write, or an unusable run.json.
    """
    place = Location(job.target, OutputError)
    if "run.json" not in _require_run_folder(place):
        place, job = _previous_location(place), dataclasses.replace(job, overwrite=True)
    content = (place / "run.json").read()
    if content is None:
        return job, None
    run = None if job.overwrite else parse_run(content, place.url)
    job.folder.mkdir(parents=True)
    (job.folder / "run.json").write_bytes(content)
    for name in _PREVIOUS[:-1] if job.overwrite else ():
        if (labels := (place / name).read()) is not None:
            (job.folder / name).write_bytes(labels)
    return job, run


def _require_run_folder(place: Location) -> set[str]:
    """Return the names in a run folder.

    Raises
    ------
    OutputError : the folder holds files that shapecat did not write, and no run.json.
    """
    names = place.names()
    if "run.json" not in names and not all(map(_is_of_run, names)):
        msg = f"{place.url}: shapecat did not make this; choose another --out, or move it away"
        raise OutputError(msg)
    return names


def _is_of_run(name: str) -> bool:
    return name in RUN_FILES or fnmatchcase(name, LOST)


def _previous_location(place: Location) -> Location:
    """Return where a run is kept while a new one replaces it."""
    parent, _, name = place.url.rstrip("/").rpartition("/")
    return Location(f"{parent}/.{name}.old", OutputError)


def upload(folder: Path, url: str, claim: Claim) -> None:
    """Upload a run folder, frames.parquet first and run.json last, and replace an earlier run.

    A search for recordings then always sees one of the two files, and does not mistake
    annotated.mcap for a recording.

    Raises
    ------
    OutputError : the storage is not writable, the folder there was not written by shapecat, or
        another process has taken it over.
    """
    place = Location(url, OutputError)
    previous = _previous_location(place)
    names = _require_run_folder(place)
    if claim.inherited:
        place.abort_uploads()
    claim.require()
    if "run.json" in names:
        for name in _PREVIOUS:
            if name in names:
                (place / name).copy(previous / name)
        (place / "run.json").remove()
    sent = {path.name for path in folder.iterdir() if _is_of_run(path.name)}
    for name in sorted(sent, key=lambda name: (name == "run.json", name != "frames.parquet", name)):
        if name == "run.json":
            claim.require()
        (place / name).upload(folder / name)
    for name in (set(RUN_FILES) - sent) & names:
        (place / name).remove()
    for name in previous.names():
        (previous / name).remove()
