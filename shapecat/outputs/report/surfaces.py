"""Draw the surface of an object from three sides: shaded points, and the mesh over them."""

import base64
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from shapecat.arrays import F4, F8, U1, Bool, Record, array
from shapecat.outputs.png import png, with_palette
from shapecat.surface.triangles import triangles_of
from shapecat.types import NeuralGas

__all__ = ["MOST_POINTS", "SIDE", "Snapshot", "SurfaceDrawing", "draw", "recoloured"]

SIDE = 160
"""Width and height of a picture in pixels."""

_SHADES = 14
_PASSES = 3
"""Number of times that holes are closed, and that nearness is smoothed."""
MOST_POINTS = 8000
"""Largest number of points of an object that are drawn."""
_LIGHT = np.array([-0.4, 0.65, 0.65]) / np.linalg.norm([-0.4, 0.65, 0.65])


class Snapshot(Record):
    """One view of an object in the level frame: z up, the support at z = 0, metres.

    ``points`` is (n, 3); ``eye`` (3,) is the position of the sensor.
    """

    points: F4 = array("n 3", "f4")
    gas: NeuralGas
    eye: F8 = array("3", "f8")


class SurfaceDrawing(NamedTuple):
    """A picture as a data URI, and the mesh over it as SVG path data in the same pixels."""

    title: str
    image: str
    edges: str
    neurons: str


