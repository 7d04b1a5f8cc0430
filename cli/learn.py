"""``shapecat learn``."""

from pathlib import Path

import click

from shapecat.outputs.counts import plural

from .options import ANY_PATH, json_option, none_if_default, seed_option
from .render import note_skipped, print_json, progress_bars


@click.command()
@click.argument("model", type=ANY_PATH, callback=none_if_default)
@click.argument("dataset", type=ANY_PATH)
@click.option("--out", type=ANY_PATH, required=True, help="Model file to write.")
@click.option("--overwrite", is_flag=True, help="Replace an existing model.")
@seed_option
@json_option
def learn(
    *, model: Path | None, dataset: Path, out: Path, overwrite: bool, seed: int, as_json: bool
) -> None:
    """Add the new categories of a data set to a model.

    MODEL is a model file, or `default` for the model that comes with shapecat. What the model
    has learned about its own categories is kept. DATASET is laid out as for `shapecat train`;
    `shapecat export --format crops` writes such a data set. Views of `unknown` are not used;
    views of categories that the model knows are negative examples.

    \b
    shapecat learn default crops --out mine.npz
    shapecat process lab.mcap --out again --model mine.npz
    """
    from shapecat.evaluation.training import learn_on_folder
    from shapecat.learning import require_model_path

    require_model_path(out, overwrite=overwrite)
    with progress_bars() as bars:
        result = learn_on_folder(model, dataset, out, seed=seed, observe=bars)
    note_skipped(result)
    if as_json:
        print_json(result)
    else:
        views = plural(result["views"], "view")
        click.echo(f"{out}: learned {', '.join(result['added'])} from a data set of {views}")
