"""Progress of ``process`` on stderr: bars, plain lines, or JSON lines."""

import json
import math
import sys
import time
from collections import Counter
from collections.abc import Sequence
from threading import Lock
from typing import TYPE_CHECKING, Any, Self

import click

from shapecat.errors import listed, printable
from shapecat.outputs.counts import plural, size_words
from shapecat.system.progress import COMPILE, WAIT_FOR_KERNELS, kernel_words

from .render import PHASES, rich_progress

if TYPE_CHECKING:
    from shapecat.batch.ledger import Outcome
    from shapecat.batch.plans import Status, Task

_LINE_S = 5.0
_EVENT_S = 0.5
"""Shortest time between two lines of plain progress, and between two events of a recording."""
_MOST_WARNINGS = 3
"""At most this many warnings about a recording are printed."""
_STATUS_WORDS: "dict[Status, str]" = {
    "complete": "already complete",
    "resume": "to resume",
    "retry": "to retry",
    "check": "to verify",
    "new": "new",
}
_SHARES = {
    "perceive": (0.0, 0.7),
    "revise": (0.7, 0.8),
    "review": (0.8, 0.9),
    "annotate": (0.9, 1.0),
}
"""Rough fractions of the work on a recording that are done when a phase begins and ends."""


def describe_plan(
    tasks: Sequence["Task"], skipped: int, workers: int, cores: int, notes: Sequence[str] = ()
) -> str:
    """Return a one-line summary of the plan.

    Parameters
    ----------
    skipped : number of files that are not recordings.
    workers, cores : recordings processed at once, and frames of each processed at once.
    notes : as in `SearchResult`.
    """
    counts = Counter(task.status for task in tasks)
    words = _STATUS_WORDS.items()
    parts = [", ".join(f"{counts[status]} {text}" for status, text in words if counts[status])]
    if remaining := _remaining_bytes(tasks):
        parts += [size_words(remaining), plural(workers * cores, "process")]
    if skipped:
        parts.append(f"skipped {plural(skipped, 'file')} of other formats")
    if notes:
        parts.append(listed(notes))
    return f"{plural(len(tasks), 'recording')}: {'; '.join(parts)}"


def _remaining_bytes(tasks: Sequence["Task"]) -> int:
    return sum(task.source.bytes for task in tasks if task.status != "complete")


class Progress:
    """Counts finished recordings and prints notes and errors; subclasses show more."""

    def __init__(self, tasks: Sequence["Task"]) -> None:
        """Begin with the planned tasks."""
        self.lock = Lock()
        self.begun = time.monotonic()
        self.tasks = {task.name: task for task in tasks}
        self.total_bytes = _remaining_bytes(tasks)
        self.done_bytes = 0  # of recordings that have ended
        self.running: dict[str, tuple[str, int, int | None]] = {}
        self.complete = self.failed = 0
        self._announced = False  # that this command compiles kernels
        self._counted = -math.inf  # time of the last line with the number of kernels
        self._first: tuple[float, float] | None = None  # time and bytes of the first progress

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the display as it is."""

    def plan(self, text: str) -> None:
        """Show the summary of the plan, in subclasses."""

    def progress(self, folder: str, phase: str, done: int, total: int | None) -> None:
        """Receive the progress of the recording with this run folder; total is None if unknown."""
        with self.lock:
            if phase in {COMPILE, WAIT_FOR_KERNELS}:
                self._compiling(phase, done)
                return
            if folder in self.tasks:
                self.running[folder] = (phase, done, total)
                if self._first is None:
                    self._first = time.monotonic(), self._bytes_done()
                self.show(folder)

    def _compiling(self, phase: str, done: int) -> None:
        """Note once that kernels are being compiled, and then how many, at intervals.

        ``phase`` is `COMPILE` or `WAIT_FOR_KERNELS`, ``done`` the number of kernels. All workers
        report; most of them wait for one that compiles.
        """
        counts = phase == COMPILE and done > 0
        now = time.monotonic()
        if (self._announced and not counts) or (done and now - self._counted < _LINE_S):
            return
        self._announced |= phase == COMPILE
        self._counted = now if done else self._counted
        self.note(kernel_words(phase, done))

    def ended(self, outcome: "Outcome") -> None:
        """Count a recording that has ended, and show its outcome."""
        with self.lock:
            name = outcome.job.folder.name
            self.running.pop(name, None)
            if outcome.summary is None:
                self.failed += 1
            else:
                self.complete += 1
            task = self.tasks.get(name)
            if task is not None and (outcome.summary is None or outcome.summary.processed):
                self.done_bytes += task.source.bytes
            self.show_ended(outcome)

    def remaining_s(self) -> float | None:
        """Return the estimated seconds left, from the bytes done so far; None before any are done.

        The time for loading and compiling, before the first frame, is excluded.
        """
        begun, before = self._first or (self.begun, 0.0)
        now, done = time.monotonic(), self._bytes_done()
        return (
            (now - begun) * (self.total_bytes - done) / (done - before) if done > before else None
        )

    def _bytes_done(self) -> float:
        running = (
            self.tasks[name].source.bytes * _share(*state) for name, state in self.running.items()
        )
        return float(self.done_bytes + sum(running))

    def note(self, text: str) -> None:
        """Show a line."""
        click.echo(printable(text), err=True)

    def show(self, folder: str) -> None:
        """Show the progress of a recording, in subclasses."""

    def show_ended(self, outcome: "Outcome") -> None:
        """Show the error of a recording, or the warnings about its new results."""
        if outcome.message:
            self.note(f"Error: {outcome.message}")
        if outcome.summary is not None and outcome.summary.processed:
            name, warnings = outcome.job.folder.name, outcome.summary.warnings
            for text in warnings[:_MOST_WARNINGS]:
                self.note(f"Warning: {name}: {text}")
            if rest := warnings[_MOST_WARNINGS:]:
                self.note(f"Warning: {name}: {plural(len(rest), 'more warning')} in run.json")


class PlainProgress(Progress):
    """Prints a line every few seconds."""

    _last = 0.0

    def plan(self, text: str) -> None:
        """Write the plan."""
        self.note(text)

    def show(self, folder: str) -> None:  # noqa: ARG002  the line is about all
        """Write a line about all recordings, at most one in five seconds."""
        now = time.monotonic()
        if now - max(self._last, self.begun) < _LINE_S:
            return
        self._last = now
        running = ", ".join(_words(name, *state) for name, state in sorted(self.running.items()))
        if len(self.tasks) == 1:
            self.note(running)
            return
        left = self.remaining_s()
        eta = "" if left is None else f", about {_duration(left)} left"
        failed = f", {self.failed} failed" if self.failed else ""
        done = f"{self.complete + self.failed}/{len(self.tasks)} recordings{failed}{eta}"
        self.note(f"{done}; {running}")


def _share(phase: str, done: int, total: int | None) -> float:
    """Return how much of the work on a recording is done, from 0 to 1."""
    begin, end = _SHARES.get(phase, (0.0, 0.0))
    return begin + (end - begin) * min(done / total, 1.0) if total else begin


def _words(name: str, phase: str, done: int, total: int | None) -> str:
    count = f" {done}/{total}" if total else f" {done}"
    return f"{name}: {PHASES.get(phase, phase)}{count}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(max(0, round(seconds)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class JsonProgress(Progress):
    """Prints one JSON object per line, for programs."""

    def __init__(self, tasks: Sequence["Task"]) -> None:
        """Begin with the planned tasks and write the plan."""
        super().__init__(tasks)
        self._last: dict[str, tuple[str, float]] = {}
        statuses = Counter(task.status for task in tasks)
        _event("plan", recordings=len(tasks), bytes=self.total_bytes, status=dict(statuses))

    def note(self, text: str) -> None:
        """Write a line of text as an event."""
        _event("note", text=text)

    def show(self, folder: str) -> None:
        """Write a recording's progress at most twice a second, and as a phase begins or ends."""
        phase, done, total = self.running[folder]
        before, now = self._last.get(folder, ("", 0.0)), time.monotonic()
        if phase != before[0] or now - before[1] >= _EVENT_S or done == total:
            self._last[folder] = (phase, now)
            recording = self.tasks[folder].source.recording
            _event("progress", recording=recording, phase=phase, done=done, total=total)

    def show_ended(self, outcome: "Outcome") -> None:
        """Write the outcome of a recording."""
        summary = outcome.summary
        _event(
            "ended",
            recording=outcome.job.name,
            folder=outcome.job.place,
            state="failed" if summary is None else "complete",
            seconds=None if summary is None else round(summary.seconds, 3),
            processed=None if summary is None else summary.processed,
            exit_code=outcome.code,
            message=outcome.message or None,
            warnings=None if summary is None else list(summary.warnings) or None,
            complete=self.complete,
            failed=self.failed,
            of=len(self.tasks),
        )


