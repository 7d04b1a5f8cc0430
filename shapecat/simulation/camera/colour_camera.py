"""Images of textured scenes from a colour camera that is mounted beside the depth camera."""

import io
from functools import cache

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.cameras.colour import LensCamera
from shapecat.cameras.lenses import undistorted_rays
from shapecat.geometry import compose, inverse, rotation_from_quaternion
from shapecat.jit import kernel
from shapecat.simulation.camera.render import Image, render
from shapecat.simulation.scenes.worlds import World
from shapecat.types import Camera, Pose

__all__ = ["COLOUR_LENS", "DEPTH_FROM_COLOUR", "jpeg", "render_colour"]


COLOUR_LENS = LensCamera(
    Camera(960, 720, 706.0, 704.0, 483.5, 355.2),
    "plumb_bob",
    (0.11, -0.24, 0.0007, -0.0004, 0.08),
)
"""Lens of the colour camera, with distortion; its field of view is 68 degrees wide."""
DEPTH_FROM_COLOUR = Pose(
    rotation_from_quaternion((0.004, -0.009, 0.006, 1.0)), np.array([0.05, 0.0015, -0.002])
)
"""Pose of the colour camera in the depth camera's frame: 5 cm to the right, rotated by a degree."""

_NOTHING = 18
"""Value of red, green and blue where no surface is visible."""
_GRAIN_M = 0.005
"""Size of the cells of the textures' fine grain."""
_HASH_FACTORS = (73856093, 19349663, 83492791)
"""Factors of the spatial hash that gives each cell of the grain its brightness."""
_BAND = 0.6
"""Fraction of a band's width in the first of its two colours."""
_FINE = 2
"""Oversampling factor of the pinhole image from which the distorted image is sampled."""


def render_colour(world: World, frame: int) -> tuple[U1, U1]:
    """Render a frame of a world with the colour camera beside the depth camera.

    Returns
    -------
    The image (h, w, 3), uint8 red, green, blue; and its pixel labels (h, w), uint8, 0 without
    surface.
    """
    pose = compose(world.path[frame], DEPTH_FROM_COLOUR)
    fine, rows, columns = _distortion_map()
    image = render(world.geometry(frame), fine, pose)
    colours = _paint(world, frame, pose, fine, image, rows, columns)
    return colours, world.labels_of(image.mesh_ids[rows, columns])


@cache
def _distortion_map() -> tuple[Camera, I4, I4]:
    """Return an oversampled pinhole camera, and the rows and columns of its image to sample.

    Each pixel of the distorted image shows a pixel of the pinhole image; two arrays (h, w) give the
    row and the column of that pixel.
    """
    camera = COLOUR_LENS.pinhole
    rays = np.asarray(undistorted_rays(camera, COLOUR_LENS.model, COLOUR_LENS.coefficients))
    fx, fy = _FINE * camera.fx, _FINE * camera.fy
    low, high = rays.min(axis=(0, 1)), rays.max(axis=(0, 1))
    cx, cy = -np.floor(low * (fx, fy)) + 2
    size = np.ceil(high * (fx, fy) + (cx, cy)).astype(int) + 3
    fine = Camera(int(size[0]), int(size[1]), fx, fy, float(cx), float(cy))
    pixels = np.rint(rays * (fx, fy) + (cx, cy)).astype(np.int32)
    pixels.flags.writeable = False
    return fine, pixels[..., 1], pixels[..., 0]


def _paint(
    world: World, frame: int, pose: Pose, camera: Camera, image: Image, rows: I4, columns: I4
) -> U1:
    """Return the shaded colours (h, w, 3), uint8, of an image; textures move with their objects.

    ``image`` is frame number ``frame``, rendered with the intrinsics ``camera`` at ``pose``,
    ``world_from_camera``. ``rows`` and ``columns`` are as for `_colour_in`.
    """
    supports = len(world.supports)
    poses = [pose] * supports  # from the camera to the frame of each texture
    poses += [compose(inverse(world.pose_of(item, frame)), pose) for item in world.objects]
    textures = np.array([_texture(k, plain=k < supports) for k in range(len(poses))])
    rotations = np.array([each.rotation for each in poses])
    translations = np.array([each.translation for each in poses])
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    colours = np.full((*rows.shape, 3), _NOTHING, np.uint8)
    _colour_in(
        *(image.inverse, image.mesh_ids, image.cosine, rows, columns),
        *(intrinsics, rotations, translations, textures, colours),
    )
    return colours


def _texture(number: int, *, plain: bool) -> F8:
    """Draw the texture (3, 3) of mesh ``number``: two colours, 0 to 255, and its bands.

    The last row is the direction across the bands, divided by their spacing, 1/m. The two colours
    of a ``plain`` texture are similar.
    """
    rng = np.random.default_rng(number + 71)
    tone = rng.uniform(90, 180, 3) if plain else rng.uniform(30, 235, 3)
    second_tone = tone + rng.uniform(-25, 25, 3) if plain else rng.uniform(30, 235, 3)
    direction, width = rng.normal(size=3), rng.uniform(0.03, 0.08)
    return np.stack([tone, second_tone, direction / np.sqrt((direction * direction).sum()) / width])


@kernel
def _colour_in(
    inverse_depth: F8,
    mesh_ids: I4,
    cosine: F4,
    rows: I4,
    columns: I4,
    intrinsics: F8,
    rotations: F8,
    translations: F8,
    textures: F8,
    colours: U1,
) -> None:
    """Paint two-tone bands and fine grain into ``colours`` (h, w, 3) where a surface is visible.

    The texture uses only basic arithmetic, no sines, so that images are equal on every machine.

    Parameters
    ----------
    inverse_depth, mesh_ids, cosine : the rendered image: inverse depth (1/m), index of the visible
        mesh (-1 without surface), and cosine of the angle of incidence.
    rows, columns : (h, w) pixel of that image to show in each pixel of ``colours``.
    intrinsics : fx, fy, cx, cy of the rendered image, pixels.
    rotations, translations : (k, 3, 3) and (k, 3) from the camera to the frame of each texture,
        metres.
    textures : (k, 3, 3) from `_texture`.
    """
    fx, fy, cx, cy = intrinsics
    point = np.zeros(3)
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            row, column = rows[i, j], columns[i, j]
            mesh_id = mesh_ids[row, column]
            if mesh_id < 0:
                continue
            z = 1.0 / inverse_depth[row, column]
            x, y = (column - cx) / fx * z, (row - cy) / fy * z
            r, t, texture = rotations[mesh_id], translations[mesh_id], textures[mesh_id]
            cell, along = 0, 0.0
            for k in range(3):
                point[k] = r[k, 0] * x + r[k, 1] * y + r[k, 2] * z + t[k]
                cell ^= int(np.floor(point[k] / _GRAIN_M)) * _HASH_FACTORS[k]
                along += point[k] * texture[2, k]
            tone = texture[1] if abs(along - np.floor(along + 0.5)) * 2 > _BAND else texture[0]
            shade = 0.45 + 0.55 * abs(cosine[row, column])
            for k in range(3):
                value = (tone[k] + cell % 13 - 6) * shade
                colours[i, j, k] = min(max(np.floor(value + 0.5), 0.0), 255.0)


def jpeg(colours: U1) -> bytes:
    """Encode an image (h, w, 3), uint8, as JPEG."""
    from PIL import Image as Picture  # noqa: PLC0415  # only for colour

    file = io.BytesIO()
    Picture.fromarray(colours).save(file, "jpeg", quality=85)
    return file.getvalue()
