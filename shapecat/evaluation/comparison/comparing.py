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
from shapecat.runs.run_info import Options
from shapecat.runs.selection import read_frames
from shapecat.runs.tables.reading import Key
from shapecat.system.progress import Observer, ignore, observed
from shapecat.types import UNKNOWN, Frame

__all__ = ["Comparison", "compare"]

_PICTURES = 12  # maximum number: one for each of as many equal parts of the run
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
    rows : one for each true object and each unmatched detection of each compared frame.
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
    RecordingError : the reference cannot be read, is for images of another size, or has no frame in
        common with the run; or ``recording`` cannot be opened.
    """
    finished = read_complete(folder)
    other = open_reference(
        reference, finished.categories, finished.name, finished.info["input"]["digest"]
    )
    if isinstance(other, OtherRun):
        _require_same_recording(finished, other)
    only_run, repeated = 0, repeated_stamps(folder)
    total = int(finished.info["counts"]["frames"])
    with ExitStack() as stack:
        recorded_frames, notes = _recorded_frames(finished, recording, stack)
        compared = _ComparedFrames(recorded_frames)
        labellings = observed(run_labellings(finished), "compare", total, observe)
        for done, (key, row, found) in enumerate(labellings):
            place = (row["topic"], row["stamp_ns"])
            true = other.at(key, row["stamp_ns"], repeated=place in repeated)
            if true is None:
                only_run += 1
            else:
                compared.add(key, row["stamp_ns"], found, true, done * _PICTURES // total)
    tally, categories = compared.tally, finished.info["model"]["categories"]
    if not tally.frames:
        raise RecordingError(_nothing_in_common(finished, reference, other))
    notes += numbering_notes(other, finished.info["options"]["start_s"])
    notes += _doubts(tally.rows, reference)
    notes += _categories_left_out(tally, categories)
    return Comparison(
        run=str(folder),
        reference=str(reference),
        kind=other.kind,
        figures={
            "frames": {
                "compared": tally.frames,
                "only_in_run": only_run,
                "only_in_reference": max(other.frames - tally.frames, 0),
            },
            **figures_of(tally, categories, tracked=other.tracked),
        },
        rows=tuple(tally.rows),
        pictures=compared.pictures(),
        notes=tuple(notes),
    )


def _require_same_recording(finished: FinishedRun, other: OtherRun) -> None:
    a, b = finished.info["input"], other.finished.info["input"]
    if a["digest"] != b["digest"]:
        msg = f"{other.finished.folder}: a run of another recording, {b['path']}, not {a['path']}"
        raise OutputError(msg)


def _nothing_in_common(finished: FinishedRun, reference: Path, other: Reference[Any]) -> str:
    stamps = [row["stamp_ns"] for _, row, _ in run_labellings(finished)]
    topics = ", ".join(finished.info["options"]["topics"])
    own = f"stamps {min(stamps)} to {max(stamps)} of {topics}" if stamps else "none"
    return (
        f"{reference}: no frame in common with {finished.folder}: it has "
        f"{other.describe_frames()}, the run {own}; is it from another recording?"
    )


def _doubts(rows: Sequence[Difference], reference: Path) -> list[str]:
    """Return a list with a note if the reference may be from another recording.

    Then run and reference both have unmatched objects, but hardly any matched ones.
    """
    found, true = (Counter(row.difference for row in rows)[kind] for kind in ("surplus", "missed"))
    matched = len(rows) - found - true
    if not min(found, true) or matched >= _DOUBTFUL * (matched + min(found, true)):
        return []
    note = (
        f"Hardly any object matches: is {reference} from the same recording? Labels of images "
        "must be of its depth images (--format coco --depth)."
    )
    return [note]


def _categories_left_out(tally: Tally, categories: Sequence[str]) -> list[str]:
    """Return a list with a note if the model lacks the category of any matched true object.

    *unknown* does not count.
    """
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
        return (frame for frame, _ in read_frames(source, options)), []
    except (RecordingError, OutputError) as error:
        if recording is not None:
            raise
        return iter(()), [f"The pictures lack depth: {error}"]


class _ComparedFrames:
    """Counts over the compared frames, and a picture of each part of the run.

    Attributes
    ----------
    tally : the counts.
    """

    def __init__(self, recorded_frames: Iterator[Frame]) -> None:
        """Begin with the frames of the recording, whose depth the pictures show."""
        self.tally = Tally()
        self._recorded_frames = recorded_frames
        self._last_tracks: dict[int, int] = {}  # by true track, the track last matched with it
        self._worst: dict[int, tuple[float, DifferenceImage]] = {}  # by part, with its severity

    def pictures(self) -> tuple[DifferenceImage, ...]:
        """Return pictures of the frames that differ most, in the order of the run."""
        return tuple(self._worst[part][1] for part in sorted(self._worst))

    def add(self, key: Key, stamp_ns: int, found: Labelling, true: Labelling, part: int) -> None:
        """Match the objects of a frame, and count agreements and differences.

        Keep a picture of the frame if it differs more than all earlier frames in its part of the
        run, number ``part``.

        Raises
        ------
        RecordingError : the labels are for an image of another size.
        """
        frame = next((f for f in self._recorded_frames if (f.topic, f.index) == key), None)
        _require_same_size(found, true, frame, key)
        found = labelled_part(found, true)
        matched = match_objects(found.items, true.items)
        rows = list(self._rows((*key, stamp_ns), found.items, true.items, matched))
        self.tally.add(found.items, true.items, matched, rows)
        differing = sum(row.difference is not None for row in rows)
        severity = differing + 1 - float(np.mean([row.iou or 0 for row in rows] or [1]))
        if differing and (part not in self._worst or severity > self._worst[part][0]):
            picture = draw_frame(key, frame, found, true, matched.pairs, rows)
            if picture is not None:
                self._worst[part] = severity, picture

    def _rows(
        self,
        head: tuple[str, int, int],
        found: Sequence[LabelledItem],
        true: Sequence[LabelledItem],
        matched: Matched,
    ) -> Iterator[Difference]:
        """Yield the rows of a frame: matched pairs and surplus objects, then missed objects.

        ``head`` is the topic, the number and the timestamp of the frame.
        """
        for i, a in enumerate(found):
            if i not in matched.pairs:
                yield Difference(
                    *head, "surplus", track=a.track, category=a.category, confidence=a.confidence
                )
                continue
            b, j = true[matched.pairs[i]], matched.pairs[i]
            f = None if matched.f is None else float(matched.f[i, j])
            yield Difference(
                *head,
                _difference(a, b, f, switched=self._follow(a, b)),
                true_track=b.track,
                true_category=b.category,
                track=a.track,
                category=a.category,
                confidence=a.confidence,
                f=f,
                iou=None if f is None else float(matched.similarity[i, j]),
                box_iou=item_box_iou(a, b),
            )
        for j, b in enumerate(true):
            if j not in matched.pairs.values():
                yield Difference(*head, "missed", true_track=b.track, true_category=b.category)

    def _follow(self, a: LabelledItem, b: LabelledItem) -> bool:
        """Note which track the true object ``b`` has now; return whether it had another before."""
        if a.track is None or b.track is None:
            return False
        before = self._last_tracks.get(b.track, a.track)
        self._last_tracks[b.track] = a.track
        return before != a.track


def _difference(a: LabelledItem, b: LabelledItem, f: float | None, *, switched: bool) -> str | None:
    """Return the most serious difference of a pair, None if there is none.

    ``a`` is the found object, ``b`` the true one, ``f`` the overlap F of their masks; ``switched``
    says whether ``b`` had another track before.
    """
    if b.decidable and a.category != b.category:
        return "category"
    if switched:
        return "identity"
    return "outline" if f is not None and f < MATCHED_F else None


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
