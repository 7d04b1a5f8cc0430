"""``shapecat export``."""

from collections.abc import Sequence
from pathlib import Path

import click

from .options import ANY_PATH, BOXES, BOXES_HELP
from .render import progress_bars

_FORMATS = ("crops", "kitti", "labelcloud", "point-labels")


@click.command()
@click.argument("folders", nargs=-1, required=True, type=ANY_PATH, metavar="DIR...")
@click.option("--format", "kind", type=click.Choice(_FORMATS), required=True, help="See above.")
@click.option("--out", type=ANY_PATH, required=True, help="Crops go to OUT, others to OUT/NAME.")
@click.option("--every", type=click.IntRange(1), default=1, help="Keep only every Nth frame.")
@click.option("--boxes", type=click.Choice(BOXES), default="full", help=BOXES_HELP)
@click.option("--recording", type=ANY_PATH, help="Where the recording is now, if it was moved.")
def export(
    *,
    folders: tuple[Path, ...],
    kind: str,
    out: Path,
    every: int,
    boxes: str,
    recording: Path | None,
) -> None:
    """Write the labels of runs, with their points, for other tools.

    Each DIR is a run, or a folder of runs.

    \b
    crops         views of objects, laid out as for `shapecat train` and `learn`
    kitti         label_2, calib, velodyne
    labelcloud    a project of the labelling tool labelCloud
    point-labels  masks for depth images, SemanticKITTI labels for clouds

    \b
    shapecat export results/lab --format crops --out crops
    shapecat export results --format kitti --out kitti
    """
    from shapecat.outputs.exports import export_run
    from shapecat.outputs.rereading import find_runs

    runs = find_runs(folders)
    if recording is not None and len(runs) > 1:
        msg = f"--recording names the recording of one run, not of {len(runs)}"
        raise click.UsageError(msg)
    if kind != "crops":
        _require_own_names(runs)
    for run in runs:
        with progress_bars() as bars:
            count = export_run(
                run,
                kind,
                out,
                every=every,
                visible_boxes=boxes == "visible",
                recording=recording,
                observe=bars,
            )
        click.echo(f"{run}: {count} objects in {out}")


def _require_own_names(runs: Sequence[Path]) -> None:
    """Refuse runs whose exports would have the same name."""
    from shapecat.errors import OutputError

    names: dict[str, Path] = {}
    for run in runs:
        other = names.setdefault(run.resolve().name, run)
        if other is not run:
            msg = f"{other} and {run} would both be exported as {run.resolve().name}; use two --out"
            raise OutputError(msg)
