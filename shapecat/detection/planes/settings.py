"""Tuned constants of the plane search, with their units and the reason for each."""

import math
from typing import NamedTuple

__all__ = ["ASSUMED", "PLANES", "STRIPS", "UP"]


class UpSettings(NamedTuple):
    """Constants for estimating the up direction.

    A level is a peak in the histogram of heights along a direction that may be up.
    """

    facing_cos: float = math.cos(math.radians(20))
    """Minimum cosine between a direction and the normals of surfaces that face it (20 degrees):
    noise turns normals by up to 15 degrees."""
    hint_cos: float = math.cos(math.radians(15))
    """Minimum cosine between a normal and the given up direction (15 degrees): the errors of IMUs
    and poses are smaller."""
    corner_cos: float = 0.3
    """Directions with a smaller absolute cosine between them may be the normals of two walls."""
    min_share: float = 0.04
    """Minimum fraction of the points that must face a direction, and of the weight that must be in
    a large level. A table at the edge of the image has about this."""
    trials: int = 120
    """Number of directions tried. A direction shared by 1 in 25 normals is missed with a
    probability below 1 %."""
    level_bin_m: float = 0.04
    """Size of a bin of the histogram of heights, metres: more than the noise at a depth of 2 m,
    less than the gap between boards."""
    level_exponent: float = 0.7
    """Exponent of the weight of large levels in the score of a direction. It is below 1, because a
    camera sees more of the wall behind a counter than of the counter."""
    purity_exponent: float = 2.0
    """Exponent of the purity in the score. The purity of a direction is the fraction of the surface
    facing it that is in large levels."""
    frontal_penalty: float = 0.6
    """Fraction of the score that a direction along the optical axis loses: it is likely the normal
    of a wall."""
    roll_penalty: float = 4.0
    """The score of a direction that implies a camera on its side or upside down is divided by up to
    1 plus this, depending on the roll."""
    frontal_sin2: float = 0.03
    """Squared sine of the angle to the optical axis below which a direction implies no roll."""
    half_weight_m: float = 1.5
    """Depth at which a point has half the weight, metres, so that near surfaces dominate."""


class PlaneSettings(NamedTuple):
    """Constants for finding planes and distinguishing them from the tops of objects."""

    tolerance: float = 0.01
    """Distance of an inlier from a plane in inverse depth, 1/m: three disparity steps of a
    Kinect."""
    level_cos: float = math.cos(math.radians(25))
    """Minimum cosine between up and the normals of level surfaces (25 degrees): noise tilts them
    by less."""
    bin_m: float = 0.01
    """Size of a bin in the histogram of heights, metres: the noise at a depth of 1.5 m."""
    min_area_m2: float = 0.02
    """Minimum visible area of a plane: about the uncovered strip of a table."""
    margin_m: float = 0.01
    """A plane extends this far beyond its samples, metres: about the spacing of the samples."""
    steady_cos: float = math.cos(math.radians(6))
    """Minimum cosine between up and the normal of a fitted plane (6 degrees). If the plane tilts
    more, its samples do not determine the tilt."""
    close_share: float = 0.75
    """Minimum fraction of the inliers within half the tolerance. A plane tilted between two others,
    such as a table and the plates on it, has fewer."""
    furniture_m2: float = 0.25
    """Larger planes are furniture, unless they have a wall below their edge and nothing on them."""
    likely_m2: float = 0.1
    """Larger planes are likely furniture if the space below their edge is not visible."""
    board_m2: float = 0.03
    """Smaller planes above another plane are not boards."""
    min_drop_m: float = 0.06
    """A plane less than this above another is the top of an object, metres."""
    step_m: float = 0.01
    """Length of the steps in which the surroundings of an edge are searched, metres."""
    wall_m: float = 0.03
    """Samples within this depth of the vertical below an edge are on the wall of a box, metres."""
    wall_share: float = 0.5
    """A plane is the top of a box if more than this fraction of the samples below its edge are on a
    wall."""
    bare_share: float = 0.02
    """A plane has nothing on it if less than this fraction of the samples inside its outline is
    higher above it than twice the minimum height of an object."""
    around_m: float = 0.03
    """Distance from a sample of a plane to where its surroundings are examined, metres."""
    drop_ratio: float = 0.2
    """Number of places around the floor of a bin at which the surface may drop, relative to the
    number at which it rises."""
    hidden_m: float = 0.2
    """Maximum width of the part of a bin's floor that objects hide at one side, metres."""
    max_object_m: float = 0.4
    """Maximum height of an object above the large plane it stands on, metres."""


class StripSettings(NamedTuple):
    """Constants for finding planes of which only narrow strips are visible."""

    bin_m: float = 0.005
    """Height of a bin, metres: the noise of strips at 1 m."""
    grazing: float = 0.015
    """Change of inverse depth per cell, 1/m, above which a plane is seen at a grazing angle: from
    one cell to the next, the change exceeds the tolerance."""
    min_slope: float = 0.03
    """Smallest downward slope of a ray (down / forward); flatter rays run along a surface."""
    min_rise: float = 0.05
    """Lower bound of the downward slope in the computation of a cell's area."""
    below: int = 10
    """Number of bins below a plane that hold almost no surface."""
    above: int = 30
    """Number of bins above a covered plane that hold the tops of the objects on it."""
    covers: float = 1.0
    """Minimum area of the tops of objects that cover a plane, relative to the visible area of the
    plane."""
    contrast: float = 2.0
    """Minimum area of a plane, relative to the area in the bins below it."""
    end: float = 1.25
    """Minimum inverse depth of strips, relative to that of the farthest sample: strips lie within
    four fifths of the range."""
    dip: float = 0.6
    """Just above a plane, the area of level surface falls below this fraction of the area of the
    plane."""
    min_area_m2: float = 0.001
    """Minimum visible area of a covered plane."""
    min_points: int = 15
    """Minimum number of oriented points at a height that may have strips."""
    same_m: float = 0.012
    """Planes whose heights differ by less are the same plane, metres."""
    tallest_m: float = 0.15
    """Height of the tallest objects that cover a plane, metres."""
    max_visible: float = 0.45
    """Largest visible fraction of the outline of a covered plane; a lid is fully visible."""


class AssumedSettings(NamedTuple):
    """Constants for a plane assumed below samples that no visible plane supports."""

    max_depth_m: float = 2.0
    """Depth up to which unexplained samples may be objects that hide their support, metres; farther
    away they are background."""
    unexplained: float = 0.2
    """A plane is assumed if more than this fraction of the samples is unexplained. If a table is in
    plain view, the fraction is at most 0.06."""
    noise_share: float = 0.01
    """Fraction of the unexplained samples that may lie below the plane, as noise."""


UP, PLANES, STRIPS = UpSettings(), PlaneSettings(), StripSettings()
ASSUMED = AssumedSettings()
