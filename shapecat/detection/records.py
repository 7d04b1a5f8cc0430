"""What the steps of the detection hand on to each other."""

from typing import NamedTuple

from shapecat.arrays import F8, I4, U1
from shapecat.detection.merging.segments import Pieces
from shapecat.detection.output.measurements import Things
from shapecat.detection.planes.extent import Support
from shapecat.detection.planes.height_map import Heights
from shapecat.detection.segmentation.connectivity import Surfaces

__all__ = ["LabelledGrid", "OverSegmentation", "PlaneModel"]


class PlaneModel(NamedTuple):
    """What objects stand on and before.

    Attributes
    ----------
    up : (3,) unit vector.
    supports : the planes, lowest first.
    planes : their rows of `table_of`.
    heights : of the samples, and the plane each is above.
    raised : (rows, columns) int16, the numbers of the low-profile objects.
    walls : (rows, columns) uint8, not 0 on walls.
    """

    up: F8
    supports: list[Support]
    planes: F8
    heights: Heights
    raised: I4
    walls: U1


class OverSegmentation(NamedTuple):
    """What stands above the planes, parted where two objects may meet.

    Attributes
    ----------
    surfaces : which samples are connected, and which way they face.
    regions : (rows, columns) int16, the segments, 0 elsewhere.
    pieces : their statistics.
    """

    surfaces: Surfaces
    regions: I4
    pieces: Pieces


class LabelledGrid(NamedTuple):
    """A depth grid with its objects.

    Attributes
    ----------
    up : (3,) unit vector.
    supports : the planes, lowest first.
    planes : their rows of `table_of`.
    labels : (rows, columns) int16, 1..count, 0 elsewhere.
    filled : (rows, columns) uint8, 1 where a label lies at the level of the plane.
    owners : (count + 1,) the plane that each label stands above; 0 for label 0.
    things : what is measured of the labels.
    """

    up: F8
    supports: list[Support]
    planes: F8
    labels: I4
    filled: U1
    owners: I4
    things: Things
