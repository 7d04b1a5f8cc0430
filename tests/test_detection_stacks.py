"""Stacks and containers: where one object ends, told without an edge."""

from collections.abc import Callable
from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np
import pytest

from benchmarks.ablation import without
from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.simulation import KINECT, make_scene, render_frame
from tests.test_detection import (
    Array,
    Shape,
    ball,
    box,
    can,
    check,
    found,
    frame_of,
    overlaps,
    render,
    shell,
    table,
)


def union(*parts: Shape) -> Shape:
    """Return several shapes that are one object."""

    def hit(origin: Array, rays: Array) -> Array:
        return np.asarray(np.minimum.reduce([part(origin, rays) for part in parts]))

    return hit


def test_can_on_the_corner_of_a_box_is_no_neck() -> None:
    """Two faces of a box seen at once turn as the side of a bottle does; but its top is level."""
    shapes = [table(), box((0, 0, 0), (0.14, 0.14, 0.13), np.pi / 4), can(0, 0, 0.13, 0.045, 0.05)]
    check(shapes, [1, 2], tilt_deg=28)


def test_neck_beside_the_axis_is_part_of_the_bottle() -> None:
    """The head of a spray bottle; no level top shows between neck and body."""
    shoulder = [can(0.0003 * k, 0, 0.14 + 0.0006 * k, 0.04 - 0.0009 * k, 7e-4) for k in range(20)]
    bottle = union(can(0, 0, 0, 0.04, 0.14), *shoulder, can(0.006, 0, 0.152, 0.022, 0.04))
    check([table(), bottle], [1], tilt_deg=25)


def test_level_shoulder_of_a_bottle_is_no_ledge() -> None:
    """Little of it shows beside the neck, and all turns about one axis."""
    shoulder = [can(0, 0, 0.12 + 0.0004 * k, 0.045 - 0.001 * k, 0.0005) for k in range(20)]
    bottle = union(can(0, 0, 0, 0.045, 0.12), *shoulder, can(0, 0, 0.128, 0.025, 0.05))
    check([table(), bottle], [1], tilt_deg=25)


def again(*case: object) -> Any:
    """Return a further scene of the same hazard, which takes longer to make than the others."""
    return pytest.param(*case, marks=pytest.mark.many)


def overlap_in_clutter(seed: int, labels: list[int]) -> float:
    """Return how well the worst of some things in a cluttered scene is found."""
    rng = np.random.default_rng(seed)
    frame, seen = render_frame(make_scene("clutter", rng, frames=1), 0, rng=rng, sensor=KINECT)
    return min(overlaps(found(frame), seen, labels))


def test_ball_that_touches_a_box_is_no_handle() -> None:
    """It hides where it stands; but handles are not round all about."""
    assert overlap_in_clutter(690, [27]) > 0.8


@pytest.mark.parametrize(("seed", "label"), [(430, 20), again(2, 25), again(39, 30)])
def test_neighbour_that_hides_where_it_stands_is_no_handle(seed: int, label: int) -> None:
    """Little of its foot is seen, but it meets what it seems to hang on along a short line."""
    assert overlap_in_clutter(seed, [label]) > 0.8


@pytest.mark.parametrize(("seed", "labels"), [(400, [20, 21]), (708, [21]), again(532, [21])])
def test_what_stands_on_a_top_seen_edge_on_is_no_part_of_it(seed: int, labels: list[int]) -> None:
    """A can on a box shows nothing of the top that bears it, but a step at its foot."""
    assert overlap_in_clutter(seed, labels) > 0.8


@pytest.mark.parametrize(("seed", "labels"), [(541, [26]), (651, [23]), (944, [29])])
def test_what_leans_above_another_does_not_hang_on_it(seed: int, labels: list[int]) -> None:
    """It ends in the air, but is too wide for a handle or rises far above what it would be of."""
    assert overlap_in_clutter(seed, labels) > 0.8


def test_what_is_a_step_before_the_side_of_a_can_is_no_neck() -> None:
    """A bowl of the width of the can that it stands on hides the top of that."""
    assert overlap_in_clutter(464, [20, 27]) > 0.8


@pytest.mark.parametrize(("seed", "label"), [(703, 23), (938, 20)])
def test_tall_box_with_little_top_is_no_side_of_a_shelf(seed: int, label: int) -> None:
    """Its faces are seen at a grazing angle too; but something of it faces up."""
    assert overlap_in_clutter(seed, [label]) > 0.8


Scenery = Callable[[np.random.Generator], list[Shape]]


