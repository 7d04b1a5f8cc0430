"""``shapecat export``."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from shapecat.errors import common_exit_code
from shapecat.outputs.counts import plural

from .options import ANY_PATH, boxes_option, recording_option
from .render import for_any_reader, progress_bars

if TYPE_CHECKING:
    from shapecat.runs.finished import FinishedRun

_DATASETS = ("coco", "yolo")
_BOX_FORMATS = ("kitti", "labelcloud")
_FORMATS = (*_DATASETS, "crops", *_BOX_FORMATS, "point-labels")
_NO_VAL = (
    "all frames of a recording go to the same split; export more recordings, or raise --val if "
    "there are several"
)


@click.command()
@click.argument("folders", nargs=-1, required=True, type=ANY_PATH, metavar="DIR...")
@click.option(
    "--format",
    "kind",
    type=click.Choice(_FORMATS),
    required=True,
    help="Format of the export, listed above.",
)
@click.option("--out", type=ANY_PATH, required=True, metavar="OUT", help="Folder for the export.")
@click.option(
    "--every", type=click.IntRange(1), default=1, metavar="N", help="Keep only every Nth frame."
)
@click.option(
    "--per-track",
    type=click.IntRange(0),
    default=0,
    help="coco, yolo: keep only the frames with the N most different views of each track; 0, the "
    "default, keeps all.",
    metavar="N",
)
@click.option(
    "--min-confidence",
    type=click.FloatRange(0, 1),
    default=0.0,
    metavar="CONFIDENCE",
    help="coco, yolo: only objects with at least this confidence, or labelled by a person, "
    "count as reliable. coco marks the others as iscrowd, yolo leaves them out; images without a "
    "reliable object are left out.",
)
@click.option(
    "--corrected-only",
    is_flag=True,
    help="coco, yolo: only objects whose track a person has labelled count as reliable, see "
    "--min-confidence.",
)
@click.option(
    "--depth",
    is_flag=True,
    help="coco, yolo: export 16-bit depth images (millimetres) instead of colour images.",
)
@click.option(
    "--val",
    type=click.FloatRange(0, 1, max_open=True),
    default=0.2,
    show_default=True,
    metavar="FRACTION",
    help="coco, yolo: fraction of the recordings in the validation split.",
)
@boxes_option("kitti, labelcloud: {}; full by default.")
@recording_option
@click.pass_context
def export(
    ctx: click.Context,
    /,
    *,
    folders: tuple[Path, ...],
    kind: str,
    out: Path,
    every: int,
    boxes: str | None,
    recording: Path | None,
    **chosen: Any,
) -> None:
    """Export labels, with images or points, for other tools.

    Each DIR is a run, or a folder of runs. coco, yolo and crops merge all runs into one data set,
    OUT; the other formats write one folder per run, OUT/NAME, named after the run.

    \b
    coco          instance segmentation: images with masks (RLE), boxes and tracks
    yolo          instance segmentation: images with a polygon per object
    crops         points of each object, for `shapecat train` and `learn`
    kitti         3D detection: label_2, calib, velodyne, image_2
    labelcloud    3D boxes to edit by hand in the tool labelCloud
    point-labels  3D segmentation: masks if the run has depth images, labels of
                  points (SemanticKITTI) if it has clouds

    \b
    shapecat export results/lab --format crops --out crops
    shapecat export results --format kitti --out kitti
    shapecat export results --format coco --out coco --min-confidence 0.8
    """
    from shapecat.runs.finished import find_runs, read_finished

    given = [name for name in chosen if ctx.get_parameter_source(name) != ParameterSource.DEFAULT]
    if given and kind not in _DATASETS:
        msg = f"--{given[0].replace('_', '-')} is for --format coco and yolo, not {kind}"
        raise click.UsageError(msg)
    if boxes is not None and kind not in _BOX_FORMATS:
        msg = f"--boxes is for --format {' and '.join(_BOX_FORMATS)}, not {kind}"
        raise click.UsageError(msg)
    found = find_runs(folders)
    if recording is not None and len(found) > 1:
        msg = f"--recording is for a single run, not for {len(found)}"
        raise click.UsageError(msg)
    needs_colour = kind in _DATASETS and not chosen["depth"]
    if len(found) > 1:
        runs, failed = _usable(found, needs_colour=needs_colour)
    else:
        runs, failed = [read_finished(found[0])], False
    if kind in {*_DATASETS, "crops"}:
        _require_distinct_frames(runs)
    else:
        _require_distinct_names(runs)
    if kind in _DATASETS:
        _export_dataset(runs, kind, out, recording, {"every": every, **chosen})
    else:
        visible = boxes == "visible"
        _export_runs(runs, kind, out, every=every, visible_boxes=visible, recording=recording)
    if len(runs) < len(found):
        click.echo(f"skipped {len(found) - len(runs):,} of {plural(len(found), 'run')}", err=True)
    ctx.exit(1 if failed else 0)


def _usable(folders: Sequence[Path], *, needs_colour: bool) -> tuple[list["FinishedRun"], bool]:
    """Return the runs that can be exported, and whether others have errors.

    Print to stderr why runs are skipped; end the command if none is left.
    """
    from shapecat.runs.finished import find_usable

    found, errors = find_usable(folders)
    for error in errors:
        click.echo(f"Error: {error}", err=True)
    gray = [run for run in found if needs_colour and not run.info["color"]]
    for run in gray:
        said = "skipped: no colour images (--depth exports depth images)"
        click.echo(f"{run.folder}: {said}", err=True)
    runs = [run for run in found if run not in gray]
    if not runs:
        click.echo("Error: no run is left to export", err=True)
        codes = {error.exit_code for error in errors}
        raise click.exceptions.Exit(common_exit_code(codes | {1} if gray else codes))
    return runs, bool(errors)


def _export_runs(runs: Sequence["FinishedRun"], kind: str, out: Path, **options: Any) -> None:
    """Export runs one by one."""
    from shapecat.outputs.exports.formats import common_categories, export_run

    categories = common_categories(runs)
    for run in runs:
        with progress_bars() as bars:
            count = export_run(run, kind, out, categories=categories, observe=bars, **options)
        with for_any_reader():
            click.echo(f"{run.folder}: {plural(count, 'labelled view')} in {out}")


def _export_dataset(
    runs: Sequence["FinishedRun"],
    kind: str,
    out: Path,
    recording: Path | None,
    chosen: dict[str, Any],
) -> None:
    """Export runs as one data set; ``chosen`` are the fields of `ImageSelection`."""
    from shapecat.outputs.exports.dataset_frames import ImageSelection
    from shapecat.outputs.exports.formats import export_dataset

    with progress_bars() as bars:
        selection = ImageSelection(**chosen)
        exported = export_dataset(runs, kind, out, selection, recording=recording, observe=bars)
    click.echo(f"{plural(len(runs), 'run')}: {plural(exported.objects, 'labelled view')} in {out}")
    train, val = exported.images["train"], exported.images["val"]
    hint = "" if val or not selection.val else f": {_NO_VAL}"
    click.echo(f"{plural(train, 'image')} in train, {val:,} in val{hint}")
    if kind == "yolo" and exported.uncertain:
        click.echo(
            f"Warning: a model will learn {plural(exported.uncertain, 'visible object')} without a "
            "reliable label as background; the format coco marks such objects as ignored",
            err=True,
        )


def _require_distinct_names(runs: Sequence["FinishedRun"]) -> None:
    """Refuse runs with the same name: their exports would collide."""
    from shapecat.errors import OutputError

    names: dict[str, FinishedRun] = {}
    for run in runs:
        other = names.setdefault(run.name, run)
        if other is not run:
            hint = "export them to different folders (--out)"
            msg = f"{other.folder} and {run.folder} have the same name; {hint}"
            raise OutputError(msg)


def _require_distinct_frames(runs: Sequence["FinishedRun"]) -> None:
    """Refuse runs of the same frames: they would be in the data set twice."""
    from shapecat.errors import OutputError
    from shapecat.outputs.exports.crops import Origin

    origins: dict[Path, Origin] = {}
    for run in runs:
        origin = Origin.of(run)
        for other, earlier in origins.items():
            if origin.shares_frames(earlier):
                both = f"{other} and {run.folder}"
                msg = f"{both} hold the same frames of a recording; export only one"
                raise OutputError(msg)
        origins[run.folder] = origin
