"""Process many recordings on an executor; a failure of one does not stop the others."""

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor, Future
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any
from uuid import uuid4

from shapecat import __version__
from shapecat.batch.ledger import Ledger, Outcome
from shapecat.batch.manifest import Manifest
from shapecat.batch.plans import Task
from shapecat.batch.remote import Ticket, process_remote
from shapecat.errors import ShapecatError
from shapecat.executors import ProgressReceiver, is_lost, send_progress
from shapecat.pipeline import process
from shapecat.runs.jobs import Job
from shapecat.system import stopping
from shapecat.system.progress import Observer

__all__ = ["attempt", "process_here", "process_on"]

_log = logging.getLogger(__name__)

_TRIES = 2
"""Attempts at a recording whose workers die, before it is reported as failed."""
_AHEAD = 1000
"""Recordings submitted to an executor at a time, so that a scheduler need not hold them all."""
_REPORT_S = 0.2
"""Shortest time between progress reports of a worker in one phase."""
_HEED_S = 0.1
"""Time between two checks for signals while waiting for workers."""


_Ended = tuple[Task, Future[Outcome]]
_Report = Callable[[str, str, int, int | None], None]
"""Called with the run folder of a recording, its phase, the frames done, and the total (None if
unknown), possibly from several threads."""


def process_here(
    tasks: Sequence[Task], report: _Report, *, cores: int = 1, manifest: Manifest | None = None
) -> Iterator[Outcome]:
    """Process the tasks one by one in this process; yield their outcomes.

    Parameters
    ----------
    report : receives the progress.
    cores : processes that perceive the frames of a recording.
    manifest : receives the state of each recording.

    Raises
    ------
    Stopped : a signal asked the process to stop.
    """
    ledger, batch = Ledger(manifest), uuid4().hex
    ledger.plan(tasks)
    for task in tasks:
        stopping.check()

        def observe(phase: str, done: int, total: int | None, name: str = task.name) -> None:
            report(name, phase, done, total)

        if task.status == "complete":
            outcome = ledger.known(task)
        else:
            ledger.begin(task)
            ledger.running(task.name)
            outcome = attempt(task.job, observe, cores=cores, ticket=_ticket(task, batch))
            ledger.ended(task, outcome)
        yield outcome


def process_on(
    executor: Executor,
    tasks: Sequence[Task],
    report: _Report,
    *,
    cores: int = 1,
    manifest: Manifest | None = None,
) -> Iterator[Outcome]:
    """Process the tasks on an executor, largest first; yield their outcomes.

    If a worker dies, its recording is retried once, then reported as failed. A recording that was
    still queued when the scheduler was lost does not use up an attempt.

    The parameters are as for `process_here`.

    Raises
    ------
    Stopped : a signal asked the process to stop; running tasks go on until the executor is stopped.
    """
    ledger = Ledger(manifest)
    ledger.plan(tasks)

    def receive(progress: Any) -> None:
        name, phase, done, total = progress
        ledger.running(name)
        report(name, phase, done, total)

    with ProgressReceiver(receive) as receiver:
        yield from _outcomes(executor, tasks, ledger, receiver.address, cores)


def _outcomes(
    executor: Executor, tasks: Sequence[Task], ledger: Ledger, address: str, cores: int
) -> Iterator[Outcome]:
    ended: SimpleQueue[_Ended] = SimpleQueue()
    batch = uuid4().hex

    def begin(task: Task) -> None:
        ledger.begin(task)
        ticket = _ticket(task, batch)
        future = executor.submit(_attempt_elsewhere, task.job, address, cores, ticket, __version__)
        future.add_done_callback(lambda done: ended.put((task, done)))

    yield from (ledger.known(task) for task in tasks if task.status == "complete")
    waiting = [task for task in tasks if task.status != "complete"]
    waiting.sort(key=lambda task: task.bytes)
    running = 0
    while waiting or running:
        while waiting and running < _AHEAD:
            begin(waiting.pop())
            running += 1
        task, future = _next(ended)
        error = CancelledError() if future.cancelled() else future.exception()
        if error is not None and is_lost(error) and ledger.lost(task, error, most=_TRIES):
            begin(task)
            continue
        running -= 1
        outcome = future.result() if error is None else _unknown(task.job, error)
        ledger.ended(task, outcome)
        yield outcome


def _ticket(task: Task, batch: str) -> Ticket:
    return Ticket(batch, task.input, task.work)


def _next(ended: SimpleQueue[_Ended]) -> _Ended:
    """Wait for the next finished task; raise `Stopped` at a signal."""
    while True:
        stopping.check()
        with suppress(Empty):
            return ended.get(timeout=_HEED_S)


def _unknown(job: Job, error: BaseException) -> Outcome:
    if is_lost(error):
        reason = str(error) or type(error).__name__
        msg = f"{job.name}: gave up after {_TRIES} tries: {reason}"
        return Outcome(job, message=msg, code=1)
    return Outcome(job, message=f"{job.name}: {type(error).__name__}: {error}", code=1)


def _attempt_elsewhere(job: Job, address: str, cores: int, ticket: Ticket, version: str) -> Outcome:
    """Process one job in a worker; refuse a command of another version of shapecat."""
    if version != __version__:
        what = f"a worker has shapecat {__version__}, this command {version}"
        return Outcome(job, message=f"{job.name}: {what}; install one version", code=1)
    logging.basicConfig(level=logging.ERROR, format="%(levelname)s %(message)s")
    return attempt(job, _reporter(job.folder.name, address), cores=cores, ticket=ticket)


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


def attempt(job: Job, observe: Observer, *, cores: int = 1, ticket: Ticket) -> Outcome:
    """Process one job; an error becomes its outcome, and an unexpected one is logged in full.

    ``cores`` is the number of processes that perceive frames; only a job with URLs uses ``ticket``.
    """
    try:
        if job.origin or job.target:
            return Outcome(job, process_remote(job, observe, cores=cores, ticket=ticket))
        return Outcome(job, process(job, observe, cores=cores))
    except ShapecatError as error:
        return Outcome(job, message=str(error), code=error.exit_code)
    except Exception as error:  # noqa: BLE001  one bad recording must not stop the others
        _log.exception("%s: this is a bug in shapecat", job.name)
        return Outcome(job, message=f"{job.name}: {type(error).__name__}: {error}", code=1)
