"""The outline: the width of an object in the image, slice by slice.

Depth cameras err mainly along the line of sight. In distant views, widths are therefore the most
reliable features.
"""

import numpy as np

from shapecat.arrays import F4
from shapecat.description.ranges import inner_range
from shapecat.jit import kernel

__all__ = ["OUTLINE_NAMES", "OUTLINE_SLICES", "outline"]

OUTLINE_SLICES = 10
_SLICE = ("width", "aside")
OUTLINE_NAMES = (
    *(f"upright_{i}_{name}" for i in range(OUTLINE_SLICES) for name in _SLICE),
    *(f"long_{i}_{name}" for i in range(OUTLINE_SLICES) for name in _SLICE),
    "upright_length",  # length / (length + largest width)
    "long_length",
    "long_level",  # absolute cosine between the principal axis and the horizontal
    "upright_fill",  # mean width / largest width
    "long_fill",
)
_UPRIGHT, _TO_NARROW = np.bool_(0), np.bool_(1)  # Python's bools are compiled as two versions
_LONG, _END = 2 * OUTLINE_SLICES, 4 * OUTLINE_SLICES  # ends of both kinds of slices in the block


@kernel
def outline(cloud: F4, eye: F4, out: F4) -> None:
    """Write the features named by `OUTLINE_NAMES`.

    Widths are measured in slices along two directions: upwards, and along the principal axis of the
    outline from its wide to its narrow end. The feature ``aside`` is the distance of a slice's
    middle from the mean of all middles.

    Parameters
    ----------
    cloud : (3, n) points, z up, in units of the mean distance between neurons.
    eye : (3,) position of the sensor in the same frame.
    out : the block ``outline`` of the descriptor, zeros on entry, written in place;
        slices without points stay 0.
    """
    across, upward = _image(cloud, eye)
    out[_END], out[_END + 3] = _widths(upward, across, _UPRIGHT, out[:_LONG])
    mean_a = mean_u = aa = au = uu = 0.0
    for i in range(across.size):
        mean_a += across[i] / across.size
        mean_u += upward[i] / across.size
    for i in range(across.size):
        a, u = across[i] - mean_a, upward[i] - mean_u
        aa, au, uu = aa + a * a, au + a * u, uu + u * u
    angle = 0.5 * np.arctan2(2 * au, aa - uu)
    c, s = np.float32(np.cos(angle)), np.float32(np.sin(angle))
    for i in range(across.size):
        a, u = across[i], upward[i]
        across[i], upward[i] = c * a + s * u, c * u - s * a
    out[_END + 1], out[_END + 4] = _widths(across, upward, _TO_NARROW, out[_LONG:_END])
    out[_END + 2] = abs(c)


@kernel(inline=True)
def _image(cloud: F4, eye: F4) -> tuple[F4, F4]:
    """Project the points onto the plane through the origin that faces the sensor.

    Returns their coordinates (n,) to the right and (n,) upwards. ``cloud`` (3, n) and ``eye`` (3,)
    are as in `outline`.
    """
    count = cloud.shape[1]
    across, upward = np.zeros(count, np.float32), np.zeros(count, np.float32)
    distance = max(np.sqrt(np.float64(eye[0]) ** 2 + eye[1] ** 2 + eye[2] ** 2), 1e-6)
    sx, sy, sz = eye[0] / distance, eye[1] / distance, eye[2] / distance
    flat = np.sqrt(sx * sx + sy * sy)
    rx, ry = (-sy / flat, sx / flat) if flat > 1e-6 else (1.0, 0.0)
    ux, uy, uz = -sz * ry, sz * rx, sx * ry - sy * rx
    for i in range(count):
        x, y, z = cloud[0, i], cloud[1, i], cloud[2, i]
        depth = max(1.0 - (x * sx + y * sy + z * sz) / distance, 0.1)
        across[i] = (x * rx + y * ry) / depth
        upward[i] = (x * ux + y * uy + z * uz) / depth
    return across, upward


@kernel(inner=True)
def _widths(
    along: F4,
    across: F4,
    to_narrow: bool,  # noqa: FBT001  compiled kernels take their arguments by position
    out: F4,
) -> tuple[float, float]:
    """Write ``width`` and ``aside`` of each slice to ``out``, relative to the largest width.

    ``along`` and ``across`` (n,) are coordinates of the points; the slices divide the length, which
    is the `inner_range` of ``along``. With ``to_narrow``, they go from the wide to the narrow end.
    Returns length / (length + largest width), and the mean width divided by the largest.
    """
    low, high = inner_range(along)
    length = max(high - low, 1e-6)
    left, right = np.zeros(OUTLINE_SLICES), np.zeros(OUTLINE_SLICES)
    left[:], right[:] = np.inf, -np.inf
    for i in range(along.size):
        k = min(max(int((along[i] - low) / length * OUTLINE_SLICES), 0), OUTLINE_SLICES - 1)
        left[k], right[k] = min(left[k], across[i]), max(right[k], across[i])
    widest, middle, total, lean = 1e-6, 0.0, 0.0, 0.0
    for k in range(OUTLINE_SLICES):
        width = max(right[k] - left[k], 0.0)
        if width > 0:
            widest = max(widest, width)
            middle += width * (right[k] + left[k]) / 2
            total += width
            lean += width * (k - 0.5 * (OUTLINE_SLICES - 1))
    middle /= max(total, 1e-6)
    for k in range(OUTLINE_SLICES):
        source = OUTLINE_SLICES - 1 - k if to_narrow and lean > 0 else k
        if right[source] > left[source]:
            out[2 * k] = (right[source] - left[source]) / widest
            out[2 * k + 1] = abs((right[source] + left[source]) / 2 - middle) / widest
    return length / (length + widest), total / OUTLINE_SLICES / widest
