"""Simulated recordings with ground truth."""

import json
import math
import sqlite3
import tempfile
import zipfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Literal, Self

import numpy as np

from shapecat.arrays import U1
from shapecat.errors import OutputError
from shapecat.geometry import LINK_FROM_OPTICAL, compose, inverse
from shapecat.simulation.camera.colour_camera import COLOUR, jpeg, render_colour
from shapecat.simulation.camera.presets import SENSORS
from shapecat.simulation.camera.sensors import Sensor
from shapecat.simulation.camera.views import render_frame
from shapecat.simulation.containers import CONTAINERS, Container
from shapecat.simulation.scenes.kinds import SceneKind, make_scene
from shapecat.simulation.scenes.worlds import World
from shapecat.simulation.truth import frame_truth
from shapecat.system.files import flush
from shapecat.system.progress import Observer, ignore
from shapecat.types import Camera, Frame, Pose

__all__ = ["EPOCH_NS", "record", "robot_links", "simulate", "written_paths"]

EPOCH_NS = 1_700_200_000_000_000_000
"""Timestamp of the first frame."""

_LATENCY_NS = 12_000_000
_OPTICAL = "camera_depth_optical_frame"
_COLOUR_OPTICAL = "camera_color_optical_frame"


def simulate(
    out: Path,
    *,
    scene: SceneKind = "tabletop",
    format: Literal["mcap", "ros1", "ros2"] = "mcap",  # noqa: A002  # the word users know
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
    lists the objects of each frame with their poses, and ``NAME.labels.npz`` holds the object of
    each depth pixel. All of them replace those of an earlier recording of this name. The same
    arguments give the same messages on every machine.

    Parameters
    ----------
    out : path of the recording; the suffix of the format is added if it has none.
    clouds : write organized point clouds instead of depth images.
    color : also write the images of a colour camera beside the depth camera:
        /camera/color/image_raw/compressed (JPEG), /camera/color/camera_info, its pose in
        /tf_static, and ``NAME.color_labels.npz`` with the object of each colour pixel.
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
    format: Literal["mcap", "ros1", "ros2"] = "mcap",  # noqa: A002  # the word users know
    clouds: bool = False,
    color: bool = False,
    rate_hz: float = 30.0,
    observe: Observer = ignore,
) -> Path:
    """Write a recording of a world, as `simulate` does.

    ``seed`` seeds the sensor noise and names the scene in the ground truth.

    Raises
    ------
    ValueError : the format does not exist.
    OutputError : the recording cannot be written.
    """
    if format not in CONTAINERS:
        msg = f"no recording format {format!r}; known: {', '.join(CONTAINERS)}"
        raise ValueError(msg)
    _, container = CONTAINERS[format]
    paths = written_paths(out, format, color=color)
    out = paths[0]
    try:
        _require_replaceable(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=".simulated-") as hidden:
            recording, truth, *labels = (Path(hidden) / path.name for path in paths)
            with container(recording) as writer, ExitStack() as stack:
                cameras = (sensor.camera, COLOUR.lens.pinhole)
                files = [
                    stack.enter_context(_LabelFile(path, len(world), camera))
                    for path, camera in zip(labels, cameras, strict=False)
                ]
                found = []
                for index in range(len(world)):
                    rng = np.random.default_rng((seed, index))
                    frame, image = render_frame(
                        world, index, rng=rng, sensor=sensor, rate_hz=rate_hz, start_ns=EPOCH_NS
                    )
                    _write_frame(writer, world, frame, clouds=clouds, color=color)
                    files[0].append(image)
                    if color:
                        files[1].append(_write_colour(writer, world, frame))
                    found.append(_truth(world, frame, image, sensor.camera, seed))
                    observe("simulate", index + 1, len(world))
            truth.write_text("[" + ",\n".join(map(json.dumps, found)) + "]\n", "utf-8")
            for path in paths:
                _move(Path(hidden) / path.name, path)
            for path in written_paths(out, format, color=True)[len(paths) :]:
                path.unlink(missing_ok=True)  # colour labels of another scene
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, "strerror", None) or error
        msg = f"{out}: cannot write the recording: {reason}"
        raise OutputError(msg) from error
    return out


