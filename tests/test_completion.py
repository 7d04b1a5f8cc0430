"""Tests of full boxes of cylinders, boxes and balls of known size, from one or several views."""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from shapecat.completion import DIRECTIONS, BoxViews, complete, fuse_boxes
from shapecat.completion.outline import COSINES, SINES
from shapecat.completion.whole import faced, footprint
from shapecat.evaluation.comparison.overlap import box_iou
from shapecat.geometry import (
    gravity_rotation,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from shapecat.runs.full_boxes import _spread
from shapecat.types import CATEGORIES, Box, FullBox

TILT = np.radians(37)
UP = np.array([0, -np.cos(TILT), -np.sin(TILT)])
"""Up direction for a camera that looks down at 37 degrees."""
LEVEL = gravity_rotation(UP)
PLACE = np.array([0.21, 1.03, -0.74])
"""Position of the object in the level frame of the camera."""
RNG = np.random.default_rng(5)


@pytest.fixture(autouse=True)
def reseeded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw the same numbers in each test, whatever ran before it."""
    monkeypatch.setattr(sys.modules[__name__], "RNG", np.random.default_rng(5))


def above(height: float) -> np.ndarray:
    return np.asarray(PLACE + np.array([0, 0, height]))


def one_hot(category: str) -> np.ndarray:
    return np.asarray(np.eye(len(CATEGORIES))[CATEGORIES.index(category)])


def estimate(surface: np.ndarray, normals: np.ndarray, category: str) -> FullBox:
    """Complete the visible part of a convex surface (n, 3) that stands at `PLACE`."""
    points = surface + PLACE
    visible = points[(normals * points).sum(axis=1) < 0] @ LEVEL
    return complete(visible.astype(np.float32), UP, PLACE[2], one_hot(category), CATEGORIES)


def cylinder(radius: float, height: float, count: int = 6000) -> tuple[np.ndarray, np.ndarray]:
    angle, z = RNG.uniform(0, 2 * np.pi, count), RNG.uniform(0, height, count)
    around = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    points = around * radius + np.array([0, 0, 1]) * z[:, None]
    top = around * (radius * np.sqrt(RNG.uniform(0, 1, count)))[:, None] + [0, 0, height]
    upward = np.tile([0.0, 0.0, 1.0], (count, 1))
    return np.concatenate([points, top]), np.concatenate([around, upward])


def cuboid(size: np.ndarray, yaw: float) -> tuple[np.ndarray, np.ndarray]:
    points, normals = [], []
    for axis in range(3):
        for sign in (-1, 1):
            face = RNG.uniform(-0.5, 0.5, (3000, 3))
            face[:, axis] = sign / 2
            points.append(face * size + [0, 0, size[2] / 2])
            normals.append(np.tile(sign * np.eye(3)[axis], (3000, 1)))
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return np.concatenate(points) @ rotation.T, np.concatenate(normals) @ rotation.T


def test_hidden_half_of_can_mirrors_visible_half() -> None:
    """Without a visible top, only the near half of its depth is visible."""
    points, normals = cylinder(0.034, 0.12)
    side = normals[:, 2] == 0
    box = estimate(points[side], normals[side], "can")

    assert_allclose(np.sort(box.size), [0.068, 0.068, 0.12], rtol=0.05)
    assert_allclose(LEVEL @ box.center, above(0.06), atol=0.003)
    assert_allclose(rotation_from_quaternion(box.orientation)[:, 2], UP, atol=1e-6)


def test_full_box_of_ball_is_a_cube() -> None:
    normals = RNG.normal(size=(8000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    box = estimate(0.095 * normals + [0, 0, 0.095], normals, "ball")

    assert_allclose(box.size, 0.19, rtol=0.05)
    assert_allclose(LEVEL @ box.center, above(0.095), atol=0.006)


def test_rotated_box_keeps_its_size_and_yaw() -> None:
    size = np.array([0.23, 0.09, 0.14])
    points, normals = cuboid(size, 0.431)
    box = estimate(points, normals, "box")
    heading = LEVEL @ rotation_from_quaternion(box.orientation)[:, 0]
    off = np.arctan2(heading[1], heading[0]) - 0.431

    assert_allclose(np.sort(box.size), np.sort(size), rtol=0.06)
    assert_allclose(LEVEL @ box.center, above(0.07), atol=0.006)
    assert abs(np.sin(2 * off)) < np.sin(2 * np.radians(3))


def test_noise_of_flat_side_does_not_shift_box_to_sensor() -> None:
    """The extremes of many noisy points lie in front of the side; the far edge has few points."""
    size = np.array([0.16, 0.1, 0.2])
    points, normals = cuboid(size, np.pi / 2 - 0.24)
    rays = (points + PLACE) / np.linalg.norm(points + PLACE, axis=1)[:, None]
    noisy = points + rays * RNG.normal(0, 0.0025, len(points))[:, None]
    box = estimate(noisy, normals, "box")

    axes, center = LEVEL @ rotation_from_quaternion(box.orientation), LEVEL @ box.center - PLACE
    front = normals[0]  # of the side that is 8 cm in front of the centre
    assert center @ front + abs(front @ axes) @ box.size / 2 == pytest.approx(0.08, abs=0.0035)


def test_partly_hidden_ball_stays_round() -> None:
    """The visible part of an occluded ball is not a circle."""
    normals = RNG.normal(size=(8000, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    shown = normals[:, 0] > -0.4
    box = estimate(0.06 * normals[shown] + [0, 0, 0.06], normals[shown], "ball")

    assert box.size[0] == pytest.approx(box.size[1], rel=0.02)


def test_full_box_reaches_down_to_hidden_support() -> None:
    """The height of an object whose lower part is hidden has a larger standard deviation."""
    points, normals = cylinder(0.04, 0.2)
    top = points[:, 2] > 0.12
    box, hidden = (
        estimate(points, normals, "bottle"),
        estimate(points[top], normals[top], "bottle"),
    )

    assert hidden.size[2] == pytest.approx(0.2, rel=0.02)
    assert hidden.size_std[2] == pytest.approx(np.hypot(0.006, 0.35 * 0.12), rel=0.08)
    assert hidden.size_std[2] > 3 * box.size_std[2]


@pytest.mark.parametrize(
    ("boxy", "depth", "deviation"),
    [
        (1.0, 0.0576, 0.0),
        (0.9, 0.0576, 0.3),  # of a choice between both depths: √(0.9 · 0.1) of their difference
        (0.25, 0.096, np.hypot(0.35, 0.433)),  # and 0.35 of the guessed part
        (0.0, 0.096, 0.35),
    ],
)
def test_hidden_side_is_uncertain_if_object_may_be_box_or_round(
    boxy: float, depth: float, deviation: float
) -> None:
    """Users would trust a guessed length.

    Of an oval of 104 by 96 mm, a sensor before its wide side sees a depth of 57.6 mm.
    """
    angle = np.linspace(0, 2 * np.pi, 3000)
    around = np.stack([0.052 * np.cos(angle), 0.048 * np.sin(angle)], axis=1)
    turn = about_z(17 * 2 * np.pi / DIRECTIONS)[:2, :2]
    visible = around[np.sin(angle) < 0.2] @ turn.T
    outline = (visible @ np.stack([COSINES, SINES])).max(axis=0)
    facing = faced(turn @ [0, -1]).astype(np.float64)
    posterior = boxy * one_hot("box") + (1 - boxy) * one_hot("bottle")
    plan = footprint(outline, facing, posterior, CATEGORIES)

    assert plan.side == 17
    assert_allclose(plan.size, [0.104, depth], atol=0.0015)
    assert_allclose(plan.std, [0.006, np.hypot(0.006, deviation * (0.096 - 0.0576))], rtol=0.08)


def test_lying_bottle_is_not_as_wide_as_long() -> None:
    """A footprint as wide as the bottle is long would be more than three times too large."""
    points, normals = cylinder(0.035, 0.25)
    lying = points[:, [2, 0, 1]] + [-0.125, 0, 0.035]
    box = estimate(lying, normals[:, [2, 0, 1]], "bottle")

    assert np.sort(box.size)[-1] == pytest.approx(0.25, rel=0.08)
    assert min(box.size[:2]) < 0.1


@pytest.mark.parametrize("count", [1, 2, 3, 50])
def test_coincident_points_give_a_finite_box(count: int) -> None:
    """Equal points make every fit singular; exported boxes must have a volume."""
    points = np.tile(np.array([0.1, 0.2, 1.3], np.float32), (count, 1))
    for category in CATEGORIES:
        box = complete(points, UP, float(UP @ points[0]), one_hot(category), CATEGORIES)
        assert np.isfinite([*box.center, *box.size, *box.size_std]).all()
        assert (box.size > 0.004).all()


def test_empty_cloud_is_rejected() -> None:
    with pytest.raises(ValueError, match="at least one point"):
        complete(np.zeros((0, 3), np.float32), UP, 0.0, one_hot("cup"), CATEGORIES)


def about_z(yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def rectangular(size: np.ndarray) -> np.ndarray:
    """Return the extents (DIRECTIONS,) of a rectangle from its centre, one for each direction."""
    angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    return np.asarray(abs(np.cos(angles)) * size[0] / 2 + abs(np.sin(angles)) * size[1] / 2)


def views_of(centers: np.ndarray, axes: np.ndarray, sizes: np.ndarray) -> BoxViews:
    """Return views of n boxes, given by centres, axes and sizes, from sensors all around."""
    outlines = np.stack([rectangular(size) for size in sizes])
    around = np.linspace(0, 2 * np.pi, len(centers), endpoint=False)
    sensors = centers + np.stack([np.cos(around), np.sin(around), np.ones(len(centers))], axis=1)
    return BoxViews(centers, axes, sizes, np.full(sizes.shape, 0.01), outlines, sensors)


class InViews(NamedTuple):
    """The box of an object: centres (n, 3) and axes (n, 3, 3) in n views, one size and std (3,)."""

    centers: np.ndarray
    axes: np.ndarray
    size: np.ndarray
    std: np.ndarray


def fused_in(
    views: BoxViews, weights: np.ndarray, posterior: np.ndarray, categories: tuple[str, ...]
) -> InViews:
    """Return the fused box in each of the views."""
    box = fuse_boxes(views, weights, posterior, categories)
    return InViews(*box.in_views(views.centers, views.axes, views.sizes), box.size, box.std)


def test_fused_size_is_independent_of_quarter_turns() -> None:
    """Length and width swap with the yaw that a view happens to find."""
    size, yaw = np.array([0.21, 0.11, 0.3]), 0.37
    noise = RNG.normal(0, 0.004, (9, 3))
    quarters = np.array([0, 1, 0, 3, 2, 0, 1, 0, 1])
    sizes = np.where((quarters % 2 == 1)[:, None], size[[1, 0, 2]], size) + noise
    axes = np.stack([about_z(yaw + q * np.pi / 2) for q in quarters])
    centers = PLACE + RNG.normal(0, 0.003, (9, 3))
    fused = fused_in(views_of(centers, axes, sizes), np.ones(9), one_hot("box"), CATEGORIES)

    for k in range(9):
        true = Box(PLACE, size, quaternion_from_rotation(about_z(yaw)))
        turn = quaternion_from_rotation(fused.axes[k])
        assert box_iou(true, Box(fused.centers[k], fused.size, turn)) > 0.9


def test_partial_views_do_not_shrink_fused_box() -> None:
    """Behind an occluder, part of a box is visible from a side that no other view faces."""
    sizes = np.array([[0.2, 0.1, 0.3]] * 5 + [[0.16, 0.1, 0.3]] * 9)
    centers = np.array([[0.0, 0, 0]] * 5 + [[-0.02, 0, 0]] * 9)
    views = views_of(centers, np.tile(np.eye(3), (14, 1, 1)), sizes)
    sensors = np.array([[-1.0, 0.2, 0]] * 5 + [[1.0, 0.2, 0]] * 9)
    weights = np.array([1.0] * 5 + [0.25] * 9)
    fused = fused_in(views._replace(sensors=sensors), weights, one_hot("box"), CATEGORIES)
    np.testing.assert_allclose(fused.size, [0.2, 0.1, 0.3], atol=0.005)
    np.testing.assert_allclose(fused.centers[0], 0, atol=0.005)


def test_thin_object_that_moved_has_no_negative_size() -> None:
    """A side seen after the object has moved may be beyond the opposite side seen before."""
    sizes = np.tile([0.02, 0.2, 0.3], (6, 1))
    centers = np.array([[0.02, 0, 0]] * 3 + [[-0.02, 0, 0]] * 3)
    views = views_of(centers, np.tile(np.eye(3), (6, 1, 1)), sizes)
    sensors = np.array([[-1.0, 0, 0]] * 3 + [[1.0, 0, 0]] * 3)
    fused = fused_in(views._replace(sensors=sensors), np.ones(6), one_hot("box"), CATEGORIES)

    # Half as thick as in a single view, and not as thin as an object can be.
    assert_allclose(np.sort(fused.size), [0.01, 0.2, 0.3], atol=0.002)


def test_view_of_moved_object_keeps_its_pose() -> None:
    """The size is that of the other views, and this view does not make it more certain."""
    centers, sizes = np.zeros((7, 3)), np.tile([0.2, 0.1, 0.3], (7, 1))
    centers[5:], axes = [0.4, 0.1, 0], np.tile(np.eye(3), (7, 1, 1))
    sizes[6], axes[6] = [0.1, 0.2, 0.3], about_z(0.5)
    fused = fused_in(views_of(centers, axes, sizes), np.ones(7), one_hot("box"), CATEGORIES)

    assert_allclose(fused.centers, centers, atol=1e-12)
    assert_allclose(fused.axes[5], np.eye(3), atol=1e-12)
    assert_allclose(fused.axes[6], about_z(0.5 + np.pi / 2), atol=1e-12)
    assert_allclose(fused.size, [0.2, 0.1, 0.3])
    assert_allclose(fused.std[2], 0.01 * np.sqrt(0.5 + 0.5 / 5))


def test_guessed_length_is_the_uncertain_one() -> None:
    """With the deviations of length and width swapped, users would trust the guessed depth."""
    points, normals = cylinder(0.05, 0.12)
    side = normals[:, 2] == 0
    turn = about_z(np.arctan2(PLACE[1], PLACE[0]))  # the longer axis is that of the sight
    box = estimate(points[side] * [1.15, 1, 1] @ turn.T, normals[side] @ turn.T, "bottle")
    axes = LEVEL @ rotation_from_quaternion(box.orientation)
    views = BoxViews(
        *(np.tile(value, (3, *[1] * np.ndim(value))) for value in (LEVEL @ box.center, axes)),
        *(np.tile(value, (3, 1)) for value in (box.size, box.size_std, box.outline, np.zeros(3))),
    )
    fused = fuse_boxes(views, np.ones(3), one_hot("bottle"), CATEGORIES)
    depth = int(abs(PLACE[:2] @ axes[:2, :2]).argmax())
    fused_depth = int(abs(PLACE[:2] @ fused.axes[:2, :2]).argmax())

    assert box.size_std[depth] > 1.5 * box.size_std[1 - depth]
    assert fused.std[fused_depth] > 1.5 * fused.std[1 - fused_depth]


def test_box_of_object_at_rest_does_not_turn_with_the_noise_of_its_yaw() -> None:
    """Seen from two sides, the yaw of a box may be off by eight degrees each way."""
    yaws = np.radians(np.where(np.arange(24) < 12, 30.0 - 8, 30.0 + 8))
    axes, sizes = np.stack([about_z(yaw) for yaw in yaws]), np.tile([0.2, 0.1, 0.3], (24, 1))
    views = views_of(np.zeros((24, 3)), axes, sizes)
    fused = fused_in(views, np.ones(24), one_hot("box"), CATEGORIES)

    assert_allclose(fused.axes, np.tile(fused.axes[0], (24, 1, 1)), atol=1e-12)
    turned = about_z(np.radians(30)).T @ fused.axes[0]
    assert np.abs(turned[0, :2]).max() > np.cos(np.radians(9))


def test_box_of_round_object_at_rest_does_not_turn() -> None:
    """The yaw of a can is random, and views that reuse a description repeat it."""
    yaws = np.repeat(np.radians([10, 55, 85, 30, 60]), 6)
    axes, sizes = np.stack([about_z(yaw) for yaw in yaws]), np.tile([0.08, 0.08, 0.1], (30, 1))
    views = views_of(RNG.normal(0, 0.003, (30, 3)), axes, sizes)
    views = views._replace(outlines=np.full((30, DIRECTIONS), 0.04))
    fused = fused_in(views, np.ones(30), one_hot("can"), CATEGORIES)

    assert_allclose(fused.axes, np.tile(fused.axes[0], (30, 1, 1)), atol=1e-12)
    assert_allclose(fused.centers, np.tile(fused.centers[0], (30, 1)), atol=1e-12)


@pytest.mark.parametrize("turn", [40, 90])
def test_box_of_object_turned_in_place_turns_with_it(turn: float) -> None:
    """A person may turn a box to show another side; a mean of both yaws is neither."""
    yaws = np.radians(np.where(np.arange(24) < 13, 10, 10 + turn)) + RNG.normal(0, 0.05, 24)
    axes = np.stack([about_z(yaw) for yaw in yaws])
    sizes = np.tile([0.2, 0.1, 0.3], (24, 1))
    fused = fused_in(
        views_of(np.zeros((24, 3)), axes, sizes), np.ones(24), one_hot("box"), CATEGORIES
    )

    longer = int(fused.size[1] > fused.size[0])
    assert_allclose(fused.size[[longer, 1 - longer, 2]], [0.2, 0.1, 0.3], atol=0.012)
    same = np.abs((fused.axes[:, :, longer] * axes[:, :, 0]).sum(axis=1)) > np.cos(0.2)
    assert np.delete(same, [13, 14]).all()  # single views may err: their neighbours must agree


def test_square_box_turned_in_place_turns_with_it() -> None:
    """Only the yaw of a round object is random, not that of every object with equal sides."""
    yaws = np.radians(np.repeat([10, 50], [13, 11]))
    axes, sizes = np.stack([about_z(yaw) for yaw in yaws]), np.tile([0.1, 0.1, 0.3], (24, 1))
    views = views_of(np.zeros((24, 3)), axes, sizes)
    fused = fused_in(views, np.ones(24), one_hot("box"), CATEGORIES)

    for k in (0, -1):
        turned = axes[k].T @ fused.axes[k]
        assert np.abs(turned[0, :2]).max() > np.cos(np.radians(3))


def test_box_of_carried_object_is_that_of_its_longest_rest() -> None:
    """The median of its places is on the way, where its box reaches down to the table."""
    there, on_the_way = np.array([0.8, 0.5, 0]), np.linspace(0.1, 0.9, 14)[:, None]
    height = 0.3 * on_the_way * (1 - on_the_way)  # of the centre, in a box that reaches down
    carried = on_the_way * there + height * [0, 0, 1]
    centers = np.concatenate([np.zeros((10, 3)), carried, np.tile(there, (12, 1))])
    sizes = np.tile([0.2, 0.1, 0.3], (36, 1))
    sizes[10:24, 2:] += 2 * height
    views = views_of(centers, np.tile(np.eye(3), (36, 1, 1)), sizes)
    fused = fused_in(views, np.ones(36), one_hot("box"), CATEGORIES)

    assert_allclose(fused.size, [0.2, 0.1, 0.3], atol=0.005)
    assert_allclose(fused.centers[[0, -1]], [0 * there, there], atol=0.005)


def test_partial_views_do_not_decide_where_an_object_rests() -> None:
    """The object is seen longer behind an occluder, but the outlines show only a part of it."""
    there, on_the_way = np.array([0.8, 0.5, 0]), np.linspace(0.1, 0.9, 8)[:, None]
    centers = np.concatenate([np.zeros((6, 3)), on_the_way * there, np.tile(there, (10, 1))])
    sizes, weights = np.tile([0.2, 0.1, 0.3], (24, 1)), np.ones(24)
    sizes[14:, 0], weights[14:] = 0.12, 0.25
    views = views_of(centers, np.tile(np.eye(3), (24, 1, 1)), sizes)
    fused = fused_in(views, weights, one_hot("box"), CATEGORIES)

    assert_allclose(fused.size, [0.2, 0.1, 0.3], atol=0.005)


def test_partial_views_do_not_decide_yaw_of_object_at_rest() -> None:
    """The visible part of an object behind an occluder has another yaw, in however many views."""
    yaws = np.radians([10.0] * 6 + [50.0] * 12)
    axes, sizes = np.stack([about_z(yaw) for yaw in yaws]), np.tile([0.2, 0.1, 0.3], (18, 1))
    weights = np.repeat([1.0, 0.25], [6, 12])
    fused = fused_in(views_of(np.zeros((18, 3)), axes, sizes), weights, one_hot("box"), CATEGORIES)

    turns = fused.axes[:6, :, 0] @ about_z(np.radians(10))[:, :2]
    assert_allclose(np.abs(turns).max(axis=1), 1, atol=0.005)
    assert_allclose(np.sort(fused.size), [0.1, 0.2, 0.3], atol=0.005)


def test_fused_views_give_true_size_of_oval_bottle() -> None:
    """It looks round from each side; only all views together show its two widths."""
    points, normals = cylinder(1.0, 0.25)
    wall = normals[:, 2] == 0
    oval = points[wall] * [0.045, 0.033, 1.0]
    outward = normals[wall] / [0.045, 0.033, 1.0]
    views = []
    for angle in np.radians([10, 40, 70, 100, 130]):
        away = about_z(-angle - np.pi / 2)  # into the frame of a sensor in this direction
        place = PLACE.copy()
        visible = ((outward @ away.T) * (oval @ away.T + place)).sum(axis=1) < 0
        box = complete(
            ((oval[visible] @ away.T + place) @ LEVEL).astype(np.float32),
            UP, place[2], one_hot("bottle"), CATEGORIES,
        )  # fmt: skip
        axes = away.T @ LEVEL @ rotation_from_quaternion(box.orientation)
        center = away.T @ (LEVEL @ box.center - place)
        views.append((center, axes, box.size, box.size_std, box.outline, away.T @ -place))
    stacked = BoxViews(*map(np.array, zip(*views, strict=True)))
    fused = fused_in(stacked, np.ones(5), one_hot("bottle"), CATEGORIES)

    assert_allclose(np.sort(fused.size), [0.066, 0.09, 0.25], atol=0.006)
    assert_allclose(fused.centers, np.tile([0, 0, 0.125], (5, 1)), atol=0.004)
    heading = fused.axes[0][:, int(fused.size[1] > fused.size[0])]
    assert abs(heading[0]) > np.cos(np.radians(8))


def test_full_box_includes_handle_of_cup() -> None:
    """An oval around the body alone would cut off the handle."""
    points, normals = cylinder(0.04, 0.1)
    wall = normals[:, 2] == 0
    tips = np.stack([np.full(60, -0.068), RNG.normal(0, 0.003, 60), RNG.uniform(0.03, 0.07, 60)], 1)
    outward = np.concatenate([normals[wall], -np.tile(PLACE, (60, 1))])
    box = estimate(np.concatenate([points[wall], tips]), outward, "cup")
    axes = LEVEL @ rotation_from_quaternion(box.orientation)
    inside = axes.T @ (above(0.05) + np.array([-0.065, 0, 0]) - LEVEL @ box.center)

    assert (abs(inside) < box.size / 2).all()
    assert (LEVEL @ box.center)[0] < PLACE[0] - 0.005
    assert box.size[:2].max() < 0.12


def test_track_has_one_full_size(guessed_run: Path) -> None:
    """People read the size of an object from any row of its track."""
    detections = pq.read_table(guessed_run / "detections.parquet").to_pylist()
    tracks = pq.read_table(guessed_run / "tracks.parquet").to_pylist()
    sizes: dict[int, set[tuple[float, ...]]] = {}
    for row in tracks:
        if row["detection"] is not None:
            sizes.setdefault(row["track"], set()).add(tuple(row["size_full"]))
            assert min(row["size_full_std"]) > 0
        else:
            assert row["center_full"] is None

    assert len(sizes) > 3
    assert all(len(found) == 1 for found in sizes.values())
    assert all(min(row["size_full"]) > 0 for row in detections)


def test_quarter_turn_swaps_length_and_width() -> None:
    """If half of the views swap them, the box is still the same."""
    size, yaw = np.array([0.06, 0.15, 0.2]), 0.3
    yaws = [yaw + np.pi / 2 * (k % 2) for k in range(6)]
    sizes = np.array([size[[1, 0, 2]] if k % 2 else size for k in range(6)])
    axes = Rotation.from_euler("z", np.array(yaws)[:, None]).as_matrix()
    fused = fused_in(
        views_of(np.zeros((6, 3)), axes, sizes), np.ones(6), one_hot("box"), CATEGORIES
    )

    along = np.array([np.cos(yaw), np.sin(yaw), 0.0])  # the shorter side lies along it
    for rotation in fused.axes:
        first = int(np.argmax(np.abs(along @ rotation)))
        assert abs(along @ rotation[:, first]) == pytest.approx(1, abs=1e-6)
        assert fused.size[first] == pytest.approx(0.06, abs=0.002)
        assert fused.size[1 - first] == pytest.approx(0.15, abs=0.002)
        assert fused.size[2] == pytest.approx(0.2)


def test_many_views_do_not_make_size_certain() -> None:
    """All views may share an error, so the deviation must not fall to a few micrometres."""
    stds = []
    for count in (1, 400):
        sizes, axes = np.tile([0.2, 0.1, 0.3], (count, 1)), np.tile(np.eye(3), (count, 1, 1))
        views = views_of(np.zeros((count, 3)), axes, sizes)
        stds.append(fused_in(views, np.ones(count), one_hot("box"), CATEGORIES).std)

    assert_allclose(stds[0], [0.006, 0.006, 0.01], atol=1e-4)
    assert_allclose(stds[1] / stds[0], np.sqrt(0.5), rtol=0.01)


def test_views_for_full_size_are_spread_over_track() -> None:
    """A camera that moves around an object sees its far side only at the end."""
    chosen = _spread(7000)

    assert (len(chosen), chosen[0], chosen[-1]) == (1000, 0, 6999)
    assert set(np.diff(chosen)) <= {7, 8}
    assert _spread(4).tolist() == [0, 1, 2, 3]
    assert _spread(0).size == 0
