"""Comparison of a run with ground truth, labels of other tools, or another run."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.errors import OutputError, RecordingError
from shapecat.evaluation.comparison.figures import Tally, figures_of
from shapecat.evaluation.comparison.labellings import (
    LabelledItem,
    Labelling,
    Reference,
    numbering_notes,
)
from shapecat.evaluation.comparison.matching import (
    Difference,
    item_box_iou,
    labelled_part,
    match_objects,
)
from shapecat.evaluation.comparison.overlap import MATCHED_F, Matched
from shapecat.evaluation.comparison.pictures import DifferenceImage, draw_frame
from shapecat.evaluation.comparison.references import (
    OtherRun,
    open_reference,
    read_complete,
    repeated_stamps,
    run_labellings,
)
from shapecat.outputs.counts import plural
from shapecat.runs.finished import FinishedRun, open_source
from shapecat.runs.perceive.selection import read_frames
from shapecat.runs.run_info import Options
from shapecat.runs.tables.reading import Key
from shapecat.system.progress import Observer, ignore, observed
from shapecat.types import UNKNOWN, Frame

__all__ = ["Comparison", "compare"]

_PICTURES = 12
_DOUBTFUL = 0.1
"""If a smaller fraction of the objects matches, the reference may be from another recording."""


@dataclass(frozen=True)
class Comparison:
    """The results of a comparison.

    Attributes
    ----------
    run, reference : their paths.
    kind : kind of the reference, in words.
    figures : metrics by name, as plain values; None if they cannot be computed.
    rows : one for each object of each compared frame.
    pictures : the frames that differ most, in the order of the run.
    notes : remarks for the reader.
    """

    run: str
    reference: str
    kind: str
    figures: Mapping[str, Any]
    rows: tuple[Difference, ...]
    pictures: tuple[DifferenceImage, ...]
    notes: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for ``--json``."""
        kinds = Counter(row.difference for row in self.rows if row.difference)
        head = {"run": self.run, "reference": self.reference, "kind": self.kind}
        return {**head, **self.figures, "differences": dict(kinds), "notes": list(self.notes)}


def compare(
    folder: Path,
    reference: Path,
    *,
    recording: Path | None = None,
    observe: Observer = ignore,
) -> Comparison:
    """Compare a finished run with a reference.

    Parameters
    ----------
    reference : path as for `open_reference`.
    recording : current path of the recording, if it was moved; only the pictures need it.

    Raises
    ------
    OutputError : the folder is not a complete run, or the reference is a run of another recording.
    RecordingError : the reference cannot be read, or has no frame in common with the run.
    """
    finished = read_complete(folder)
    digest = finished.info["input"]["digest"]
    other = open_reference(reference, finished.categories, finished.name, digest)
    if isinstance(other, OtherRun):
        _require_same_recording(finished, other)
    tally, repeated = Tally(), repeated_stamps(folder)
    with ExitStack() as stack:
        recorded_frames, notes = _recorded_frames(finished, recording, stack)
        notes += numbering_notes(other, finished.info["options"]["start_s"])
        total = int(finished.info["counts"]["frames"])
        labellings = observed(run_labellings(finished), "compare", total, observe)
        for done, (key, row, found) in enumerate(labellings):
            place = (row["topic"], row["stamp_ns"])
            true = other.at(key, row["stamp_ns"], repeated=place in repeated)
            if true is None:
                tally.only_run += 1
            else:
                _compare_frame(
                    tally, key, row, found, true, recorded_frames, done * _PICTURES // total
                )
    if not tally.frames:
        raise RecordingError(_nothing_in_common(finished, reference, other))
    if _hardly_matches(tally.rows):
        notes.append(
            f"Hardly any object matches: is {reference} from the same recording? Labels of images "
            "must be of its depth images (--format coco --depth)."
        )
    categories = finished.info["model"]["categories"]
    notes += _categories_left_out(tally, categories)
    return Comparison(
        run=str(folder),
        reference=str(reference),
        kind=other.kind,
        figures={
            "frames": {
                "compared": tally.frames,
                "only_in_run": tally.only_run,
                "only_in_reference": max(other.frames - tally.frames, 0),
            },
            **figures_of(tally, categories, tracked=other.tracked),
        },
        rows=tuple(tally.rows),
        pictures=tuple(tally.pictures[k] for k in sorted(tally.pictures)),
        notes=tuple(notes),
    )


def _require_same_recording(finished: FinishedRun, other: OtherRun) -> None:
    a, b = finished.info["input"], other.finished.info["input"]
    if a["digest"] != b["digest"]:
        msg = f"{other.finished.folder}: a run of another recording, {b['path']}, not {a['path']}"
        raise OutputError(msg)


def _nothing_in_common(finished: FinishedRun, reference: Path, other: Reference[Any]) -> str:
    stamps = [row["stamp_ns"] for _, row, _ in run_labellings(finished)]
    own = f"stamps {min(stamps)} to {max(stamps)}" if stamps else "none"
    return (
        f"{reference}: no frame in common with {finished.folder}: it has "
        f"{other.describe_frames()}, the run {own}; is it from another recording?"
    )


def _hardly_matches(rows: Sequence[Difference]) -> bool:
    """Return whether run and reference both have unmatched objects, but hardly any matched ones."""
    found, true = (Counter(row.difference for row in rows)[kind] for kind in ("surplus", "missed"))
    matched = len(rows) - found - true
    return min(found, true) > 0 and matched < _DOUBTFUL * (matched + min(found, true))


