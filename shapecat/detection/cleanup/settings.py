"""Tuned constants of this stage, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["CLEANUP", "CleanupSettings"]


class CleanupSettings(NamedTuple):
    """Constants for rejecting structure and completing labels."""

    min_logit: float = 0.0
    """Minimum logit of an object, which is then more likely than structure. Of the segments between
    -1 and 0 that cover less than `large_share` of the image, a fifth are objects."""
    min_large_logit: float = -1.0
    """Minimum logit of a larger object; between -1 and 0, two thirds of them are objects."""
    far_m: float = 2.0
    """Depth beyond which most segments are background, metres."""
    min_far_logit: float = 1.0
    """Minimum logit of an object that is far. In 160 simulated rooms, it rejects 60 of the 73 false
    objects that a range of 3 m adds to one of 2 m, and 2 of the 57 true ones."""
    certain_logit: float = 4.0
    """Absolute partial logit beyond which evaluation stops: of 1,742 segments, the remaining trees
    would reclassify none."""
    uncertain_logit: float = 3.0
    """Absolute logit below which a segment is classified again in its context. Doing so for all of
    98,747 segments would change the numbers of lost and of false objects by 0.3 %."""
    sure_logit: float = 4.0
    """Logit at which a neighbour counts three quarters of one that is certain."""
    tiny_share: float = 0.5
    """Segments with a smaller fraction of the cells of the smallest object are rejected here.
    Dropped only at the end, they would prevent the filling of the holes around them."""
    around_cells: int = 4
    """Distance from an object, in cells, at which the roughness of its plane is measured."""
    large_share: float = 0.02
    """Minimum fraction of the image covered by a large object, an arm, furniture or the bent end of
    a table."""
    cut_share: float = 0.4
    """Minimum fraction of the perimeter of such structure, assumed to be square, at the image
    border."""
    enclosed_share: float = 0.6
    """Minimum fraction of the boundary of a hole with the label around it: a ring seen from the
    side has this much, the gap between two objects half."""
    continuous_share: float = 0.15
    """Minimum fraction of the boundary of a hole where the surface continues; less in a handle."""
    mouth_share: float = 0.5
    """Minimum area of a hole without a continuous surface, relative to the object around it: more
    in the mouth of a cup seen from above, less in a handle."""


CLEANUP = CleanupSettings()
