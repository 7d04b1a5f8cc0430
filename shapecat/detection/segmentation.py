"""Segmentation: the rules from cells to labelled cells, on one page.

The thesis stops at objects that do not touch. Beyond it, concave edges part touching and stacked
objects (`regions`), and learned trees (`parts`) between two rules bring the pieces of one object
together again (`joins`). Nothing else is learned.
"""

from functools import cache
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8, I4, U1, Bool
from shapecat.config import DetectionSettings
from shapecat.detection.axes import cut_at_axes
from shapecat.detection.borders import meet
from shapecat.detection.depth_grid import Cells
from shapecat.detection.fill import fill_enclosed, grow_feet
from shapecat.detection.foreground.low_profile import raise_low
from shapecat.detection.foreground.overhang import reach_over
from shapecat.detection.foreground.walls import clear_walls
from shapecat.detection.furniture import Field, Limits, is_no_object
from shapecat.detection.joins import join_raised, join_small
from shapecat.detection.ledges import cut_at_ledges
from shapecat.detection.occluders import join_around, join_behind
from shapecat.detection.parts import Sight, Trees, join_parts, trees
from shapecat.detection.pieces import Pieces, pieces_after_cuts, pieces_of
from shapecat.detection.planes.extent import Support
from shapecat.detection.planes.height_map import Heights, heights_of, table_of
from shapecat.detection.planes.parallel import find_levels
from shapecat.detection.planes.ransac import draws_of
from shapecat.detection.planes.supporting import boards_of
from shapecat.detection.planes.up_direction import estimate_up
from shapecat.detection.regions import regions_of, rename
from shapecat.detection.steps import cut_at_steps
from shapecat.detection.surfaces import Surfaces, surfaces_of
from shapecat.detection.things import Things, things_of
from shapecat.errors import ConfigError
from shapecat.jit import kernel

__all__ = ["RULES", "Ground", "Parted", "Segmentation", "part", "segment"]


class Rules(NamedTuple):
    """Which of the rules beyond the thesis apply, in their order.

    Without any of them what remains is the plane, the height above it, and depth jumps.
    """

    low: bool
    concave: bool
    ledge: bool
    axis: bool
    step: bool
    small: bool
    parts: bool
    occluder: bool
    feet: bool
    fill: bool


RULES = Rules._fields
NO_HINT = np.zeros(3)
"""Takes the place of a direction away from gravity that is not known."""


class Ground(NamedTuple):
    """What objects stand on and before.

    Attributes
    ----------
    up : (3,) unit vector.
    planes : rows of `table_of`, the lowest first.
    heights : of the cells, and the plane each is above.
    raised : (rows, columns) int16, the numbers of the low objects that are known by their outline.
    walls : (rows, columns) uint8, not 0 on walls.
    """

    up: F8
    planes: F8
    heights: Heights
    raised: I4
    walls: U1


