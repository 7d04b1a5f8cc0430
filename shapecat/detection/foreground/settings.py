"""Tuned constants of the foreground, with their units and the reason for each."""

from typing import NamedTuple

__all__ = ["LOW", "OUTLINES", "OVERHANG", "WALLS"]


class LowProfileSettings(NamedTuple):
    """How low-profile objects are told from slow errors of depth."""

    levels: tuple[float, ...] = (3.0, 2.0, 1.3, 0.9, 0.6, 0.4)
    """Heights above the mean at which outlines are looked for, as multiples of the least rise:
    one of them parts an object from the swell beside it."""
    fine: float = 0.006
    """Most that they are multiples of, 1/m: more is no noise but a plane at a grazing angle."""
    step: float = 0.002
    """Least mean rise across the outline of an object, 1/m: less than a step of a Kinect."""
    steady: float = 3.5
    """Least rise as a multiple of the median between cells of the plane that are as far apart."""
    slip: float = 0.7
    """Least rise as a share of what the plane rises in a cell: where it is seen at a grazing angle,
    samples a little beside their place seem to rise."""
    grown: float = 0.95
    """A part replaces known objects in it if its rise per side is this share of the greatest of
    theirs: an object and a swell beside it rise less."""
    side: float = 0.004
    """Rise over two cells of the side of something, 1/m."""
    slope: float = 0.0016
    """Fall per cell of the side of something, 1/m."""
    same: float = 0.9
    """Share of the cells of a part from which it is a known object."""
    least_cells: int = 80
    """Of a low-profile object: smaller parts are noise."""
    small_part: int = 12
    """Fewer cells have no outline to judge."""
    beside: float = 0.3
    """Least share of the outline of a swell that is along the plane."""
    low_m: float = 0.03
    """Higher things are objects anyway, metres."""
    window: int = 20
    """Cells to each side over which the mean is taken: wider than a rim, narrower than a wave."""
    most: float = 0.006
    """Excess above which a cell counts no more in the mean, 1/m, lest it make a pit around it."""
    apart: int = 5
    """Cells over which rises are measured, of noise as of outlines."""


class OutlineSettings(NamedTuple):
    """What the outline of an object is like. Shares are of the sides of its cells."""

    steep: float = 0.5
    """A rise that is more than noise, as a share of the least mean rise."""
    steep_share: float = 0.7
    """Share that rises so."""
    most_steps: float = 3
    """A place counts for at most so many times the least mean rise."""
    all_around: float = 0.75
    """Least sum of the rises for each side, whether it looks at the plane or not."""
    chance: float = 16
    """A short outline must rise more, by this over its sides: few waves rise all around."""
    inward: int = 2
    """Cells from the outline to where its rise is measured inside."""
    least_sides: int = 30
    """Along the plane: fewer say nothing."""
    along: float = 0.4
    """Least share along the plane."""
    known: float = 0.65
    """Least share, of what nothing hides, along the plane, in touch with what is not low, or before
    something farther."""
    broad: float = 1.5
    """Cells for each side of what may be partly hidden: strips beside something are narrower."""
    ragged: float = 80
    """Square of the sides by the cells of what fills a gap: 16 of a square, 50 of a crescent."""


class WallSettings(NamedTuple):
    """What a wall is."""

    most: int = 5
    """Walls that are looked for, which bounds the time."""
    least_samples: int = 50
    """On a wall: about a hundredth of the image."""
    vertical_cos: float = 0.2
    """Largest cosine between up and the normal of a wall: shelves lean by a few degrees."""
    least_m2: float = 0.05
    """Area of the smallest wall, m²."""
    part_m2: float = 0.04
    """Area of a connected part that is cleared, m²: smaller ones may be objects before the wall."""
    cleared_m2: float = 0.1
    """Area of these parts together, m²."""
    patch_m2: float = 0.008
    """Area of a part that is cleared if it lies in the wall exactly, m²."""
    exact: float = 0.0045
    """Standard deviation from the wall of such a part, 1/m: as of the samples of the wall."""
    cut_off: float = 0.75
    """Diagonal of a wall that two sides of the image cut off, as a share of the largest object."""
    filled: float = 0.3
    """Share of its extent that a wall fills: the front edges of a shelf lie in a plane too."""
    strip_m: float = 0.05
    """Width of the strips whose area is summed to find the extent of a wall, metres."""


class OverhangSettings(NamedTuple):
    """What reaches over the outline of its plane."""

    reach_m: float = 0.15
    """How far objects reach over an outline, metres."""
    beyond: float = 5
    """So many times as much of an object may be seen outside as inside."""


LOW, OUTLINES = LowProfileSettings(), OutlineSettings()
WALLS, OVERHANG = WallSettings(), OverhangSettings()
