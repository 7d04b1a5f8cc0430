"""``shapecat train``."""

from pathlib import Path

import click

from .options import ANY_PATH, json_option, seed_option
from .render import print_json, progress_bars


@click.command()
@click.argument("dataset", type=ANY_PATH)
@click.option("--out", type=ANY_PATH, required=True, help="Model file to write.")
@seed_option
@json_option
def train(*, dataset: Path, out: Path, seed: int, as_json: bool) -> None:
    """Learn a model from labelled views of objects.

    DATASET/<category>/<instance>/<view>.pcd (or .ply, .npz): one partial view each, in metres, z
    up, standing on z = 0. A folder named `unknown` holds shapes of no category.

    \b
    shapecat train crops --out mine.npz
    shapecat process lab.mcap --out results --model mine.npz
    """
    from shapecat.evaluation.training import train_on_folder
    from shapecat.system.files import require_writable

    require_writable(out)
    with progress_bars() as bars:
        result = train_on_folder(dataset, out, seed=seed, observe=bars)
    if as_json:
        print_json(result)
    else:
        click.echo(f"{out}: {result['views']} views of {', '.join(result['categories'])}")
