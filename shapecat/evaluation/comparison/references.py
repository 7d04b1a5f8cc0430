"""References for comparisons: simulated ground truth, labels of other tools, another run."""

import json
import zipfile
from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from shapecat.arrays import U1
from shapecat.errors import OutputError, RecordingError
from shapecat.evaluation.comparison.labellings import (
    UNREADABLE,
    LabelledItem,
    Labelling,
    Reference,
    finite_box,
)
from shapecat.evaluation.comparison.references_coco import CocoLabels
from shapecat.evaluation.comparison.references_kitti import KittiLabels
from shapecat.evaluation.dataset import DAMAGED
from shapecat.geometry import box_around
from shapecat.runs.finished import FinishedRun, read_finished
from shapecat.runs.folder import read_run
from shapecat.runs.labelled_frames import rows_by_frame
from shapecat.runs.labelled_tracks import LabelledTracks
from shapecat.runs.tables.reading import (
    Key,
    misfit,
    read_row_groups,
    read_stamps,
    read_together,
)
from shapecat.runs.tables.schemas import FULL_BOX
from shapecat.types import Box

__all__ = [
    "OtherRun",
    "SimulatedTruth",
    "open_reference",
    "read_complete",
    "repeated_stamps",
    "run_labellings",
]


def open_reference(
    path: Path, categories: Sequence[str] = (), run: str = "", digest: str = ""
) -> Reference[Any]:
    """Open a reference.

    Parameters
    ----------
    path : a run folder; a KITTI folder, which has a folder ``label_2``; a JSON file of `shapecat
        simulate` or COCO; or a simulated recording with its ground truth beside it.
    categories : categories of the run to compare; they tell which ``_`` in a KITTI type are spaces.
    run, digest : name of the run to compare, and digest of its recording; they select the images of
        a COCO file that has several recordings.

    Raises
    ------
    RecordingError : the path is none of these, or is damaged.
    OutputError : the run is not complete.
    """
    if (path / "run.json").is_file():
        return OtherRun(path)
    if (path / "label_2").is_dir():
        return KittiLabels(path, categories)
    beside = path.parent / f"{path.stem}.truth.json"
    if path.suffix != ".json" and beside.is_file():
        path = beside
    if path.suffix != ".json" or not path.is_file():
        msg = (
            f"{path}: nothing to compare with; expected NAME.truth.json of `shapecat simulate`, "
            "a COCO file, a folder with label_2 (KITTI), or a run"
        )
        raise RecordingError(msg)
    try:
        content = json.loads(path.read_text("utf-8"))
        if isinstance(content, list):
            return SimulatedTruth(path, content)
        return CocoLabels(path, content, run, digest)
    except UNREADABLE as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else error
        msg = f"{path}: neither ground truth of `shapecat simulate` nor COCO labels ({reason})"
        raise RecordingError(msg) from error


class SimulatedTruth(Reference[dict[str, Any]]):
    """Ground truth of `shapecat simulate`: NAME.truth.json and NAME.labels.npz.

    Its ``hidden`` objects, with too few visible pixels, count neither as missed nor as false.
    """

    kind, unit = "ground truth of each pixel", "stamps"

    def __init__(self, path: Path, content: list[dict[str, Any]]) -> None:
        super().__init__(path, (((None, int(entry["stamp_ns"]), None), entry) for entry in content))
        objects = [item for entry in content for item in entry["objects"]]
        self.tracked = bool(objects) and all("track" in item for item in objects)
        labels = path.with_name(f"{path.name.removesuffix('truth.json')}labels.npz")
        self._labels = _LabelImages(labels)

    def labelling(self, entry: dict[str, Any]) -> Labelling:
        """Return the objects of a frame, given its entry in the truth.

        Raises
        ------
        RecordingError : an object lacks a field or has a wrong one, or its image is damaged.
        """
        try:
            return _true_labelling(entry, self._labels.read(int(entry["frame"])))
        except UNREADABLE as error:
            reason = f"lacks {error}" if isinstance(error, KeyError) else f"is damaged ({error})"
            msg = f"{self.path}: the frame with stamp {entry['stamp_ns']} {reason}"
            raise RecordingError(msg) from error


def _true_labelling(entry: Mapping[str, Any], image: U1) -> Labelling:
    """Return the objects of a ground-truth entry, given its label image (h, w)."""
    flat = image.reshape(-1)
    items = (
        LabelledItem(
            track=None if item.get("track") is None else int(item["track"]),
            category=str(item["category"]),
            pixels=np.flatnonzero(np.isin(flat, item["parts"])),
            box=finite_box(**item["box"]) if "box" in item else None,
            decidable=not item["ambiguous"],
        )
        for item in entry["objects"]
    )
    small = [part for item in entry.get("hidden", ()) for part in item["parts"]]
    ignored = np.isin(flat, small)
    size = image.shape[0], image.shape[1]
    return Labelling(tuple(items), (flat > 0) & ~ignored, size, ignored)


