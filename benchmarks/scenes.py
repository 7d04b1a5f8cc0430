"""The frames that are measured: simulated clutter, and real sensor data when present."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapecat.recordings import choose_streams, frames, open_recording
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.types import Frame

SHARED = Path(__file__).parents[2] / "shared" / "data"


def simulated_clutter(count: int, first_seed: int = 500) -> Iterator[Frame]:
    """Yield a frame of each of ``count`` cluttered tables."""
    for seed in range(first_seed, first_seed + count):
        rng = np.random.default_rng(seed)
        world = make_scene("clutter", rng, frames=1)
        yield render_frame(world, 0, rng=rng, sensor=KINECT)[0]


def real_tables(every: int = 1) -> Iterator[Frame]:
    """Yield real Kinect frames of tables; none where the data is absent."""
    path = SHARED / "osd_learn" / "depth.mcap"
    if path.exists():
        with open_recording(path) as recording:
            streams = choose_streams(recording, ())
            yield from frames(recording, streams, every=every, skipped=Counter())
