"""Export the labels of runs in the formats of other tools."""

import itertools
import json
import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from shapecat.errors import OutputError
from shapecat.outputs.colouring import PairedFrame, with_colour
from shapecat.outputs.exports.coco import DATASETS
from shapecat.outputs.exports.crops import write_crops
from shapecat.outputs.exports.dataset_frames import (
    DatasetImage,
    ImageSelection,
    image_stems,
    images_of,
    split_runs,
    thinned,
)
from shapecat.outputs.exports.kitti import write_kitti
from shapecat.outputs.exports.labelcloud import write_labelcloud
from shapecat.outputs.exports.points import write_point_labels
from shapecat.outputs.wording import different_names
from shapecat.runs.finished import FinishedRun, open_source
from shapecat.runs.folder import clear, recover, staged
from shapecat.runs.labels.meaning import order_categories
from shapecat.runs.tables.placed_frames import streams_with_poses
from shapecat.system.files import flush, replacing
from shapecat.system.progress import Observer, ignore, observed
from shapecat.types import LabelledFrame

__all__ = [
    "BOX_FORMATS",
    "FORMATS",
    "Exported",
    "common_categories",
    "export_dataset",
    "export_run",
]

Write = Callable[[Path, Iterable[PairedFrame], FinishedRun], int]
"""A function that writes the frames of a run, each with its depth and colour images, into a folder,
and returns the number of objects written."""


@dataclass
class Exported:
    """Counts of an exported data set of images, filled while it is written.

    Attributes
    ----------
    objects : number of objects with a reliable label, summed over all images.
    uncertain : number of the other objects with a mask, except unknown ones.
    images : number of images in each split.
    """

    objects: int = 0
    uncertain: int = 0
    images: Counter[str] = field(default_factory=Counter)


FORMATS: dict[str, Write] = {
    "crops": write_crops,
    "kitti": write_kitti,
    "labelcloud": write_labelcloud,
    "point-labels": write_point_labels,
}
BOX_FORMATS = ("kitti", "labelcloud")
"""Formats with full or visible boxes, as the caller chooses; `cli/export.py` repeats the names."""
_MARK = "export.json"


def export_run(
    finished: FinishedRun,
    format: str,  # noqa: A002  # the word users know
    out: Path,
    *,
    every: int = 1,
    visible_boxes: bool = False,
    categories: Sequence[str] = (),
    recording: Path | None = None,
    observe: Observer = ignore,
) -> int:
    """Export the labels of a finished run with their points.

    Crops are added to the data set ``out``. The other formats are written to ``out/NAME``, where
    NAME is the name of the run folder; only an earlier export is replaced. Frames without a pose in
    the fixed frame are left out if most frames of their topic have one: they have no tracks.

    Parameters
    ----------
    format : a key of `FORMATS`.
    every : export every n-th frame of a stream.
    visible_boxes : whether boxes enclose the visible part of objects instead of the whole.
    categories : those of all runs that are exported together, which then number them alike.
    recording : path of the recording; None means the path where it was processed.
    observe : called with the phase, the number of frames done, and the total.

    Returns
    -------
    The number of objects written, summed over all frames.

    Raises
    ------
    OutputError : the content of the recording has changed, the format cannot hold the labels, or
        ``out`` is not writable, is a run, or holds something else.
    RecordingError : the recording is missing or unreadable.
    """
    _require_no_run(out)
    finished = replace(finished, common=tuple(categories))
    total = int(finished.info["counts"]["frames"])
    with open_source(finished.info, recording) as source:
        full = format in BOX_FORMATS and not visible_boxes
        frames = finished.frames_with_full_boxes() if full else finished.frames()
        labelled = observed(frames, "export", total, observe)
        wanted = _tracked(thinned(labelled, every), streams_with_poses(finished.folder))
        pairs = with_colour(wanted, source, finished.info)
        write = FORMATS[format]
        if format == "crops":
            return write(out, pairs, finished)
        about = {
            "format": format,
            "run": finished.info["id"],
            "input": finished.info["input"],
            "topics": finished.info["options"]["topics"],
            "range_s": [finished.info["options"][name] for name in ("start_s", "end_s")],
        }
        return _staged(out / finished.name, about, lambda hidden: write(hidden, pairs, finished))


