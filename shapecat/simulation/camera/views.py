"""Simulated depth frames with pixel labels, in memory, for training and evaluation."""

from numpy.random import Generator

from shapecat.arrays import U1
from shapecat.simulation.camera.measuring import measure
from shapecat.simulation.camera.presets import KINECT
from shapecat.simulation.camera.render import render
from shapecat.simulation.camera.sensors import Sensor
from shapecat.simulation.scenes.worlds import World
from shapecat.types import Frame, Pose

__all__ = ["render_frame"]


def render_frame(
    world: World,
    view: int | Pose,
    *,
    rng: Generator,
    sensor: Sensor = KINECT,
    rate_hz: float = 30.0,
    start_ns: int = 0,
) -> tuple[Frame, U1]:
    """Render one depth image of a world.

    Parameters
    ----------
    view : index of a frame of the world's path, or a pose ``world_from_camera`` from which to see
        the world of frame 0.
    rng : generator of the sensor noise.
    rate_hz, start_ns : frames per second, and timestamp of frame 0.

    Returns
    -------
    The frame, and pixel labels (h, w), uint8: 0 without depth, 1 to 9 on supports, and
    `PlacedObject.label` on objects.
    """
    index = view if isinstance(view, int) else 0
    pose = world.path[view] if isinstance(view, int) else view
    image = render(world.geometry(index), sensor.camera, pose)
    depth, mesh_ids = measure(image, sensor, rng)
    stamp = start_ns + round(index * 1e9 / rate_hz)
    topic = "/camera/depth/image_raw"
    frame = Frame(
        topic, index, stamp, stamp, "camera_depth_optical_frame", depth=depth, camera=sensor.camera
    )
    return frame, world.labels_of(mesh_ids)
