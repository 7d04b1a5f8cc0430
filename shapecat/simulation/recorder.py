"""Simulated recordings with ground truth."""

import json
import math
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapecat.arrays import U1
from shapecat.geometry import LINK_FROM_OPTICAL, compose, inverse
from shapecat.simulation.camera.colour_camera import (
    COLOUR_LENS,
    DEPTH_FROM_COLOUR,
    jpeg,
    render_colour,
)
from shapecat.simulation.camera.presets import SENSORS
from shapecat.simulation.camera.sensors import Sensor
from shapecat.simulation.camera.views import render_frame
from shapecat.simulation.containers import CONTAINERS, Container, FormatName
from shapecat.simulation.files import completed, label_file, written_paths
from shapecat.simulation.scenes.kinds import SceneKind, make_scene
from shapecat.simulation.scenes.worlds import World
from shapecat.simulation.truth import frame_truth
from shapecat.system.progress import Observer, ignore
from shapecat.types import Frame, Pose

__all__ = ["EPOCH_NS", "record", "robot_links", "simulate", "write_frame"]

EPOCH_NS = 1_700_200_000_000_000_000
"""Timestamp of the first frame."""

_LATENCY_NS = 12_000_000
"""Time from the timestamp of a depth image to its log time."""
_OPTICAL = "camera_depth_optical_frame"
_COLOUR_OPTICAL = "camera_color_optical_frame"


def simulate(
    out: Path,
    *,
    scene: SceneKind = "tabletop",
    format: FormatName = "mcap",  # noqa: A002  # the word users know
    frames: int = 90,
    seed: int = 0,
    sensor: str = "kinect",
    clouds: bool = False,
    color: bool = False,
    rate_hz: float = 30.0,
    observe: Observer = ignore,
) -> Path:
    """Write a recording of a random scene.

    Topics: /camera/depth/image_raw (16UC1, mm) or /camera/depth/points, /camera/depth/camera_info,
    /tf (map, base_link, camera_link) and /tf_static. Beside the recording, ``NAME.truth.json``
    lists the objects of each frame with their boxes, and ``NAME.labels.npz`` holds the label of
    each depth pixel. These files replace those of an earlier recording of the same name. The same
    arguments give the same messages on every machine.

    Parameters
    ----------
    out : path of the recording; the suffix of the format is added if it has none.
    sensor : name of a sensor in `SENSORS`.
    clouds : write organized point clouds instead of depth images.
    color : also write the images of a colour camera beside the depth camera:
        /camera/color/image_raw/compressed (JPEG), /camera/color/camera_info, its pose in
        /tf_static, and ``NAME.color_labels.npz`` with the label of each colour pixel.
    rate_hz : frames per second.
    observe : called with the phase, the number of finished frames, and the total.

    Returns
    -------
    The path of the recording.

    Raises
    ------
    ValueError : the scene, format or sensor does not exist, there is no frame, or the rate is not
        positive.
    OutputError : the recording cannot be written.
    """
    if sensor not in SENSORS:
        msg = f"no sensor {sensor!r}; known: {', '.join(SENSORS)}"
        raise ValueError(msg)
    if frames < 1 or not 0 < rate_hz < math.inf:
        msg = f"expected at least 1 frame and a positive rate, got {frames} at {rate_hz} Hz"
        raise ValueError(msg)
    world = make_scene(scene, np.random.default_rng(seed), frames=frames, rate_hz=rate_hz)
    return record(
        world,
        out,
        format=format,
        seed=seed,
        sensor=SENSORS[sensor],
        clouds=clouds,
        color=color,
        rate_hz=rate_hz,
        observe=observe,
    )


