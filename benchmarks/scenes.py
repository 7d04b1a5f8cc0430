"""Frames for the benchmarks: simulated scenes and, if available, real tables."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.pipeline import process
from shapecat.recordings import FrameRange, choose_streams, frames, open_recording
from shapecat.runs.jobs import Job
from shapecat.simulation import KINECT, Sensor, World, make_scene, render_frame, simulate
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.simulation.scenes.worlds import FIRST_OBJECT_LABEL
from shapecat.types import Frame, Scene

Array = NDArray[Any]
SHARED = Path(__file__).parents[2] / "shared" / "data"
SEEN_PIXELS = 250
"""Objects with fewer depth pixels are not expected to be found."""


class Labelled(NamedTuple):
    """A frame with its pixel labels (h * w,), 0 if unknown, and the labels of each object."""

    frame: Frame
    labels: Array
    objects: list[list[int]]


def simulated_frame(kind: SceneKind, seed: int, sensor: Sensor) -> tuple[World, Frame, Array]:
    """Return a random scene, a frame of it, and the pixel labels (h * w,) of the frame."""
    rng = np.random.default_rng(seed)
    world = make_scene(kind, rng, frames=1)
    frame, labels = render_frame(world, 0, rng=rng, sensor=sensor)
    return world, frame, labels.reshape(-1)


def make_run(folder: Path, **options: Any) -> None:
    """Simulate ``recording.mcap`` in a folder, and process it into ``run``, a folder beside it.

    annotated.mcap and review.rrd are not written; ``options`` are those of `simulate`.
    """
    source = simulate(folder / "recording.mcap", **options)
    process(Job(source, folder / "run", mcap=False, rrd=False))


def object_masks(labels: Array) -> list[Array]:
    """Return the pixel indices (k,) of each simulated object, given the pixel labels (h * w,)."""
    seen = np.unique(labels)
    return [np.flatnonzero(labels == label) for label in seen[seen >= FIRST_OBJECT_LABEL]]


def detected(frame: Frame) -> Scene:
    """Detect objects with the default settings and a fixed seed."""
    return detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0))


def real_tables(every: int = 1) -> Iterator[Frame]:
    """Yield one in ``every`` real Kinect frames of tables; none if the data are missing."""
    path = SHARED / "osd_learn" / "depth.mcap"
    if path.exists():
        with open_recording(path) as recording:
            streams = choose_streams(recording, ())
            yield from frames(recording, streams, FrameRange(every=every))


def labelled_clutter(count: int, first_seed: int = 500) -> Iterator[Labelled]:
    """Yield a Kinect frame of each of ``count`` cluttered tables."""
    for seed in range(first_seed, first_seed + count):
        world, frame, labels = simulated_frame("clutter", seed, KINECT)
        seen = np.bincount(labels, minlength=256)
        objects = [[t.label] for t in world.objects if seen[t.label] >= SEEN_PIXELS]
        yield Labelled(frame, labels, objects)


def labelled_tables() -> list[Labelled]:
    """Return the real frames with their labels; none if the data are missing."""
    folder = SHARED / "osd_learn"
    if not (folder / "labels.npz").exists():
        return []
    with np.load(folder / "labels.npz") as file:
        labels = file["labels"]
    truth = {t["stamp_ns"]: t for t in json.loads((folder / "truth.json").read_text("utf-8"))}
    return [
        Labelled(
            frame,
            labels[truth[frame.stamp_ns]["frame"]].reshape(-1),
            [o["parts"] for o in truth[frame.stamp_ns]["objects"]],
        )
        for frame in real_tables()
        if frame.stamp_ns in truth
    ]
