"""Process many recordings on an executor; a failure of one does not stop the others."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from contextlib import suppress
from functools import partial
from queue import Empty, SimpleQueue
from typing import Any
from uuid import uuid4

from shapecat import __version__
from shapecat.batch.ledger import MOST_TRIES, Ledger, Outcome
from shapecat.batch.manifest import Manifest
from shapecat.batch.plans import Task
from shapecat.batch.remote import process_remote
from shapecat.errors import ShapecatError, shortage
from shapecat.executors import ProgressReceiver, is_lost, send_progress
from shapecat.pipeline import process
from shapecat.runs.jobs import Job
from shapecat.system import stopping
from shapecat.system.progress import Observer

__all__ = ["attempt", "process_here", "process_on"]

_log = logging.getLogger(__name__)

_MOST_SUBMITTED = 1000
"""Recordings submitted to an executor at a time, so that a scheduler need not hold them all."""
_REPORT_S = 0.2
"""Shortest time between progress reports of a worker in one phase."""
_POLL_S = 0.1
"""Time between two checks for signals while waiting for workers."""

_Finished = tuple[Task, Future[Outcome]]
_Report = Callable[[str, str, int, int | None], None]
"""Called with the name of a recording's run folder, the phase, the frames done, and the total (None
if unknown), possibly from several threads."""


def process_here(
    tasks: Sequence[Task], report: _Report, *, manifest: Manifest, cores: int = 1
) -> Iterator[Outcome]:
    """Process the tasks one by one in this process; yield their outcomes.

    Parameters
    ----------
    report : receives the progress.
    manifest : receives the state of each recording.
    cores : number of processes that perceive the frames of a recording.

    Raises
    ------
    Stopped : a signal asked the process to stop.
    """
    ledger, batch = Ledger(manifest), uuid4().hex
    ledger.record_planned(tasks)
    for task in tasks:
        stopping.check()
        if task.status == "complete":
            outcome = ledger.earlier_outcome(task)
        else:
            ledger.begin(task)
            ledger.record_running(task.name)
            observe = partial(report, task.name)
            outcome = attempt(task.job, observe, cores=cores, batch=batch)
            ledger.record_outcome(task, outcome)
        yield outcome


def process_on(
    executor: Executor,
    tasks: Sequence[Task],
    report: _Report,
    *,
    manifest: Manifest,
    cores: int = 1,
) -> Iterator[Outcome]:
    """Process the tasks on an executor, largest first; yield their outcomes.

    If a worker dies, its recording is retried once, then reported as failed. A recording that was
    still queued when the scheduler was lost does not use up an attempt.

    The parameters are as for `process_here`.

    Raises
    ------
    Stopped : a signal asked the process to stop; running tasks continue until the executor stops.
    """
    ledger = Ledger(manifest)
    ledger.record_planned(tasks)

    def receive(progress: Any) -> None:
        name, phase, done, total = progress
        ledger.record_running(name)
        report(name, phase, done, total)

    with ProgressReceiver(receive) as receiver:
        yield from _outcomes(executor, tasks, ledger, receiver.address, cores)


def _outcomes(
    executor: Executor, tasks: Sequence[Task], ledger: Ledger, address: str, cores: int
) -> Iterator[Outcome]:
    finished: SimpleQueue[_Finished] = SimpleQueue()
    batch = uuid4().hex

    def submit(task: Task) -> None:
        ledger.begin(task)
        future = executor.submit(_attempt_on_worker, task.job, address, cores, batch, __version__)
        future.add_done_callback(lambda done: finished.put((task, done)))

    yield from (ledger.earlier_outcome(task) for task in tasks if task.status == "complete")
    waiting = [task for task in tasks if task.status != "complete"]
    waiting.sort(key=lambda task: task.source.bytes)
    running = 0
    while waiting or running:
        while waiting and running < _MOST_SUBMITTED:
            submit(waiting.pop())
            running += 1
        task, future = _wait_for_next(finished)
        error = CancelledError() if future.cancelled() else future.exception()
        if error is not None and is_lost(error) and ledger.record_lost(task, error):
            submit(task)
            continue
        running -= 1
        outcome = future.result() if error is None else _give_up(task.job, error)
        ledger.record_outcome(task, outcome)
        yield outcome


def _wait_for_next(finished: SimpleQueue[_Finished]) -> _Finished:
    """Wait for the next finished task; raise `Stopped` at a signal."""
    while True:
        stopping.check()
        with suppress(Empty):
            return finished.get(timeout=_POLL_S)


def _failed(job: Job, reason: str) -> Outcome:
    return Outcome(job, message=f"{job.name}: {reason}", code=1)


def _give_up(job: Job, error: BaseException) -> Outcome:
    kind = type(error).__name__
    if is_lost(error):
        hint = "if memory is short, use fewer --jobs"
        return _failed(job, f"gave up after {MOST_TRIES} tries: {str(error) or kind}; {hint}")
    return _failed(job, f"{kind}: {error}")


def _attempt_on_worker(job: Job, address: str, cores: int, batch: str, version: str) -> Outcome:
    """Process one job in a worker; refuse a command from a different version of shapecat.

    ``address`` is that of the `ProgressReceiver`, ``version`` that of the command's shapecat.
    """
    if version != __version__:
        versions = f"a worker has shapecat {__version__}, this command {version}"
        return _failed(job, f"{versions}; install one version")
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s %(message)s")
    return attempt(job, _reporter(job.folder.name, address), cores=cores, batch=batch)


def _reporter(name: str, address: str) -> Observer:
    """Return an observer that sends progress to ``address``, a few times a second."""
    last = ("", 0.0)

    def observe(phase: str, done: int, total: int | None) -> None:
        nonlocal last
        now = time.monotonic()
        if phase != last[0] or now - last[1] >= _REPORT_S or done == total:
            last = (phase, now)
            send_progress(address, (name, phase, done, total))

    return observe


def attempt(job: Job, observe: Observer, *, cores: int = 1, batch: str) -> Outcome:
    """Process one job; an error becomes its outcome, and an unexpected one is logged in full.

    ``cores`` is the number of processes that perceive frames. ``batch`` identifies the command;
    only jobs with URLs use it.
    """
    try:
        if job.origin or job.target:
            return Outcome(job, process_remote(job, observe, cores=cores, batch=batch))
        return Outcome(job, process(job, observe, cores=cores))
    except ShapecatError as error:
        return Outcome(job, message=str(error), code=error.exit_code)
    except Exception as error:  # noqa: BLE001  one bad recording must not stop the others
        if text := shortage(error):
            return _failed(job, text)
        _log.exception("%s: this is a bug in shapecat", job.name)
        return _failed(job, f"{type(error).__name__}: {error}")
