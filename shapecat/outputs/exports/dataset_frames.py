"""Select frames, objects and splits for an image data set."""

import logging
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xxhash

from shapecat.arrays import F8, U1
from shapecat.colour.masks import Mask, dense_masks
from shapecat.colour.snapping import snapped
from shapecat.outputs.colouring import Coloured, with_colour
from shapecat.outputs.exports.points import depth_in_mm
from shapecat.outputs.png import png
from shapecat.outputs.wording import different_names
from shapecat.recordings import MessageError
from shapecat.recordings.decoding.colour_image import encoded, pixels_of
from shapecat.runs.finished import FinishedRun, open_source
from shapecat.system.progress import Observer, ignore, observed
from shapecat.types import UNKNOWN, Frame, LabelledFrame, LabelledObject

__all__ = [
    "DatasetImage",
    "DatasetObject",
    "ImageSelection",
    "image_stems",
    "images_of",
    "snapped_masks",
    "split_runs",
    "thinned",
]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImageSelection:
    """Options of a data set.

    Attributes
    ----------
    every : take every n-th frame of a stream.
    per_track : largest number of views to choose per track, as different as possible; only frames
        with a chosen view are taken. 0 takes all frames.
    min_confidence : objects with a lower confidence are not used for training, unless a person
        labelled their track.
    corrected_only : whether only objects with a label from a person are used for training.
    depth : whether the images are depth images in millimetres instead of colour images.
    val : fraction of the recordings for the validation split, from 0 to below 1.
    """

    every: int = 1
    per_track: int = 0
    min_confidence: float = 0.0
    corrected_only: bool = False
    depth: bool = False
    val: float = 0.2


@dataclass(frozen=True)
class DatasetImage:
    """An image of a data set, and the objects in it.

    ``name`` is the file name with suffix, ``contents`` the content of the file.
    """

    name: str
    contents: bytes
    width: int
    height: int
    labelled: LabelledFrame
    objects: tuple["DatasetObject", ...]


class DatasetObject(NamedTuple):
    """An object, its mask, and whether its label is reliable enough for training (``sure``)."""

    item: LabelledObject
    mask: Mask
    sure: bool


def split_runs(runs: Sequence[FinishedRun], val: float) -> list[str]:
    """Return ``train`` or ``val`` for each run; runs of the same recording are in the same split.

    Recordings are taken for validation in the order of hashes of their content, so that adding runs
    changes few splits. At least one recording goes to the training split.

    Parameters
    ----------
    val : fraction of the recordings for the validation split, from 0 to below 1.
    """
    digests = {run.info["input"]["digest"] or run.name for run in runs}
    order = sorted(digests, key=lambda digest: xxhash.xxh3_64_hexdigest(digest.encode()))
    chosen = set(order[: min(round(val * len(order)), len(order) - 1)])
    return ["val" if (r.info["input"]["digest"] or r.name) in chosen else "train" for r in runs]


def image_stems(runs: Sequence[FinishedRun]) -> list[dict[str, str]]:
    """Return, for each run, the prefix of the image names of each topic; all prefixes differ."""
    names = different_names([run.name for run in runs])
    topics = [run.info["options"]["topics"] for run in runs]
    stems = [
        f"{name}_{topic}" if len(run_topics) > 1 else name
        for name, run_topics in zip(names, topics, strict=True)
        for topic in run_topics
    ]
    different = iter(different_names(stems))
    return [{topic: next(different) for topic in run_topics} for run_topics in topics]


def images_of(
    finished: FinishedRun,
    selection: ImageSelection,
    recording: Path | None = None,
    *,
    stems: Mapping[str, str],
    left_out: Counter[str],
    observe: Observer = ignore,
) -> Iterator[DatasetImage]:
    """Yield the images of a run with at least one object to train on; log damaged images.

    The images also list objects whose label is not reliable, but no unknown objects.

    Parameters
    ----------
    recording : path of the recording; None means the path where it was processed.
    stems : the prefix of the image names of each topic.
    left_out : counter to which selected frames without such an image are added, by reason.
    observe : called after each frame of the run, even if it is left out.

    Raises
    ------
    OutputError : the content of the recording has changed.
    RecordingError : the recording is missing or unreadable.
    """
    corrected = {track for track, label in finished.table.labels.items() if label}
    chosen = _chosen(finished, selection, corrected)
    with open_source(finished.info, recording) as source:
        every = observed(finished.frames(), "export", None, observe)
        frames = (f for f in every if (f.topic, f.index) in chosen)
        for labelled, frame, coloured in with_colour(frames, source, finished.info):
            name = f"{stems[labelled.topic]}_{labelled.index:06d}"
            try:
                image = _image(name, labelled, frame, coloured, selection, corrected)
            except MessageError as error:
                _log.warning("%s: skipped frame %d: %s", finished.name, labelled.index, error)
                left_out["damaged image"] += 1
                continue
            if image is None:
                left_out["no image"] += 1
            elif not any(one.sure for one in image.objects):
                left_out["no object with a reliable label"] += 1
            else:
                yield image


def _is_sure(item: LabelledObject, selection: ImageSelection, corrected: set[int]) -> bool:
    """Return whether the label of an object is reliable enough for training; *unknown* never is.

    ``corrected`` are the numbers of the tracks that a person labelled.
    """
    if item.category == UNKNOWN:
        return False
    certain = item.confidence >= selection.min_confidence and not selection.corrected_only
    return certain or item.track in corrected


