"""The outcomes of the recordings of a batch, and their lines in the manifest."""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from threading import Lock
from typing import Any

from shapecat.batch.manifest import Entry, Manifest, State
from shapecat.batch.plans import Task, run_of
from shapecat.errors import OutputError
from shapecat.executors import is_dropped
from shapecat.runs.jobs import Job, Summary, summarize

__all__ = ["MOST_TRIES", "Ledger", "Outcome"]

_log = logging.getLogger(__name__)

MOST_TRIES = 2
"""A recording is reported as failed when its worker has died in this many attempts."""
_MOST_LINES = 1000
"""Lines of the manifest written at a time."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a job: a summary, or the message and exit code of an error."""

    job: Job
    summary: Summary | None = None
    message: str = ""
    code: int = 0


class Ledger:
    """Counts the attempts at each recording, and writes the manifest.

    A failed write ends the writing, but not the batch.
    """

    def __init__(self, manifest: Manifest) -> None:
        self._manifest = manifest
        self._lock = Lock()
        self._in_progress: dict[str, Entry] = {}

    def record_planned(self, tasks: Iterable[Task]) -> None:
        """List in the manifest the recordings to process, except those already listed."""
        entries = (task.entry() for task in tasks if task.status != "complete")
        new = (entry for entry in entries if not self._is_recorded(entry, "planned"))
        while some := list(islice(new, _MOST_LINES)):
            self._write(some)

    def _is_recorded(self, entry: Entry, state: State) -> bool:
        """Return whether the last entry of the folder of ``entry`` has this state.

        It must also have the same input, work and command.
        """
        last = self._manifest.entries.get(entry.folder)
        return last is not None and last.state == state and last.same_command(entry)

    def earlier_outcome(self, task: Task) -> Outcome:
        """Return the outcome of a task that an earlier command completed."""
        job = task.job
        entry = self._manifest.entries.get(task.name)
        if entry is not None and entry.tracks is not None and entry.frames is not None:
            counts = {"frames": entry.frames, "tracks": entry.tracks}
            return Outcome(job, Summary(counts, entry.seconds or 0.0, (), processed=False))
        try:
            return Outcome(job, summarize(run_of(job), processed=False))
        except OutputError as error:
            return Outcome(job, message=str(error), code=error.exit_code)

    def begin(self, task: Task) -> None:
        """Begin to count the attempts at a recording; call this before `record_running`."""
        with self._lock:
            self._in_progress.setdefault(task.name, replace(task.entry(), tries=1))

    def record_running(self, name: str) -> None:
        """Record that the recording of a run folder is being processed, once per attempt."""
        with self._lock:
            entry = self._in_progress.get(name)
            if entry is not None and entry.state != "running":
                self._record(entry, state="running")

    def record_lost(self, task: Task, error: BaseException) -> bool:
        """Record a lost worker; return whether the recording is to be tried again.

        An attempt that had not begun when the scheduler was lost does not count.
        """
        with self._lock:
            entry = self._in_progress[task.name]
            if is_dropped(error) and entry.state != "running":
                return True
            if entry.tries < MOST_TRIES:
                self._record(entry, state="planned", tries=entry.tries + 1)
            return entry.tries < MOST_TRIES

    def record_outcome(self, task: Task, outcome: Outcome) -> None:
        """Record the outcome of a recording."""
        with self._lock:
            entry, summary = self._in_progress[task.name], outcome.summary
            if summary is None:
                self._record(entry, state="failed", exit_code=outcome.code, message=outcome.message)
            elif not self._is_recorded(entry, "complete"):
                self._record(
                    entry,
                    state="complete",
                    seconds=round(summary.seconds, 3),
                    frames=summary.counts["frames"],
                    tracks=summary.counts["tracks"],
                )
            del self._in_progress[task.name]

    def _record(self, entry: Entry, **changes: Any) -> None:
        new = self._in_progress[entry.folder] = replace(entry, **changes)
        self._write([new])

    def _write(self, entries: Sequence[Entry]) -> None:
        try:
            self._manifest.record(entries)
        except OutputError as error:
            _log.error("%s", error)
            self._manifest = Manifest()
