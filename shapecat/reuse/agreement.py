"""Decide whether two depth images show the same surface."""

import numpy as np

from shapecat.arrays import F4, F8, U4
from shapecat.geometry import AGREE, NEAREST_M
from shapecat.jit import kernel
from shapecat.types import Camera, Pose

__all__ = ["agreement"]

_SAMPLES = 256
"""Approximate number of points that are sampled."""
_KNOWN = 0.5
"""Minimum fraction of the sampled points that must be comparable; points without depth in either
image are not."""


def agreement(
    pixels: U4, depth: F4, camera: Camera, other: F4, other_camera: Camera, other_from_one: Pose
) -> tuple[float, float]:
    """Compare an object's points with another depth image.

    Parameters
    ----------
    pixels : (n,) flat indices of the object's pixels in ``depth``.
    depth, other : (h, w) metres, 0 where depth is missing.
    camera, other_camera : the cameras of ``depth`` and ``other``.
    other_from_one : pose of the sensor of ``depth`` in the sensor frame of ``other``.

    Returns
    -------
    The fraction of the compared points that agree with ``other``, and the mean difference of their
    inverse depths, 1/m, positive if ``other`` sees the agreeing points nearer; (0, 0) if too few
    points are comparable (`_KNOWN`) or none agrees.
    """
    # Writable, in C order, so that the kernel is compiled only once.
    rotation = np.array(other_from_one.rotation, order="C")
    translation = other_from_one.translation
    compared, agreeing, total = _compare(
        pixels, depth, _numbers(camera), other, _numbers(other_camera), rotation, translation
    )
    sampled = -(-len(pixels) // _step(len(pixels)))
    if not agreeing or compared < _KNOWN * sampled:
        return 0.0, 0.0
    return agreeing / compared, total / agreeing


def _numbers(camera: Camera) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera."""
    return float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)


@kernel
def _step(count: int) -> int:
    """Return the step between the points compared, given the number of all points."""
    return max(1, count // _SAMPLES)


@kernel
def _compare(
    pixels: U4,
    depth: F4,
    camera: tuple[float, float, float, float],
    other: F4,
    other_camera: tuple[float, float, float, float],
    rotation: F8,
    translation: F8,
) -> tuple[int, int, float]:
    """Return the numbers of compared and agreeing points, and the latter's summed differences, 1/m.

    Only a sample of the points is compared. Points that ``other`` cannot see count as compared, but
    not points without depth in either image.

    Parameters
    ----------
    pixels : (n,) flat indices of the points in ``depth``.
    depth, other : (h, w) metres, the image with the points and the image to compare with.
    camera, other_camera : fx, fy, cx, cy, pixels.
    rotation, translation : rotation (3, 3) and translation (3,), metres, of ``other_from_one``.
    """
    fx, fy, cx, cy = camera
    gx, gy, ax, ay = other_camera
    width = depth.shape[1]
    compared, agreeing, total = 0, 0, 0.0
    for k in range(0, len(pixels), _step(len(pixels))):
        v, u = int(pixels[k]) // width, int(pixels[k]) % width
        z = depth[v, u]
        if z <= 0:
            continue
        x, y = (u - cx) / fx * z, (v - cy) / fy * z
        a = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
        b = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
        c = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z + translation[2]
        if c < NEAREST_M:
            compared += 1
            continue
        has_depth, difference = _difference_at(
            other, int(np.floor(gy * b / c + ay + 0.5)), int(np.floor(gx * a / c + ax + 0.5)), 1 / c
        )
        if has_depth:
            compared += 1
            if abs(difference) <= AGREE:
                agreeing += 1
                total += difference
    return compared, agreeing, total


@kernel(inline=True)
def _difference_at(depth: F4, row: int, column: int, expected: float) -> tuple[bool, float]:
    """Return whether a pixel has depth, and its inverse depth minus the expected one, 1/m.

    If the pixel itself does not agree, its best neighbour counts: at an edge, the outline may be
    off by a pixel. Outside the image, the result is (True, infinity): nothing agrees there.
    ``depth`` is (h, w), metres.
    """
    height, width = depth.shape
    if not (0 <= row < height and 0 <= column < width):
        return True, np.inf
    has_depth, difference = False, np.inf
    if depth[row, column] > 0:
        has_depth, difference = True, 1 / depth[row, column] - expected
        if abs(difference) <= AGREE:
            return has_depth, difference
    for v in range(max(row - 1, 0), min(row + 2, height)):
        for u in range(max(column - 1, 0), min(column + 2, width)):
            if depth[v, u] > 0 and abs(1 / depth[v, u] - expected) < abs(difference):
                has_depth, difference = True, 1 / depth[v, u] - expected
    return has_depth, difference