@cache
def rendered(scenery: Scenery) -> list[tuple[np.random.Generator, Array, Any, list[int]]]:
    """Return ten made-up scenes: the state of chance, the depth, what is seen, the things."""
    scenes = []
    for seed in range(10):
        rng = np.random.default_rng((7, seed))
        shapes = scenery(rng)
        depth, seen = render(shapes, tilt_deg=rng.uniform(25, 35), seed=seed)
        scenes.append((rng, depth, seen, list(range(1, len(shapes)))))
    return scenes


def share_found(scenery: Scenery, least: float) -> float:
    """Return in which share of made-up scenes each thing on the table is found so well."""
    good = []
    for rng, depth, seen, things in rendered(scenery):
        chance = deepcopy(rng)
        scene = detect(frame_of(depth), settings=DetectionSettings(), rng=chance)
        good.append(min(overlaps(scene, seen, things)) > least)
    return sum(good) / len(good)


def can_before_a_box(rng: np.random.Generator) -> list[Shape]:
    back = box((0, 0.1, 0), (rng.uniform(0.16, 0.24), 0.06, rng.uniform(0.06, 0.12)))
    radius, height = rng.uniform(0.02, 0.035), rng.uniform(0.12, 0.2)
    return [table(), back, can(rng.uniform(-0.03, 0.03), -0.02, 0, radius, height)]


def test_two_sides_of_a_box_are_one_object() -> None:
    """What is in front of its middle hides where they meet."""
    assert share_found(can_before_a_box, 0.75) > 0.9
    with without("across occlusion"):
        assert share_found(can_before_a_box, 0.75) < 0.4


def test_two_cans_beside_a_third_are_no_sides_of_one() -> None:
    """They are of one height, and each turns about an axis of its own."""
    shapes = [table(), can(-0.05, 0.08, 0, 0.04, 0.1), can(0.05, 0.08, 0, 0.04, 0.1)]
    check([*shapes, can(0, -0.02, 0, 0.035, 0.12)], [1, 2, 3], tilt_deg=25)


@pytest.mark.parametrize(("seed", "labels"), [(140, [21, 23]), (437, [21, 28])])
def test_what_bears_something_of_its_width_is_no_lower_half(seed: int, labels: list[int]) -> None:
    """Bottles stand on cans and boxes that show no top; they meet at one height."""
    assert overlap_in_clutter(seed, labels) > 0.8


def test_cans_of_one_radius_are_parted_by_their_axes() -> None:
    """No edge parts their sides, and the ledge between them is thin."""
    shapes = [table(), can(0, 0, 0, 0.04, 0.1), can(0.012, 0, 0.1, 0.038, 0.1)]
    check(shapes, [1, 2], 0.8, tilt_deg=28)


def tower_of_cans(rng: np.random.Generator) -> list[Shape]:
    radii = [rng.uniform(0.045, 0.05), rng.uniform(0.03, 0.034), rng.uniform(0.045, 0.05)]
    tower, level = [table()], 0.0
    for radius in radii:
        height = rng.uniform(0.07, 0.1)
        tower.append(can(rng.uniform(-0.004, 0.004), 0, level, radius, height))
        level += height
    return tower


def test_towers_of_three_cans_of_two_widths() -> None:
    """What stands on another may bear a third."""
    assert share_found(tower_of_cans, 0.75) > 0.6
    with without("concavity", "width split"):
        assert share_found(tower_of_cans, 0.75) < 0.2


def flush_boxes(rng: np.random.Generator) -> list[Shape]:
    narrow = rng.uniform(0.06, 0.1)
    widths = rng.permutation([narrow, narrow + rng.uniform(0.03, 0.07)])
    low, high = rng.uniform(0.07, 0.12, 2)
    lower, upper = (widths[0], 0.06, low), (widths[1], 0.06, high)
    return [table(), box((0, 0, 0), lower), box((0, 0, low), upper)]


def test_stacked_boxes_with_flush_fronts_stay_two() -> None:
    """Only their outline tells where one ends, and the merging must leave them apart."""
    assert share_found(flush_boxes, 0.75) > 0.7
    with without("width split"):
        assert share_found(flush_boxes, 0.75) < 0.1


def test_round_object_with_one_axis_stays_whole() -> None:
    """A waist changes the radius, not the axis."""
    slices = [can(0, 0, 0.01 * k, 0.04 + 0.006 * np.cos(k / 2.5), 0.0101) for k in range(20)]
    check([table(), union(*slices)], [1])


def test_small_ball_behind_the_middle_of_the_scene() -> None:
    """It has fewer cells than the smallest object would have at the median depth."""
    shapes = [
        table(0.5, 0.9),
        box((-0.2, -0.25, 0), (0.15, 0.15, 0.1)),
        ball((0.15, 0.45, 0.02), 0.02),
    ]
    check(shapes, [1, 2])


