"""``shapecat process``."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

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
from .outcomes import Outcomes, print_closing, summaries_as_dicts
from .progress import KINDS, Progress, describe_plan, open_progress
from .render import for_any_reader, print_json

if TYPE_CHECKING:
    from shapecat.batch.ledger import Outcome
    from shapecat.batch.plans import Batch
    from shapecat.recordings import FrameRange
    from shapecat.runs.jobs import Job


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
    "frame. auto uses transforms, else an accelerometer, else the planes that the camera sees; it "
    "ignores a direction that the planes contradict.",
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
    "processes, several processes share the frames of a recording.",
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
    help="Process only part I of N of the recordings, for job arrays. I may count from 1 or from "
    "0: 0/N is the same part as N/N.",
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
    help="Topic of the colour images for all depth cameras; by default, each has its own.",
)
@click.option("--no-color", is_flag=True, help="Do not use colour images.")
@boxes_option("In annotated.mcap, {}; full by default.")
@click.option("--no-mcap", is_flag=True, help="Do not write annotated.mcap.")
@click.option("--no-rrd", is_flag=True, help="Do not write review.rrd.")
@click.option(
    "--overwrite",
    is_flag=True,
    help="Replace earlier results. Corrected labels of the same recording are transferred to the "
    "objects at the same places. If only `tracking` or `outputs` settings differ, detection is not "
    "repeated.",
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
    jobs: int | None,
    executor: str,
    scheduler: str | None,
    shard: str | None,
    no_fsync: bool,
    progress: str,
    as_json: bool,
    **options: Any,
) -> None:
    """Find, categorize and track the objects in recordings.

    Each RECORDING is an MCAP file, a ROS 1 bag, a ROS 2 bag (file or folder), a folder with
    recordings, or a URL. The results of lab.mcap go to the folder OUT/lab, called a run:
    tables, annotated.mcap for Foxglove, and review.rrd for Rerun. If recordings have the same
    name, the name of their folder is put in front, as in OUT/monday_lab; if that is not enough,
    a number is appended. For several recordings, OUT/manifest.jsonl records the state of each.
    To resume after an interruption, run the same command again.

    \b
    shapecat process lab.mcap kitchen.bag --out results
    shapecat process log.mcap --out results --topic /head/points --end 30
    shapecat process /data/recordings --out results --jobs 8
    shapecat process /data/recordings --out results --shard 2/16
    """
    # Load these heavy libraries only when there is work, so that --help stays fast.
    from shapecat.batch.plans import plan_batch
    from shapecat.errors import common_exit_code
    from shapecat.system.files import FSYNC

    job = _job(**options)
    if no_fsync:
        os.environ[FSYNC] = "0"  # which worker processes inherit
    if executor != "local":  # its workers may have another current folder
        recordings, out = tuple(map(_absolute, recordings)), _absolute(out)
        if job.model is not None:
            job = replace(job, model=job.model.absolute())
    with plan_batch(job, recordings, out, shard=shard) as batch:
        display = open_progress(progress, batch.tasks)
        tally = Outcomes(keep_all=as_json)
        for outcome in _process(batch, display, jobs, executor, scheduler):
            display.ended(outcome)
            tally.add(outcome)
    with for_any_reader():
        if as_json:
            print_json(summaries_as_dicts(tally.in_order(batch.tasks)))
        else:
            print_closing(batch.tasks, tally)
    ctx.exit(common_exit_code(tally.codes))


def _job(
    *,
    start_s: float | None,
    end_s: float | None,
    every: int,
    color: str | None,
    no_color: bool,
    no_mcap: bool,
    no_rrd: bool,
    boxes: str | None,
    config: Path | None,
    overrides: tuple[str, ...],
    **choices: Any,
) -> "Job":
    """Return the job that all recordings have in common; refuse options that contradict others."""
    from shapecat.config import load_settings
    from shapecat.runs.jobs import Job

    if color is not None and no_color:
        msg = "--color and --no-color contradict each other"
        raise click.UsageError(msg)
    if choices["discard_labels"] and not choices["overwrite"]:
        msg = "--discard-labels needs --overwrite: without it, labels stay with their results"
        raise click.UsageError(msg)
    frame_range = _frame_range(start_s, end_s, every)
    if boxes is not None:
        overrides = (*overrides, f"outputs.boxes={boxes}")
    return Job(
        source=Path(),
        folder=Path(),
        settings=load_settings(config, overrides),
        frame_range=frame_range,
        color="" if no_color else color,
        mcap=not no_mcap,
        rrd=not no_rrd,
        **choices,
    )


def _absolute(place: str) -> str:
    """Return an absolute path, or a URL as it is."""
    from shapecat.batch.storage import is_url

    return place if is_url(place) else str(Path(place).absolute())


def _frame_range(start_s: float | None, end_s: float | None, every: int) -> "FrameRange":
    """Return the frames to process; refuse an empty time range."""
    from shapecat.errors import ConfigError
    from shapecat.recordings import FrameRange

    try:
        return FrameRange(start_s, end_s, every)
    except ConfigError:  # each option alone is valid
        msg = f"--end {end_s:g} is not after --start {start_s or 0:g}"
        raise click.UsageError(msg) from None


def _process(
    batch: "Batch", display: Progress, jobs: int | None, name: str, scheduler: str | None
) -> Iterator["Outcome"]:
    """Process a batch in this process if one is enough, otherwise on the executor ``name``."""
    from shapecat.batch.runs import process_here, process_on
    from shapecat.executors import open_executor, share_cores

    tasks, manifest = batch.tasks, batch.manifest
    workers, cores = share_cores(jobs, sum(task.status != "complete" for task in tasks))
    if len(tasks) > 1 or batch.skipped or batch.notes:
        display.plan(describe_plan(tasks, batch.skipped, workers, cores, batch.notes))
    if not tasks:
        display.plan("no recordings in this shard")
    if name == "local" and scheduler is None and workers <= 1:
        with display:
            yield from process_here(tasks, display.progress, cores=cores, manifest=manifest)
        return
    with open_executor(name, workers=workers, address=scheduler) as executor, display:
        if executor.lacks_workers():
            display.note("the scheduler has no worker yet: waiting for one")
        yield from process_on(executor, tasks, display.progress, cores=cores, manifest=manifest)
