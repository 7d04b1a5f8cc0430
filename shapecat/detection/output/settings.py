"""Tuned constants of this stage, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["OUTPUT", "OutputSettings"]


class OutputSettings(NamedTuple):
    """How objects are measured and given back."""

    occluded_share: float = 0.12
    """Share of the boundary behind something nearer that makes an object occluded."""
    gap_m: float = 0.025
    """How far the bottom of an object may seem to be above the top of what it stands on, metres:
    what is between is hidden."""
    overlap_m: float = 0.04
    """And below it: a strip of it may go with the object."""
    lifted_m: float = 0.03
    """What reaches no lower than this above its plane, metres, does not stand on it."""
    sunk_m: float = 0.015
    """What reaches this much lower than a surface, metres, does not stand on that."""
    voxel_m: float = 0.01
    """Occluded points in voxels of this size, metres, that touch are of one object."""
    most_labels: int = 1000
    """Clusters of occluded points; this bounds the time."""
    highest_m: float = 0.6
    """Height above a plane of the highest of them, metres."""
    enough_cells: int = 60
    """Cells of what is no noise, however near and therefore small it is."""
    border_cells: float = 2.5
    """Width of the border of a cloud, in cells."""
    straight_share: float = 0.3
    """Least share of a side that such a border is straight along."""
    forward_cos: float = 0.2
    """Least cosine, about, of what is in front of a camera."""
    crowded: float = 0.08
    """Share of points behind others from which a cloud is taken for fused from several views."""


OUTPUT = OutputSettings()
