"""``shapecat process``."""

from pathlib import Path
from typing import Any

import click

from .options import ANY_PATH, config_option, json_option, model_option, set_option
from .render import count_words, print_json, print_table, progress_bars


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=ANY_PATH)
@click.option("--out", type=ANY_PATH, required=True, help="Results go to OUT/NAME per recording.")
@click.option("--topic", "topics", multiple=True, help="Cloud stream to read. Repeatable.")
@click.option(
    "--up",
    default="auto",
    show_default=True,
    metavar="auto|tf|imu|X,Y,Z",
    help="Where up is: from transforms, an IMU, or a vector in the sensor frame.",
)
@click.option("--fixed-frame", metavar="F", help="Frame in which things stand still.")
@click.option("--start", "start_s", type=float, help="Seconds after the start of the recording.")
@click.option("--end", "end_s", type=float, help="Seconds after the start of the recording.")
@click.option("--every", type=click.IntRange(1), default=1, help="Read only every Nth frame.")
@click.option("--jobs", type=click.IntRange(1), default=1, help="Recordings at the same time.")
@click.option("--no-mcap", is_flag=True, help="Do not write annotated.mcap.")
@click.option("--no-rrd", is_flag=True, help="Do not write review.rrd.")
@click.option("--overwrite", is_flag=True, help="Replace results that are there.")
@model_option
@config_option
@set_option
@json_option
@click.pass_context
def process(
    ctx: click.Context,
    /,
    *,
    recordings: tuple[Path, ...],
    out: Path,
    no_mcap: bool,
    no_rrd: bool,
    config: Path | None,
    overrides: tuple[str, ...],
    jobs: int,
    as_json: bool,
    **choices: Any,
) -> None:
    """Find, categorize and follow the objects in recordings.

    Each RECORDING is an MCAP file, a ROS 1 bag, or a ROS 2 bag (file or folder). The results are
    tables, annotated.mcap for Foxglove, and review.rrd for Rerun.

    \b
    shapecat process lab.mcap kitchen.bag --out results
    shapecat process log.mcap --out results --topic /head/points --end 30
    """
    # The libraries behind take a second to load: only when there is work.
    from shapecat.batch import exit_code, process_many, with_same
    from shapecat.config import load_settings
    from shapecat.jobs import Job

    job = Job(
        source=Path(),
        folder=out,
        settings=load_settings(config, overrides),
        mcap=not no_mcap,
        rrd=not no_rrd,
        **choices,
    )
    outcomes = []
    with progress_bars() as bars:
        for outcome in process_many(with_same(job, recordings, out), workers=jobs, observe=bars):
            bars.restart()
            outcomes.append(outcome)
            if outcome.message:
                click.echo(f"Error: {outcome.message}", err=True)
    summaries = [outcome.summary for outcome in outcomes if outcome.summary]
    if as_json:
        print_json([summary.as_dict() for summary in summaries])
    elif summaries:
        print_table(
            ("recording", "frames", "seconds", "tracks", "results"), [_row(s) for s in summaries]
        )
    ctx.exit(exit_code(outcomes))


def _row(summary: Any) -> tuple[Any, ...]:
    counts = summary.counts
    return (
        summary.source.name,
        counts["frames"],
        round(summary.seconds, 1) if summary.fresh else "was complete",
        count_words(counts["tracks"]),
        summary.folder,
    )