class Parted(NamedTuple):
    """What stands above the planes, parted where two objects may meet.

    Attributes
    ----------
    surfaces : which cells go on in which, and which way they face.
    regions : (rows, columns) int16, the pieces, 0 elsewhere.
    pieces : their statistics.
    """

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
    filled : (rows, columns) uint8, 1 where a label lies at the level of the plane.
    owners : (count + 1,) the plane that each label stands above; 0 for label 0.
    things : what is measured of the labels.
    """

    up: F8
    supports: list[Support]
    planes: F8
    labels: I4
    filled: U1
    owners: I4
    things: Things


def segment(
    cells: Cells,
    hint: F8 | None,
    *,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Segmentation | None:
    """Find planes and objects among ``cells``; None if there is no supporting plane."""
    rules, limits = _rules_of(settings.rules), _limits_of(settings)
    hint = NO_HINT if hint is None else hint
    supports, ground = _ground(cells, hint, rules, limits, draws_of(rng))
    if not supports:
        return None
    objects = _objects(cells, ground, rules, limits, trees())
    return Segmentation(ground.up, supports, ground.planes, *objects)


def part(
    cells: Cells, *, settings: DetectionSettings, rng: np.random.Generator
) -> tuple[Ground, Parted] | None:
    """Find planes and the pieces of objects; None if no plane bears anything."""
    rules, limits = _rules_of(settings.rules), _limits_of(settings)
    supports, ground = _ground(cells, NO_HINT, rules, limits, draws_of(rng))
    return (ground, _part(cells, ground, rules, limits)) if supports else None


def _limits_of(settings: DetectionSettings) -> Limits:
    return Limits(settings.max_height_m, settings.max_size_m, settings.max_range_m)


@cache
def _rules_of(text: str) -> Rules:
    rules = text.split()
    unknown = [rule for rule in rules if rule not in RULES]
    if unknown:
        msg = f"detection.rules: unknown {', '.join(unknown)}; known: {' '.join(RULES)}"
        raise ConfigError(msg)
    return Rules(*(rule in rules for rule in RULES))


@kernel
def _ground(
    cells: Cells, hint: F8, rules: Rules, limits: Limits, draws: F8
) -> tuple[list[Support], Ground]:
    """Return the planes, lowest first, and what is of use only if there are any."""
    up = estimate_up(cells, hint, draws)
    supports = boards_of(cells, find_levels(cells, up, draws))
    largest = 0.0
    for support in supports:
        if support.area_m2 > largest:
            up, largest = support.up, support.area_m2
    planes = table_of(supports, cells.lens)
    heights = heights_of(cells, planes, limits.highest_m)
    raised = np.zeros(cells.w.shape, np.int16)
    if rules.low:
        raise_low(cells, heights, planes, raised, limits.largest_m)
    walls = clear_walls(cells, heights.owner, up, limits.largest_m, draws)
    return supports, Ground(up, planes, heights, raised, walls)


@kernel
def _part(cells: Cells, ground: Ground, rules: Rules, limits: Limits) -> Parted:
    """Part what stands on the ground, after it was given what reaches over its edge."""
    heights, up = ground.heights, ground.up
    reach_over(cells, heights, ground.planes, ground.walls, limits.highest_m)
    surfaces = surfaces_of(cells, heights)
    regions, n = regions_of(heights, surfaces, rules.concave)
    pieces = pieces_of(cells, heights, surfaces, regions, n, up)
    more = n
    if rules.ledge:
        more = cut_at_ledges(cells, heights, surfaces, pieces, regions, up)
    if rules.axis:
        more = cut_at_axes(cells, heights, surfaces, pieces, regions, up, more)
    if rules.step:
        more = cut_at_steps(cells, heights, surfaces, pieces, regions, up, more)
    if more > n:
        pieces = pieces_after_cuts(cells, heights, surfaces, regions, more, up, pieces)
    meet(cells.w, heights, surfaces, regions, up, pieces)
    return Parted(surfaces, regions, pieces)


@kernel
def _objects(
    cells: Cells, ground: Ground, rules: Rules, limits: Limits, grown: Trees
) -> tuple[I4, U1, I4, Things]:
    """Return the last four parts of a `Segmentation`."""
    surfaces, regions, pieces = _part(cells, ground, rules, limits)
    up, planes, heights, raised, walls = ground
    known = join_raised(pieces, raised, regions, surfaces.spans)
    if rules.small:
        join_small(pieces, cells)
    if rules.parts:
        join_parts(pieces, Sight(cells.lens.fx, up[2]), grown)
    if rules.occluder:
        join_behind(pieces, cells.w, cells.lens, surfaces.normal, regions)
        join_around(pieces)
    field = Field(cells.w, cells.lens, planes, heights.owner, walls, regions, surfaces.spans)
    refused = is_no_object(field, pieces, up, known, limits)
    leaders, numbers = _number(pieces, refused)
    labels = regions  # of pieces before, of objects from here on
    rename(labels, surfaces.spans, numbers)
    if rules.feet:
        grow_feet(cells.w, heights, labels)
    filled = np.zeros(labels.shape, np.uint8)
    if rules.fill:
        fill_enclosed(cells.w, heights.height, labels, leaders.size - 1, filled)
    _fill_raised(raised, labels, filled)
    owners = np.zeros(leaders.size, np.int64)
    for n in range(1, leaders.size):
        owners[n] = pieces.owner[leaders[n]] - 1
    things = things_of(cells, labels, pieces, leaders, up, limits.range_m)
    return labels, filled, owners, things


@kernel
def _number(pieces: Pieces, refused: Bool) -> tuple[I4, I4]:
    """Return the leading piece of each object, and the label of each piece; group 0 is none."""
    numbers = np.zeros(pieces.group.size, np.int16)
    leaders = np.zeros(pieces.group.size, np.int64)
    n = 0
    for p in range(1, numbers.size):
        if pieces.group[p] == p and not refused[p]:
            n += 1
            leaders[n], numbers[p] = p, n
    for p in range(1, numbers.size):
        leader = pieces.group[p]
        numbers[p] = numbers[leader]
        pieces.group[p] = 0 if refused[leader] else leader
    return leaders[: n + 1], numbers


@kernel(leaf=True)
def _fill_raised(raised: I4, labels: I4, filled: U1) -> None:
    """Count what is known by its outline as filled: it may lie at the level of its plane."""
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            filled[i, j] |= (raised[i, j] > 0) & (labels[i, j] > 0)
