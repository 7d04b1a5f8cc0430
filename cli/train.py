"""``shapecat train``."""

from pathlib import Path

import click

from shapecat.outputs.counts import plural

from .options import ANY_PATH, json_option, seed_option
from .render import note_skipped, print_json, progress_bars


@click.command()
@click.argument("dataset", type=ANY_PATH)
@click.option("--out", type=ANY_PATH, required=True, help="Model file to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing model.")
@seed_option
@json_option
def train(*, dataset: Path, out: Path, overwrite: bool, seed: int, as_json: bool) -> None:
    """Train a model on labelled views of objects.

    DATASET holds one file per view, <category>/<instance>/<view>.pcd (or .ply, .npz): the points of
    an object seen from one side, in metres, z up, with the supporting plane at z = 0. The category
    folder `unknown` holds shapes that belong to no category. `shapecat export --format crops`
    writes such a data set.

    \b
    shapecat train crops --out mine.npz
    shapecat process lab.mcap --out results --model mine.npz
    """
    from shapecat.evaluation.training import train_on_folder
    from shapecat.learning import require_model_path

    require_model_path(out, overwrite=overwrite)
    with progress_bars() as bars:
        result = train_on_folder(dataset, out, seed=seed, observe=bars)
    note_skipped(result)
    if not result["calibrated"]:
        click.echo(
            "the confidence is not calibrated: most categories have only one object", err=True
        )
    if as_json:
        print_json(result)
    else:
        click.echo(f"{out}: {plural(result['views'], 'view')} of {', '.join(result['categories'])}")
        held_out = result["held_out"]
        if held_out["n"]:
            click.echo(
                f"trained without {plural(held_out['n'], 'view')} of other objects, it has an "
                f"accuracy of {held_out['accuracy']:.3f} on them"
            )
