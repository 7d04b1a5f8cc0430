"""Tuned constants of this stage, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["CLEANUP", "CleanupSettings"]


class CleanupSettings(NamedTuple):
    """How background is rejected and labels are completed."""

    least_logit: float = -1.5
    """Logit, of 0.18, from which on something is taken for an object: one that is missed is lost,
    one too many can still be rejected over time."""
    hopeless: float = -8.0
    """Logit of the first trees that the others never made up for."""
    border_share: float = 0.08
    """Share of the image that sensors leave empty at most at its border."""
    cut_off_m: float = 0.02
    """What reaches so near to the greatest height, metres, goes on above it."""
    large_share: float = 0.02
    """Share of the image that an arm, furniture or a bent end of a table covers at least."""
    cut_share: float = 0.4
    """Share of its outline, taken for a square, that is at the border of the image then."""
    fringe: float = 0.6
    """Share of the least height from which a sample next to an object belongs to it: the least
    height is safe against the noise of the plane, and what is as low farther away is as often
    the plane."""
    enclosed_share: float = 0.6
    """Least share of the boundary of a hole that is of what encloses it: of a ring seen from the
    side it is so much, of two objects side by side half."""
    goes_on_share: float = 0.15
    """Share of it where the surface goes on at least: not so through the hole of a handle."""


CLEANUP = CleanupSettings()
