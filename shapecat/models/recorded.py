"""Views of real objects from hand-labelled recordings, for evaluation.

A folder holds ``depth.mcap`` and ``truth.json``, a list with one entry per frame. An entry has the
``stamp_ns`` and ``scene`` of the frame, and its ``objects``. Each object has a ``category`` and a
place. The place is either ``parts``, the values of its pixels in the frame's label image (in
``labels.npz``; 1 to 9 are tables), or ``centroid_m`` and ``extent_m`` in the sensor frame.
"""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.evaluation import View
from shapecat.perception import level_points
from shapecat.recordings import choose_streams, frames, open_recording
from shapecat.types import Frame, Scene

__all__ = ["detected_views"]

_OVERLAP = 0.5
"""Minimum IoU of the masks of a detection and its object."""


def detected_views(folder: Path) -> Iterator[View]:
    """Yield a view of each unambiguous object in each frame of a folder, as detection segments it.

    Missed objects, and those merged with others, are left out.
    """
    path = folder / "labels.npz"
    labels = np.load(path, allow_pickle=False) if path.exists() else None
    images = labels[labels.files[0]] if labels else None
    for number, (frame, truth) in enumerate(_frames(folder)):
        rng = np.random.default_rng((0, number))
        scene = detect(frame, up=None, settings=DetectionSettings(), rng=rng)
        image = None if images is None else images[number].reshape(-1)
        for item in truth["objects"]:
            if item.get("ambiguous", False):
                continue
            match = _nearest(scene, item) if image is None else _best_overlap(scene, image, item)
            if match is None:
                continue
            points, level = level_points(frame, scene, scene.candidates[match])
            name = f"{truth['scene']}_{item.get('label', 0)}"
            yield View(points, level.translation, item["category"], name)


def _frames(folder: Path) -> Iterator[tuple[Frame, dict[str, Any]]]:
    """Yield the frames of a labelled recording, each with its entry in truth.json."""
    truth = json.loads((folder / "truth.json").read_text("utf-8"))
    by_stamp = {entry["stamp_ns"]: entry for entry in truth}
    skipped: Counter[str] = Counter()
    with open_recording(folder / "depth.mcap") as recording:
        for frame in frames(recording, choose_streams(recording, ()), skipped=skipped):
            yield frame, by_stamp[frame.stamp_ns]


def _best_overlap(scene: Scene, image: np.ndarray, item: dict[str, Any]) -> int | None:
    """Return the index of the candidate with the best IoU; None if none reaches `_OVERLAP`.

    ``image`` (h * w,) are the labels of the pixels, ``item`` is the truth of the object.
    """
    of_object = np.isin(image, item["parts"])
    shares = [
        of_object[c.indices].sum() / (of_object.sum() + np.count_nonzero(~of_object[c.indices]))
        for c in scene.candidates
    ]
    return int(np.argmax(shares)) if shares and max(shares) >= _OVERLAP else None


def _nearest(scene: Scene, item: dict[str, Any]) -> int | None:
    """Return the index of the candidate nearest to an object; None if all are too far away.

    ``item`` is the truth of the object. Candidates must be nearer than half of its largest extent.
    """
    place = np.array(item["centroid_m"])
    gaps = [float(np.linalg.norm(c.box.center - place)) for c in scene.candidates]
    max_distance = 0.5 * max(item["extent_m"])
    return int(np.argmin(gaps)) if gaps and min(gaps) < max_distance else None
