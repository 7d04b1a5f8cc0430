"""Process many recordings on an executor; a failure of one does not stop the others."""

import dataclasses
import json
import logging
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from contextlib import suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from threading import Lock
from typing import Any, Protocol

from shapecat.batch.manifest import Entry, Manifest
from shapecat.batch.plans import Task
from shapecat.batch.remote import download, fetch, finish_upload, look_at, scratch, upload
from shapecat.errors import OutputError, ShapecatError
from shapecat.executors import Mailbox, is_dropped, is_lost, post
from shapecat.pipeline import Observer, process
from shapecat.runs.folder import read_run, require_ours
from shapecat.runs.jobs import Job, Summary, summarize
from shapecat.runs.run_info import RunInfo
from shapecat.system import stopping

__all__ = ["Outcome", "Watcher", "attempt", "exit_code", "process_here", "process_on"]

_log = logging.getLogger(__name__)

_TRIES = 2
"""Times a recording is begun before it is held to kill its workers."""
_AHEAD = 1000
"""Recordings handed to an executor at a time: a scheduler need not hold a hundred thousand."""
_REPORT_S = 0.2
"""A worker tells how far it is no more often than this."""


_PREVIOUS = ("tracks.csv", "tracks.original.csv", "tracks.parquet", "frames.parquet")
"""What carrying labels over to a new run needs of the old one."""
_HEED_S = 0.1
"""Whoever waits for workers looks so often whether a signal has come."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job: a summary, or an error message with its exit code."""

    job: Job
    summary: Summary | None = None
    message: str = ""
    code: int = 0


_Ended = tuple[Job, Future[Outcome]]


class Watcher(Protocol):
    """Receives progress and outcomes, possibly from several threads."""

    def progress(self, folder: str, phase: str, done: int, total: int | None) -> None:
        """Receive the progress of a recording."""

    def ended(self, outcome: Outcome) -> None:
        """Receive the outcome of a recording."""


def process_here(
    tasks: Sequence[Task], watcher: Watcher, *, cores: int = 1, manifest: Manifest | None = None
) -> Iterator[Outcome]:
    """Process the tasks one by one in this process; yield their outcomes."""
    ledger = _Ledger(tasks, manifest)
    for task in tasks:
        stopping.check()
        name = task.job.folder.name

        def observe(phase: str, done: int, total: int | None, name: str = name) -> None:
            watcher.progress(name, phase, done, total)

        if task.status != "complete":
            ledger.running(name)
        outcome = _already(task) or attempt(task.job, observe, cores=cores)
        ledger.ended(outcome)
        watcher.ended(outcome)
        yield outcome


def process_on(
    executor: Executor,
    tasks: Sequence[Task],
    watcher: Watcher,
    *,
    cores: int = 1,
    manifest: Manifest | None = None,
) -> Iterator[Outcome]:
    """Process the tasks on an executor, largest first; yield their outcomes.

    A recording whose worker dies is tried once more, then reported; the others go on. One that
    only waited when the scheduler was lost has not been tried.

    Raises
    ------
    Stopped : a signal has asked for it; what runs goes on until the executor is stopped.
    """
    ledger = _Ledger(tasks, manifest)

    def receive(report: Any) -> None:
        name, phase, done, total = report
        ledger.running(name)
        watcher.progress(name, phase, done, total)

    with Mailbox(receive) as mailbox:
        for outcome in _outcomes(executor, tasks, ledger, mailbox.address, cores):
            ledger.ended(outcome)
            watcher.ended(outcome)
            yield outcome


def _outcomes(
    executor: Executor, tasks: Sequence[Task], ledger: "_Ledger", address: str, cores: int
) -> Iterator[Outcome]:
    ended: SimpleQueue[_Ended] = SimpleQueue()

    def begin(job: Job) -> None:
        future = executor.submit(_attempt_elsewhere, job, address, cores)
        future.add_done_callback(lambda done: ended.put((job, done)))

    yield from filter(None, map(_already, tasks))
    todo = [task for task in tasks if task.status != "complete"]
    waiting = [task.job for task in sorted(todo, key=lambda task: task.bytes)]
    running = 0
    while waiting or running:
        while waiting and running < _AHEAD:
            begin(waiting.pop())
            running += 1
        job, future = _next(ended)
        error = _error(future)
        if error is not None and is_lost(error) and ledger.lost(job, error) < _TRIES:
            begin(job)
            continue
        running -= 1
        yield future.result() if error is None else _unknown(job, error)


def _next(ended: SimpleQueue[_Ended]) -> _Ended:
    """Wait for the next outcome, or for a signal to stop."""
    while True:
        stopping.check()
        with suppress(Empty):
            return ended.get(timeout=_HEED_S)


def _error(future: Future[Outcome]) -> BaseException | None:
    return CancelledError() if future.cancelled() else future.exception()


def _unknown(job: Job, error: BaseException) -> Outcome:
    if is_lost(error):
        reason = str(error) or type(error).__name__
        msg = f"{job.name}: gave up after {_TRIES} tries: {reason}"
        return Outcome(job, message=msg, code=1)
    return Outcome(job, message=f"{job.name}: {type(error).__name__}: {error}", code=1)


def _already(task: Task) -> Outcome | None:
    """Return the outcome of a complete task, None for others."""
    if task.status != "complete":
        return None
    return Outcome(task.job, summarize(task.job, _run_of(task.job), processed=False))


