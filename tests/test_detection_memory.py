"""Test of the memory that the detection in one frame needs."""

import numpy as np
import pytest

from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.types import Frame


@pytest.mark.parametrize(("organized", "clouds"), [(True, 2), (False, 8)])
def test_peak_memory_is_few_times_the_cloud(*, organized: bool, clouds: int) -> None:
    """A worker holds several frames at a time; temporary images must not multiply each of them.

    tracemalloc also counts the arrays that compiled kernels allocate.
    """
    tracemalloc = pytest.importorskip("tracemalloc")
    rng = np.random.default_rng(500)
    frame = render_frame(make_scene("clutter", rng, frames=1), 0, rng=rng, sensor=KINECT)[0]
    points = frame.xyz()
    if not organized:
        points = points[np.isfinite(points[:, 2])]
        frame = Frame("t", 0, 0, 0, "c", points=points)
    settings = DetectionSettings()
    assert detect(frame, settings=settings, rng=rng).candidates  # also compiles the kernels

    tracemalloc.start()
    try:
        detect(frame, settings=settings, rng=rng)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()

    assert 0 < peak < clouds * points.nbytes
