"""Computing time of the detection over the number of points (thesis figure 4.8)."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import cpu_ms, markdown
from benchmarks.scenes import simulated_clutter
from shapecat.config import Settings
from shapecat.detection import detect
from shapecat.types import Camera, Frame

POINTS = (5_000, 10_000, 20_000, 40_000, 80_000, 160_000, 300_000)
STRIDES = (8, 6, 4, 3, 2, 1)


def run(count: int, plot: Path) -> tuple[str, dict[str, Any]]:
    """Time clouds and images of each density; return a table and the times, and save a plot."""
    frames = list(simulated_clutter(count))
    figures: dict[str, list[tuple[float, float]]] = {"cloud": [], "depth image": []}
    for points in POINTS:
        figures["cloud"].append(_median([_thinned(frame, points) for frame in frames]))
    for stride in STRIDES:
        figures["depth image"].append(_median([_coarse(frame, stride) for frame in frames]))
    _plot(figures, plot)
    rows = [(kind, round(n), ms) for kind, line in figures.items() for n, ms in line]
    return markdown("Detection, points and CPU time", ("input", "points", "ms"), rows), figures


def _median(frames: list[Frame]) -> tuple[float, float]:
    """Return the median number of points and the median CPU time in ms of the frames."""
    spent = [cpu_ms(partial(_detect, frame), 2) for frame in frames]
    points = [np.count_nonzero(np.isfinite(frame.xyz()[:, 2])) for frame in frames]
    return float(np.median(points)), round(float(np.median(spent)), 3)


def _detect(frame: Frame) -> None:
    detect(frame, settings=Settings().detection, rng=np.random.default_rng(0))


def _thinned(frame: Frame, count: int) -> Frame:
    points = frame.xyz()
    points = points[np.isfinite(points[:, 2])]
    kept = np.random.default_rng(0).permutation(len(points))[:count]
    return Frame(frame.topic, 0, frame.stamp_ns, 0, frame.frame_id, points=points[np.sort(kept)])


def _coarse(frame: Frame, stride: int) -> Frame:
    depth, camera = frame.depth, frame.camera
    if depth is None or camera is None:
        msg = "a depth image is needed"
        raise ValueError(msg)
    depth = np.ascontiguousarray(depth[::stride, ::stride])
    small = Camera(
        depth.shape[1],
        depth.shape[0],
        camera.fx / stride,
        camera.fy / stride,
        camera.cx / stride,
        camera.cy / stride,
    )
    return Frame(frame.topic, 0, frame.stamp_ns, 0, frame.frame_id, depth=depth, camera=small)


def _plot(figures: dict[str, list[tuple[float, float]]], path: Path) -> None:
    import matplotlib as mpl  # noqa: PLC0415  only for the plot

    mpl.use("Agg")
    from matplotlib import pyplot as plt  # noqa: PLC0415  after the backend is chosen

    figure, axes = plt.subplots(figsize=(6, 4))
    for kind, line in figures.items():
        axes.plot(*zip(*line, strict=True), marker="o", label=kind)
    axes.set(xscale="log", xlabel="points of a frame", ylabel="CPU time, ms", ylim=0)
    axes.set_title("Detection, one core")
    axes.grid(visible=True, alpha=0.3)
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
