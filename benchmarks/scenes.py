"""Frames for the benchmarks: simulated clutter and, if available, real tables."""

import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapecat.recordings import choose_streams, frames, open_recording
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.types import Frame

SHARED = Path(__file__).parents[2] / "shared" / "data"
SEEN_PIXELS = 250
"""Objects with fewer readings are not expected to be found."""


def simulated_clutter(count: int, first_seed: int = 500) -> Iterator[Frame]:
    """Return a Kinect frame of each of ``count`` cluttered tables."""
    return (frame for frame, _, _ in labelled_clutter(count, first_seed))


def real_tables(every: int = 1) -> Iterator[Frame]:
    """Yield real Kinect frames of tables; none if the data are missing."""
    path = SHARED / "osd_learn" / "depth.mcap"
    if path.exists():
        with open_recording(path) as recording:
            streams = choose_streams(recording, ())
            yield from frames(recording, streams, every=every, skipped=Counter())


def labelled_clutter(
    count: int, first_seed: int = 500
) -> Iterator[tuple[Frame, NDArray[Any], list[list[int]]]]:
    """Yield frames of `simulated_clutter`, pixel labels (h * w,), and each object's labels."""
    for seed in range(first_seed, first_seed + count):
        rng = np.random.default_rng(seed)
        world = make_scene("clutter", rng, frames=1)
        frame, labels = render_frame(world, 0, rng=rng, sensor=KINECT)
        seen = np.bincount(labels.reshape(-1), minlength=256)
        objects = [[t.label] for t in world.objects if seen[t.label] >= SEEN_PIXELS]
        yield frame, labels.reshape(-1), objects


def labelled_tables() -> list[tuple[Frame, NDArray[Any], list[list[int]]]]:
    """Return the real frames with their labels, as `labelled_clutter`; none if data are missing."""
    folder = SHARED / "osd_learn"
    if not (folder / "labels.npz").exists():
        return []
    with np.load(folder / "labels.npz") as file:
        labels = file["labels"]
    truth = {t["stamp_ns"]: t for t in json.loads((folder / "truth.json").read_text("utf-8"))}
    return [
        (
            frame,
            labels[truth[frame.stamp_ns]["frame"]].reshape(-1),
            [o["parts"] for o in truth[frame.stamp_ns]["objects"]],
        )
        for frame in real_tables()
        if frame.stamp_ns in truth
    ]
