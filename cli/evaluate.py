"""``shapecat evaluate``."""

from pathlib import Path

import click

from .options import ANY_PATH, json_option, model_option
from .render import print_json, progress_bars


@click.command()
@click.argument("dataset", type=ANY_PATH)
@model_option
@json_option
def evaluate(*, dataset: Path, model: Path | None, as_json: bool) -> None:
    """Measure a model on labelled views: accuracy, confusion, calibration, novelty.

    DATASET is laid out as for `shapecat train`.

    \b
    shapecat evaluate crops --model mine.npz
    """
    from shapecat.evaluation import evaluate_folder, format_report

    with progress_bars() as bars:
        report = evaluate_folder(dataset, model, observe=bars)
    if as_json:
        print_json(report.as_dict())
    else:
        click.echo(format_report(report))
