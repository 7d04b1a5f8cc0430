"""The upright axis of an object, and its radial profile."""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.description.surface import Surface
from shapecat.jit import kernel

__all__ = ["PROFILE_NAMES", "VerticalAxis", "profile", "vertical_axis"]

_PROFILE_SLICES = 8
_PROFILE = ("share", "radius", "spread", "inward", "up", "curvature")
PROFILE_NAMES = tuple(f"{i}_{name}" for i in range(_PROFILE_SLICES) for name in _PROFILE)


class VerticalAxis(NamedTuple):
    """A vertical line, in the units of the surface.

    Attributes
    ----------
    x, y : its position.
    residual : root mean square distance between this line and the horizontal lines to which
        `vertical_axis` fits it.
    """

    x: float
    y: float
    residual: float


@kernel
def vertical_axis(x: F4, y: F4, normals: F4, weight: F4) -> VerticalAxis:
    """Find the vertical axis that the normals of a surface point to or away from.

    It is the vertical line nearest to the horizontal lines that pass through the neurons in the
    horizontal direction of their normals. A weak prior at the origin makes the result unique even
    if all normals are parallel or vertical.

    Parameters
    ----------
    x, y : (n,) positions of the neurons, in any unit of length.
    normals : (3, n) unit vectors.
    weight : (n,) each neuron's fraction of the points.
    """
    axx = axy = ayy = bx = by = total = 0.0
    for i in range(x.size):
        tx, ty = -normals[1, i], normals[0, i]
        w = weight[i]
        along = tx * x[i] + ty * y[i]
        axx += w * tx * tx
        axy += w * tx * ty
        ayy += w * ty * ty
        bx += w * tx * along
        by += w * ty * along
        total += w * (tx * tx + ty * ty)
    pull = 1e-2 * total + 1e-6
    axx += pull
    ayy += pull
    det = axx * ayy - axy * axy
    cx, cy = (ayy * bx - axy * by) / det, (axx * by - axy * bx) / det
    residual = 0.0
    for i in range(x.size):
        off = -normals[1, i] * (x[i] - cx) + normals[0, i] * (y[i] - cy)
        residual += weight[i] * off * off
    return VerticalAxis(cx, cy, np.sqrt(residual / max(total, 1e-6)))


@kernel
def profile(
    surface: Surface,
    normals: F4,
    curvatures: F4,
    upright: VerticalAxis,
    low: float,
    high: float,
    out: F4,
) -> None:
    """Write the radial profile about the vertical axis, named by `PROFILE_NAMES`.

    The features of each of 8 horizontal slices are its fraction of the points, the mean radius and
    its standard deviation (relative to the largest mean radius), the fraction of the points that
    face the axis (the steeper the surface, the more they count), the mean of the normals' z, and
    the mean curvature, mapped to -1 to 1.

    Parameters
    ----------
    normals, curvatures : (3, n) and (2, n), from `fit_surfaces`.
    upright : from `vertical_axis`.
    low, high : 2nd and 98th percentiles of the heights of the points, in units of the surface.
    out : the block ``profile`` of the descriptor, zeros on entry, written in place.
    """
    x, y, z = surface.neurons[0], surface.neurons[1], surface.neurons[2]
    weight = surface.weight
    widest = 1e-6
    for i in range(x.size):
        level = (z[i] - low) / (high - low) if high > low else 0.5
        place = min(max(level * _PROFILE_SLICES - 0.5, 0.0), _PROFILE_SLICES - 1.0)
        first = min(int(place), _PROFILE_SLICES - 2)
        rx, ry = x[i] - upright.x, y[i] - upright.y
        r = np.sqrt(rx * rx + ry * ry)
        inward = rx * normals[0, i] + ry * normals[1, i] < 0
        curvature = curvatures[0, i] + curvatures[1, i]
        for k in range(2):
            share = weight[i] * (place - first if k == 1 else first + 1 - place)
            at = (first + k) * 6
            out[at] += share
            out[at + 1] += share * r
            out[at + 2] += share * r * r
            out[at + 3] += share * (1.0 - abs(normals[2, i])) * inward
            out[at + 4] += share * normals[2, i]
            out[at + 5] += share * curvature / (1 + abs(curvature))
    for k in range(_PROFILE_SLICES):
        at = k * 6
        share = out[at]
        for m in range(1, 6):
            out[at + m] = out[at + m] / share if share > 1e-4 else 0.0
        out[at + 2] = np.sqrt(max(out[at + 2] - out[at + 1] ** 2, 0.0))
        widest = max(widest, out[at + 1])
    for k in range(_PROFILE_SLICES):
        out[k * 6 + 1] /= widest
        out[k * 6 + 2] /= widest
