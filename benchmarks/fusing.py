"""Gains and cost of fusing consecutive frames: noise of planes, detection, CPU time."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.measure import cpu_ms, markdown
from benchmarks.overlap import Labelled, score
from benchmarks.scenes import SEEN_PIXELS
from shapecat.config import DetectionSettings
from shapecat.depth_fusion import Earlier, RecentFrames, fuse
from shapecat.detection import detect
from shapecat.simulation import KINECT, REALSENSE, Sensor, World, make_scene, render_frame
from shapecat.simulation.scenes import SceneKind
from shapecat.simulation.truth import frame_truth
from shapecat.types import Frame

Array = NDArray[Any]
FUSED = (1, 3, 5)
RATE_HZ = 10.0
FIRST_SEED = 900
TABLES: tuple[SceneKind, ...] = ("tabletop", "clutter")
MOVING: tuple[SceneKind, ...] = ("crossing", "rearranged")
SENSORS = {"Kinect": KINECT, "RealSense": REALSENSE}


class Shot(NamedTuple):
    """The last frame of a short sequence, its pixel labels (h, w), and the frames before it."""

    world: World
    frame: Frame
    labels: Array
    earlier: tuple[Earlier, ...]

    def fused(self, count: int) -> Frame:
        """Return the frame fused with the preceding ones, ``count`` frames in total."""
        return fuse(self.frame, self.earlier[: count - 1], range_m=2.0)


def shots(
    kinds: tuple[SceneKind, ...],
    count: int,
    *,
    sensor: Sensor = KINECT,
    rests: bool = False,
    lost: tuple[float, int] = (0.0, 1),
) -> Iterator[Shot]:
    """Yield a shot of each of ``count`` scenes of each kind.

    Parameters
    ----------
    rests : whether the camera stands still.
    lost : fraction of the readings that are lost, and the width in pixels of the lost squares.
    """
    for kind, seed in ((k, s) for k in kinds for s in range(FIRST_SEED, FIRST_SEED + count)):
        world = make_scene(kind, np.random.default_rng(seed), frames=30, rate_hz=RATE_HZ)
        if rests:
            world = replace(world, path=world.path[:1] * len(world.path))
        recent, first = RecentFrames(max(FUSED)), 12
        for k in range(first, first + max(FUSED)):
            rng = np.random.default_rng((seed, k))
            frame, labels = render_frame(world, k, rng=rng, sensor=sensor, rate_hz=RATE_HZ)
            frame = _without(frame, *lost, rng)
            earlier = recent.before(frame, world.path[k])
        seen = frame.depth if frame.depth is not None else np.zeros(labels.shape)
        yield Shot(world, frame, np.where(seen > 0, labels, 0), earlier)


def _without(frame: Frame, share: float, width: int, rng: np.random.Generator) -> Frame:
    if frame.depth is None or share == 0:
        return frame
    rows, columns = frame.depth.shape
    failed = rng.random((-(-rows // width), -(-columns // width))) < share
    failed = failed.repeat(width, axis=0).repeat(width, axis=1)[:rows, :columns]
    return replace(frame, depth=np.where(failed, 0, frame.depth))


def run(count: int) -> tuple[str, dict[str, Any]]:
    """Measure on up to ``count`` scenes; return Markdown tables, and the values by name."""
    noise, found, times = _noise(count // 3), _found(count), _times(count // 4)
    title = tuple(f"{k} frames" if k > 1 else "1 frame" for k in FUSED)
    tables = [
        markdown("Noise of tables, mm", ("sensor", *title), [(n, *v) for n, v in noise.items()]),
        markdown(
            "Detection on fused frames",
            ("frames", *(f"{t}, {what}" for t in title for what in ("F", "obj75"))),
            [(n, *(v for s in scores for v in s)) for n, scores in found.items()],
        ),
        markdown("Fusing, ms", ("camera", *title[1:]), [(n, *v) for n, v in times.items()]),
    ]
    return "\n".join(tables), {"noise": noise, "found": found, "times": times}


def _noise(count: int) -> dict[str, list[float]]:
    """Return the noise of the readings of tables perpendicular to the true plane, millimetres.

    It is 1.48 times the median absolute deviation, on which ragged outlines have little effect.
    """
    result = {}
    for name, sensor in SENSORS.items():
        for error, used in (("", sensor), (", no fixed error", replace(sensor, wave=0.0))):
            for rests in (True, False):
                all_shots = list(shots(TABLES, count, sensor=used, rests=rests))
                values = [
                    float(np.median([_deviation(s, k, used) for s in all_shots])) for k in FUSED
                ]
                camera = "rests" if rests else "walks"
                result[f"{name}{error}, camera {camera}"] = [round(v, 2) for v in values]
    return result


def _deviation(shot: Shot, count: int, sensor: Sensor) -> float:
    truth = frame_truth(shot.world, shot.frame.index, shot.labels, sensor)
    table = max(truth.planes, key=lambda plane: (plane["height"] > 0.3, plane["pixels"]))
    seen = np.flatnonzero(shot.labels == table["label"]).astype(np.uint32)
    points = shot.fused(count).xyz(seen)
    away = points[points[:, 2] < 2] @ np.array(table["normal"]) - table["offset"]
    return 1482.6 * float(np.median(np.abs(away - np.median(away))))


def _found(count: int) -> dict[str, list[tuple[float, float]]]:
    """Return F and the fraction of objects found, on single and on fused frames."""
    sets: dict[str, dict[str, Any]] = {
        "tables, camera rests": {"kinds": TABLES, "rests": True},
        "tables, camera walks": {"kinds": TABLES},
        "things that move, camera walks": {"kinds": MOVING},
    }
    for share, width in ((0.1, 1), (0.3, 1), (0.1, 6), (0.3, 6)):
        where = f"{share:.0%} lost" + (f" in squares of {width} px" if width > 1 else "")
        sets[f"tables, camera walks, {where}"] = {"kinds": TABLES, "lost": (share, width)}
    result = {}
    for name, options in sets.items():
        lists: list[list[Labelled]] = [[] for _ in FUSED]
        for shot in shots(options.pop("kinds"), count, **options):
            pixels = np.bincount(shot.labels.reshape(-1), minlength=256)
            things = [[t.label] for t in shot.world.things if pixels[t.label] >= SEEN_PIXELS]
            for frames, k in zip(lists, FUSED, strict=True):
                frames.append(Labelled(shot.fused(k), shot.labels.reshape(-1), things))
        scores = [score(frames, _find) for frames in lists]
        result[name] = [(s["F"], s["obj75"]) for s in scores]
    return result


def _find(frame: Frame) -> list[Array]:
    scene = detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0))
    return [candidate.indices for candidate in scene.candidates]


def _times(count: int) -> dict[str, list[float]]:
    result = {}
    for name, rests in (("rests", True), ("walks", False)):
        all_shots = list(shots(TABLES, count, rests=rests))
        result[name] = [
            round(float(np.median([cpu_ms(partial(s.fused, k)) for s in all_shots])), 1)
            for k in FUSED[1:]
        ]
    return result