def draw(shot: Snapshot, colour: tuple[int, int, int]) -> tuple[SurfaceDrawing, ...]:
    """Draw an object as the sensor sees it, from the side, and from above.

    All three drawings have the same scale, set by the sphere around the points and neurons. If the
    snapshot has no points, points on its mesh are drawn instead.
    """
    points = np.asarray(shot.points[:: 1 + len(shot.points) // MOST_POINTS], np.float64)
    points = points if len(points) else np.asarray(_graph_points(shot.gas), np.float64)
    everything = np.concatenate([points, shot.gas.neurons])
    if not len(everything):
        everything = points = np.zeros((1, 3))
    low, high = np.percentile(everything, [0.5, 99.5], axis=0)
    middle = (low + high) / 2
    radius = max(float(np.percentile(np.linalg.norm(everything - middle, axis=1), 99.5)), 1e-3)
    x, y, z = shot.eye - middle
    azimuth = float(np.arctan2(y, x))
    elevation = float(np.clip(np.arctan2(z, np.hypot(x, y)), np.radians(12), np.radians(65)))
    palette, alpha = _palette(colour)
    pictures = []
    for title, turn, rise in (
        ("as seen", 0.0, elevation),
        ("from the side", np.radians(70), np.radians(16)),
        ("from above", 0.0, np.pi / 2),
    ):
        view = _view(azimuth + turn, rise)
        scale = 0.46 * SIDE / radius
        spots = _project(points - middle, view, scale)
        image = png(_shade(spots), palette, alpha)
        nodes = np.round(_project(shot.gas.neurons - middle, view, scale)[:, :2]).astype(int)
        pictures.append(
            SurfaceDrawing(
                title,
                _uri(image),
                "".join(f"M{a} {b}L{c} {d}" for (a, b), (c, d) in nodes[shot.gas.edges].tolist()),
                "".join(f"M{a} {b}h0" for a, b in nodes.tolist()),
            )
        )
    return tuple(pictures)


def recoloured(picture: str, colour: tuple[int, int, int]) -> str:
    """Return the ``image`` of a `SurfaceDrawing` in another colour (red, green, blue)."""
    return _uri(with_palette(base64.b64decode(picture.partition(",")[2]), _palette(colour)[0]))


def _uri(image: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(image).decode('ascii')}"


def _graph_points(gas: NeuralGas) -> F4:
    """Return points (n, 3), metres, on the triangles and edges of a mesh."""
    corners = gas.neurons[triangles_of(gas.edges, len(gas.neurons))]
    weights = np.array([[a, b, 8 - a - b] for a in range(9) for b in range(9 - a)]) / 8
    faces = np.einsum("kc,tcd->tkd", weights, corners).reshape(-1, 3)
    ends = gas.neurons[gas.edges]
    steps = np.linspace(0, 1, 9)[None, :, None]
    lines = (ends[:, None, 0] * (1 - steps) + ends[:, None, 1] * steps).reshape(-1, 3)
    return np.concatenate([gas.neurons, faces, lines]).astype(np.float32)


def _view(azimuth: float, elevation: float) -> F8:
    """Return the axes of a view as rows (3, 3): right, up, and towards the viewer.

    ``azimuth`` and ``elevation`` are the direction of the viewer, radians.
    """
    c, s, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    return np.array([[-s, c, 0], [-c * se, -s * se, ce], [c * ce, s * ce, se]])


def _project(points: F8, view: F8, scale: float) -> F8:
    """Return column, row and nearness to the viewer (n, 3), pixels, of points (n, 3).

    ``points`` are in metres, with the origin at the centre of the picture. ``view`` (3, 3) is from
    `_view`; ``scale`` is in pixels per metre.
    """
    right, up, toward_viewer = (np.asarray(points, np.float64) @ view.T * scale).T
    return np.stack([SIDE / 2 + right, SIDE / 2 - up, toward_viewer], axis=1)


def _shade(spots: F8) -> U1:
    """Return an image (h, w) of shades from 1 to `_SHADES`, 0 where there is no point.

    Points are drawn as discs, the nearest in front. The surface is lit from above left, with
    normals from the slopes of its smoothed nearness. ``spots`` is from `_project`.
    """
    nearness = _closed(_nearest(spots))
    bare = ~np.isfinite(nearness)
    smooth = _smoothed(nearness, bare)
    down, right = np.gradient(smooth)
    normal = np.stack([-right, down, np.ones_like(right)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = 0.25 + 0.75 * np.clip(normal @ _LIGHT, 0, 1)
    light *= np.clip(1.0 - 0.05 * np.clip(_smoothed(smooth, bare) - smooth, 0, 8), 0.5, 1)
    shades = 1 + np.round(light * (_SHADES - 1))
    return np.where(bare, 0, np.clip(shades, 1, _SHADES)).astype(np.uint8)


def _nearest(spots: F8) -> F8:
    """Return the nearness (h, w) of the nearest disc at each pixel, -inf without a disc.

    ``spots``, the centres of the discs, is from `_project`.
    """
    area = float(np.prod(np.ptp(spots[:, :2], axis=0) + 1))
    radius = float(np.clip(0.9 * np.sqrt(area / len(spots)), 1.0, 4.5))
    columns, rows = np.round(spots[:, :2].T).astype(int)
    inside = (columns >= 0) & (columns < SIDE) & (rows >= 0) & (rows < SIDE)
    nearness = np.full((SIDE, SIDE), -np.inf)
    np.maximum.at(nearness, (rows[inside], columns[inside]), spots[inside, 2])
    steps = np.arange(-int(radius) - 1, int(radius) + 2)
    disc = np.hypot(steps[:, None], steps) <= radius
    widened = ndimage.maximum_filter(nearness, footprint=disc, mode="constant", cval=-np.inf)
    return np.asarray(widened)


def _closed(nearness: F8) -> F8:
    """Fill empty pixels, if the object mostly surrounds them, with the mean of their neighbours.

    ``nearness`` (h, w) is from `_nearest`; empty pixels are -inf.
    """
    for _ in range(_PASSES):
        solid = np.isfinite(nearness)
        share = _blurred(solid.astype(np.float64))
        mean = _blurred(np.where(solid, nearness, 0.0)) / np.maximum(share, 1e-9)
        nearness = np.where(~solid & (share > 0.5), mean, nearness)
    return nearness


def _smoothed(nearness: F8, bare: Bool) -> F8:
    """Average each pixel (h, w), even an empty one (``bare``), with those nearby on the object.

    The result is 0 where the object is not nearby.
    """
    weight: F8 = (~bare).astype(np.float64)
    value: F8 = np.where(bare, 0.0, nearness)
    for _ in range(_PASSES):
        value, weight = _blurred(value * weight), _blurred(weight)
        value = np.divide(value, weight, out=np.zeros_like(value), where=weight > 0)
        weight = np.minimum(weight, 1.0)
    return value


def _blurred(image: F8) -> F8:
    return np.asarray(ndimage.uniform_filter(image, 3, mode="constant"))


def _palette(colour: tuple[int, int, int]) -> tuple[U1, U1]:
    """Return a palette (k, 3), and the opacity (1,) of its first entry, which is transparent.

    The other entries are shades of ``colour``, the darkest first.
    """
    light = np.linspace(0, 1, _SHADES)
    shades = [
        np.interp(light, (0, 0.75, 1), (0.32 * part, part, part + 0.45 * (255 - part)))
        for part in colour
    ]
    palette = np.concatenate([np.zeros((1, 3)), np.stack(shades, axis=1)])
    return np.round(palette).astype(np.uint8), np.zeros(1, np.uint8)
