"""The clouds of the review: which points are kept, and how they are coloured."""

from collections.abc import Sequence

import numpy as np

from shapecat.arrays import F4, F8, I4, U1, U2, U4, Record, array
from shapecat.jit import kernel
from shapecat.outputs.colours import colour_of
from shapecat.types import Frame, LabelledObject, Plane

__all__ = ["PaintedCloud", "paint"]

_GROUND = np.array([118, 128, 140], np.uint8)  # points of no plane and no object
_PLANES = np.array([[128, 112, 92], [104, 120, 108], [112, 104, 126], [100, 118, 128]], np.uint8)
_RADIUS_M = 0.003  # of points of unorganized clouds
_PLANE_M = 0.015  # points this near to a plane and inside its outline are its own


class PaintedCloud(Record):
    """Points (n, 3) in the sensor frame, and how they are drawn.

    ``colours`` (n,) packed 0xRRGGBBAA; at ``radius_m`` they nearly close the surface.
    """

    points: F4 = array("n 3", "f4")
    colours: U4 = array("n", "u4")
    radius_m: float


def paint(
    frame: Frame, planes: Sequence[Plane], objects: Sequence[LabelledObject], *, limit: int
) -> tuple[PaintedCloud, PaintedCloud]:
    """Return the scene and the points on objects, together about ``limit`` points (0: all).

    Images are thinned on a grid of pixels, clouds by taking every k-th point; objects keep a
    finer grid, up to half of the points. Points of an object have the colour of its category,
    those of a plane a muted one, the others are grey; images are shaded as if lit from above the
    camera.
    """
    owner = _owners(frame, objects)
    fine, near = _thin(frame, np.flatnonzero(owner != 0), limit // 2)
    coarse, far = _grid(frame, max(limit - near.size, 1) if limit else 0)
    palette = np.array([(0, 0, 0), *(colour_of(o.category) for o in objects)], np.uint8)
    near, points = _measured(frame, near)
    labelled = _painted(frame, near, points, palette[owner[near]], fine)
    far, points = _measured(frame, far[owner[far] == 0])
    return _painted(frame, far, points, _scene_colours(points, planes), coarse), labelled


def _painted(frame: Frame, pixels: I4, points: F4, colours: U1, step: int) -> PaintedCloud:
    if frame.depth is None or frame.camera is None:
        return PaintedCloud(points, _pack(colours, np.ones(len(points), np.float32)), _RADIUS_M)
    light = _light(frame.depth, pixels, frame.camera.fx, frame.camera.fy)
    pitch = step * float(np.median(points[:, 2])) / frame.camera.fx if len(points) else 0.0
    return PaintedCloud(points, _pack(colours, light), 0.55 * pitch)


def _owners(frame: Frame, objects: Sequence[LabelledObject]) -> U2:
    """Return for each pixel or point the number of its object, from 1; 0 for none."""
    source = frame.depth if frame.depth is not None else frame.points
    size = 0 if source is None else source.size if frame.organized else len(source)
    owner = np.zeros(size, np.uint16)
    for number, item in enumerate(objects, 1):
        owner[item.indices] = number
    return owner


def _grid(frame: Frame, limit: int) -> tuple[int, I4]:
    """Return the pitch and about ``limit`` pixels on a grid, or every k-th point; all if 0."""
    if frame.depth is None:
        n = 0 if frame.points is None else len(frame.points)
        step = -(-n // limit) if limit and n else 1
        return step, np.arange(0, n, step)
    height, width = frame.depth.shape
    step = _step(height * width, limit)
    rows, columns = np.arange(step // 2, height, step), np.arange(step // 2, width, step)
    return step, (rows[:, None] * width + columns).ravel()


def _thin(frame: Frame, pixels: I4, limit: int) -> tuple[int, I4]:
    """Return the pitch of a grid and those of ``pixels`` on it, about ``limit``; all if 0."""
    if frame.depth is None:
        step = -(-pixels.size // limit) if limit and pixels.size else 1
        return step, pixels[::step]
    step, width = _step(pixels.size, limit), frame.depth.shape[1]
    return step, pixels[(pixels % width % step == 0) & (pixels // width % step == 0)]


def _step(size: int, limit: int) -> int:
    return int(np.ceil(np.sqrt(size / limit))) if limit and size > limit else 1


def _measured(frame: Frame, pixels: I4) -> tuple[I4, F4]:
    """Return the pixels that have a reading, and their points."""
    points = frame.xyz(pixels)
    valid = np.isfinite(points[:, 2])
    return pixels[valid], points[valid]


def _scene_colours(points: F4, planes: Sequence[Plane]) -> U1:
    colours = np.tile(_GROUND, (len(points), 1))
    for k, plane in enumerate(planes):
        height = points @ plane.normal - np.float32(plane.offset)
        near = np.flatnonzero(np.abs(height) < _PLANE_M)
        middle = plane.outline.mean(axis=0)
        reach = np.linalg.norm(plane.outline - middle, axis=1).max(initial=0.0)
        inside = ((points[near] - middle) ** 2).sum(axis=1) <= reach**2
        colours[near[inside]] = _PLANES[k % len(_PLANES)]
    return colours


def _pack(colours: U1, light: F4) -> U4:
    scaled = np.minimum(colours * light[:, None], 255).astype(np.uint32)
    return np.asarray((scaled[:, 0] << 24) | (scaled[:, 1] << 16) | (scaled[:, 2] << 8) | 0xFF)


@kernel
def _light(depth: F4, pixels: I4, fx: float, fy: float) -> F8:
    """Return (n,) brightness, 0.55 to 1.2, of pixels lit from above and left of the camera."""
    height, width = depth.shape
    result = np.ones(pixels.size, np.float32)
    reach = 3  # pixels: beyond the quantisation of the depth
    for k in range(pixels.size):
        v, u = pixels[k] // width, pixels[k] % width
        z = depth[v, u]
        near = 0.05 * z  # a larger difference is an edge, not a slope
        slope_x = slope_y = np.float32(0)
        left, right = depth[v, max(u - reach, 0)], depth[v, min(u + reach, width - 1)]
        if abs(left - z) < near and abs(right - z) < near:
            slope_x = (right - left) * fx / (2 * reach * z)
        above, below = depth[max(v - reach, 0), u], depth[min(v + reach, height - 1), u]
        if abs(above - z) < near and abs(below - z) < near:
            slope_y = (below - above) * fy / (2 * reach * z)
        # The normal is (slope_x, slope_y, -1); the light comes from (-0.4, -0.7, -0.6).
        facing = (-0.4 * slope_x - 0.7 * slope_y + 0.6) / np.sqrt(1 + slope_x**2 + slope_y**2)
        result[k] = 0.55 + 0.65 * max(facing, 0.0)
    return result
