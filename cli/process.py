"""``shapecat process``."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import click

from shapecat.outputs.counts import count_words
from shapecat.system.stopping import Stopped

from .options import (
    PATH_OR_URL,
    SECONDS,
    array_option,
    boxes_option,
    choice_option,
    config_option,
    model_option,
    set_option,
    verbose_option,
)
from .progress import KINDS, Progress, describe_plan, open_progress
from .render import for_any_reader, missed_words, print_json, print_table

_MOST_ROWS = 100


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=PATH_OR_URL, metavar="RECORDING...")
@click.option(
    "--out", required=True, type=PATH_OR_URL, metavar="OUT", help="Folder or URL for the results."
)
@click.option(
    "--topic",
    "topics",
    multiple=True,
    metavar="TOPIC",
    help="Topic of depth images or point clouds; needed if there are several cameras. Repeatable.",
)
@click.option(
    "--up",
    default="auto",
    show_default=True,
    metavar="auto|tf|imu|X,Y,Z",
    help="Up direction: from transforms (tf), an accelerometer (imu), or a vector in the sensor "
    "frame. auto uses transforms, else an accelerometer, else the planes that the camera sees.",
)
@click.option(
    "--fixed-frame",
    metavar="FRAME",
    help="Frame in which objects stand still, such as map or odom; by default shapecat chooses "
    "one.",
)
@click.option("--start", "start_s", type=SECONDS, help="Skip the first SECONDS of a recording.")
@click.option("--end", "end_s", type=SECONDS, help="Stop SECONDS after the start of a recording.")
@click.option(
    "--every", type=click.IntRange(1), default=1, metavar="N", help="Process every Nth frame."
)
@click.option(
    "--jobs",
    type=click.IntRange(1),
    metavar="N",
    help="Number of processes; by default one per core. If there are fewer recordings than "
    "processes, several processes share the frames of one.",
)
@choice_option(
    "--executor",
    ("local", "dask", "ray"),
    "Run the processes on this machine, or with Dask or Ray.",
)
@click.option(
    "--scheduler", metavar="ADDRESS", help="Address of a running Dask scheduler or Ray cluster."
)
@click.option(
    "--shard",
    metavar="I/N",
    help="Process part I of N, for job arrays. Number the jobs 0 to N-1, or 1 to N.",
)
@choice_option(
    "--progress",
    ("auto", *KINDS),
    "Show progress on stderr as bars (rich), plain lines, JSON lines, or not at all. auto "
    "shows bars on a terminal, else plain lines.",
)
@click.option(
    "--color",
    metavar="TOPIC",
    help="Topic of colour images; by default those of the depth camera.",
)
@click.option("--no-color", is_flag=True, help="Do not use colour images.")
@boxes_option("In annotated.mcap, {}; full by default.")
@click.option("--no-mcap", is_flag=True, help="Do not write annotated.mcap.")
@click.option("--no-rrd", is_flag=True, help="Do not write review.rrd.")
@click.option(
    "--overwrite",
    is_flag=True,
    help="Replace earlier results. Corrected labels are transferred to the objects at the same "
    "places. If only settings of tracking or outputs differ, perceived frames are kept.",
)
@click.option("--discard-labels", is_flag=True, help="With --overwrite: drop corrected labels.")
@click.option(
    "--no-fsync", is_flag=True, help="Do not flush files to disk; faster, for scratch folders."
)
@verbose_option
@model_option
@config_option
@set_option
@array_option
@click.pass_context
def process(
    ctx: click.Context,
    /,
    *,
    recordings: tuple[str, ...],
    out: str,
    color: str | None,
    no_color: bool,
    no_mcap: bool,
    no_rrd: bool,
    config: Path | None,
    overrides: tuple[str, ...],
    jobs: int | None,
    executor: str,
    scheduler: str | None,
    shard: str | None,
    no_fsync: bool,
    boxes: str | None,
    progress: str,
    as_json: bool,
    **choices: Any,
) -> None:
    """Find, categorize and track the objects in recordings.

    Each RECORDING is an MCAP file, a ROS 1 bag, a ROS 2 bag (file or folder), a folder with
    recordings, or a URL. The results of lab.mcap go to OUT/lab: tables, annotated.mcap for
    Foxglove, and review.rrd for Rerun. If recordings have the same name, the names of their
    folders are prepended: OUT/monday_lab. For several recordings, OUT/manifest.jsonl records the
    state of each. To resume after an interruption, run the same command again.

    \b
    shapecat process lab.mcap kitchen.bag --out results
    shapecat process log.mcap --out results --topic /head/points --end 30
    shapecat process /data/recordings --out results --jobs 8
    shapecat process /data/recordings --out results --shard 2/16
    """
    # Load these heavy libraries only when there is work, so that --help stays fast.
    from shapecat.batch import exit_code
    from shapecat.batch.plans import plan_batch
    from shapecat.config import load_settings
    from shapecat.runs.jobs import Job
    from shapecat.system.files import FSYNC

    if color is not None and no_color:
        msg = "--color and --no-color contradict each other"
        raise click.UsageError(msg)
    if choices["discard_labels"] and not choices["overwrite"]:
        msg = "--discard-labels needs --overwrite: without it, labels stay with their results"
        raise click.UsageError(msg)
    _require_range(choices["start_s"], choices["end_s"])
    if no_fsync:
        os.environ[FSYNC] = "0"  # which worker processes inherit
    if executor != "local":  # its workers may have another current folder
        recordings, out = tuple(map(_absolute, recordings)), _absolute(out)
        if choices["model"] is not None:
            choices["model"] = choices["model"].absolute()
    chosen = [f"outputs.boxes={boxes}"] if boxes else []
    job = Job(
        source=Path(),
        folder=Path(),
        settings=load_settings(config, (*overrides, *chosen)),
        color="" if no_color else color,
        mcap=not no_mcap,
        rrd=not no_rrd,
        **choices,
    )
    with plan_batch(job, recordings, out, shard=shard) as batch:
        watcher = open_progress(progress, batch.tasks)
        tally = _Tally(keep_all=as_json)
        for outcome in _run(batch, watcher, jobs, executor, scheduler):
            watcher.ended(outcome)
            tally.add(outcome)
    with for_any_reader():
        if as_json:
            print_json([_plain(outcome) for outcome in tally.kept])
        else:
            _print_closing(batch.tasks, tally)
    ctx.exit(exit_code(list(tally.of_each_code.values())))


def _absolute(place: str) -> str:
    """Return an absolute path, or a URL as it is."""
    from shapecat.batch.storage import is_url

    return place if is_url(place) else str(Path(place).absolute())


def _require_range(start_s: float | None, end_s: float | None) -> None:
    """Reject an empty time range."""
    if end_s is not None and end_s <= (start_s or 0):
        msg = f"--end {end_s:g} is not after --start {start_s or 0:g}"
        raise click.UsageError(msg)


def _run(
    batch: Any, watcher: Progress, jobs: int | None, name: str, scheduler: str | None
) -> Iterator[Any]:
    """Process a batch in this process if one is enough, otherwise on an executor."""
    from shapecat.batch import process_here, process_on
    from shapecat.executors import open_executor, share_cores

    report = watcher.progress
    workers, cores = share_cores(jobs, sum(task.status != "complete" for task in batch.tasks))
    if len(batch.tasks) > 1:
        watcher.plan(describe_plan(batch.tasks, batch.left_out, workers, cores))
    if not batch.tasks:
        watcher.plan("no recordings in this shard")
    if name == "local" and scheduler is None and workers <= 1:
        with watcher:
            yield from process_here(batch.tasks, report, cores=cores, manifest=batch.manifest)
        return
    started = open_executor(name, workers=workers, address=scheduler)
    with _closing(started) as executor, watcher:
        if executor.lacks_workers():
            watcher.note("the scheduler has no worker yet: waiting for one")
        yield from process_on(executor, batch.tasks, report, cores=cores, manifest=batch.manifest)


@contextmanager
def _closing(executor: Any) -> Iterator[Any]:
    """Shut the workers down after the work; after a signal, let them stop and save results."""
    try:
        yield executor
    except Stopped:
        executor.stop()
        raise
    except BaseException:
        executor.terminate()
        raise
    executor.shutdown()


class _Tally:
    """Counts of a batch's outcomes, and its first 100 outcomes, or all if ``keep_all``."""

    def __init__(self, *, keep_all: bool) -> None:
        self.complete = self.failed = self.frames = 0
        self.of_each_code: dict[int, Any] = {}
        self.kept: list[Any] = []
        self._most = None if keep_all else _MOST_ROWS

    def add(self, outcome: Any) -> None:
        """Count an outcome."""
        self.of_each_code.setdefault(outcome.code, outcome)
        if outcome.summary is None:
            self.failed += 1
            return
        self.complete += 1
        self.frames += outcome.summary.counts["frames"]
        few = self._most is None or self.complete <= self._most
        if few or outcome.summary.corrections is not None:
            self.kept.append(outcome)


