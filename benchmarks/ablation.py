"""Ablation of detection: overlap with the truth as steps are added and removed one by one.

    python -m benchmarks.ablation --first 500 --count 30

The frames are simulated clutter and, if available, real tables.
"""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

import click
import numpy as np

from benchmarks.measure import markdown
from benchmarks.open3d_clusters import cluster_above_plane
from benchmarks.overlap import Finder, labelled_sets, objects_in, score
from benchmarks.scenes import Array, detected
from shapecat.detection.depth_grid import DepthGrid
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.detection.segmentation.watershed import NO_EDGE
from shapecat.types import Frame


def _nothing(*_: object) -> None:
    """Do nothing."""


def _no_cell(grid: DepthGrid, *_: object) -> Array:
    """Return a mask (rows, columns) in which no cell belongs to an object."""
    return np.zeros(grid.inverse_depth.shape, bool)


STEPS: dict[str, tuple[str, Any]] = {
    "low profile": ("pipeline.find_low_profile", _no_cell),
    "concavity": ("segmentation.watershed.SEGMENTATION", SEGMENTATION._replace(edge_deg=NO_EDGE)),
    "width split": ("pipeline.split_at_width_changes", lambda *given: given[-1]),
    "learned merging": ("pipeline.learned.merge_learned", _nothing),
    "across occlusion": ("pipeline.merge_across_occluder", _nothing),
    "hole filling": ("pipeline.fill_holes", _nothing),
}
"""Steps beyond the thesis: for each, the attribute of `shapecat.detection` that does it, and the
value that takes its place when the step is left out."""


@contextmanager
def without(*steps: str) -> Iterator[None]:
    """Leave some of the `STEPS` out during the block."""
    with ExitStack() as stack:
        for target, replacement in map(STEPS.__getitem__, steps):
            stack.enter_context(patch(f"shapecat.detection.{target}", replacement))
        yield


def run(count: int, first_seed: int = 500) -> str:
    """Score every set of steps on ``count`` simulated frames and the real ones; return a table."""
    sets = labelled_sets(count, first_seed)
    rows = []
    for method, finder, left_out in _methods():
        with without(*left_out):
            scores = [score(frames, finder) for frames in sets.values()]
        rows.append((method, *(v for s in scores for v in (s["F"], s["obj75"]))))
    columns = ("steps", *(f"{name}, {what}" for name in sets for what in ("F", "obj75")))
    return markdown("Detection, overlap with the truth", columns, rows)


def _methods() -> Iterator[tuple[str, Finder, list[str]]]:
    """Yield the name of each method, its finder, and the steps to leave out."""
    yield "voxels, plane, DBSCAN (Open3D)", _clusters, []
    names = list(STEPS)
    yield "plane, height, depth discontinuities", objects_in, names
    for k, name in enumerate(names, start=1):
        yield f"+ {name}", objects_in, names[k:]
    for name in names:
        yield f"all but {name}", objects_in, [name]


def _clusters(frame: Frame) -> list[Array]:
    """Find the largest horizontal plane; cluster the points above it by distance; a `Finder`."""
    import open3d as o3d  # noqa: PLC0415  heavy

    points = frame.xyz().astype(np.float64)
    used = np.flatnonzero(points[:, 2] < 2)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[used]))
    low, high = cloud.get_min_bound(), cloud.get_max_bound()
    cloud, _, members = cloud.voxel_down_sample_and_trace(0.01, low, high)
    above, label = cluster_above_plane(cloud, detected(frame).up)
    return [
        used[np.concatenate([members[k] for k in above[label == n]])]
        for n in range(int(label.max(initial=-1)) + 1)
    ]


@click.command(help=__doc__)
@click.option("--first", default=500, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=30, show_default=True, help="Number of simulated scenes.")
def main(*, first: int, count: int) -> None:
    """Score detection without each of the steps, and print a table."""
    print(run(count, first))


if __name__ == "__main__":
    main()
