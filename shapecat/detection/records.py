"""What the steps of the detection hand on to each other."""

from typing import NamedTuple

from shapecat.arrays import F8, I4, U1
from shapecat.detection.merging.segments import Segments
from shapecat.detection.output.measurements import ObjectMeasurements
from shapecat.detection.planes.extent import SupportingPlane
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import SurfaceGraph

__all__ = ["OverSegmentation", "PlaneModel", "Segmentation"]


class PlaneModel(NamedTuple):
    """What objects stand on and before.

    Attributes
    ----------
    up : (3,) unit vector.
    supports : the planes, lowest first.
    planes : their rows of `pack_planes`.
    heights : of the samples, and the plane each is above.
    low_profile : (rows, columns) int16, the numbers of the low-profile objects.
    walls : (rows, columns) uint8, not 0 on walls.
    """

    up: F8
    supports: list[SupportingPlane]
    planes: F8
    heights: HeightMap
    low_profile: I4
    walls: U1


class OverSegmentation(NamedTuple):
    """What stands above the planes, parted where two objects may meet.

    Attributes
    ----------
    graph : which samples are connected, and which way they face.
    labels : (rows, columns) int16, the segments, 0 elsewhere.
    segments : their statistics.
    """

    graph: SurfaceGraph
    labels: I4
    segments: Segments


class Segmentation(NamedTuple):
    """A depth grid with its objects.

    Attributes
    ----------
    up : (3,) unit vector.
    supports : the planes, lowest first.
    planes : their rows of `pack_planes`.
    labels : (rows, columns) int16, 1..count, 0 elsewhere.
    filled : (rows, columns) uint8, 1 where a label lies at the level of the plane.
    plane_ids : (count + 1,) the plane that each label stands above; 0 for label 0.
    measured : what is measured of the labels.
    """

    up: F8
    supports: list[SupportingPlane]
    planes: F8
    labels: I4
    filled: U1
    plane_ids: I4
    measured: ObjectMeasurements
