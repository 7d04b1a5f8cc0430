"""The labels of a run in the formats of other tools."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from shapecat.errors import OutputError
from shapecat.outputs.exports_crops import write_crops
from shapecat.outputs.exports_kitti import write_kitti
from shapecat.outputs.exports_labelcloud import write_labelcloud
from shapecat.outputs.exports_points import write_point_labels
from shapecat.outputs.rereading import FinishedRun, open_source, read_finished, with_clouds
from shapecat.runs.folder import staged
from shapecat.types import Frame, LabelledFrame

__all__ = ["FORMATS", "export_run"]

Write = Callable[[Path, Iterable[tuple[LabelledFrame, Frame]], FinishedRun], int]
Observer = Callable[[str, int, int | None], None]

FORMATS: dict[str, Write] = {
    "crops": write_crops,
    "kitti": write_kitti,
    "labelcloud": write_labelcloud,
    "point-labels": write_point_labels,
}
_MARK = "export.json"


def _ignore(_phase: str, _done: int, _total: int | None) -> None:
    """Observe nothing."""


def export_run(
    folder: Path,
    format: str,  # noqa: A002  # the word users know
    out: Path,
    *,
    every: int = 1,
    observe: Observer = _ignore,
) -> int:
    """Export the labels of a finished run with the points they belong to.

    Crops are added to the data set ``out``; the other formats make ``out/NAME``, and replace only
    what an earlier export has written there.

    Parameters
    ----------
    every : keep each so-many-th frame of a stream.

    Returns
    -------
    The number of objects written, counted in each frame.

    Raises
    ------
    ValueError : an unknown format.
    OutputError : not a finished run, or ``out`` is not writable or holds something else.
    RecordingError : the recording is no longer there.
    """
    if format not in FORMATS:
        msg = f"no export format {format!r}; known: {', '.join(FORMATS)}"
        raise ValueError(msg)
    finished = read_finished(folder)
    total = -(-int(finished.run["counts"]["frames"]) // every)
    with open_source(finished) as recording:
        chosen = _thinned(finished.frames(), every)
        pairs = _observed(with_clouds(chosen, recording, finished.run), total, observe)
        if format == "crops":
            return write_crops(out, pairs, finished)
        target = out / finished.name
        _require_own(target, format)
        with staged(target) as hidden:
            count = FORMATS[format](hidden, pairs, finished)
            about = {"format": format, "input": finished.run["input"], "objects": count}
            (hidden / _MARK).write_text(json.dumps(about, indent=1) + "\n", "utf-8")
    return count


def _thinned(frames: Iterable[LabelledFrame], every: int) -> Iterator[LabelledFrame]:
    seen: Counter[str] = Counter()
    for frame in frames:
        if seen[frame.topic] % every == 0:
            yield frame
        seen[frame.topic] += 1


def _observed(
    pairs: Iterable[tuple[LabelledFrame, Frame]], total: int, observe: Observer
) -> Iterator[tuple[LabelledFrame, Frame]]:
    for done, pair in enumerate(pairs, start=1):
        yield pair
        observe("export", done, total)


def _require_own(target: Path, format: str) -> None:  # noqa: A002  # the word users know
    """Refuse to replace anything but an earlier export, above all a run."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    try:
        made = json.loads((target / _MARK).read_text("utf-8"))["format"]
    except (OSError, ValueError, KeyError, TypeError):
        made = "something else"
    if made != format:
        msg = f"{target}: holds {made}, not an earlier {format} export; choose another --out"
        raise OutputError(msg)
