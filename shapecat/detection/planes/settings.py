"""Tuned constants of the plane search, with their units and the reason for each."""

import math
from typing import NamedTuple

__all__ = ["PLANES", "STRIPS", "UP", "PlaneSettings", "StripSettings", "UpSettings"]


class UpSettings(NamedTuple):
    """How the up direction is estimated."""

    facing_cos: float = math.cos(math.radians(20))
    """A surface faces a direction within this angle: noise turns normals by up to 15 degrees."""
    hint_cos: float = math.cos(math.radians(15))
    """Accelerometers and poses of cameras are off by less."""
    corner_cos: float = 0.3
    """Two directions farther from each other than this may be of two walls."""
    least_share: float = 0.04
    """Share of the surface that faces up at least: of a table at the edge of the image."""
    trials: int = 120
    """Directions tried: one in 25 misses with a chance of less than a hundredth."""
    level_bin_m: float = 0.04
    """Height of a bin, metres: more than the noise at 2 m and less than a board is apart from the
    next."""
    several: float = 1.5
    """Power of the number of levels: a shelf has several, the wall behind it one."""
    clear: float = 2.0
    """Power of the share of what faces a direction that lies in large levels."""
    aslant: float = 0.6
    """What of a direction's merit is lost where the camera looks along it: at walls, not tables."""
    held: float = 3.0
    """A direction that means a camera on its side or upside down counts a quarter."""
    steep: float = 0.03
    """Squared sine of the angle to the line of sight below which a direction tells no roll."""
    half_m: float = 1.5
    """Distance at which a surface counts half: what is near decides."""


class PlaneSettings(NamedTuple):
    """How planes are found and told from the tops of objects."""

    tolerance: float = 0.01
    """Distance of an inlier from a plane in inverse depth, 1/m: three steps of a Kinect."""
    level_cos: float = math.cos(math.radians(25))
    """Noise tilts a level surface by less than 25 degrees."""
    bin_m: float = 0.01
    """Height of a bin of level surface, metres: as the noise at 1.5 m."""
    least_m2: float = 0.02
    """Visible area of the smallest plane: a strip of a table that is left free."""
    margin_m: float = 0.01
    """A plane goes on so far beyond the samples on it, metres: as far as these are apart."""
    steady_cos: float = math.cos(math.radians(6))
    """A plane that is tilted more against up does not follow from the samples at its height."""
    close_share: float = 0.75
    """Of the samples near a plane, fewer are within half the tolerance if it lies tilted between
    two, as between a table and the plates on it."""
    turned_cos: float = math.cos(math.radians(1))
    """Where up turns out to be off by more, heights blur by a centimetre at half a metre."""
    furniture_m2: float = 0.25
    """Larger planes are furniture, whatever is under their edge."""
    likely_m2: float = 0.1
    """Larger planes are furniture if nothing is seen of what is under their edge."""
    board_m2: float = 0.03
    """Smaller planes are no boards above another plane."""
    least_drop_m: float = 0.06
    """What is less high above a plane is an object."""
    step_m: float = 0.01
    """Length of the steps by which the surroundings of an edge are looked at, metres."""
    wall_m: float = 0.03
    """Samples within this distance behind an edge are of the wall of a box, metres."""
    closed: float = 0.5
    """Share of the samples below an edge on a wall that closes a box."""
    borne_m: float = 0.4
    """What is higher above a large plane does not stand on it, metres."""


class StripSettings(NamedTuple):
    """How planes are found of which strips are seen."""

    bin_m: float = 0.005
    """Height of a bin, metres: as the noise of strips at 1 m."""
    grazing: float = 0.015
    """Change of inverse depth from row to row, 1/m, from which a plane is seen at a grazing angle:
    the tolerance is passed within a row."""
    least_depth_m: float = 0.03
    """Rays that fall less steeply, down over forward, run along a surface."""
    least_rise: float = 0.05
    """Slope of a ray, down over forward, below which the surface of a cell is no larger."""
    below: int = 10
    """Bins below a plane in which there is next to nothing."""
    above: int = 30
    """Bins above a covered plane in which the tops of the things on it lie."""
    covers: float = 1.0
    """Tops of things that cover a plane show so many times its surface."""
    contrast: float = 2.0
    """A plane has so many times the surface of what is below."""
    dip: float = 0.6
    """Above a plane the surface falls to this share of its own."""
    least_m2: float = 0.001
    """What is seen of a covered plane at least."""
    least_points: int = 15
    """Of every third sample, at a height that may be that of strips."""
    same_m: float = 0.012
    """Planes whose heights differ by less, metres, are one."""
    tallest_m: float = 0.15
    """Height of the tallest things that cover a plane, metres."""
    most_seen: float = 0.45
    """Share of its outline that is seen of a covered plane at most: a lid is seen whole."""


UP, PLANES, STRIPS = UpSettings(), PlaneSettings(), StripSettings()