def _event(event: str, **values: Any) -> None:
    """Write an event without the values that are None."""
    present = {name: value for name, value in values.items() if value is not None}
    click.echo(json.dumps({"event": event, **present}), err=True)


class LiveProgress(Progress):
    """Bars on a terminal: one for the batch, one for each running recording."""

    def __init__(self, tasks: Sequence["Task"]) -> None:
        """Prepare the bars."""
        super().__init__(tasks)
        self._bars: dict[str, Any] = {}
        self._rich = rich_progress()
        self._batch_bar = (
            self._rich.add_task("recordings", total=len(tasks)) if len(tasks) > 1 else None
        )

    def __enter__(self) -> Self:
        self._rich.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Remove the bars."""
        self._rich.stop()

    def plan(self, text: str) -> None:
        """Show the plan above the bars."""
        self.note(text)

    def note(self, text: str) -> None:
        """Show a line above the bars."""
        self._rich.console.print(printable(text), markup=False, highlight=False, soft_wrap=True)

    def show(self, folder: str) -> None:
        """Move the bar of a recording, which starts again in each phase."""
        phase, done, total = self.running[folder]
        words = PHASES.get(phase, phase)
        text = words if self._batch_bar is None else f"{folder}: {words}"
        bar = self._bars.get(folder)
        if bar is None:
            bar = self._bars[folder] = self._rich.add_task(text, total=total)
        self._rich.update(bar, description=text, completed=done, total=total)

    def show_ended(self, outcome: "Outcome") -> None:
        """Remove the bar of a recording; print its error or warnings."""
        bar = self._bars.pop(outcome.job.folder.name, None)
        if bar is not None:
            self._rich.remove_task(bar)
        if self._batch_bar is not None:
            self._rich.update(self._batch_bar, completed=self.complete + self.failed)
        super().show_ended(outcome)


KINDS: dict[str, type[Progress]] = {
    "rich": LiveProgress,
    "plain": PlainProgress,
    "jsonl": JsonProgress,
    "none": Progress,
}


def open_progress(kind: str, tasks: Sequence["Task"]) -> Progress:
    """Return a progress display; ``auto`` is bars on a terminal and plain lines elsewhere."""
    if kind == "auto":
        kind = "rich" if sys.stderr.isatty() else "plain"
    return KINDS[kind](tasks)
