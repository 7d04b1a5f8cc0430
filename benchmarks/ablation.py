"""What each rule of the detection gains: overlap with the truth, the rules added one by one."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from benchmarks.measure import markdown
from benchmarks.scenes import labelled_clutter, labelled_tables
from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.types import Frame

Array = NDArray[Any]
Finder = Callable[[Frame], list[Array]]
MATCHED = 0.75
"""Overlap F from which an object counts as found."""


class Labelled(NamedTuple):
    """A frame, the pixel labels (h w,) of its things, 0 where unknown, and which are objects."""

    frame: Frame
    labels: Array
    objects: list[list[int]]


def run(count: int) -> tuple[str, dict[str, Any]]:
    """Score every set of rules on the same frames; return a Markdown table and the figures."""
    sets = {
        "simulated clutter": [Labelled(*f) for f in labelled_clutter(count)],
        "real tables": [Labelled(*f) for f in labelled_tables()],
    }
    sets = {name: frames for name, frames in sets.items() if frames}
    figures: dict[str, Any] = {}
    rows = []
    for method, finder in _methods():
        scores = {name: score(frames, finder) for name, frames in sets.items()}
        figures[method] = scores
        rows.append((method, *(v for s in scores.values() for v in (s["F"], s["obj75"]))))
    columns = ("rules", *(f"{name}, {what}" for name in sets for what in ("F", "obj75")))
    return markdown("Detection, overlap with the truth", columns, rows), figures


def _methods() -> Iterator[tuple[str, Finder]]:
    rules = DetectionSettings().rules.split()
    yield "voxels, plane, DBSCAN (Open3D)", _clusters
    yield "plane, height, depth jumps", _with_rules([])
    for k in range(1, len(rules) + 1):
        yield f"+ {rules[k - 1]}", _with_rules(rules[:k])
    for rule in rules:
        yield f"all but {rule}", _with_rules([r for r in rules if r != rule])


def _with_rules(rules: Sequence[str]) -> Finder:
    settings = DetectionSettings(rules=" ".join(rules))

    def find(frame: Frame) -> list[Array]:
        scene = detect(frame, settings=settings, rng=np.random.default_rng(0))
        return [candidate.indices for candidate in scene.candidates]

    return find


def _clusters(frame: Frame) -> list[Array]:
    """Find the largest level plane, and cluster what is above it by distance alone."""
    import open3d as o3d  # noqa: PLC0415  heavy

    points = frame.xyz().astype(np.float64)
    used = np.flatnonzero(points[:, 2] < 2)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[used]))
    low, high = cloud.get_min_bound(), cloud.get_max_bound()
    cloud, _, members = cloud.voxel_down_sample_and_trace(0.01, low, high)
    up = detect(frame, settings=DetectionSettings(rules=""), rng=np.random.default_rng(0)).up
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(20))
    o3d.utility.random.seed(0)
    level = np.flatnonzero(np.abs(np.asarray(cloud.normals) @ up) > 0.95)
    if level.size < 3:
        return []
    (a, b, c, d), _ = cloud.select_by_index(level.tolist()).segment_plane(0.01, 3, 200)
    height = np.sign(d) * (np.asarray(cloud.points) @ [a, b, c] + d)
    above = np.flatnonzero((height > 0.01) & (height < 0.6))
    label = np.asarray(cloud.select_by_index(above.tolist()).cluster_dbscan(0.02, 10))
    return [
        used[np.concatenate([members[k] for k in above[label == n]])]
        for n in range(int(label.max(initial=-1)) + 1)
    ]


def score(frames: Sequence[Labelled], finder: Finder) -> dict[str, float]:
    """Match found and true objects one to one; return the overlap F and the share matched."""
    shared = found = true = hits = objects = 0.0
    for frame, labels, things in frames:
        masks = [np.isin(labels, parts) for parts in things]
        lists = [index[labels[index] > 0] for index in finder(frame)]
        common = np.array([[m[p].sum() for m in masks] for p in lists]).reshape(
            len(lists), len(masks)
        )
        sizes = np.array([p.size for p in lists]), np.array([m.sum() for m in masks])
        overlap = 2 * common / np.maximum(sizes[0][:, None] + sizes[1], 1) if lists else common
        rows, columns = linear_sum_assignment(-overlap)
        shared += common[rows, columns].sum()
        found, true = found + sizes[0].sum(), true + sizes[1].sum()
        hits += np.count_nonzero(overlap[rows, columns] >= MATCHED)
        objects += len(masks)
    return {
        "F": round(2 * shared / max(found + true, 1), 4),
        "obj75": round(hits / max(objects, 1), 4),
        "objects": objects,
    }