def _run_of(job: Job) -> RunInfo:
    """Return the run.json of a complete run."""
    if not job.target:
        return read_run(job.folder)
    run: RunInfo = json.loads(fetch(f"{job.target}/run.json"))
    return run


def _attempt_elsewhere(job: Job, address: str, cores: int) -> Outcome:
    """Process one job in a worker."""
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s %(message)s")
    return attempt(job, _reporter(job.folder.name, address), cores=cores)


def _reporter(name: str, address: str) -> Observer:
    last = ("", 0.0)

    def observe(phase: str, done: int, total: int | None) -> None:
        nonlocal last
        now = time.monotonic()
        if phase != last[0] or now - last[1] >= _REPORT_S or done == total:
            last = (phase, now)
            post(address, (name, phase, done, total))

    return observe


def attempt(job: Job, observe: Observer, *, cores: int = 1) -> Outcome:
    """Process one job; a known error is an outcome, an unknown one too, but logged in full."""
    try:
        if job.origin or job.target:
            return Outcome(job, _process_remote(job, observe, cores))
        return Outcome(job, process(job, observe, cores=cores))
    except ShapecatError as error:
        return Outcome(job, message=str(error), code=error.exit_code)
    except Exception as error:  # noqa: BLE001  one bad recording must not stop the others
        _log.exception("%s: this is a bug in shapecat", job.name)
        return Outcome(job, message=f"{job.name}: {type(error).__name__}: {error}", code=1)


def _process_remote(job: Job, observe: Observer, cores: int) -> Summary:
    """Process a job between downloading its recording and uploading its results."""
    with scratch() as folder:
        local = job
        if job.origin:
            (folder / "input").mkdir()
            local = dataclasses.replace(local, source=download(job.origin, folder / "input"))
        if job.target:
            local = dataclasses.replace(local, folder=folder / "output" / job.folder.name)
            _look_for_results(local)
        try:
            summary = process(local, observe, cores=cores)
        except ShapecatError as error:
            text = str(error).replace(str(local.source), job.name)
            text = text.replace(str(local.folder), job.target or str(local.folder))
            raise type(error)(text) from error
        if job.target and summary.processed:
            upload(local.folder, job.target)
    return summary


def _look_for_results(job: Job) -> None:
    """Fetch the parts of earlier results at the target that `process` needs.

    Raises
    ------
    OutputError : the target holds what shapecat did not make.
    """
    finish_upload(job.target)
    wanted = ("run.json", *(_PREVIOUS if job.overwrite else ()))
    there = [name for name in wanted if look_at(f"{job.target}/{name}")[1]]
    if "run.json" in there:
        job.folder.mkdir(parents=True)
    for name in there:
        (job.folder / name).write_bytes(fetch(f"{job.target}/{name}"))
    require_ours(job.folder)


class _Ledger:
    """Write the manifest, if there is one; a full disk does not end the batch."""

    def __init__(self, tasks: Sequence[Task], manifest: Manifest | None) -> None:
        self._manifest = manifest
        self._lock = Lock()
        self._entries = {task.job.folder.name: task.entry() for task in tasks}
        self._tries = dict.fromkeys(self._entries, 1)
        open_ones = [task.job.folder.name for task in tasks if task.status != "complete"]
        self._write([self._entries[name] for name in open_ones])

    def running(self, name: str) -> None:
        """Record the start of a recording, once per attempt."""
        with self._lock:
            entry = self._entries.get(name)
            if entry is not None and (entry.state, entry.tries) != ("running", self._tries[name]):
                if entry.state in {"complete", "failed"}:
                    return
                self._note(entry, state="running")

    def lost(self, job: Job, error: BaseException) -> int:
        """Record the death of a worker; return the number of deaths at this recording."""
        name = job.folder.name
        with self._lock:
            waited = self._entries[name].state != "running"
            if not (is_dropped(error) and waited):
                self._tries[name] += 1
                self._note(self._entries[name], state="planned")
            return self._tries[name] - 1

    def ended(self, outcome: Outcome) -> None:
        """Record the outcome of a recording."""
        with self._lock:
            entry = self._entries[outcome.job.folder.name]
            if outcome.summary is None:
                self._note(entry, state="failed", exit_code=outcome.code, message=outcome.message)
                return
            known = self._manifest and self._manifest.entries.get(entry.folder)
            if known and (known.state, known.input, known.work) == (
                "complete",
                entry.input,
                entry.work,
            ):
                return
            frames = outcome.summary.counts["frames"]
            self._note(
                entry, state="complete", seconds=round(outcome.summary.seconds, 3), frames=frames
            )

    def _note(self, entry: Entry, **changes: Any) -> None:
        new = dataclasses.replace(entry, tries=self._tries[entry.folder], **changes)
        self._entries[entry.folder] = new
        self._write([new])

    def _write(self, entries: Sequence[Entry]) -> None:
        if self._manifest is None:
            return
        try:
            self._manifest.record(entries)
        except OutputError as error:
            _log.error("%s", error)
            self._manifest = None


def exit_code(outcomes: Sequence[Outcome]) -> int:
    """Return 0 if all are complete, 1 if some; if none, the exit code 3, 4, 2 or 1 of a failure."""
    codes = {outcome.code for outcome in outcomes}
    if codes <= {0}:
        return 0
    if 0 in codes:
        return 1
    return next((code for code in (3, 4, 2) if code in codes), 1)