def _write_frame(
    writer: Container, world: World, frame: Frame, *, clouds: bool, color: bool
) -> None:
    make, stamp, depth, camera = writer.messages, frame.stamp_ns, frame.depth, frame.camera
    if depth is None or camera is None:
        msg = "a simulated frame is a depth image"
        raise ValueError(msg)
    if frame.index == 0:
        still = [("camera_link", _OPTICAL, LINK_FROM_OPTICAL)]
        still += [(_OPTICAL, _COLOUR_OPTICAL, COLOUR.depth_from_colour)] if color else []
        writer.write("/tf_static", make.transforms(still, stamp), stamp)
    links = robot_links(world.path[frame.index])
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
    """Write the colour image of a frame; return its pixel labels (h, w)."""
    make, stamp = writer.messages, frame.stamp_ns
    colours, labels = render_colour(world, frame.index)
    lens, logged = COLOUR.lens, stamp + _LATENCY_NS + _LATENCY_NS // 2
    info = make.camera_info(lens.pinhole, stamp, _COLOUR_OPTICAL, lens.coefficients)
    writer.write("/camera/color/camera_info", info, logged)
    image = make.compressed(jpeg(colours), stamp, _COLOUR_OPTICAL)
    writer.write("/camera/color/image_raw/compressed", image, logged)
    return labels


def _truth(world: World, frame: Frame, labels: U1, camera: Camera, seed: int) -> dict[str, Any]:
    return {
        "frame": frame.index,
        "scene": f"sim{seed}",
        "kind": world.kind,
        "stamp_ns": frame.stamp_ns,
        **vars(frame_truth(world, frame.index, labels, camera)),
    }


class _LabelFile:
    """A compressed .npz with ``labels`` (t, h, w), uint8, written frame by frame."""

    def __init__(self, path: Path, frames: int, camera: Camera) -> None:
        self._archive = zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=4)
        # ZipInfo's fixed date makes equal labels give equal bytes.
        member = zipfile.ZipInfo("labels.npy")
        member.compress_type = zipfile.ZIP_DEFLATED
        self._file: IO[bytes] = self._archive.open(member, "w", force_zip64=True)
        shape = (frames, camera.height, camera.width)
        header = {"descr": "|u1", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(self._file, header)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()
        self._archive.close()

    def append(self, labels: U1) -> None:
        """Add the labels of the next frame."""
        self._file.write(np.ascontiguousarray(labels).tobytes())


def written_paths(out: Path, format: str, *, color: bool = False) -> list[Path]:  # noqa: A002  the word users know
    """Return the paths that `simulate` writes: the recording, the ground truth, the labels."""
    suffix, _ = CONTAINERS[format]
    out = out if out.suffix or not suffix else out.with_name(out.name + suffix)
    names = [out.name, f"{out.stem}.truth.json", f"{out.stem}.labels.npz"]
    names += [f"{out.stem}.color_labels.npz"] if color else []
    return [out.with_name(name) for name in names]


def _require_replaceable(path: Path) -> list[Path]:
    """Return the files of a folder that a recording may replace; none if it is no folder.

    Raises
    ------
    OutputError : the path is a folder that holds anything but a ROS 2 bag.
    """
    files = list(path.iterdir()) if path.is_dir() and not path.is_symlink() else []
    if any(file.name != "metadata.yaml" and file.suffix != ".db3" for file in files):
        msg = f"{path}: a folder that is not a recording; choose another name"
        raise OutputError(msg)
    return files


def _move(made: Path, path: Path) -> None:
    """Move a finished file or folder to its path, replacing a file or a recorded folder.

    Raises
    ------
    OutputError : as for `_require_replaceable`.
    """
    for file in _require_replaceable(path):
        file.unlink()
    if path.is_dir() and not path.is_symlink():
        path.rmdir()
    flush(made)
    made.replace(path)


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
