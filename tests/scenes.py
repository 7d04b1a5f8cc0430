"""A small table with objects and a low-resolution camera: perception at a tenth of the cost."""

from collections.abc import Iterable, Iterator
from functools import cache
from itertools import cycle, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.geometry import LINK_FROM_OPTICAL
from shapecat.simulation import IDEAL, make_scene, render_frame
from shapecat.simulation.containers import CONTAINERS
from shapecat.simulation.messages import MessageFactory
from shapecat.simulation.recorder import robot_links
from shapecat.types import Camera, Frame, Pose
from tests.messages import EPOCH, SECOND

OPTICAL = "camera_depth_optical_frame"
STEP = 4  # keeps every fourth row and column
PERIOD = SECOND // 30  # ns


class View(NamedTuple):
    """Depth (120, 160) in metres, rounded to millimetres, and the pose of the camera."""

    depth: F4
    camera: Camera
    pose: Pose

    def points(self) -> F4:
        """Return the organized cloud (120, 160, 3), NaN where depth is missing."""
        frame = Frame("", 0, 0, 0, "", depth=self.depth, camera=self.camera)
        return frame.xyz().reshape(*self.depth.shape, 3)


@cache
def views(count: int = 4) -> tuple[View, ...]:
    """Return the views of a camera that moves past the table."""
    world = make_scene("tabletop", np.random.default_rng(7), frames=30)
    rendered = []
    for index in range(count):
        rng = np.random.default_rng(index)
        frame, _ = render_frame(world, index, rng=rng, sensor=IDEAL)
        if frame.depth is None or frame.camera is None:
            raise ValueError
        c = frame.camera
        small = Camera(160, 120, c.fx / STEP, c.fy / STEP, c.cx / STEP, c.cy / STEP)
        depth = np.round(frame.depth[::STEP, ::STEP] * 1000) / np.float32(1000)
        rendered.append(View(depth.astype(np.float32), small, world.path[index]))
    return tuple(rendered)


def back_and_forth(frames: int) -> Iterator[View]:
    """Return a number of views of a camera that moves back and forth."""
    forward = views()
    return islice(cycle([*forward, *forward[-2:0:-1]]), frames)


def stream(
    make: MessageFactory, frames: int, *, clouds: bool = False, camera: str = "/camera"
) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, log time and message of a recording of the table."""
    static = [("camera_link", OPTICAL, LINK_FROM_OPTICAL)]
    yield "/tf_static", EPOCH, make.transforms(static, EPOCH)
    for k, view in enumerate(back_and_forth(frames)):
        stamp = EPOCH + k * PERIOD
        yield "/tf", stamp, make.transforms(robot_links(view.pose), stamp)
        if clouds:
            yield f"{camera}/depth/points", stamp, make.cloud(view.points(), stamp, OPTICAL)
        else:
            info = make.camera_info(view.camera, stamp, OPTICAL)
            yield f"{camera}/depth/camera_info", stamp, info
            image = make.image(view.depth, stamp, OPTICAL)
            yield f"{camera}/depth/image_raw", stamp, image


def record(path: Path, frames: int, *, container: str = "mcap", clouds: bool = False) -> Path:
    """Write a recording of the table with the simulator's containers."""
    with CONTAINERS[container].open(path) as writer:
        for topic, time, message in stream(writer.messages, frames, clouds=clouds):
            writer.write(topic, message, time)
    return path


def serialized(
    items: Iterable[tuple[str, int, Any]], make: MessageFactory
) -> Iterator[tuple[str, str, int, bytes]]:
    """Yield topic, type, log time and bytes of each message."""
    for topic, time, message in items:
        yield topic, message.__msgtype__, time, make.serialize(message)
