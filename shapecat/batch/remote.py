"""A recording and its run folder at URLs: downloaded to scratch, processed, uploaded.

Object stores have no rename. A run folder there is complete when it has its run.json, which is
sent last; without one, whatever else lies there is no run.
"""

import dataclasses
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from shapecat.batch.claims import Claim, claimed
from shapecat.batch.storage import Location
from shapecat.errors import OutputError, ShapecatError
from shapecat.pipeline import Observer, process
from shapecat.runs.folder import OUTPUTS, RUN_FILES, read_run, require_ours, write_run
from shapecat.runs.jobs import Job, Summary, summarize
from shapecat.runs.run_info import OriginInfo, RunInfo
from shapecat.system.files import lock

__all__ = ["Ticket", "process_remote", "scratch", "upload"]

_SCRATCH = "shapecat-scratch-"
_PREVIOUS = tuple(name for name in RUN_FILES if name not in {*OUTPUTS, "report.html"})
"""Files that the transfer of labels to a new run needs; run.json last."""


@dataclass(frozen=True)
class Ticket:
    """Identifies the work of a task, so that it is not done twice.

    ``batch`` names the command that has sent it; ``input`` changes with the recording, ``work``
    with what is to be done with it.
    """

    batch: str
    input: str = ""
    work: str = ""

    def made(self, run: RunInfo) -> bool:
        """Return whether a run has the same input and work."""
        return bool(self.input and self.work) and run.get("origin") == self._origin()

    def note(self, folder: Path) -> None:
        """Add the origin to run.json."""
        run = read_run(folder)
        run["origin"] = self._origin()
        write_run(folder, run)

    def _origin(self) -> OriginInfo:
        return {"input": self.input, "work": self.work}


def process_remote(job: Job, observe: Observer, *, cores: int, ticket: Ticket) -> Summary:
    """Download the recording of a job, process it, and upload the results.

    Raises
    ------
    RecordingError, NoStreamError, ModelError : as `process` does.
    OutputError : the storage cannot be written to, or another process works on the run folder.
    """
    claim = claimed(job.target, ticket.batch) if job.target else nullcontext()
    with scratch() as folder, claim as held:
        local = job
        if job.target:
            local, run = _fetch_run(
                dataclasses.replace(job, folder=folder / "output" / job.folder.name)
            )
            if run is not None and not local.overwrite and ticket.made(run):
                return summarize(job, run, processed=False)
        if job.origin:
            (folder / "input").mkdir()
            local = dataclasses.replace(local, source=_download(job.origin, folder / "input"))
        summary = _process(job, local, observe, cores)
        if held is not None and summary.processed:
            ticket.note(local.folder)
            upload(local.folder, job.target, held)
    return dataclasses.replace(summary, folder=job.folder)


def _process(job: Job, local: Job, observe: Observer, cores: int) -> Summary:
    """Process the job in scratch; errors name the URLs."""
    try:
        return process(local, observe, cores=cores)
    except ShapecatError as error:
        text = str(error).replace(str(local.source), job.name)
        text = text.replace(str(local.folder), job.target or str(local.folder))
        raise type(error)(text) from error


def _download(url: str, folder: Path) -> Path:
    target = folder / PurePosixPath(url.partition("?")[0].rstrip("/")).name
    Location(url).download(target)
    return target


def _fetch_run(job: Job) -> tuple[Job, RunInfo | None]:
    """Fetch the parts of earlier results at the target that `process` needs.

    Returns
    -------
    The job, and what run.json says; None where there is no run. A run that was being replaced
    when the process was killed is replaced by this one.

    Raises
    ------
    OutputError : the target holds what shapecat did not make.
    """
    place = Location(job.target, OutputError)
    if "run.json" not in _require_ours(place):
        place, job = _replaced(place), dataclasses.replace(job, overwrite=True)
    content = (place / "run.json").read()
    if content is None:
        return job, None
    job.folder.mkdir(parents=True)
    (job.folder / "run.json").write_bytes(content)
    for name in _PREVIOUS[:-1] if job.overwrite else ():
        previous = (place / name).read()
        if previous is not None:
            (job.folder / name).write_bytes(previous)
    require_ours(job.folder)
    return job, read_run(job.folder)


def _require_ours(place: Location) -> set[str]:
    """Return the names in a run folder; refuse one that holds files but none of a run.

    Raises
    ------
    OutputError : it is a stranger's.
    """
    names = place.names()
    if "run.json" not in names and names - set(RUN_FILES):
        msg = f"{place.url}: shapecat did not make this; choose another --out, or move it away"
        raise OutputError(msg)
    return names


def _replaced(place: Location) -> Location:
    """Return the place of a run while another replaces it."""
    parent, _, name = place.url.rstrip("/").rpartition("/")
    return Location(f"{parent}/.{name}.old", OutputError)


def upload(folder: Path, url: str, claim: Claim) -> None:
    """Send a run folder; run.json, which makes it a run, comes last.

    Raises
    ------
    OutputError : the storage cannot be written to, the place is a stranger's, or another process
        has taken it over.
    """
    place = Location(url, OutputError)
    old = _replaced(place)
    names = _require_ours(place)
    if claim.inherited:
        place.abort_uploads()
    claim.require()
    if "run.json" in names:
        for name in _PREVIOUS:
            if name in names:
                (place / name).copy(old / name)
        (place / "run.json").remove()
    sent = sorted(path.name for path in folder.iterdir() if path.name in RUN_FILES)
    for name in sorted(sent, key=lambda name: name == "run.json"):
        if name == "run.json":
            claim.require()
        (place / name).upload(folder / name)
    for name in (set(RUN_FILES) - set(sent)) & names:
        (place / name).remove()
    for name in old.names():
        (old / name).remove()


@contextmanager
def scratch() -> Iterator[Path]:
    """Yield a temporary folder; remove those that killed processes have left."""
    parent = Path(tempfile.gettempdir())
    for left in parent.glob(f"{_SCRATCH}*"):
        with suppress(OSError):
            _remove_unless_used(left)
    with tempfile.TemporaryDirectory(prefix=_SCRATCH, ignore_cleanup_errors=True) as folder:
        held = lock(Path(folder))
        try:
            yield Path(folder)
        finally:
            _release(held)


def _remove_unless_used(folder: Path) -> None:
    held = lock(folder)
    if held is not None:
        shutil.rmtree(folder, ignore_errors=True)
        _release(held)


def _release(held: int | None) -> None:
    if held is not None:
        os.close(held)