def _categories_left_out(tally: Tally, categories: Sequence[str]) -> list[str]:
    """Return a list with a note if the model lacks the true category of any matched object."""
    others = [pair.truth for pair in tally.pairs if pair.truth not in (*categories, UNKNOWN)]
    if not others:
        return []
    names = ", ".join(sorted(set(others)))
    what = f"{plural(len(others), 'matched object')} of {names}"
    return [f"The metrics of categories leave out {what}: the model has no such category."]


def _recorded_frames(
    finished: FinishedRun, recording: Path | None, stack: ExitStack
) -> tuple[Iterator[Frame], list[str]]:
    """Return the frames of the recording, opened in ``stack``, and an empty list.

    If it cannot be opened, return no frames and a list with a note; but if ``recording`` says where
    it is, raise the error.
    """
    try:
        source = stack.enter_context(open_source(finished.info, recording))
        options: Options = {**finished.info["options"], "color": ""}
        return (frame for frame, _ in read_frames(source, options, skipped=Counter())), []
    except (RecordingError, OutputError) as error:
        if recording is not None:
            raise
        return iter(()), [f"The pictures lack depth: {error}"]


def _compare_frame(
    tally: Tally,
    key: Key,
    row: Mapping[str, Any],
    found: Labelling,
    true: Labelling,
    recorded_frames: Iterator[Frame],
    part: int,
) -> None:
    """Match the objects of a frame, and count agreements and differences in ``tally``.

    ``row`` is the frame's row in the table of the run; ``recorded_frames`` yields the frames of the
    recording. Keep a picture of the frame if it differs more than all earlier frames in its part of
    the run, number ``part``.
    """
    frame = next((f for f in recorded_frames if (f.topic, f.index) == key), None)
    _require_same_size(found, true, frame, key)
    found = labelled_part(found, true)
    matched = match_objects(found.items, true.items)
    rows = list(_differences(tally, key, row["stamp_ns"], found.items, true.items, matched))
    tally.add(found.items, true.items, matched, rows)
    differing = [item for item in rows if item.difference]
    severity = len(differing) + 1 - float(np.mean([item.iou or 0 for item in rows] or [1]))
    best = tally.pictures.get(part)
    if differing and (best is None or severity > best.severity):
        picture = draw_frame(key, frame, found, true, matched.pairs, rows, severity)
        if picture is not None:
            tally.pictures[part] = picture


def _require_same_size(found: Labelling, true: Labelling, frame: Frame | None, key: Key) -> None:
    """Check that the label image has the size of the depth image.

    Without the recording (``frame`` is None), only a label image that is too small is noticed.

    Raises
    ------
    RecordingError : the images differ in size.
    """
    if true.shape is None:
        return
    height, width = true.shape
    size, depth = height * width, None if frame is None else frame.depth
    pixels = [item.pixels for item in found.items if item.pixels is not None and item.pixels.size]
    if depth is not None and depth.shape != true.shape:
        other = f"the depth image has {depth.shape[1]} x {depth.shape[0]}"
    elif any(int(some.max()) >= size for some in pixels):
        other = "the depth image is larger"
    else:
        return
    msg = (
        f"frame {key[1]} of {key[0]}: the labels are for an image of {width} x {height} pixels, "
        f"but {other}: are they from another recording? COCO labels must be of its depth images "
        "(--format coco --depth)"
    )
    raise RecordingError(msg)


def _differences(
    tally: Tally,
    key: Key,
    stamp_ns: int,
    found: Sequence[LabelledItem],
    true: Sequence[LabelledItem],
    matched: Matched,
) -> Iterator[Difference]:
    """Yield the rows of a frame: matched pairs and surplus objects, then missed objects."""
    head = (*key, stamp_ns)
    for i, a in enumerate(found):
        if i not in matched.pairs:
            yield Difference(
                *head, "surplus", track=a.track, category=a.category, confidence=a.confidence
            )
            continue
        b, j = true[matched.pairs[i]], matched.pairs[i]
        f = None if matched.f is None else float(matched.f[i, j])
        iou = None if f is None else float(matched.similarity[i, j])
        kind = _kind(tally, a, b, f)
        yield Difference(
            *head,
            kind,
            true_track=b.track,
            true_category=b.category,
            track=a.track,
            category=a.category,
            confidence=a.confidence,
            f=f,
            iou=iou,
            box_iou=item_box_iou(a, b),
        )
    for j, b in enumerate(true):
        if j not in matched.pairs.values():
            yield Difference(*head, "missed", true_track=b.track, true_category=b.category)


def _kind(tally: Tally, a: LabelledItem, b: LabelledItem, f: float | None) -> str | None:
    """Return the most serious difference of a pair, None if there is none.

    ``a`` is the found object, ``b`` the true one, ``f`` the overlap F of their masks. Notes the
    track of ``a`` in ``tally.last_tracks``.
    """
    switched = False
    if a.track is not None and b.track is not None:
        switched = tally.last_tracks.get(b.track, a.track) != a.track
        tally.last_tracks[b.track] = a.track
    if b.decidable and a.category != b.category:
        return "category"
    if switched:
        return "identity"
    return "outline" if f is not None and f < MATCHED_F else None
