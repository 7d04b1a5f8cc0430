"""Surface reconstruction (thesis ch. 5): a cloud becomes a graph that has learned its surface."""

from shapecat.surface.gas import MIN_POINTS, reconstruct
from shapecat.surface.smoothing import smooth, thin
from shapecat.surface.voxels import voxelize

__all__ = ["MIN_POINTS", "reconstruct", "smooth", "thin", "voxelize"]
