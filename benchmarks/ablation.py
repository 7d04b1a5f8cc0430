"""Ablation of the detection: overlap with the truth as steps are added and removed one by one.

    python -m benchmarks.ablation --first 500 --count 30

The frames are simulated clutter and, if available, real tables.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.measure import markdown, save
from benchmarks.overlap import Array, Finder, labelled_sets, score, with_steps
from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.detection.pipeline import ALL_STEPS, Steps
from shapecat.types import Frame

NO_STEPS = Steps(*[False] * len(Steps._fields))


def run(count: int, first_seed: int = 500) -> tuple[str, dict[str, Any]]:
    """Score every set of steps on the same frames; return a Markdown table and the metrics."""
    sets = labelled_sets(count, first_seed)
    figures: dict[str, Any] = {}
    rows = []
    for method, finder in _methods():
        scores = {name: score(frames, finder) for name, frames in sets.items()}
        figures[method] = scores
        rows.append((method, *(v for s in scores.values() for v in (s["F"], s["obj75"]))))
    columns = ("steps", *(f"{name}, {what}" for name in sets for what in ("F", "obj75")))
    return markdown("Detection, overlap with the truth", columns, rows), figures


def _methods() -> Iterator[tuple[str, Finder]]:
    yield "voxels, plane, DBSCAN (Open3D)", _clusters
    yield "plane, height, depth discontinuities", with_steps(NO_STEPS)
    steps = NO_STEPS
    for name in Steps._fields:
        steps = steps._replace(**{name: True})
        yield f"+ {_words(name)}", with_steps(steps)
    for name in Steps._fields:
        yield f"all but {_words(name)}", with_steps(ALL_STEPS._replace(**{name: False}))


def _words(name: str) -> str:
    return name.replace("_", " ")


def _clusters(frame: Frame) -> list[Array]:
    """Find the largest horizontal plane and cluster the points above it by distance alone."""
    import open3d as o3d  # noqa: PLC0415  heavy

    points = frame.xyz().astype(np.float64)
    used = np.flatnonzero(points[:, 2] < 2)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[used]))
    low, high = cloud.get_min_bound(), cloud.get_max_bound()
    cloud, _, members = cloud.voxel_down_sample_and_trace(0.01, low, high)
    up = detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0)).up
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


@click.command(help=__doc__)
@click.option("--first", default=500, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=30, show_default=True, help="Number of simulated scenes.")
def main(*, first: int, count: int) -> None:
    """Print a table and write ``build/benchmarks_ablation.json``."""
    table, figures = run(count, first)
    print(table)
    save(Path("build/benchmarks_ablation.json"), figures)


if __name__ == "__main__":
    main()
