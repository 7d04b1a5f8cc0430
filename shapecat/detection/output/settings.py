"""Tuned constants of the output, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["OUTPUT", "OutputConstants"]


class OutputConstants(NamedTuple):
    """Constants for measuring and labelling objects."""

    occluded_share: float = 0.12
    """Minimum fraction of the boundary of an occluded object that is behind a nearer surface."""
    gap_m: float = 0.025
    """Largest gap between the bottom of an object and the top of its support, metres: the part in
    between is hidden."""
    overlap_m: float = 0.04
    """Largest height, metres, by which an object may reach below the top of its support: a strip of
    the support may be labelled as the object."""
    beside_m: float = 0.01
    """Largest distance, metres, from an object to the middle of another one that stands on it."""
    behind_m: float = 0.04
    """Largest distance, metres, from the visible part of an object backwards to the middle of
    another one that stands on it: its back is hidden."""
    lifted_m: float = 0.03
    """An object whose bottom is more than this above its plane, metres, without touching it, stands
    on something else, which may be hidden."""
    sunk_m: float = 0.015
    """An object that extends this far below a surface, metres, does not stand on it."""
    voxel_m: float = 0.01
    """Edge of the voxels in which occluded points are connected, metres."""
    max_label: int = 1000
    """Largest label of a cluster of occluded points; this bounds the time."""
    border_cells: float = 2.5
    """Width of the border of a cloud, in cells."""
    forward_cos: float = 0.2
    """Approximate minimum cosine to the optical axis of a point in front of a camera."""
    min_cells_at_limit: int = 3
    """Minimum number of cells, at the range limit, of an object that the limit cuts off: fewer are
    noise."""
    crowded: float = 0.08
    """A cloud counts as fused from several views if more than this fraction of its points is behind
    others."""


OUTPUT = OutputConstants()