def _print_closing(tasks: Sequence[Any], tally: _Tally) -> None:
    """Print the complete recordings in the order of the plan, if they are few, and totals."""
    ended = {outcome.job.folder.name: outcome for outcome in tally.kept}
    complete = [ended[task.name] for task in tasks if task.name in ended]
    if 0 < tally.complete <= _MOST_ROWS:
        columns = ("recording", "frames", "seconds", "tracks", "results")
        print_table(columns, [_row(outcome) for outcome in complete])
    for outcome in complete:
        if outcome.summary.corrections is not None:
            _print_corrections(outcome)
    if len(tasks) > 1:
        click.echo(f"{tally.complete} complete, {tally.failed} failed, {tally.frames:,} frames")


def _plain(outcome: Any) -> dict[str, Any]:
    """Return the summary of a complete recording as plain values.

    The manifest, which tells what was complete before, has no warnings and not all counts.
    """
    from shapecat.errors import OutputError
    from shapecat.runs.folder import read_run
    from shapecat.runs.jobs import summarize

    summary, job = outcome.summary, outcome.job
    if not summary.processed and not job.target:
        with suppress(OutputError):  # it was removed meanwhile
            summary = summarize(job, read_run(job.folder), processed=False)
    plain: dict[str, Any] = summary.as_dict()
    return plain


def _print_corrections(outcome: Any) -> None:
    """Report the transfer of corrected labels from the replaced results."""
    found = outcome.summary.corrections
    done, missed = len(found["transferred"]), found["not_transferred"]
    name = outcome.job.name.rpartition("/")[2]
    where = outcome.job.target or outcome.summary.folder
    kept = f"; the others are in {where}/tracks.previous.csv" if missed else ""
    text = f"{name}: transferred {done} of {done + len(missed)} corrected labels{kept}"
    click.echo("\n".join((text, *map(missed_words, missed))), err=True)


def _row(outcome: Any) -> tuple[Any, ...]:
    summary = outcome.summary
    counts = summary.counts
    return (
        outcome.job.name.rpartition("/")[2],
        counts["frames"],
        round(summary.seconds, 1) if summary.processed else "already complete",
        count_words(counts["tracks"]),
        outcome.job.target or summary.folder,
    )