def record(
    world: World,
    out: Path,
    *,
    seed: int,
    sensor: Sensor,
    format: FormatName = "mcap",  # noqa: A002  # the word users know
    clouds: bool = False,
    color: bool = False,
    rate_hz: float = 30.0,
    observe: Observer = ignore,
) -> Path:
    """Write a recording of a world, as `simulate` does; return its path.

    ``rate_hz`` is the frame rate. ``seed`` seeds the sensor noise, and appears in the name of the
    scene in the ground truth.

    Raises
    ------
    ValueError : the format does not exist.
    OutputError : the recording cannot be written.
    """
    if format not in CONTAINERS:
        msg = f"no recording format {format!r}; known: {', '.join(CONTAINERS)}"
        raise ValueError(msg)
    paths = written_paths(out, format)
    count = 4 if color else 3
    truths = []
    with (
        completed(paths[:count], obsolete=paths[count:]) as (recording, truth, *labels),
        CONTAINERS[format].open(recording) as writer,
        ExitStack() as stack,
    ):
        cameras = (sensor.camera, COLOUR_LENS.pinhole)
        add_labels = [
            stack.enter_context(label_file(path, len(world), camera))
            for path, camera in zip(labels, cameras, strict=False)
        ]
        for index in range(len(world)):
            rng = np.random.default_rng((seed, index))
            frame, image = render_frame(
                world, index, rng=rng, sensor=sensor, rate_hz=rate_hz, start_ns=EPOCH_NS
            )
            write_frame(writer, frame, world.path[index], clouds=clouds, color=color)
            add_labels[0](image)
            if color:
                add_labels[1](_write_colour(writer, world, frame))
            truths.append(
                {
                    "frame": index,
                    "scene": f"sim{seed}",
                    "kind": world.kind,
                    "stamp_ns": frame.stamp_ns,
                    **frame_truth(world, index, image, sensor.camera),
                }
            )
            observe("simulate", index + 1, len(world))
        truth.write_text("[" + ",\n".join(map(json.dumps, truths)) + "]\n", "utf-8")
    return paths[0]


def write_frame(
    writer: Container,
    frame: Frame,
    world_from_camera: Pose,
    *,
    clouds: bool = False,
    color: bool = False,
) -> None:
    """Write the depth image, camera info and transforms of a frame.

    The first frame also writes the static transforms; with ``color``, the pose of the colour
    camera is one of them. ``clouds`` is as for `simulate`.

    Raises
    ------
    ValueError : the frame is not a depth image.
    """
    make, stamp, depth, camera = writer.messages, frame.stamp_ns, frame.depth, frame.camera
    if depth is None or camera is None:
        msg = "a simulated frame is a depth image"
        raise ValueError(msg)
    if frame.index == 0:
        still = [("camera_link", _OPTICAL, LINK_FROM_OPTICAL)]
        still += [(_OPTICAL, _COLOUR_OPTICAL, DEPTH_FROM_COLOUR)] if color else []
        writer.write("/tf_static", make.transforms(still, stamp), stamp)
    links = robot_links(world_from_camera)
    writer.write("/tf", make.transforms(links, stamp), stamp + _LATENCY_NS // 4)
    logged = stamp + _LATENCY_NS
    info = make.camera_info(camera, stamp, _OPTICAL)
    writer.write("/camera/depth/camera_info", info, logged)
    if clouds:
        # Like drivers, compute the points from a depth image in whole millimetres.
        image = np.round(depth * 1000) * np.float32(0.001)
        points = replace(frame, depth=image).xyz().reshape(camera.height, camera.width, 3)
        writer.write("/camera/depth/points", make.cloud(points, stamp, _OPTICAL), logged)
    else:
        writer.write("/camera/depth/image_raw", make.image(depth, stamp, _OPTICAL), logged)


def _write_colour(writer: Container, world: World, frame: Frame) -> U1:
    """Write the colour image of a frame and its camera info; return the pixel labels (h, w)."""
    make, stamp = writer.messages, frame.stamp_ns
    colours, labels = render_colour(world, frame.index)
    lens, logged = COLOUR_LENS, stamp + _LATENCY_NS + _LATENCY_NS // 2
    info = make.camera_info(lens.pinhole, stamp, _COLOUR_OPTICAL, lens.coefficients)
    writer.write("/camera/color/camera_info", info, logged)
    image = make.compressed(jpeg(colours), stamp, _COLOUR_OPTICAL)
    writer.write("/camera/color/image_raw/compressed", image, logged)
    return labels


def robot_links(world_from_camera: Pose) -> list[tuple[str, str, Pose]]:
    """Split the camera's pose into the links of a robot with its base on the floor.

    Returns
    -------
    Links (parent, child, ``parent_from_child``): map to base_link, and base_link to camera_link.
    """
    world_from_link = compose(world_from_camera, inverse(LINK_FROM_OPTICAL))
    heading = world_from_link.rotation[:2, 0]
    c, s = heading / np.linalg.norm(heading)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    place = world_from_camera.translation * [1, 1, 0]
    base = Pose(turn, place)
    return [
        ("map", "base_link", base),
        ("base_link", "camera_link", compose(inverse(base), world_from_link)),
    ]