def export_dataset(
    runs: Sequence[FinishedRun],
    format: str,  # noqa: A002  # the word users know
    out: Path,
    selection: ImageSelection,
    *,
    recording: Path | None = None,
    observe: Observer = ignore,
) -> Exported:
    """Export the images of several runs with their labels as one data set.

    ``out`` is replaced only if an earlier export wrote it. Damaged images are left out.

    Parameters
    ----------
    format : a key of `DATASETS`.
    recording : path of the recording, for a single run; None means where it was processed.
    observe : called with the phase, the number of frames done, and the total.

    Raises
    ------
    OutputError : a run has no images, no image can be exported, a category has two spellings, a
        recording has changed, or ``out`` is not writable, is a run, or holds something else.
    RecordingError : a recording is missing or unreadable.
    """
    _require_no_run(out)
    gray = [str(run.folder) for run in runs if not (selection.depth or run.info["color"])]
    if gray:
        msg = f"{', '.join(gray)}: no colour images (--depth exports depth images)"
        raise OutputError(msg)
    categories = common_categories(runs)
    names = different_names([run.name for run in runs])
    about = {
        "format": format,
        "runs": {name: run.info["id"] for name, run in zip(names, runs, strict=True)},
        "recordings": sorted({run.info["input"]["digest"] for run in runs}),
    }
    counts = Exported()
    images = _labelled_images(runs, selection, counts, recording, observe)
    objects = _staged(out, about, lambda hidden: DATASETS[format](hidden, images, categories))
    return replace(counts, objects=objects)


def _labelled_images(
    runs: Sequence[FinishedRun],
    selection: ImageSelection,
    counts: Exported,
    recording: Path | None,
    observe: Observer,
) -> Iterator[tuple[str, FinishedRun, DatasetImage]]:
    """Yield images with split and run; count them in ``counts``. Raise `OutputError` if none."""
    total = sum(int(run.info["counts"]["frames"]) for run in runs)
    done, left_out = itertools.count(1), Counter[str]()
    splits = split_runs(runs, selection.val)
    for split, stems, run in zip(splits, image_stems(runs), runs, strict=True):
        for image in images_of(
            run,
            selection,
            recording,
            stems=stems,
            left_out=left_out,
            observe=lambda *_: observe("export", next(done), total),
        ):
            counts.images[split] += 1
            counts.uncertain += sum(not one.sure for one in image.objects)
            yield split, run, image
    if not counts.images:
        reasons = ", ".join(f"{reason} ({count}×)" for reason, count in left_out.items())
        msg = f"no image to export: {reasons or 'no object with a reliable label'}"
        raise OutputError(msg)


def common_categories(runs: Sequence[FinishedRun]) -> tuple[str, ...]:
    """Return the categories of several runs, in an order that depends on their names alone.

    Raises
    ------
    OutputError : two categories differ only in upper and lower case.
    """
    names = order_categories(name for run in runs for name in run.categories)
    spelled: dict[str, str] = {}
    for name in names:
        if spelled.setdefault(name.lower(), name) != name:
            msg = f"the runs spell a category {spelled[name.lower()]!r} and {name!r}; relabel one"
            raise OutputError(msg)
    return names


def _require_no_run(out: Path) -> None:
    if (out / "run.json").exists():
        msg = f"{out}: is a run; choose another --out"
        raise OutputError(msg)


def _staged(target: Path, about: Mapping[str, Any], write: Callable[[Path], int]) -> int:
    """Let ``write`` fill ``target``, which appears when complete; return the number of objects."""
    recover(target, _made_by_export)
    _require_own(target, about)
    with staged(target, _made_by_export) as hidden:
        clear(hidden, _made_by_export(hidden) or ())
        _mark(hidden, about)
        objects = write(hidden)
        for file in hidden.rglob("*"):
            flush(file)
        _mark(hidden, {**about, "objects": objects})
    return objects


