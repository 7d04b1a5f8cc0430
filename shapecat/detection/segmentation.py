"""Segmentation: the rules from cells to labelled cells, on one page.

The thesis stops at objects that do not touch. Beyond it, concave edges part touching and stacked
objects (`regions`), and learned trees (`parts`) between two rules bring the pieces of one object
together again (`joins`). Nothing else is learned.
"""

from typing import NamedTuple

import numpy as np

from shapecat.arrays import F4, F8, I4, U1
from shapecat.config import DetectionSettings
from shapecat.detection.axes import cut_at_axes
from shapecat.detection.boards import boards_of
from shapecat.detection.borders import meet
from shapecat.detection.cells import Cells
from shapecat.detection.directions import estimate_up
from shapecat.detection.fill import fill_enclosed, grow_feet
from shapecat.detection.furniture import (
    cut_by_range,
    is_no_object,
    posts_of,
    remains_of,
    sides_of,
    towers_of,
    unbounded,
)
from shapecat.detection.heights import Heights, heights_of, table_of
from shapecat.detection.joins import join_pieces
from shapecat.detection.ledges import cut_at_ledges
from shapecat.detection.levels import find_levels
from shapecat.detection.pieces import Pieces, pieces_of
from shapecat.detection.planes import Support
from shapecat.detection.raised import join_raised
from shapecat.detection.reach import reach_over
from shapecat.detection.regions import regions_of, rename
from shapecat.detection.relief import raise_low
from shapecat.detection.surfaces import Surfaces, surfaces_of
from shapecat.detection.walls import clear_walls
from shapecat.errors import ConfigError

__all__ = ["RULES", "Parted", "Segmentation", "part", "segment"]

RULES = (
    "low",
    "concave",
    "ledge",
    "axis",
    "small",
    "parts",
    "occluder",
    "feet",
    "fill",
)
"""The rules beyond the thesis, in their order. Without any of them what remains is the plane, the
height above it, and depth jumps."""


class Parted(NamedTuple):
    """What stands above the planes, parted where two objects may meet.

    Attributes
    ----------
    up, supports, planes : as in `Segmentation`.
    heights : of the cells, and the plane each is above.
    raised : (rows, columns) int16, the numbers of the low objects that are known by their outline.
    walls : (rows, columns) uint8, not 0 on walls.
    surfaces : which cells go on in which, and which way they face.
    regions : (rows, columns) int16, the pieces, 0 elsewhere.
    pieces : their statistics.
    """

    up: F8
    supports: list[Support]
    planes: F8
    heights: Heights
    raised: I4
    walls: U1
    surfaces: Surfaces
    regions: I4
    pieces: Pieces


class Segmentation(NamedTuple):
    """Labelled cells.

    Attributes
    ----------
    up : (3,) unit vector.
    supports : the planes, lowest first.
    planes : their rows of `table_of`.
    labels : (rows, columns) int16, 1..count, 0 elsewhere.
    heights : (rows, columns) float32 metres above the plane.
    filled : (rows, columns) uint8, 1 where a label lies at the level of the plane.
    pieces : statistics of the regions the objects were joined from.
    leaders : (count + 1,) the piece that holds the sums of each label.
    """

    up: F8
    supports: list[Support]
    planes: F8
    labels: I4
    heights: F4
    filled: U1
    pieces: Pieces
    leaders: I4

    @property
    def owners(self) -> I4:
        """The plane that each label stands above; 0 for label 0."""
        return np.maximum(self.pieces.owner[self.leaders].astype(np.int64) - 1, 0)


def _checked(text: str) -> list[str]:
    rules = text.split()
    unknown = [rule for rule in rules if rule not in RULES]
    if unknown:
        msg = f"detection.rules: unknown {', '.join(unknown)}; known: {' '.join(RULES)}"
        raise ConfigError(msg)
    return rules


def part(
    cells: Cells,
    hint: F8 | None,
    *,
    upright: bool,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Parted | None:
    """Find planes and the pieces of objects among ``cells``; None if no plane bears anything."""
    rules = _checked(settings.rules)
    up = estimate_up(cells, hint, upright=upright, rng=rng)
    supports = [] if up is None else boards_of(cells, find_levels(cells, up, rng))
    if up is None or not supports:
        return None
    up = max(supports, key=lambda s: s.area_m2).up
    planes = table_of(supports, cells.lens)
    heights = heights_of(cells, planes, highest_m=settings.max_height_m)
    raised = np.zeros(cells.w.shape, np.int16)
    stacks = np.zeros((2, cells.w.size), np.int32)
    if "low" in rules:
        raise_low(cells, heights, planes, raised, stacks, largest_m=settings.max_size_m)
    walls = clear_walls(cells, heights.owner, up, largest_m=settings.max_size_m, rng=rng)
    reach_over(cells, heights, planes, walls, stacks, highest_m=settings.max_height_m)
    surfaces = surfaces_of(cells, heights)
    regions, n = regions_of(heights, surfaces, stacks, concave="concave" in rules)
    pieces = pieces_of(cells, heights, surfaces, regions, n, up)
    more = n
    if "ledge" in rules:
        more = cut_at_ledges(cells, heights, surfaces, pieces, regions, up)
    if "axis" in rules:
        more = cut_at_axes(cells, heights, surfaces, pieces, regions, up, more)
    if more > n:
        pieces = pieces_of(cells, heights, surfaces, regions, more, up)
    meet(cells.w, heights, surfaces, regions, up, pieces)
    return Parted(up, supports, planes, heights, raised, walls, surfaces, regions, pieces)


def segment(
    cells: Cells,
    hint: F8 | None,
    *,
    upright: bool,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Segmentation | None:
    """Find planes and objects among ``cells``; None if there is no supporting plane."""
    parted = part(cells, hint, upright=upright, settings=settings, rng=rng)
    if parted is None:
        return None
    up, supports, planes, heights, raised, walls, surfaces, regions, pieces = parted
    rules = settings.rules.split()
    known = join_raised(pieces, raised, regions, surfaces.spans)
    join_pieces(pieces, cells, surfaces, regions, up, rules)
    furniture = posts_of(cells, heights.owner, regions, surfaces.spans, pieces, up)
    furniture |= towers_of(cells, planes, pieces, up, highest_m=settings.max_height_m)
    furniture |= sides_of(cells, pieces)
    furniture |= unbounded(cells, planes, heights.owner, walls, regions, surfaces.spans, pieces)
    furniture |= remains_of(walls, regions, pieces)
    furniture |= cut_by_range(cells, regions, pieces, range_m=settings.max_range_m)
    refused = is_no_object(pieces, furniture, known, largest_m=settings.max_size_m)
    pieces.group[refused[pieces.group]] = 0
    leaders = np.flatnonzero(np.bincount(pieces.group))
    number = np.zeros(pieces.group.size, np.int16)
    number[leaders] = np.arange(leaders.size)
    labels = regions  # of pieces before, of objects from here on
    rename(labels, surfaces.spans, number[pieces.group])
    if "feet" in rules:
        grow_feet(cells.w, heights.owner, heights.height, labels, np.zeros(cells.w.size, np.int32))
    filled = fill_enclosed(
        cells.w, heights.height, labels, leaders.size - 1, active="fill" in rules
    )
    filled |= np.minimum(raised, labels) > 0
    return Segmentation(up, supports, planes, labels, heights.height, filled, pieces, leaders)