def _image(
    name: str,
    labelled: LabelledFrame,
    frame: Frame,
    coloured: Coloured | None,
    selection: ImageSelection,
    corrected: set[int],
) -> DatasetImage | None:
    """Return the image of a frame, named ``name`` with a suffix; None if the frame has no image.

    Raises
    ------
    MessageError : the image is damaged.
    """
    image = _depth_file(labelled, frame) if selection.depth else _colour_file(frame, coloured)
    if image is None:
        return None
    suffix, contents, (height, width), masks = image
    objects = tuple(
        DatasetObject(item, mask, _is_sure(item, selection, corrected))
        for item, mask in zip(labelled.objects, masks, strict=True)
        if mask.pixels.size and item.category != UNKNOWN
    )
    return DatasetImage(f"{name}{suffix}", contents, width, height, labelled, objects)


_File = tuple[str, bytes, tuple[int, int], tuple[Mask, ...]]


def _colour_file(frame: Frame, coloured: Coloured | None) -> _File | None:
    """Return suffix, content, (height, width) and masks of a colour image.

    The result is None without an image, or if the image is the colours of an unorganized cloud.
    """
    if coloured is None or coloured.view.image.height <= 1:
        return None
    image = coloured.view.image
    pixels = pixels_of(image)
    suffix, contents = encoded(image, pixels)
    masks = snapped_masks(frame, coloured, pixels)
    return suffix, contents, (image.height, image.width), masks


def _depth_file(labelled: LabelledFrame, frame: Frame) -> _File | None:
    """Return suffix, content, (height, width) and masks of a depth image; None for a cloud."""
    if frame.depth is None:
        return None
    masks = dense_masks(frame, [item.indices for item in labelled.objects])
    return ".png", png(depth_in_mm(frame.depth), level=4), frame.depth.shape, masks


def snapped_masks(frame: Frame, coloured: Coloured, pixels: U1) -> tuple[Mask, ...]:
    """Return the masks of a frame with outlines moved to edges of its colour image.

    ``pixels`` (h, w, 3) are those of the image.
    """
    lens, camera, scale = coloured.view.lens, frame.camera, 1.0
    if not coloured.view.registered and lens is not None and camera is not None:
        scale = lens.pinhole.fx / camera.fx
    return snapped(coloured.masks, pixels, scale)


def _chosen(
    finished: FinishedRun, selection: ImageSelection, corrected: set[int]
) -> set[tuple[str, int]]:
    """Return topic and number of the frames to export.

    Of the frames that share a colour image, only the nearest to the image in time is exported.
    """
    best: dict[tuple[str, int, int], tuple[int, tuple[str, int], list[tuple[int, F8]]]] = {}
    for labelled in thinned(finished.frames(), selection.every):
        image = None if selection.depth else labelled.masks
        key = (labelled.topic, labelled.index)
        place, apart = (*key, 0), 0
        if image is not None:
            # After a clock is set back, different images may have the same stamp.
            place = (image.topic, image.stamp_ns, image.log_time_ns)
            apart = abs(labelled.stamp_ns - image.stamp_ns)
        if place not in best or apart < best[place][0]:
            sure = (o for o in labelled.objects if _is_sure(o, selection, corrected))
            views = (
                [(o.track, _view_features(labelled, o)) for o in sure]
                if selection.per_track
                else []
            )
            best[place] = apart, key, views
    if not selection.per_track:
        return {key for _, key, _ in best.values()}
    tracks: dict[int, list[tuple[tuple[str, int], F8]]] = {}
    for _, key, views in best.values():
        for track, view in views:
            tracks.setdefault(track, []).append((key, view))
    return {
        rows[k][0]
        for rows in tracks.values()
        for k in _different(np.array([view for _, view in rows]), selection.per_track)
    }


def thinned(frames: Iterable[LabelledFrame], every: int) -> Iterator[LabelledFrame]:
    """Yield every n-th frame of each topic, starting with the first."""
    counts: Counter[str] = Counter()
    for frame in frames:
        if counts[frame.topic] % every == 0:
            yield frame
        counts[frame.topic] += 1


def _view_features(labelled: LabelledFrame, item: LabelledObject) -> F8:
    """Return features (8,) of a view, scaled so that their differences are comparable.

    They are the direction to the sensor (3), in the fixed frame if there is a pose; the logarithms
    of distance and number of pixels; and the sides of the box relative to the longest (3).
    """
    pose, center = labelled.fixed_from_sensor, np.asarray(item.box.center, np.float64)
    distance = float(np.linalg.norm(center))
    way = -center / max(distance, 1e-6)
    way = way if pose is None else pose.rotation @ way
    size = np.asarray(item.box.size, np.float64) / max(float(item.box.size.max()), 1e-6)
    pixels = np.log(max(item.indices.size, 1))
    return np.concatenate([way, [np.log(max(distance, 1e-6)), 0.3 * pixels], 0.5 * size])


def _different(views: F8, count: int) -> list[int]:
    """Return the indices of up to ``count`` views that differ most, by farthest-point sampling.

    ``views`` (n, 8) are from `_view_features`. The view with the most pixels is chosen first.
    """
    chosen = [int(views[:, 4].argmax())]
    apart = np.linalg.norm(views - views[chosen[0]], axis=1)
    while len(chosen) < min(count, len(views)):
        chosen.append(int(apart.argmax()))
        apart = np.minimum(apart, np.linalg.norm(views - views[chosen[-1]], axis=1))
    return chosen
