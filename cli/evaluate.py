"""``shapecat evaluate``."""

from pathlib import Path

import click

from shapecat.outputs.counts import plural

from .options import ANY_PATH, json_option, model_option
from .render import note_off_support, print_json, progress_bars


@click.command()
@click.argument("dataset", type=ANY_PATH)
@model_option
@click.option(
    "--report", "page", type=ANY_PATH, help="Write a report with pictures, as .html or .md."
)
@click.option(
    "--baselines",
    type=ANY_PATH,
    metavar="TRAINING_SET",
    help="Also train shapecat's classifier and the baselines on TRAINING_SET and test them on "
    "DATASET. The two must have no view in common, unless they are the same folder: then shapecat "
    "cross-validates in up to five folds, with all views of an instance in one of them, and each "
    "category needs two instances.",
)
@json_option
def evaluate(
    *, dataset: Path, model: Path | None, page: Path | None, baselines: Path | None, as_json: bool
) -> None:
    """Evaluate a model on labelled views of objects.

    Print accuracy, confusion matrix, calibration error, the AUROC of novelty detection, and the
    accuracy after fusing 3, 10 and 30 views of an instance. DATASET is laid out as for
    `shapecat train`. The model must know every category of DATASET except unknown.

    \b
    --baselines compares these classifiers with shapecat's own:
    forest        random forest on shapecat's descriptor
    linear        logistic regression on shapecat's descriptor
    pnn           probabilistic neural network on shapecat's descriptor
    forest leaves (thesis)
                  linear classifiers on the leaves of a forest (Mueller 2012)
    forest on D2  random forest on the distribution of point distances
    forest on D2, D3, A3 (ESF-like)
                  random forest on distributions of distances, areas and angles

    \b
    shapecat evaluate other-crops --model mine.npz --report page.html
    shapecat evaluate other-crops --model mine.npz --baselines crops
    """
    from shapecat.evaluation import evaluate_folder, format_report
    from shapecat.evaluation.page import write_page
    from shapecat.system.files import require_writable

    if page is not None:
        if page.suffix.lower() not in {".html", ".htm", ".md"}:
            msg = f"--report {page}: name it .html or .md"
            raise click.UsageError(msg)
        require_writable(page)
    with progress_bars() as bars:
        report = evaluate_folder(dataset, model, baselines=baselines, observe=bars)
    note_off_support(report.off_support)
    if page is not None:
        name = dataset.resolve().name  # resolved, so that `.` has a name
        write_page(page, report, title=f"{name}: {plural(report.n, 'view')}")
        click.echo(page, err=True)  # stdout is for the metrics
    if as_json:
        print_json(report.as_dict())
    else:
        click.echo(format_report(report))
