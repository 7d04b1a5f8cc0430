"""A colour camera beside the depth camera, with its own resolution and lens; textured scenes."""

import io
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from shapecat.arrays import F8, I4, U1
from shapecat.cameras.colour import LensCamera
from shapecat.cameras.lenses import undistorted_rays
from shapecat.geometry import compose, inverse, rotation_from_quaternion
from shapecat.simulation.render import Image, render
from shapecat.simulation.worlds import World
from shapecat.types import Camera, Pose

__all__ = ["COLOUR", "ColourCamera", "jpeg", "render_colour"]


@dataclass(frozen=True)
class ColourCamera:
    """A colour camera mounted beside the depth camera.

    ``depth_from_colour`` is its pose in the optical frame of the depth camera, ``quality`` the JPEG
    quality of its images, 1 to 95.
    """

    lens: LensCamera
    depth_from_colour: Pose
    quality: int = 85


COLOUR = ColourCamera(
    LensCamera(
        Camera(960, 720, 706.0, 704.0, 483.5, 355.2),
        "plumb_bob",
        (0.11, -0.24, 0.0007, -0.0004, 0.08),
    ),
    Pose(rotation_from_quaternion((0.004, -0.009, 0.006, 1.0)), np.array([0.05, 0.0015, -0.002])),
)
"""Like the colour camera of a RealSense: 5 cm to the right, turned by a degree, a wider image."""

_NOTHING = 18
"""Red, green and blue where nothing is seen."""
_FINE = 2
"""Oversampling of the rendered pinhole image, which the rays of the lens then sample."""


def render_colour(world: World, frame: int, camera: ColourCamera = COLOUR) -> tuple[U1, U1]:
    """Render a frame of a world as the colour camera beside the depth camera sees it.

    Returns
    -------
    The image (h, w, 3), uint8 red, green, blue; and its labels (h, w), uint8: those of
    ``world.labels``, 0 where nothing is seen.
    """
    pose = compose(world.path[frame], camera.depth_from_colour)
    fine, rows, columns = _lookup(camera.lens)
    image = render(world.geometry(frame), fine, pose)
    owners = image.owners[rows, columns]
    colours = _paint(world, frame, pose, fine, image, rows, columns)
    return colours, np.take(np.append(world.labels, np.uint8(0)), owners, mode="wrap")


@lru_cache(maxsize=4)  # a recording has one lens
def _lookup(lens: LensCamera) -> tuple[Camera, I4, I4]:
    """Return a finer pinhole camera, and its row and column (h, w) for each pixel of the lens."""
    camera = lens.pinhole
    rays = undistorted_rays(camera, lens.model, lens.coefficients)
    if rays is None:
        msg = f"lens {lens} cannot be simulated"
        raise ValueError(msg)
    fx, fy = _FINE * camera.fx, _FINE * camera.fy
    low, high = rays.min(axis=(0, 1)), rays.max(axis=(0, 1))
    cx, cy = -np.floor(low * (fx, fy)) + 2
    size = np.ceil(high * (fx, fy) + (cx, cy)).astype(int) + 3
    fine = Camera(int(size[0]), int(size[1]), fx, fy, float(cx), float(cy))
    seen = np.rint(rays * (fx, fy) + (cx, cy)).astype(np.int32)
    seen.flags.writeable = False
    return fine, seen[..., 1], seen[..., 0]


def _paint(
    world: World, frame: int, pose: Pose, camera: Camera, image: Image, rows: I4, columns: I4
) -> U1:
    """Return the shaded colours (h, w, 3) uint8; the texture moves with each object."""
    owners = image.owners[rows, columns].reshape(-1)
    order = np.argsort(owners, kind="stable")  # the pixels of each owner together
    found, starts = np.unique(owners[order], return_index=True)
    colours = np.full((owners.size, 3), _NOTHING, np.uint8)
    for owner, here in zip(found.tolist(), np.split(order, starts[1:]), strict=True):
        if owner < 0:
            continue
        row, column = rows.reshape(-1)[here], columns.reshape(-1)[here]
        z = 1 / image.inverse[row, column]
        x, y = (column - camera.cx) / camera.fx * z, (row - camera.cy) / camera.fy * z
        points = np.stack([x, y, z], axis=-1) @ pose.rotation.T + pose.translation
        if owner >= len(world.supports):
            thing = world.things[owner - len(world.supports)]
            points = _in_mesh(points, world.pose_of(thing, frame))
        shade = 0.45 + 0.55 * np.abs(image.cosine[row, column])
        plain = _texture(points, owner, plain=owner < len(world.supports))
        colours[here] = np.clip(np.rint(plain * shade[:, None]), 0, 255)
    return colours.reshape(*rows.shape, 3)


def _in_mesh(points: F8, world_from_mesh: Pose) -> F8:
    back = inverse(world_from_mesh)
    return points @ back.rotation.T + back.translation


def _texture(points: F8, number: int, *, plain: bool) -> F8:
    """Return the colours (n, 3), 0 to 255, of surface points (n, 3): two-tone bands and fine grain.

    The texture uses only basic arithmetic, no sines, so that images are equal on every machine.
    """
    draw = np.random.default_rng(number + 71)
    tone = draw.uniform(90, 180, 3) if plain else draw.uniform(30, 235, 3)
    other = tone + draw.uniform(-25, 25, 3) if plain else draw.uniform(30, 235, 3)
    way, width = draw.normal(size=3), draw.uniform(0.03, 0.08)
    along = points @ (way / np.sqrt((way * way).sum())) / width
    band = np.abs(along - np.rint(along)) * 2 > 0.6
    cells: I4 = np.floor(points / 0.005).astype(np.int64) * [73856093, 19349663, 83492791]
    grain = ((cells[:, 0] ^ cells[:, 1] ^ cells[:, 2]) % 13).astype(np.float64) - 6
    return np.asarray(np.where(band[:, None], other, tone) + grain[:, None])


def jpeg(colours: U1, quality: int = 85) -> bytes:
    """Encode an image (h, w, 3), uint8, as JPEG; ``quality`` is from 1 to 95."""
    from PIL import Image as Picture  # noqa: PLC0415  # only for colour

    file = io.BytesIO()
    Picture.fromarray(colours).save(file, "jpeg", quality=quality)
    return file.getvalue()