class _LabelImages:
    """The label images (h, w), uint8, of a simulated recording, read one by one in order."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next = 0
        try:
            # Closed with this object, which reads frames until then.
            self._file = zipfile.ZipFile(path).open("labels.npy")  # noqa: SIM115
            self._shape = _image_shape(self._file)
        except DAMAGED as error:
            msg = f"{path}: not the labels of a simulated recording ({error})"
            raise RecordingError(msg) from error

    def read(self, index: int) -> U1:
        """Return an image (h, w); reading one before the last one read is slow.

        Raises
        ------
        RecordingError : the file is damaged, or ends before this image.
        """
        _, height, width = self._shape
        size = height * width
        try:
            self._file.seek(self._file.tell() + (index - self._next) * size)
            data = self._file.read(size)
        except DAMAGED as error:
            msg = f"{self._path}: damaged at image {index} ({error})"
            raise RecordingError(msg) from error
        self._next = index + 1
        if index >= self._shape[0] or len(data) < size:
            msg = f"{self._path}: ends before image {index}; simulate the recording again"
            raise RecordingError(msg)
        return np.frombuffer(data, np.uint8).reshape(height, width)


def _image_shape(file: IO[bytes]) -> tuple[int, int, int]:
    """Read the header of an array of images; return their number, height and width.

    Raises
    ------
    ValueError : the array does not hold uint8 images.
    """
    version = np.lib.format.read_magic(file)
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    if version != (1, 0) or len(shape) != 3 or dtype != np.uint8:
        msg = f"expected images of uint8, got {shape} {dtype}"
        raise ValueError(msg)
    return shape[0], shape[1], shape[2]


class OtherRun(Reference[Key]):
    """Another run of the same recording, whose final labels count as the truth."""

    kind, unit, tracked = "another run", "frames with stamps", True

    def __init__(self, folder: Path) -> None:
        self.finished = read_complete(folder)
        super().__init__(
            folder, (((key[0], stamp, key[1]), key) for key, stamp in read_stamps(folder))
        )
        self._rest = run_labellings(self.finished)

    def labelling(self, entry: Key) -> Labelling:
        """Return the objects of a frame of the other run.

        Raises
        ------
        OutputError : the two runs list their frames in different orders.
        """
        for other, _, labelling in self._rest:
            if other == entry:
                return labelling
        msg = f"{self.finished.folder}: its frames are in a different order; process it again"
        raise OutputError(msg)


def repeated_stamps(folder: Path) -> set[tuple[str, int]]:
    """Return each topic and timestamp (ns) that several frames of a run share."""
    counts = Counter((topic, stamp) for (topic, _), stamp in read_stamps(folder))
    return {place for place, count in counts.items() if count > 1}


def read_complete(folder: Path) -> FinishedRun:
    """Read a complete run.

    Raises
    ------
    OutputError : the folder is not a run, or the run is not complete.
    """
    read_run(folder)  # raises if there is no run
    if not (folder / "tracks.parquet").is_file():
        msg = f"{folder}: the run is not complete; run the same command again to resume"
        raise OutputError(msg)
    return read_finished(folder)


def run_labellings(finished: FinishedRun) -> Iterator[tuple[Key, Mapping[str, Any], Labelling]]:
    """Yield the frames of a run in order: topic and number, the frame's table row, its objects.

    A detection without a track keeps its own category. Detections of deleted tracks are left out;
    those of merged tracks are joined if they are in the same frame. Boxes are full boxes if these
    are known, else visible ones.

    Raises
    ------
    OutputError : the tables are damaged or do not fit together.
    """
    folder = finished.folder
    deleted = _deleted(folder, finished.labels)
    names = ("topic", "frame", "detection", "center", "size", "orientation", "indices")
    columns = [*names, *FULL_BOX, "posterior", "category", "confidence"]
    tracks = LabelledTracks.read(folder, finished.labels)
    tables = {"frames": ["topic", "frame", "stamp_ns", "up"], "detections": columns}
    for frames, detections in read_together(folder, tables):
        by_frame = rows_by_frame(detections)
        for row in frames.to_pylist():
            key = (row["topic"], row["frame"])
            remaining = {r["detection"]: r for r in by_frame.get(key, [])}
            items = {}
            for label, rows in tracks.objects(key).items():
                if rows.keys() - remaining.keys():
                    raise misfit(folder)
                parts = [remaining.pop(number) for number in rows]
                full = [tracks.full_box(k) for k in rows.values()]
                items[min(rows)] = _item(label, parts, full, row["up"])
            for number, r in remaining.items():
                if (*key, number) not in deleted:
                    untracked = (None, r["category"], r["confidence"])
                    whole = None if r[FULL_BOX[0]] is None else Box(*(r[n] for n in FULL_BOX))
                    items[number] = _item(untracked, [r], [whole], row["up"])
            yield key, row, Labelling(tuple(items[number] for number in sorted(items)))


def _deleted(folder: Path, labels: Container[int]) -> set[tuple[str, int, int]]:
    """Return (topic, frame, detection) of all detections of tracks that are not in ``labels``."""
    names = ("topic", "frame", "detection", "track")
    deleted = set()
    for group in read_row_groups(folder / "tracks.parquet", names):
        rows = zip(*(group[name].to_pylist() for name in names), strict=True)
        deleted |= {row[:3] for row in rows if row[3] not in labels}
    return deleted


def _item(
    label: tuple[int | None, str, float],
    rows: Sequence[Mapping[str, Any]],
    full: Sequence[Box | None],
    up: Sequence[float],
) -> LabelledItem:
    """Join detections into one object.

    ``label`` is its track, category and confidence; ``rows`` are the detections' rows in the table,
    ``full`` their full boxes, None if unknown; ``up`` (3,) is the up direction. The largest
    detection gives ``view_category``; ``posterior`` is the mean of all detections.
    """
    track, category, confidence = label
    boxes = [
        whole or Box(row["center"], row["size"], row["orientation"])
        for row, whole in zip(rows, full, strict=True)
    ]
    return LabelledItem(
        track=track,
        category=category,
        pixels=np.unique(np.concatenate([row["indices"] for row in rows])).astype(np.int64),
        box=boxes[0] if len(boxes) == 1 else box_around(boxes, up),
        confidence=confidence,
        view_category=max(rows, key=lambda row: len(row["indices"]))["category"],
        posterior=np.mean([row["posterior"] for row in rows], axis=0),
    )