def _mark(folder: Path, about: Mapping[str, Any]) -> None:
    """Write export.json, which marks an export: ``about``, and the names in the folder."""
    names = sorted(path.name for path in folder.iterdir() if path.name != _MARK)
    with replacing(folder / _MARK) as path:
        path.write_text(json.dumps({**about, "made": names}, indent=1) + "\n", "utf-8")


def _read_mark(folder: Path) -> dict[str, Any]:
    """Return the content of export.json in a folder; empty if it is missing or invalid."""
    with suppress(OSError, ValueError, TypeError, RecursionError):
        about = json.loads((folder / _MARK).read_text("utf-8"))
        if isinstance(about, dict) and isinstance(about.get("made"), list):
            _covers((0, None), about.get("range_s"))  # fails on wrong types
            _recordings_of(about)  # likewise
            return about
    return {}


def _made_by_export(folder: Path) -> Collection[str] | None:
    """Return the names that an export made in a folder; None if no export made the folder.

    A killed export leaves no complete list: everything in its hidden folder belongs to it.
    """
    about = _read_mark(folder)
    if not about:
        return None
    names = about["made"] if "objects" in about else [path.name for path in folder.iterdir()]
    return [*(Path(str(name)).name for name in names if name != _MARK), _MARK]


def _tracked(frames: Iterable[LabelledFrame], placed: Collection[str]) -> Iterator[LabelledFrame]:
    """Yield the frames, except those without a pose on topics that need one (``placed``)."""
    return (f for f in frames if f.fixed_from_sensor is not None or f.topic not in placed)


def _require_own(target: Path, about: Mapping[str, Any]) -> None:
    """Check that a folder is missing, empty, or an unchanged export that the new one covers.

    Raises
    ------
    OutputError : the folder holds something else, or a file in it was changed, added or removed
        after the export.
    """
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    earlier, format = _read_mark(target), about["format"]  # noqa: A001  # the word users know
    if earlier.get("format") != format:
        previous = earlier.get("format", "something else")
        msg = f"{target}: holds {previous}, not an earlier {format} export; choose another --out"
        raise OutputError(msg)
    if not _recordings_of(earlier) <= _recordings_of(about):
        hint = ", or export all runs together" if format in DATASETS else ""
        previous = f"{target}: holds the {format} export of another recording"
        msg = f"{previous}; choose another --out{hint}"
        raise OutputError(msg)
    if earlier.get("topics") != about.get("topics"):
        msg = f"{target}: holds the {format} export of other topics; choose another --out"
        raise OutputError(msg)
    if not _covers(about.get("range_s"), earlier.get("range_s")):
        msg = f"{target}: holds the {format} export of another time range; choose another --out"
        raise OutputError(msg)
    exported = (target / _MARK).stat().st_mtime_ns
    if later := [path for path in target.rglob("*") if path.lstat().st_mtime_ns > exported]:
        changed = min(later, key=lambda path: (path.is_dir(), path))
        msg = f"{changed}: was changed after the export; choose another --out, or move it away"
        raise OutputError(msg)


def _covers(new: Any, old: Any) -> bool:
    """Return whether the time range ``new`` includes ``old``.

    A range is (start, end) in seconds, where None is the start or end of the recording. The range
    of a data set is None.
    """
    if new is None or old is None:
        return new is old
    (start, end), (old_start, old_end) = (
        (first or 0, math.inf if last is None else last) for first, last in (new, old)
    )
    return start <= old_start and old_end <= end


def _recordings_of(about: Mapping[str, Any]) -> set[str]:
    """Return the digests of the recordings in ``about``, the content of an export.json."""
    source = about.get("input")
    single = [source.get("digest")] if isinstance(source, dict) else []
    return {str(digest) for digest in (*about.get("recordings", ()), *single)}
