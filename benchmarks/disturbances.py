"""Loss of detection's overlap with the truth on disturbed frames.

    python -m benchmarks.disturbances --first 500 --count 30

Frames are mirrored, rotated, halved in resolution, made noisier, or lose pixels.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import click
import numpy as np
from numpy.random import Generator

from benchmarks.measure import markdown
from benchmarks.overlap import labelled_sets, objects_in, score
from benchmarks.scenes import Array, Labelled
from shapecat.types import Camera, Frame

STEP_PER_M = 0.0029
"""Step of 1/depth of a Kinect, which measures disparity in eighths of a pixel."""

Change = Callable[[Array, Array, Camera, Generator], tuple[Array, Array, Camera]]
"""Changes a depth image (h, w), its labels (h, w) and its camera; may draw random numbers."""


def _mirrored(depth: Array, labels: Array, camera: Camera, _: Generator) -> Any:
    cx = camera.width - 1 - camera.cx
    return depth[:, ::-1], labels[:, ::-1], replace(camera, cx=cx)


def _upside_down(depth: Array, labels: Array, camera: Camera, _: Generator) -> Any:
    cx, cy = camera.width - 1 - camera.cx, camera.height - 1 - camera.cy
    return depth[::-1, ::-1], labels[::-1, ::-1], replace(camera, cx=cx, cy=cy)


def _on_its_side(depth: Array, labels: Array, camera: Camera, _: Generator) -> Any:
    """Rotate counterclockwise: the right column becomes the top row."""
    turned = Camera(
        camera.height, camera.width, camera.fy, camera.fx, camera.cy, camera.width - 1 - camera.cx
    )
    return np.rot90(depth), np.rot90(labels), turned


def _half(depth: Array, labels: Array, camera: Camera, _: Generator) -> Any:
    half = [camera.fx / 2, camera.fy / 2, camera.cx / 2, camera.cy / 2]
    small = depth[::2, ::2]
    return small, labels[::2, ::2], Camera(small.shape[1], small.shape[0], *half)


def _noisier(depth: Array, labels: Array, camera: Camera, rng: Generator) -> Any:
    seen = depth > 0
    nearness = 1 / np.where(seen, depth, 1) + rng.normal(0, STEP_PER_M, depth.shape)
    return np.where(seen, 1 / np.maximum(nearness, 1e-3), 0), labels, camera


def _holed(depth: Array, labels: Array, camera: Camera, rng: Generator) -> Any:
    lost = rng.random(depth.shape) < 0.1
    return np.where(lost, 0, depth), np.where(lost, 0, labels), camera


CHANGES: dict[str, Change] = {
    "mirrored": _mirrored,
    "upside down": _upside_down,
    "on its side": _on_its_side,
    "half resolution": _half,
    "a step of noise": _noisier,
    "a tenth lost": _holed,
}


@click.command(help=__doc__)
@click.option("--first", default=500, show_default=True, help="Seed of the first scene.")
@click.option("--count", default=30, show_default=True, help="Number of simulated scenes.")
def main(*, first: int, count: int) -> None:
    """Score detection on disturbed images, and print a table."""
    sets = labelled_sets(count, first)
    whole = {name: score(frames, objects_in)["F"] for name, frames in sets.items()}
    rows: list[tuple[str, ...]] = [("as they are", *(f"{f:.4f}" for f in whole.values()))]
    for name, change in CHANGES.items():
        changed = {kind: [_changed(f, change) for f in frames] for kind, frames in sets.items()}
        gains = [score(frames, objects_in)["F"] - whole[kind] for kind, frames in changed.items()]
        rows.append((name, *(f"{gain:+.4f}" for gain in gains)))
    print(markdown("Detection, overlap F of changed frames", ("frames", *sets), rows))


def _changed(given: Labelled, change: Change) -> Labelled:
    depth, camera = given.frame.depth, given.frame.camera
    if depth is None or camera is None:
        msg = "a depth image is needed"
        raise ValueError(msg)
    metres = np.nan_to_num(depth)
    labels = given.labels.reshape(metres.shape)
    metres, labels, camera = change(metres, labels, camera, np.random.default_rng(0))
    metres = np.ascontiguousarray(metres, np.float32)
    f = given.frame
    frame = Frame(f.topic, f.index, f.stamp_ns, 0, f.frame_id, depth=metres, camera=camera)
    return Labelled(frame, np.ascontiguousarray(labels).reshape(-1), given.objects)


if __name__ == "__main__":
    main()
