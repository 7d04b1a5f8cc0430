"""Tuned constants of merging, with their units and the reason for each."""

import math
from typing import NamedTuple

__all__ = ["MERGING", "MergingSettings"]


class MergingSettings(NamedTuple):
    """Constants for measuring, comparing and merging segments."""

    up_cos: float = 0.8
    """Minimum cosine between up and the normal of an upward-facing surface: noise turns normals by
    up to 35 degrees."""
    edge_on_cos: float = 0.2
    """Lower bound of the cosine between a normal and the line of sight in the computation of areas:
    below it, noise dominates."""
    flat_deg: int = 20
    """Largest concave angle, degrees, of a sample of a segment; others are too near an edge."""
    gap_cells: int = 3
    """Maximum number of cells without depth within one surface."""
    shadow_cells: int = 15
    """Maximum number of cells without depth between two surfaces: the nearer one blocks the
    light of the projector."""
    inward_cells: int = 3
    """Distance from a border, in cells, at which the normal of a surface is taken."""
    down_cos: float = 0.7
    """Cosine of the largest angle, in the image, between down and the direction to a neighbour that
    counts as lower."""
    top_bands: int = 4
    """Number of 5 mm bands below the top of a segment in which upward-facing surface counts as its
    top face."""
    facing_m: float = 0.015
    """Largest height difference between the tops of two walls of a pot, metres."""
    facing_share: float = 0.5
    """Minimum overlap of two walls of a pot across the line of sight, relative to the narrower."""
    no_contact_m: float = -1.0
    """Value of the features `above_second_m` and `above_first_m` if there is no contact, metres."""
    merge_logit: float = 0.3
    """Minimum logit of a pair that is merged, for a probability of 0.57: a wrong merge loses two
    objects, a missing merge rarely one."""
    stop_logit: float = -3.0
    """If the sum of the first trees is below this, the other trees are not evaluated. Even with
    -2.5, the results for 500 scenes are the same."""
    coplanar_m: float = 0.006
    """Largest distance of a sample from the local plane of another, metres: two disparity steps of
    a Kinect."""
    coplanar_slope: float = 0.05
    """Increase of ``coplanar_m`` per metre between the samples: local planes are 3 degrees off."""
    coplanar_cos: float = math.cos(math.radians(15))
    """Minimum cosine between the normals of the samples (15 degrees)."""
    partner_share: float = 0.45
    """Minimum fraction of the samples of each segment that continue the other; on round objects,
    half of them do."""
    min_samples: int = 4
    """Minimum number of samples that describe the surface of a segment."""
    max_lines: int = 300
    """Maximum number of lines between partners that are followed; this bounds the time."""
    line_steps: int = 8
    """Number of steps on each line: occluders are wider than an eighth of the gap."""
    free_share: float = 0.12
    """Maximum fraction of the points on the lines that are in free space; there are some, since the
    edges of an occluder are ragged."""
    hidden_share: float = 0.05
    """Minimum fraction of the points on the lines that are behind an occluder."""


MERGING = MergingSettings()
