"""Tuned constants of the foreground, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["LOW", "OUTLINES", "OVERHANG", "WALLS"]


class LowProfileSettings(NamedTuple):
    """Constants that distinguish low-profile objects from low-frequency depth error."""

    levels: tuple[float, ...] = (3.0, 2.0, 1.3, 0.9, 0.6)
    """Thresholds above the local mean, as multiples of `Limits.unit`. The outlines of the parts
    above each threshold are tested: one of them separates an object from the depth error around
    it."""
    fine: float = 0.006
    """Upper bound of `Limits.unit`, 1/m: larger rises come not from noise but from a plane at a
    grazing angle."""
    step: float = 0.002
    """Minimum mean rise across the outline of an object, 1/m: less than a disparity step of a
    Kinect."""
    noise_factor: float = 3.5
    """Minimum mean rise of an object, as a multiple of the median rise on the plane over the same
    number of cells."""
    slope_share: float = 0.7
    """Minimum mean rise of an object, as a fraction of the plane's change per cell: at a grazing
    angle, slightly displaced samples seem to rise."""
    grown: float = 0.95
    """A part replaces the objects within it if its mean rise is more than this fraction of their
    largest mean rise. A part that combines an object with depth error rises less."""
    side: float = 0.004
    """Minimum rise over two cells on the side of an object, 1/m."""
    slope: float = 0.0016
    """Minimum fall per cell on the side of an object, 1/m."""
    max_overlap: float = 0.9
    """A part is not tested if a larger fraction of its cells belongs to objects already found."""
    min_cells: int = 80
    """Minimum number of cells of a low-profile object: smaller parts are noise."""
    small_part: int = 12
    """Minimum number of cells of a part whose outline is meaningful."""
    facing_share: float = 0.3
    """Minimum fraction of the outline of depth error that faces the plane."""
    low_m: float = 0.03
    """Cells higher than this belong to objects in any case, metres."""
    window: int = 20
    """Half the width of the window of the local mean, in cells: wider than a rim, narrower than a
    wave of error."""
    max_value: float = 0.006
    """Upper bound of a cell's value in the local mean, 1/m: an object must not cause a pit around
    it."""
    rise_cells: int = 5
    """Distance, in cells, over which rises are measured, both of noise and of outlines."""


class OutlineSettings(NamedTuple):
    """Thresholds that separate objects from depth error by the counts of an `Outline`."""

    steep: float = 0.5
    """Minimum rise of a steep side, relative to the minimum mean rise: more than noise."""
    steep_share: float = 0.7
    """Minimum fraction of steep sides among the sides of an object that face the plane."""
    max_rise: float = 3
    """Upper bound of the rise of one side, relative to the minimum mean rise."""
    all_around: float = 0.75
    """Minimum ratio of the sum of the rises to the number of all sides, including those that do not
    face the plane."""
    chance: float = 16
    """Short outlines need more evidence: the required mean rise is multiplied by
    1 + ``chance`` / sides."""
    inward: int = 2
    """Distance from the outline, in cells, at which its inside is measured."""
    min_sides: int = 30
    """Minimum number of sides that face the plane; fewer prove nothing."""
    facing_share: float = 0.4
    """Minimum fraction of all sides that face the plane."""
    bounded_share: float = 0.65
    """Minimum fraction of bounded sides among those that are not hidden."""
    broad: float = 1.5
    """Cells per side above which a part may be partly hidden: strips beside objects have fewer."""
    ragged: float = 80
    """Largest ratio sides² / cells of a part that faces the plane with less than ``bounded_share``
    of its sides. The ratio of a square is 16, that of a crescent 50."""


class WallSettings(NamedTuple):
    """Constants for finding walls."""

    max_planes: int = 5
    """Maximum number of planes that are tested, which bounds the time."""
    min_samples: int = 50
    """Minimum number of samples on a wall: about a hundredth of the image."""
    vertical_cos: float = 0.2
    """Largest absolute cosine between up and a wall's normal: shelves lean by a few degrees."""
    min_area_m2: float = 0.05
    """Minimum area of a wall."""
    part_m2: float = 0.04
    """Minimum area of a connected part that is cleared: smaller ones may be objects."""
    cleared_m2: float = 0.1
    """Minimum area of all cleared parts together."""
    free_share: float = 0.25
    """Minimum fraction of the left and right boundary of a part that is in front of a farther
    surface, if the part is the front of an object. If a side of the object is visible too, the
    fraction is about a half."""
    filled: float = 0.3
    """Minimum fraction of its extent that a wall fills. The front edges of a shelf, which are also
    in one plane, fill less."""
    strip_m: float = 0.05
    """Width of the strips whose areas give the extent of a wall, metres."""


class OverhangSettings(NamedTuple):
    """Constants for objects that extend beyond the outline of their plane."""

    max_distance_m: float = 0.15
    """Largest distance of an object's cell from the outline, metres."""
    outside_ratio: float = 5
    """Largest ratio of the number of an object's cells outside the outline to those inside."""


LOW, OUTLINES = LowProfileSettings(), OutlineSettings()
WALLS, OVERHANG = WallSettings(), OverhangSettings()
