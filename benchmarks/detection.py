"""Speed of detection compared with Open3D and PCL on the same frames."""

import shutil
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import cpu_ms, markdown, summary
from benchmarks.open3d_clusters import cluster_above_plane
from benchmarks.scenes import labelled_clutter, real_tables
from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.types import Frame

ROUNDS = 8
"""Number of rounds, each with all methods, as the speed of a machine changes within seconds."""
PCL = ("segmentation", "features", "filters", "sample_consensus", "search", "kdtree", "common")
RANGE_M = 2.0
"""Maximum range of all methods, metres."""


def run(count: int) -> str:
    """Time every method on ``count`` simulated frames and on real ones; return a Markdown table."""
    sets = {
        "simulated clutter": [labelled.frame for labelled in labelled_clutter(count)],
        "real tables": list(real_tables(every=max(1, 45 // count))),
    }
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        program = _build_pcl(Path(folder))
        for name, frames in sets.items():
            if not frames:
                continue
            timed = _time_all(frames, program)
            own = timed["shapecat"]["median"]
            rows += [
                (name, method, len(frames), t["median"], t["p95"], f"{t['median'] / own:.1f}")
                for method, t in timed.items()
            ]
    columns = ("frames", "method", "n", "ms, median", "ms, p95", "ratio")
    return markdown("Detection, CPU time per 640×480 frame", columns, rows)


def _time_all(frames: list[Frame], program: Path | None) -> dict[str, dict[str, float]]:
    """Time every method on every frame in rounds; return the `summary` of the best times, in ms."""
    settings = DetectionSettings(max_range_m=RANGE_M)
    ups = [detect(f, settings=settings, rng=np.random.default_rng(0)).up for f in frames]
    loose = [_unorganized(frame) for frame in frames]
    clouds = None if program is None else _write_clouds(program.with_name("clouds"), frames, ups)

    def own(frame: Frame) -> Any:
        return lambda: detect(frame, settings=settings, rng=np.random.default_rng(0))

    best: dict[str, list[float]] = {}
    for _ in range(ROUNDS):
        turn = {
            "shapecat": [cpu_ms(own(frame), 1) for frame in frames],
            "shapecat, unorganized": [cpu_ms(own(frame), 1) for frame in loose],
            "Open3D": _time_open3d(frames, ups),
            **(_time_pcl(program, clouds) if program and clouds else {}),
        }
        for method, values in turn.items():
            best[method] = list(map(min, best.get(method, values), values))
    return {method: summary(values) for method, values in best.items() if values}


def _unorganized(frame: Frame) -> Frame:
    points = frame.finite_xyz()
    return Frame(frame.topic, 0, frame.stamp_ns, 0, frame.frame_id, points=points)


def _time_open3d(frames: list[Frame], ups: list[Any]) -> list[float]:
    """Return the CPU time of Open3D for each frame, ms; none if it is not installed.

    The method is a pass-through filter, 1 cm voxels, a RANSAC plane, and DBSCAN above it.
    """
    try:
        import open3d as o3d  # noqa: PLC0415  may lack its system libraries
    except (ImportError, OSError):
        return []

    def work(points: Any, up: Any) -> Any:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points[points[:, 2] < RANGE_M]))
        return cluster_above_plane(cloud.voxel_down_sample(0.01), up)

    result = []
    for frame, up in zip(frames, ups, strict=True):
        points = frame.finite_xyz().astype(np.float64)
        result.append(cpu_ms(partial(work, points, up), 1))
    return result


def _build_pcl(folder: Path) -> Path | None:
    """Build the PCL program; return its path, or None if PCL or g++ is missing."""
    compiler = shutil.which("g++")
    flags = subprocess.run(
        ["pkg-config", "--cflags-only-I", "pcl_segmentation"],
        capture_output=True,
        text=True,
        check=False,
    )
    if compiler is None or flags.returncode != 0:
        sys.stderr.write("PCL is not installed (apt-get install libpcl-dev): left out\n")
        return None
    program = folder / "pcl_detection"
    source = Path(__file__).with_name("pcl_detection.cpp")
    libraries = [f"-lpcl_{name}" for name in PCL]
    # -march=native would make the alignment of Eigen's types differ from that of the packaged PCL.
    command = [compiler, "-O3", "-mtune=native", "-std=c++17", "-w", str(source)]
    subprocess.run(
        [*command, "-o", str(program), *flags.stdout.split(), *libraries, "-llz4"], check=True
    )
    return program


def _write_clouds(path: Path, frames: list[Frame], ups: list[Any]) -> Path:
    """Write frames and their up directions in the format of the PCL program; return the path."""
    with path.open("wb") as file:
        for frame, up in zip(frames, ups, strict=True):
            height, width = frame.depth.shape if frame.depth is not None else (1, 0)
            file.write(np.array([width, height], np.int32).tobytes())
            file.write(np.asarray(up, np.float32).tobytes())
            file.write(frame.xyz().tobytes())
    return path


def _time_pcl(program: Path, clouds: Path) -> dict[str, list[float]]:
    """Return the times in ms that the PCL program measures, by method."""
    done = subprocess.run(
        [str(program), str(clouds), "1"], capture_output=True, text=True, check=True
    )
    result: dict[str, list[float]] = {}
    for line in done.stdout.splitlines():
        method, _, milliseconds, _ = line.split()
        result.setdefault(f"PCL {method.replace('_', ', ')}", []).append(float(milliseconds))
    return result
