"""The records that the steps of detection pass on."""

from typing import NamedTuple

from shapecat.arrays import F8, I4, U1, Bool, Records
from shapecat.detection.merging.segments import Segments
from shapecat.detection.output.measurements import ObjectMeasurements
from shapecat.detection.planes.height_map import HeightMap
from shapecat.detection.segmentation.connectivity import SurfaceGraph

__all__ = ["OverSegmentation", "PlaneModel", "Segmentation"]


class PlaneModel(NamedTuple):
    """The supporting planes, the samples above them, and the walls.

    Attributes
    ----------
    up : (3,) unit vector, sensor frame.
    planes : (planes,) records of `PLANE`, lowest first.
    heights : the plane below each sample, and the height above it.
    low_profile : (rows, columns) whether a cell is on a low-profile object.
    walls : (rows, columns) uint8, from `remove_walls`; not 0 on walls.
    """

    up: F8
    planes: Records
    heights: HeightMap
    low_profile: Bool
    walls: U1


class OverSegmentation(NamedTuple):
    """The samples above the planes, split wherever two objects may meet.

    Attributes
    ----------
    graph : the connections and normals of the samples.
    labels : (rows, columns) int16, the number of the segment, from 1; 0 elsewhere.
    segments : the statistics of the segments.
    """

    graph: SurfaceGraph
    labels: I4
    segments: Segments


class Segmentation(NamedTuple):
    """The objects in a depth grid.

    Attributes
    ----------
    model : the planes, the samples above them, and the walls.
    labels : (rows, columns) int16, the number of the object, from 1; 0 elsewhere.
    filled : (rows, columns) uint8, 1 where a labelled cell may be at the height of its plane: in a
        filled hole or on a low-profile object.
    plane_ids : (objects + 1,) index in ``model.planes`` of the plane below each object; 0 for
        label 0.
    measured : the boxes, supports and flags of the objects.
    """

    model: PlaneModel
    labels: I4
    filled: U1
    plane_ids: I4
    measured: ObjectMeasurements
