"""``shapecat export``."""

from pathlib import Path

import click

from .options import ANY_PATH
from .render import progress_bars

_FORMATS = ("crops", "kitti", "labelcloud", "point-labels")


@click.command()
@click.argument("runs", nargs=-1, required=True, type=ANY_PATH, metavar="RUN...")
@click.option("--format", "kind", type=click.Choice(_FORMATS), required=True, help="See above.")
@click.option("--out", type=ANY_PATH, required=True, help="Crops go to OUT, others to OUT/NAME.")
@click.option("--every", type=click.IntRange(1), default=1, help="Keep only every Nth frame.")
def export(*, runs: tuple[Path, ...], kind: str, out: Path, every: int) -> None:
    """Write the labels of runs, with their points, for other tools.

    \b
    crops         views of objects, laid out as for `shapecat train` and `learn`
    kitti         label_2, calib, velodyne
    labelcloud    a project of the labelling tool labelCloud
    point-labels  masks for depth images, SemanticKITTI labels for clouds

    The recordings must be where they were when they were processed.

    \b
    shapecat export results/lab --format crops --out crops
    """
    from shapecat.outputs.exports import export_run

    for run in runs:
        with progress_bars() as bars:
            count = export_run(run, kind, out, every=every, observe=bars)
        click.echo(f"{run}: {count} objects in {out}")
