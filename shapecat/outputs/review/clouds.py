"""The clouds of the review: choose points and colour them."""

import math
from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F4, I4, U1, U2, U4, Bool, Record, array
from shapecat.cameras.colour import ColourView
from shapecat.jit import kernel
from shapecat.outputs.colours import colour_of
from shapecat.outputs.review.colour import true_colours
from shapecat.types import Frame, LabelledObject, Plane

__all__ = ["PaintedCloud", "paint"]

_GROUND = np.array([118, 128, 140], np.uint8)  # points on no plane and no object
_PLANES = np.array([[128, 112, 92], [104, 120, 108], [112, 104, 126], [100, 118, 128]], np.uint8)
_RADIUS_M = 0.003  # of points of unorganized clouds
_PLANE_M = 0.015  # largest distance of points from the plane that they belong to


class PaintedCloud(Record):
    """Points (n, 3), metres, sensor frame, with colours (n,) packed as 0xRRGGBBAA.

    Drawn with radius ``radius_m``, metres, neighbouring points nearly touch.
    """

    points: F4 = array("n 3", "f4")
    colours: U4 = array("n", "u4")
    radius_m: float


def paint(
    frame: Frame,
    planes: Sequence[Plane],
    objects: Sequence[LabelledObject],
    *,
    limit: int,
    view: ColourView | None = None,
) -> tuple[PaintedCloud, PaintedCloud]:
    """Return the points on no object and the points on objects, together about ``limit``.

    Depth images are thinned to a grid of pixels, clouds to every k-th point. Objects are thinned
    less; they get up to half of the points. Points on objects have the colour of the category,
    points on planes a muted colour, and all others are grey. Depth images are shaded as if lit from
    above left of the camera. Points that a colour camera sees have their true colours, unshaded,
    and tinted on objects.

    Parameters
    ----------
    limit : approximate number of points; 0 for all.
    view : the colour image; None for none.

    Raises
    ------
    MessageError : the colour image is damaged.
    """
    if frame.depth is not None:
        measured = frame.depth > 0
    else:
        x, y, z = frame.xyz().T
        measured = np.isfinite(x) & np.isfinite(y) & np.isfinite(z)
    owner = np.zeros(measured.shape, np.uint16)  # number of the object, from 1
    for number, item in enumerate(objects, 1):
        owner.reshape(-1)[item.indices] = number
    fine, dense = _thin(measured & (owner > 0), limit // 2)
    coarse, sparse = _thin(measured & (owner == 0), max(limit - dense.size, 1) if limit else 0)
    object_colours = np.array([colour_of(o.category) for o in objects], np.uint8).reshape(-1, 3)
    palette = np.concatenate([_GROUND[None], object_colours, _PLANES])
    pixels = np.concatenate([sparse, dense])
    points, tones = frame.xyz(pixels), owner.reshape(-1)[pixels]
    colours: U4 = np.zeros(pixels.size, np.uint32)
    if view is not None:
        colours = true_colours(frame, view, points, pixels, fine, palette, tones)
    bare = np.flatnonzero(colours == 0)
    colours[bare] = _shaded(frame, pixels[bare], points[bare], tones[bare], palette, planes)
    n = sparse.size
    return (
        PaintedCloud(points[:n], colours[:n], _radius(frame, points[:n], coarse)),
        PaintedCloud(points[n:], colours[n:], _radius(frame, points[n:], fine)),
    )


def _shaded(
    frame: Frame, pixels: I4, points: F4, tones: U2, palette: U1, planes: Sequence[Plane]
) -> U4:
    """Return the colours (n,) of points, 0xRRGGBBAA; those of a depth image are shaded.

    ``pixels`` (n,) are the flat indices of the points; ``points``, ``tones`` and ``palette`` are as
    in `_colours`.
    """
    light = np.ones(pixels.size, np.float32)
    if frame.depth is not None and frame.camera is not None:
        light = _light(frame.depth, pixels, frame.camera.fx, frame.camera.fy)
    rows = _plane_rows(planes)
    return np.asarray(_colours(points, light, tones, palette, rows, len(_PLANES)))


def _radius(frame: Frame, points: F4, step: int) -> float:
    """Return the radius, metres, at which points ``step`` pixels apart nearly touch.

    For an unorganized cloud, it is constant.
    """
    if frame.camera is None:
        return _RADIUS_M
    middle = float(np.median(points[::16, 2])) if len(points) else 0.0
    return 0.55 * step * middle / frame.camera.fx


def _thin(wanted: Bool, limit: int) -> tuple[int, I4]:
    """Return a step, and the flat indices of about ``limit`` of the wanted pixels or points.

    In an image (h, w), the wanted pixels on a grid with this step are chosen. In a cloud (n,),
    every ``step``-th of the wanted points is chosen. A limit of 0 means all.
    """
    ratio = np.count_nonzero(wanted) / limit if limit else 1.0
    if wanted.ndim == 1:
        step = max(1, math.ceil(ratio))
        return step, np.flatnonzero(wanted)[::step]
    step = max(1, math.ceil(math.sqrt(ratio)))
    rows, columns = np.nonzero(wanted[::step, ::step])
    return step, (rows * wanted.shape[1] + columns) * step


def _plane_rows(planes: Sequence[Plane]) -> F4:
    """Return (p, 8) normal, offset, centre and squared radius of each plane's outline, metres."""
    rows = []
    for plane in planes:
        middle = plane.outline.mean(axis=0) if len(plane.outline) else np.zeros(3)
        radius_squared = ((plane.outline - middle) ** 2).sum(axis=1).max(initial=0.0)
        rows.append([*plane.normal, plane.offset, *middle, radius_squared])
    return np.array(rows, np.float32).reshape(-1, 8)


@kernel
def _colours(points: F4, light: F4, tones: U2, palette: U1, planes: F4, plane_tones: int) -> U4:
    """Return the colours (n,) of points, 0xRRGGBBAA.

    Parameters
    ----------
    points : (n, 3) metres, sensor frame.
    light : (n,) brightness factors.
    tones : (n,) indices into the palette; points of index 0 get the colour of a plane
        nearby, if there is one.
    palette : (k, 3); the last ``plane_tones`` entries are for planes, in turn.
    planes : (p, 8), from `_plane_rows`.
    """
    result = np.zeros(len(points), np.uint32)
    for i in range(len(points)):
        tone = int(tones[i])
        if tone == 0:
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            for k in range(len(planes)):
                a, b, c, offset, u, v, w, radius_squared = planes[k]
                inside = (x - u) ** 2 + (y - v) ** 2 + (z - w) ** 2 <= radius_squared
                if inside and abs(a * x + b * y + c * z - offset) < _PLANE_M:
                    tone = len(palette) - plane_tones + k % plane_tones
        packed = np.uint32(0)
        for channel in range(3):
            value = np.uint32(min(palette[tone, channel] * light[i], np.float32(255)))
            packed = (packed << np.uint32(8)) | value
        result[i] = (packed << np.uint32(8)) | np.uint32(255)
    return result


@kernel
def _light(depth: F4, pixels: I4, fx: float, fy: float) -> F4:
    """Return the brightness (n,), 0.55 to 1.2, of pixels lit from above left of the camera.

    Parameters
    ----------
    depth : (h, w) metres.
    pixels : (n,) flat indices.
    fx, fy : focal lengths, pixels.
    """
    height, width = depth.shape
    result = np.ones(pixels.size, np.float32)
    step = 3  # pixels, enough that the quantisation of depth hardly matters
    for k in range(pixels.size):
        v, u = pixels[k] // width, pixels[k] % width
        z = depth[v, u]
        edge_m = 0.05 * z  # a larger difference is an edge, not a slope
        slope_x = slope_y = np.float32(0)
        left, right = depth[v, max(u - step, 0)], depth[v, min(u + step, width - 1)]
        if abs(left - z) < edge_m and abs(right - z) < edge_m:
            slope_x = (right - left) * fx / (2 * step * z)
        above, below = depth[max(v - step, 0), u], depth[min(v + step, height - 1), u]
        if abs(above - z) < edge_m and abs(below - z) < edge_m:
            slope_y = (below - above) * fy / (2 * step * z)
        # The normal is (slope_x, slope_y, -1); the light comes from (-0.4, -0.7, -0.6).
        facing = (-0.4 * slope_x - 0.7 * slope_y + 0.6) / np.sqrt(1 + slope_x**2 + slope_y**2)
        result[k] = 0.55 + 0.65 * max(facing, 0.0)
    return result
