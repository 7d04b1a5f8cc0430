"""Test that compiled kernels stay within their arrays, whatever the sensor sends."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ODD_FRAMES = """
import numpy as np
from shapecat.config import Settings
from shapecat.learning import load_model
from shapecat.perception import perceive
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.types import Camera, Frame

settings, model = Settings(), load_model(None)
rng = np.random.default_rng(11)

def see(depth, camera):
    frame = Frame("t", 0, 0, 0, "c", depth=depth.astype(np.float32), camera=camera)
    for each in (frame, Frame("t", 0, 0, 0, "c", points=frame.xyz())):
        perceive(each, up=None, categorizer=model, settings=settings)

for kind in ("pile", "clutter", "shelf", "bin"):
    clean = render_frame(make_scene(kind, rng, frames=1), 0, rng=rng, sensor=KINECT)[0]
    depth = np.array(clean.depth)
    noise = rng.normal(0, 0.1, depth.shape)
    speckled = np.where(rng.random(depth.shape) < 0.5, depth, depth + noise)
    near = np.where(rng.random(depth.shape) < 0.2, rng.uniform(0.1, 0.6, depth.shape), depth)
    for image in (depth, speckled, near, np.where(rng.random(depth.shape) < 0.7, 0, depth)):
        see(np.maximum(image, 0), clean.camera)
for height, width in ((480, 640), (37, 51), (8, 900)):
    camera = Camera(width, height, 525.0, 525.0, width / 2, height / 2)
    see(rng.uniform(0.3, 2.5, (height, width)), camera)
    see(np.full((height, width), np.nan), camera)
"""


@pytest.mark.many
def test_kernels_stay_within_bounds_on_unusual_frames(tmp_path: Path) -> None:
    """Compiled code checks no index; a wrong one corrupts memory far from its cause."""
    checked = {"NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", ODD_FRAMES],
        env={**os.environ, **checked},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
