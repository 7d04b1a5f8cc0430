"""Tuned constants of this stage, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["MERGING", "MergingSettings"]


class MergingSettings(NamedTuple):
    """How segments are measured, compared and merged."""

    few: int = 3
    """Links between two segments that are a contact rather than noise."""
    up_cos: float = 0.8
    """Cosine of the largest angle to up of a normal that faces up: noise turns it by 35 degrees."""
    edge_on_cos: float = 0.2
    """Least cosine to the line of sight that areas are corrected for: below, noise decides."""
    flat_deg: int = 20
    """Concave angle, degrees, from which a cell is too near to an edge to stand for its segment."""
    gap_cells: int = 3
    """Cells without a sample within one surface."""
    shadow_cells: int = 15
    """And between two, of which the nearer keeps the light of the projector from the other."""
    inward_cells: int = 3
    """Cells from a border to where it is known which way the surface faces."""
    down_cos: float = 0.7
    """Cosine of the largest angle, in the image, of the neighbour below to straight down."""
    top_bands: int = 4
    """Bands of height below the top, of 5 mm, in which what faces up closes it."""
    facing_m: float = 0.015
    """Difference of the tops of what may be the two walls of a pot, metres."""
    facing_share: float = 0.5
    """Share of the narrower one's width that has the other one before or behind it."""
    nowhere_m: float = -1.0
    """Height of what faces up across a border where nothing does, metres: less than any."""
    likely: float = 0.3
    """Logit, of 0.57, from which on two segments are merged: a wrong merge loses two objects, a
    missing one seldom one."""
    hopeless: float = -4.0
    """Logit of the first trees that the others never made up for: half of the pairs."""
    low_share: float = 0.5
    """Share of the cells of a segment that belong to one low-profile object."""
    coplanar_m: float = 0.006
    """How far a sample may lie off the local plane of another, metres: two steps of a Kinect."""
    coplanar_slope: float = 0.05
    """And per metre between them: local planes are 3 degrees off."""
    coplanar_cos: float = 0.966
    """Cosine of the largest angle between their normals, 15 degrees."""
    partners: float = 0.45
    """Share of the samples of either segment that continue the other; of round ones half do."""
    fewest_samples: int = 4
    """Samples of a segment that say anything about its surface."""
    most_lines: int = 300
    """Lines between partners that are looked along; this bounds the time."""
    line_steps: int = 8
    """Places on each that are looked at: an occluder is wider than an eighth of the gap."""
    free_share: float = 0.12
    """Largest share of them in free space or on others: edges of the occluder are ragged."""
    hidden_share: float = 0.05
    """Least share of them behind something."""


MERGING = MergingSettings()
