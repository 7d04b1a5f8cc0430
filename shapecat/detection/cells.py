"""Cells: the depth image at the resolution the rules work at.

Everything is done in inverse depth ``w = 1 / z`` (1/m): a plane is exactly linear in (column, row,
w), and the noise of disparity cameras is constant in w, so thresholds need no model of range.
"""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.jit import kernel
from shapecat.types import Camera

__all__ = ["JUMP", "Cells", "Lens", "cells_of"]

JUMP = 0.012
"""Step in inverse depth that separates surfaces, 1/m: four steps of a Kinect, 1 cm at 0.9 m."""
CELL_M = 0.0035
"""Size of a cell on the objects: small against the smallest object, larger than the noise."""
NEAREST_M = 0.05
"""Nothing measures nearer; keeps inverse depth within bounds."""
LARGEST_FACTOR = 16


class Lens(NamedTuple):
    """A pinhole camera in units of cells: cell (i, j) sees ((j - cx) / fx, (i - cy) / fy, 1)."""

    fx: float
    fy: float
    cx: float
    cy: float


class Cells(NamedTuple):
    """The image of cells.

    Attributes
    ----------
    w : (rows, columns) float32 inverse depth, 1/m; 0 where there is no reading.
    lens : the camera in units of cells.
    factor : pixels along the edge of a cell.
    """

    w: F4
    lens: Lens
    factor: int


def cells_of(depth: F4, camera: Camera, *, range_m: float, cell_m: float = CELL_M) -> Cells | None:
    """Average pixels of ``depth`` (h, w), metres, into cells; None if there is no reading.

    Readings beyond ``range_m`` are left out (thesis 4.2, pass-through filter).
    """
    sample = depth[2::5, 2::5] if min(depth.shape) > 50 else depth
    sample = sample[(sample >= NEAREST_M) & (sample <= range_m)]
    if sample.size == 0:
        return None
    pixel_m = float(np.median(sample)) / max(abs(camera.fx), 1e-6)
    factor = round(min(max(cell_m / max(pixel_m, 1e-9), 1.0), LARGEST_FACTOR, *depth.shape))
    shift = (factor - 1) / 2
    lens = Lens(
        camera.fx / factor,
        camera.fy / factor,
        (camera.cx - shift) / factor,
        (camera.cy - shift) / factor,
    )
    rows, columns = depth.shape[0] // factor, depth.shape[1] // factor
    w = np.zeros((rows, columns), np.float32)
    _average(depth, factor, np.float32(range_m), np.float32(JUMP), w)
    return Cells(w, lens, factor)


@kernel
def _average(depth: F4, factor: int, range_m: float, jump: float, w: F4) -> None:
    """Write to ``w`` the inverse of the mean depth of the pixels near the nearest of each cell."""
    rows, columns = w.shape
    far = np.float32(1e9)
    zero = np.float32(0)
    one = np.float32(1)
    least = np.float32(NEAREST_M)
    nearest = np.zeros(columns, np.float32)
    total = np.zeros(columns, np.float32)
    count = np.zeros(columns, np.float32)
    for i in range(rows):
        nearest[:] = far
        total[:] = zero
        count[:] = zero
        for a in range(factor):
            for b in range(factor):
                line = depth[i * factor + a, b:]
                for j in range(columns):
                    z = line[j * factor]
                    z = z if (z >= least) & (z <= range_m) else far
                    nearest[j] = z if z < nearest[j] else nearest[j]
        for j in range(columns):
            # The depth that is one jump behind the nearest, in inverse depth.
            nearest[j] = nearest[j] / (one - min(jump * nearest[j], np.float32(0.5)))
        for a in range(factor):
            for b in range(factor):
                line = depth[i * factor + a, b:]
                for j in range(columns):
                    z = line[j * factor]
                    use = (z >= least) & (z <= range_m) & (z <= nearest[j])
                    total[j] += z if use else zero
                    count[j] += one if use else zero
        for j in range(columns):
            w[i, j] = count[j] / total[j] if count[j] > zero else zero
