"""Outcomes of ``process``: counts, the table at the end, and transferred labels."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import click

from shapecat.outputs.counts import count_words, plural

from .render import describe_missed, print_table

if TYPE_CHECKING:
    from shapecat.batch.ledger import Outcome
    from shapecat.batch.plans import Task
    from shapecat.runs.jobs import Job, Summary

_MOST_ROWS = 100
"""Maximum number of recordings in the table at the end; with more, there is no table."""
_THREADS = 16
"""Number of threads that read complete runs; at a URL, each run takes a round trip."""


class Outcomes:
    """Counts of the outcomes of a batch, and the complete recordings to print.

    It keeps the first 100 complete recordings, or all if ``keep_all``, and every one whose replaced
    results had corrected labels.
    """

    def __init__(self, *, keep_all: bool) -> None:
        self.complete = self.failed = self.frames = 0
        self.codes: set[int] = set()
        self._kept: list[tuple[Job, Summary]] = []
        self._keep_all = keep_all

    def add(self, outcome: "Outcome") -> None:
        """Count an outcome."""
        self.codes.add(outcome.code)
        summary = outcome.summary
        if summary is None:
            self.failed += 1
            return
        self.complete += 1
        self.frames += summary.counts["frames"]
        if self._keep_all or self.complete <= _MOST_ROWS or summary.corrections is not None:
            self._kept.append((outcome.job, summary))

    def in_order(self, tasks: Sequence["Task"]) -> list[tuple["Job", "Summary"]]:
        """Return the complete recordings to print, in the order of the plan."""
        by_folder = {job.folder.name: (job, summary) for job, summary in self._kept}
        return [by_folder[task.name] for task in tasks if task.name in by_folder]


def print_closing(tasks: Sequence["Task"], tally: Outcomes) -> None:
    """Print complete recordings (if at most 100), transferred labels, and totals (if several)."""
    complete = tally.in_order(tasks)
    if 0 < tally.complete <= _MOST_ROWS:
        columns = ("recording", "frames", "seconds", "tracks", "results")
        print_table(columns, [_row(*each) for each in complete])
    for job, summary in complete:
        _print_corrections(job, summary)
    if len(tasks) > 1:
        click.echo(
            f"{tally.complete} complete, {tally.failed} failed, {plural(tally.frames, 'frame')}"
        )


def summaries_as_dicts(complete: Sequence[tuple["Job", "Summary"]]) -> list[dict[str, Any]]:
    """Return the summaries of complete recordings as plain values.

    If a recording was complete before, its summary is read from its run folder, because the
    manifest lacks warnings and some counts.
    """
    from shapecat.batch.plans import run_of
    from shapecat.errors import OutputError
    from shapecat.runs.jobs import summarize

    def as_dict(job: "Job", summary: "Summary") -> dict[str, Any]:
        if not summary.processed:
            with suppress(OutputError):  # it was removed meanwhile
                summary = summarize(run_of(job), processed=False)
        return {"source": job.name, "folder": job.place, **asdict(summary)}

    with ThreadPoolExecutor(_THREADS) as pool:
        return list(pool.map(lambda each: as_dict(*each), complete))


def _print_corrections(job: "Job", summary: "Summary") -> None:
    """Report the transfer of corrected labels from the replaced results, if there were any."""
    if summary.corrections is None:
        return
    done, missed = (summary.corrections[name] for name in ("transferred", "not_transferred"))
    rest = f"; the others are in {job.place}/tracks.previous.csv" if missed else ""
    counts = f"{len(done)} of {len(done) + len(missed)}"
    text = f"{_short_name(job)}: transferred {counts} corrected labels{rest}"
    click.echo("\n".join((text, *map(describe_missed, missed))), err=True)


def _row(job: "Job", summary: "Summary") -> tuple[Any, ...]:
    return (
        _short_name(job),
        summary.counts["frames"],
        round(summary.seconds, 1) if summary.processed else "already complete",
        count_words(summary.counts["tracks"]),
        job.place,
    )


def _short_name(job: "Job") -> str:
    """Return the name of the recording without folders, and without the query of a URL."""
    from shapecat.batch.storage import names_in

    return names_in(job.origin)[1] if job.origin else job.source.name
