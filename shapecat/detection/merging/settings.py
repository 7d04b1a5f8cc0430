"""Tuned constants of this stage, with their units and the reason for each."""

import math
from typing import NamedTuple

__all__ = ["MERGING", "MergingSettings"]


class MergingSettings(NamedTuple):
    """Constants for measuring, comparing and merging segments."""

    up_cos: float = 0.8
    """Minimum cosine to up of a normal that faces up: noise turns normals by up to 35 degrees."""
    edge_on_cos: float = 0.2
    """Minimum cosine to the line of sight in the correction of areas: below, noise dominates."""
    flat_deg: int = 20
    """Largest concave angle, degrees, of a sample of a segment; others are too near an edge."""
    gap_cells: int = 3
    """Maximum number of cells without depth within one surface."""
    shadow_cells: int = 15
    """Maximum number of cells without depth between two surfaces: the nearer one shadows the
    projector."""
    inward_cells: int = 3
    """Distance from a border, in cells, at which the normal of a surface is taken."""
    down_cos: float = 0.7
    """Cosine of the largest angle, in the image, between a lower neighbour and straight down."""
    top_bands: int = 4
    """Number of 5 mm bands below the top in which upward-facing surface closes a segment."""
    facing_m: float = 0.015
    """Largest height difference between the tops of two walls of a pot, metres."""
    facing_share: float = 0.5
    """Minimum overlap of two walls of a pot across their line of sight, relative to the smaller."""
    no_contact_m: float = -1.0
    """Value of the feature for the height of a contact with upward-facing surface, if there is no
    contact, metres."""
    merge_logit: float = 0.3
    """Minimum logit of a pair that is merged, for a probability of 0.57: a wrong merge loses two
    objects, a missing merge rarely one."""
    stop_logit: float = -3.0
    """Partial logit below which evaluation stops: with -2.5, none of 500 scenes would differ."""
    coplanar_m: float = 0.006
    """Largest distance of a sample from the local plane of another: two steps of a Kinect."""
    coplanar_slope: float = 0.05
    """Increase of that limit per metre between the samples: local planes are 3 degrees off."""
    coplanar_cos: float = math.cos(math.radians(15))
    """Minimum cosine between the normals of the samples, for 15 degrees."""
    partner_share: float = 0.45
    """Minimum fraction of the samples of either segment that continue the other; on round objects,
    half of them do."""
    min_samples: int = 4
    """Minimum number of samples that describe the surface of a segment."""
    max_lines: int = 300
    """Maximum number of lines between partners that are followed; this bounds the time."""
    line_steps: int = 8
    """Steps on each line: an occluder is wider than an eighth of the gap."""
    free_share: float = 0.12
    """Maximum fraction of points on the lines in free space: edges of an occluder are ragged."""
    hidden_share: float = 0.05
    """Minimum fraction of points on the lines behind an occluder."""


MERGING = MergingSettings()
