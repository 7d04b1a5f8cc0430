"""Tuned constants of the clean-up, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["CLEANUP", "CleanupSettings"]


class CleanupSettings(NamedTuple):
    """Constants for rejecting structure and completing labels."""

    min_logit: float = 0.0
    """Minimum logit of an object, which is then more likely than structure. Of the segments with
    logits between -1 and 0 that cover less than `large_share` of the image, a fifth are objects."""
    min_large_logit: float = -1.0
    """Minimum logit of an object that covers more than `large_share` of the image. Of such segments
    with logits between -1 and 0, two thirds are objects."""
    far_m: float = 2.0
    """Depth beyond which most segments are background, metres."""
    min_far_logit: float = 1.0
    """Minimum logit of an object that is far. In 160 simulated rooms, a range of 3 m instead of 2 m
    adds 73 false and 57 true objects; this limit rejects 60 of the false and 2 of the true ones."""
    certain_logit: float = 4.0
    """If the sum of the first trees is farther from 0 than this, the other trees are not evaluated.
    They would reclassify none of 1,742 segments."""
    uncertain_logit: float = 3.0
    """Absolute logit below which a segment is classified again in its context. Doing so for all of
    98,747 segments would change the numbers of lost and of false objects by 0.3 %."""
    sure_logit: float = 4.0
    """Logit at which the verdict on a neighbour has three quarters of the weight of a certain
    one."""
    tiny_share: float = 0.5
    """Segments are rejected if they have fewer cells than this fraction of the smallest object. If
    they were rejected later, the holes around them would not be filled."""
    around_cells: int = 4
    """Distance from an object, in cells, at which the roughness of its plane is measured."""
    large_share: float = 0.02
    """A segment is large if it covers more than this fraction of the image, as large objects, arms,
    furniture and the bent ends of tables do."""
    cut_share: float = 0.4
    """A large segment is an arm or furniture if more than this fraction of its perimeter is at the
    image border. The perimeter is that of a square with the same number of cells."""
    enclosed_share: float = 0.6
    """Minimum fraction of the boundary of a hole that has the label of the object around it. For a
    ring seen from the side it is about this, for the gap between two objects a half."""
    continuous_share: float = 0.15
    """Minimum fraction of the boundary of a hole where the surface continues. For the hole of a
    handle, the fraction is smaller."""
    mouth_share: float = 0.5
    """Minimum area, relative to the object around it, of a closed hole into which the surface does
    not continue. The mouth of a cup seen from above is larger, the hole of a handle smaller."""


CLEANUP = CleanupSettings()