def test_can_that_bears_a_bowl_is_no_part_of_it() -> None:
    """What is seen below a rim is the outside of a bowl, or what the bowl stands on."""
    shapes = [table(), can(0, -0.01, 0, 0.05, 0.08), shell((0, 0, 0.18), 0.12, 0.15)]
    depth, seen = render(shapes, tilt_deg=40)
    under, above = overlaps(found(frame_of(depth)), seen, [1, 2])
    assert under > 0.5
    assert above > 0.9


@pytest.mark.parametrize("yaw", [0.3, 0.6])
def test_square_bowl_is_one_object(yaw: float) -> None:
    """Its walls are flat, meet inside in concave edges, and end at one height."""
    along, across = (0.16, 0.006, 0.07), (0.006, 0.16, 0.07)
    c, s = 0.077 * np.cos(yaw), 0.077 * np.sin(yaw)
    walls = [box((k * c, k * s, 0), across, yaw) for k in (-1, 1)]
    walls += [box((-k * s, k * c, 0), along, yaw) for k in (-1, 1)]
    check([table(), union(*walls, box((0, 0, 0), (0.16, 0.16, 0.006), yaw))], [1])


def test_ball_near_the_camera_that_shows_little_is_found() -> None:
    """What is noise among so few readings farther away is a thing half hidden here."""
    assert overlap_in_clutter(103, [29]) > 0.8


def test_head_as_large_as_the_body_is_part_of_it() -> None:
    """A plush animal beside whose axis the head is; its body touches the table nowhere seen."""
    animal = union(ball((0, 0, 0.055), 0.055), ball((0.03, 0, 0.13), 0.05))
    check([table(), animal], [1], tilt_deg=20)


def test_ball_on_a_can_whose_foot_is_hidden() -> None:
    """What the can stands on is not seen, so that nothing tells it from a body without a foot."""
    shapes = [table(), can(0, 0, 0, 0.045, 0.1), ball((0, 0, 0.159), 0.06)]
    check([*shapes, box((0, -0.1, 0), (0.2, 0.03, 0.05))], [1, 2, 3], tilt_deg=20)


MERGING = ("learned merging", "across occlusion", "contact boundary", "hole filling")
"""The steps that merge parts of an object again."""


def overlaps_without(shapes: list[Shape], *steps: str) -> list[float]:
    """Return how well all but the first shape are found if some of the steps are left out."""
    depth, seen = render(shapes)
    with without(*steps):
        rng = np.random.default_rng(0)
        scene = detect(frame_of(depth), settings=DetectionSettings(), rng=rng)
    return overlaps(scene, seen, list(range(1, len(shapes))))


@pytest.mark.parametrize("upper", [0.16, 0.05])
def test_boxes_with_flush_fronts_are_parted_where_the_outline_steps(upper: float) -> None:
    """No edge parts them; what is wider above shows no top of the lower one either."""
    boxes = [box((0, 0, 0), (0.1, 0.06, 0.1)), box((0, 0, 0.1), (upper, 0.06, 0.08))]
    shapes = [table(), *boxes]
    assert min(overlaps_without(shapes, *MERGING)) > 0.85
    assert min(overlaps_without(shapes, *MERGING, "width split")) < 0.8


@pytest.mark.parametrize(("seed", "label"), [(1132, 20), (1187, 21), (1395, 22), again(1076, 20)])
def test_stack_without_an_edge_in_clutter(seed: int, label: int) -> None:
    """Only the outline tells where one object ends."""
    assert overlap_in_clutter(seed, [label]) > 0.75


def test_outline_that_something_nearer_cuts_off_is_no_step() -> None:
    """Of the box behind the lower half is hidden on one side."""
    shapes = [
        table(),
        box((0, 0.1, 0), (0.16, 0.06, 0.2)),
        box((-0.06, -0.05, 0), (0.1, 0.05, 0.07)),
    ]
    assert min(overlaps_without(shapes, *MERGING)) > 0.85


def test_plate_that_juts_out_over_a_can_is_parted_from_it() -> None:
    """The local planes about its edge take the step for a slope.

    Whether it is the lid of the can, which cannot be seen, is left out. So are flatter views, where
    the step helps in one or two of twenty scenes only.
    """
    shapes = [table(), can(0, 0, 0, 0.038, 0.06), can(0, 0, 0.06, 0.05, 0.012)]
    depth, seen = render(shapes, tilt_deg=40)
    with without("learned merging"):
        rng = np.random.default_rng(0)
        scene = detect(frame_of(depth), settings=DetectionSettings(), rng=rng)
    assert len(scene.candidates) == 2
    assert min(overlaps(scene, seen, [1, 2])) > 0.8
