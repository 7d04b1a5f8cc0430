"""Tests of detection on scenes drawn by a small ray caster."""

from collections.abc import Callable
from functools import lru_cache, reduce
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.ablation import STEPS, without
from shapecat.arrays import I4
from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.detection.depth_grid import row_and_column
from shapecat.detection.virtual_camera import _count_occupied
from shapecat.outputs.scene_graph import Node, format_tree
from shapecat.types import Box, Camera, Candidate, Frame, Plane, Scene

Array = NDArray[Any]
Shape = Callable[[Array, Array], Array]
"""Maps an origin (3,) and rays (h, w, 3) to the depth (h, w) of a surface, inf if missed."""

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
DEFAULTS = DetectionSettings()
SQUARE = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]
"""Corners of a square in order."""


def squared(vectors: Array) -> Array:
    """Return the squared lengths of vectors (..., n), faster than a sum along the short axis."""
    return reduce(np.add, np.moveaxis(vectors**2, -1, 0))


def rotated(rotation: Array, rays: Array) -> list[Array]:
    """Return the components of rotated vectors (..., 3), each contiguous in memory."""
    x, y, z = np.moveaxis(rays, -1, 0)
    return [row[0] * x + row[1] * y + row[2] * z for row in rotation]


def table(x: float = 0.5, y: float = 0.4, z: float = 0.0) -> Shape:
    """Return a horizontal rectangle of half sizes x, y at height z."""

    def hit(origin: Array, rays: Array) -> Array:
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (z - origin[2]) / rays[..., 2]
            p = origin + t[..., None] * rays
            inside = (abs(p[..., 0]) < x) & (abs(p[..., 1]) < y) & (t > 0)
        return np.where(inside, t, np.inf)

    return hit


def box(
    center: tuple[float, float, float], size: tuple[float, float, float], yaw: float = 0
) -> Shape:
    """Return a box; ``center`` is the middle of its base."""
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    half = np.array(size) / 2

    def hit(origin: Array, rays: Array) -> Array:
        o = rotation @ (origin - np.array(center) - [0, 0, half[2]])
        near, far = np.zeros(rays.shape[:-1]), np.full(rays.shape[:-1], np.inf)
        for axis, d in enumerate(rotated(rotation, rays)):
            with np.errstate(divide="ignore", invalid="ignore"):
                a, b = (-half[axis] - o[axis]) / d, (half[axis] - o[axis]) / d
            near, far = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
        return np.where((near < far) & (near > 0), near, np.inf)

    return hit


def ball(center: tuple[float, float, float], radius: float) -> Shape:
    """Return a sphere around ``center``."""
    return shell(center, radius, None)


def shell(center: tuple[float, float, float], radius: float, rim: float | None) -> Shape:
    """Return a thin sphere, open above the height ``rim``."""

    def hit(origin: Array, rays: Array) -> Array:
        o = origin - np.array(center)
        a, (b,), c = squared(rays), rotated(2 * o[None], rays), o @ o - radius**2
        root = b * b - 4 * a * c
        best, close = np.full(a.shape, np.inf), root > 0  # other rays miss it
        d, a, b, root = rays[close], a[close], b[close], root[close]
        nearest = np.full(a.shape, np.inf)
        for sign in (-1, 1):
            t = (-b + sign * np.sqrt(root)) / (2 * a)
            z = origin[2] + t * d[..., 2]
            ok = (t > 0) & ((rim is None) | (z < (rim or 0)))
            nearest = np.where(ok & (t < nearest), t, nearest)
        best[close] = nearest
        return best

    return hit


def can(x: float, y: float, z: float, radius: float, height: float) -> Shape:
    """Return an upright closed cylinder that stands at height ``z``."""

    def hit(origin: Array, rays: Array) -> Array:
        o = origin - np.array([x, y, z])
        best = np.full(rays.shape[:-1], np.inf)
        a = squared(rays[..., :2])
        b = 2 * (o[0] * rays[..., 0] + o[1] * rays[..., 1])
        root = b * b - 4 * a * (o[:2] @ o[:2] - radius**2)
        close = root > 0  # other rays miss it
        d, a, b, root = rays[close], a[close], b[close], root[close]
        with np.errstate(invalid="ignore", divide="ignore"):
            t = (-b - np.sqrt(root)) / (2 * a)
            h = o[2] + t * d[..., 2]
            side = np.where((t > 0) & (h > 0) & (h < height), t, np.inf)
            u = (height - o[2]) / d[..., 2]
            p = o[:2] + u[..., None] * d[..., :2]
            top = np.where((u > 0) & (squared(p) < radius**2), u, np.inf)
        best[close] = np.minimum(side, top)
        return best

    return hit


def render(
    shapes: list[Shape],
    *,
    tilt_deg: float = 35,
    distance: float = 0.9,
    camera: Camera = CAMERA,
    noise: float = 0.0015,
    seed: int = 0,
) -> tuple[Array, NDArray[np.int64]]:
    """Return depth (h, w) of a camera looking at the origin, and the shape or -1 at each pixel.

    The camera is ``distance`` metres away; ``noise`` is that of inverse depth, in 1/m.
    """
    forward, rays = looking(tilt_deg, camera)
    z, labels = np.full(rays.shape[:-1], np.inf), np.full(rays.shape[:-1], -1)
    for k, shape in enumerate(shapes):
        hits = shape(-distance * forward, rays)
        labels[hits < z] = k
        z = np.minimum(z, hits)
    w = 1 / z + np.random.default_rng(seed).normal(0, noise, z.shape)
    return np.where(np.isfinite(z), 1 / np.maximum(w, 1e-3), 0), labels


@lru_cache(maxsize=8)
def looking(tilt_deg: float, camera: Camera) -> tuple[Array, Array]:
    """Return the direction (3,) of a camera and the rays (h, w, 3) of its pixels."""
    t = np.radians(tilt_deg)
    right = np.array([1.0, 0, 0])
    forward = np.array([0, np.cos(t), -np.sin(t)])
    down = np.cross(forward, right)
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    # Each component is contiguous in memory, as sums along short axes are slow.
    rays = np.stack([x * right[k] + y * down[k] + forward[k] for k in range(3)])
    return forward, np.moveaxis(rays, 0, -1)


def frame_of(depth: Array, camera: Camera = CAMERA) -> Frame:
    return Frame("depth", 0, 0, 0, "camera", depth=depth, camera=camera)


def found(frame: Frame, up: tuple[float, float, float] | None = None) -> Scene:
    return detect(frame, up=up, settings=DEFAULTS, rng=np.random.default_rng(0))


def overlaps(scene: Scene, labels: I4, objects: list[int]) -> list[float]:
    """Return the largest IoU of each true object with any candidate."""
    best = []
    for k in objects:
        truth = labels.ravel() == k
        ious = []
        for c in scene.candidates:
            shared = np.count_nonzero(truth[c.indices])
            ious.append(shared / (np.count_nonzero(truth) + len(c.indices) - shared))
        best.append(max(ious, default=0.0))
    return best


def check(shapes: list[Shape], objects: list[int], least: float = 0.85, **view: float) -> Scene:
    """Check that the candidates are the shapes ``objects``; return the scene.

    Each IoU must be above ``least``. ``view`` are options of `render`.
    """
    depth, labels = render(shapes, **view)  # type: ignore[arg-type]  # floats only
    scene = found(frame_of(depth))
    assert len(scene.candidates) == len(objects)
    assert min(overlaps(scene, labels, objects), default=1.0) > least
    return scene


def test_boxes_reach_down_to_the_plane_where_objects_touch_it() -> None:
    """The lowest millimetres cannot be told from the plane; a hidden base is not guessed."""
    scene = check(
        [table(), box((-0.2, 0, 0), (0.16, 0.14, 0.08)), can(-0.2, 0, 0.08, 0.03, 0.09),
         box((0.15, -0.06, 0), (0.2, 0.05, 0.07)), box((0.15, 0.02, 0), (0.12, 0.04, 0.17))],
        [1, 2, 3, 4],
    )  # fmt: skip
    bottoms = [
        float(scene.up @ c.box.center - c.box.size[2] / 2 - scene.planes[0].offset)
        for c in scene.candidates
    ]
    lower, front, hidden, upper = sorted(bottoms)
    assert (lower, front) == pytest.approx((0, 0), abs=1e-6)
    assert 0.02 < hidden < 0.07
    assert upper == pytest.approx(0.08, abs=0.01)


def test_separate_objects_on_plane_are_detected() -> None:
    """The plain case, with height, up direction, size and flags."""
    scene = check(
        [table(), box((-0.2, 0, 0), (0.1, 0.06, 0.15)), can(0, 0.05, 0, 0.035, 0.12),
         ball((0.2, 0, 0.05), 0.05)],
        [1, 2, 3],
    )  # fmt: skip
    assert len(scene.planes) == 1
    assert scene.planes[0].height_m == 0
    np.testing.assert_allclose(scene.up, [0, -np.cos(0.611), -np.sin(0.611)], atol=0.02)
    left = min(scene.candidates, key=lambda c: c.box.center[0])
    np.testing.assert_allclose(sorted(left.box.size), [0.06, 0.1, 0.15], atol=0.015)
    assert not any(c.touches_border or c.occluded for c in scene.candidates)
    assert all(c.plane == 0 and c.on_candidate is None for c in scene.candidates)


@pytest.mark.parametrize("tilt_deg", [20, 60])
def test_objects_are_detected_at_shallow_and_steep_tilt(tilt_deg: float) -> None:
    shapes = [table(), box((-0.15, 0, 0), (0.1, 0.1, 0.1)), can(0.1, 0, 0, 0.04, 0.12)]
    check(shapes, [1, 2], tilt_deg=tilt_deg)


def test_empty_image_gives_empty_scene_with_given_up() -> None:
    scene = found(frame_of(np.zeros((480, 640))), (0, 0, 2))
    assert (scene.planes, scene.candidates) == ((), ())
    np.testing.assert_allclose(scene.up, [0, 0, 1])


def test_bare_table_has_no_objects() -> None:
    """It fills the image, and its noise must not be detected."""
    for seed in range(4):
        depth, _ = render([table(3, 3)], seed=seed, noise=0.003)
        scene = found(frame_of(depth))
        assert len(scene.planes) == 1
        assert scene.candidates == ()


def test_empty_table_above_floor_has_no_objects() -> None:
    """Neither the edge of the table nor the floor is an object."""
    depth, _ = render([table(0.4, 0.25), table(3, 3, -0.7)], distance=0.8, tilt_deg=45)
    scene = found(frame_of(depth))
    assert scene.candidates == ()
    assert len(scene.planes) == 2
    assert abs(scene.planes[1].height_m - 0.7) < 0.02


def test_touching_boxes_are_separated() -> None:
    """They stand at an angle and meet in a concave edge."""
    check([table(), box((-0.06, 0, 0), (0.12, 0.08, 0.12), 0.35),
           box((0.055, -0.03, 0), (0.1, 0.1, 0.08), -0.3)], [1, 2])  # fmt: skip


def test_stacked_box_is_supported_by_lower_box() -> None:
    scene = check(
        [table(), box((0, 0, 0), (0.22, 0.18, 0.08)), box((0, 0.01, 0.08), (0.1, 0.08, 0.1))],
        [1, 2],
    )
    upper = max(range(2), key=lambda k: scene.candidates[k].support_m)
    candidate = scene.candidates[upper]
    assert candidate.on_candidate == 1 - upper
    assert abs(candidate.support_m - 0.08) < 0.01


@pytest.mark.parametrize("high", [0.08, 0.11, 0.2])
def test_box_behind_another_does_not_stand_on_it(high: float) -> None:
    """Only the part of a tall box above the nearer box is visible, and seems to stand on that.

    Supported by the nearer box, a low box would have no height.
    """
    shapes = [table(), box((0, 0, 0), (0.22, 0.08, 0.11)), box((0, 0.12, 0), (0.12, 0.08, high))]
    scene = check(shapes, [1, 2])
    assert [candidate.on_candidate for candidate in scene.candidates] == [None, None]
    assert all(scene.height_of(candidate) > 0.03 for candidate in scene.candidates)


def test_far_wall_belongs_to_bowl() -> None:
    """A depth discontinuity at the near rim separates the walls."""
    check([table(), shell((0, 0, 0.09), 0.09, 0.07)], [1], least=0.8)


def test_box_is_merged_across_an_occluder() -> None:
    """A narrow box divides a long one behind it into two segments."""
    scene = check(
        [table(), box((0, 0.08, 0), (0.3, 0.06, 0.12)), box((0, -0.1, 0), (0.06, 0.04, 0.2))],
        [1, 2],
    )
    assert sorted(c.occluded for c in scene.candidates) == [False, True]


def pot(x: float, y: float, radius: float, height: float, floor: float) -> Shape:
    """Return an upright cylinder with an open top and a level floor."""

    def hit(origin: Array, rays: Array) -> Array:
        o = origin - np.array([x, y, 0])
        a, b = (rays[..., :2] ** 2).sum(-1), 2 * rays[..., :2] @ o[:2]
        root = b * b - 4 * a * (o[:2] @ o[:2] - radius**2)
        best = np.full(a.shape, np.inf)
        with np.errstate(invalid="ignore", divide="ignore"):
            for sign in (-1, 1):
                t = (-b + sign * np.sqrt(root)) / (2 * a)
                h = o[2] + t * rays[..., 2]
                best = np.where(
                    (root > 0) & (t > 0) & (h > floor) & (h < height), np.minimum(t, best), best
                )
            u = (floor - o[2]) / rays[..., 2]
            p = o[:2] + u[..., None] * rays[..., :2]
        return np.where((u > 0) & ((p**2).sum(-1) < radius**2), np.minimum(best, u), best)

    return hit


@pytest.mark.parametrize(
    ("tilt_deg", "radius", "height", "floor"),
    [
        (50, 0.12, 0.08, 0.006),
        (60, 0.08, 0.08, 0.006),
        (40, 0.12, 0.08, 0.015),
        (60, 0.12, 0.08, 0.015),
        (60, 0.12, 0.15, 0.015),
    ],
)
def test_pot_is_one_object(tilt_deg: float, radius: float, height: float, floor: float) -> None:
    """Its near and far wall do not touch, and its floor may look like a low-profile object."""
    check([table(1, 1), pot(0, -0.1, radius, height, floor)], [1], tilt_deg=tilt_deg)


def test_cup_off_the_axis_is_one_object_from_above() -> None:
    """Its walls face each other along the line of sight; its floor is hardly above the table."""
    shape = pot(0, 0, 0.035, 0.08, 0.006)
    shapes = [table(1, 1), lambda origin, rays: shape(origin - [0.25, 0.1, 0], rays)]
    check(shapes, [1], tilt_deg=85, least=0.7)


def test_tall_boxes_beside_each_other_stay_apart_from_above() -> None:
    """To the left and right, the flank of one box is in line with the top of the next."""
    places = [(x, y) for y in (-0.15, -0.05, 0.05, 0.15) for x in (-0.22, -0.11, 0.0, 0.11, 0.22)]
    shapes = [box((x, y, 0), (0.05, 0.04, 0.12)) for x, y in places]
    check([table(1, 1), *shapes], list(range(1, 21)), tilt_deg=89)


@pytest.mark.parametrize(("tilt_deg", "x", "y"), [(50, -0.12, 0.15), (60, 0.05, 0.15)])
def test_plate_behind_pot_is_not_merged_with_its_floor(tilt_deg: float, x: float, y: float) -> None:
    """The plate may be as high as the floor of the pot, and the wall hides the gap between them."""
    shapes = [table(1, 1), pot(0, -0.1, 0.12, 0.08, 0.015), can(x, y, 0, 0.09, 0.012)]
    check(shapes, [1, 2], tilt_deg=tilt_deg)


@pytest.mark.parametrize(
    "tilt_deg", [50, *(pytest.param(t, marks=pytest.mark.many) for t in (70, 89))]
)
def test_equal_objects_in_rows_stay_apart(tilt_deg: float) -> None:
    """Seen from above, they look as distant and as high as the near and the far wall of a pot."""
    places = [(x, y) for y in (-0.17, -0.085, 0.0, 0.085, 0.17) for x in (-0.21, -0.07, 0.07, 0.21)]
    shapes = [box((x, y, 0), (0.038, 0.034, 0.05)) for x, y in places]
    check([table(1, 1), *shapes], list(range(1, 21)), tilt_deg=tilt_deg)


def union(*shapes: Shape) -> Shape:
    """Return a body that consists of several shapes."""
    return lambda origin, rays: np.min([shape(origin, rays) for shape in shapes], axis=0)


def drawer(width: float, height: float, wall: float, floor: float, yaw: float) -> Shape:
    """Return a square box at the origin with an open top and thick walls."""
    c, s, off = np.cos(yaw), np.sin(yaw), (width - wall) / 2
    sides = [(off, 0.0, wall, width), (-off, 0.0, wall, width),
             (0.0, off, width, wall), (0.0, -off, width, wall)]  # fmt: skip
    walls = [box((c * x - s * y, s * x + c * y, 0), (a, b, height), yaw) for x, y, a, b in sides]
    return union(box((0, 0, 0), (width, width, floor), yaw), *walls)


def test_most_drawers_are_one_object() -> None:
    """A floor a few millimetres high has a ragged outline, partly occluded."""
    rng, good = np.random.default_rng(5), 0
    for _ in range(6):
        width, height, floor = rng.uniform((0.2, 0.06, 0.005), (0.36, 0.1, 0.01))
        shapes = [table(1, 1), drawer(width, height, 0.01, floor, rng.uniform(0, np.pi / 2))]
        depth, labels = render(shapes, tilt_deg=rng.uniform(22, 60), distance=rng.uniform(0.7, 1))
        scene = found(frame_of(depth))
        good += len(scene.candidates) == 1 and overlaps(scene, labels, [1])[0] > 0.85
    assert good >= 4


@pytest.mark.parametrize(
    ("tilt_deg", "width"), [(25, 0.03), (40, 0.03), (60, 0.03), (25, 0.05), (40, 0.05)]
)
def test_spout_behind_pot_is_merged_with_it(tilt_deg: float, width: float) -> None:
    """The joint is occluded, but the spout ends in the air, where nothing can stand."""
    spout = box((0.07, 0.03, 0.04), (width, 0.02, 0.05))
    check([table(1, 1), union(can(0, 0, 0, 0.065, 0.12), spout)], [1], tilt_deg=tilt_deg)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_spout_is_merged_in_rotated_images(quarters: int) -> None:
    """Its lower end is the one nearer to the table, not the one lower in the image."""
    spout = box((0.07, 0.03, 0.04), (0.05, 0.02, 0.05))
    depth, _ = render([table(1, 1), union(can(0, 0, 0, 0.065, 0.12), spout)], tilt_deg=40)
    rotated_depth = np.ascontiguousarray(np.rot90(depth, quarters))
    h, w = rotated_depth.shape
    scene = found(frame_of(rotated_depth, Camera(w, h, 525, 525, (w - 1) / 2, (h - 1) / 2)))
    assert len(scene.candidates) == 1


@pytest.mark.parametrize("tilt_deg", [25, 40])
def test_box_behind_pot_is_not_merged_with_it(tilt_deg: float) -> None:
    """As little of it is visible as of a spout, but it does not end in the air."""
    pair = [table(1, 1), can(0, 0, 0, 0.065, 0.12), box((0.06, 0.11, 0), (0.04, 0.04, 0.16))]
    check(pair, [1, 2], tilt_deg=tilt_deg)


def test_two_boxes_behind_an_occluder_are_not_merged() -> None:
    """Neither box continues the other."""
    check([table(), box((-0.12, 0.08, 0), (0.14, 0.06, 0.12), 0.6),
           box((0.12, 0.1, 0), (0.14, 0.06, 0.1), -0.6),
           box((0, -0.1, 0), (0.08, 0.04, 0.2))], [1, 2, 3])  # fmt: skip


def test_object_at_image_border_is_flagged() -> None:
    shapes = [table(1, 1), box((-0.56, 0, 0), (0.1, 0.1, 0.1)), box((0.1, 0, 0), (0.1, 0.1, 0.1))]
    scene = check(shapes, [1, 2])
    left, right = sorted(scene.candidates, key=lambda c: c.box.center[0])
    assert left.touches_border
    assert not right.touches_border


def test_furniture_cut_by_image_border_is_rejected() -> None:
    """A small box that the border cuts is kept."""
    furniture = box((0.05, -0.45, 0.05), (0.4, 0.4, 0.09))
    small = box((-0.56, 0.05, 0), (0.08, 0.08, 0.06))
    depth, labels = render([table(1, 1), furniture, small, can(0.2, 0.15, 0, 0.04, 0.12)])
    assert (labels[-1] == 1).sum() > 100
    assert (labels[:, 0] == 2).any()
    scene = found(frame_of(depth))
    least = np.array(overlaps(scene, labels, [1, 2, 3]))
    assert least[0] < 0.05
    assert (least[1:] > 0.85).all()


def test_image_border_is_where_depth_begins() -> None:
    """A registered Kinect image has an empty margin of 10 %; a bottle's top is not a border."""
    shapes = [table(1, 1), box((-0.63, 0, 0), (0.08, 0.08, 0.1)), can(0.1, 0.45, 0, 0.04, 0.4)]
    depth, labels = render(shapes, distance=1.2, tilt_deg=20)
    assert not any(candidate.touches_border for candidate in found(frame_of(depth)).candidates)
    middle = int(np.flatnonzero((labels == 1).any(axis=0)).mean())
    top = np.flatnonzero((depth > 0).any(axis=1))[0]
    assert labels[top].max() == 2
    assert middle / 640 < 0.12
    assert 0.05 < top / 480 < 0.12
    depth[:, :middle] = 0
    flags = [candidate.touches_border for candidate in found(frame_of(depth)).candidates]
    assert sorted(flags) == [False, True]


def test_objects_belong_to_their_shelf_board() -> None:
    """Planes are sorted by height."""
    shapes = [table(0.45, 0.2), table(0.45, 0.12, 0.35), box((-0.1, -0.1, 0), (0.1, 0.1, 0.12)),
              can(0.1, -0.02, 0.35, 0.04, 0.12)]  # fmt: skip
    depth, labels = render(shapes, tilt_deg=35, distance=1.2)
    scene = found(frame_of(depth))
    np.testing.assert_allclose([p.height_m for p in scene.planes], [0, 0.35], atol=0.015)
    assert min(overlaps(scene, labels, [2, 3])) > 0.8
    assert [c.plane for c in sorted(scene.candidates, key=lambda c: c.box.center[0])] == [0, 1]


SCENE = [table(), box((-0.06, 0, 0), (0.12, 0.08, 0.12), 0.35), can(0.12, -0.05, 0, 0.04, 0.14),
         box((-0.2, -0.1, 0), (0.1, 0.08, 0.06)), shell((0.2, 0.12, 0.07), 0.07, 0.06)]  # fmt: skip


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d[:, ::-1],
        lambda d: d[::-1, ::-1],
        np.rot90,
        lambda d: np.rot90(d, -1),
    ],
    ids=["mirrored", "upside down", "left", "right"],
)
def test_detection_is_independent_of_camera_roll(change: Callable[[Array], Array]) -> None:
    depth, labels = render(SCENE)
    changed, truth = np.ascontiguousarray(change(depth)), np.ascontiguousarray(change(labels))
    h, w = changed.shape
    scene = found(frame_of(changed, Camera(w, h, 525, 525, (w - 1) / 2, (h - 1) / 2)))
    assert len(scene.candidates) == 4
    assert min(overlaps(scene, truth, [1, 2, 3, 4])) > 0.8


def test_object_cut_by_range_limit_is_flagged() -> None:
    """Samples beyond the limit are dropped, so the visible size is too small."""
    depth, labels = render(
        [table(), box((0.2, 0, 0), (0.08, 0.3, 0.1)), can(-0.2, 0, 0, 0.04, 0.14)]
    )
    whole = found(frame_of(depth))
    assert not any(candidate.touches_border for candidate in whole.candidates)
    settings = DetectionSettings(max_range_m=float(np.median(depth[labels == 1])))
    rest = detect(frame_of(depth), settings=settings, rng=np.random.default_rng(0))
    cut = [c for c in rest.candidates if (labels.reshape(-1)[c.indices] == 1).all()]
    assert [candidate.touches_border for candidate in cut] == [True]


def test_objects_are_detected_in_upside_down_image() -> None:
    """The front of the large box must not be mistaken for the supporting plane."""
    depth, labels = render(
        [table(), box((0, 0, 0), (0.44, 0.1, 0.26)), can(0.32, 0, 0, 0.04, 0.14)]
    )
    camera = Camera(640, 480, 525, 525, 319.5, 239.5)
    scene = found(frame_of(np.ascontiguousarray(depth[::-1, ::-1]), camera))
    assert min(overlaps(scene, np.ascontiguousarray(labels[::-1, ::-1]), [1, 2])) > 0.8


def test_half_resolution_gives_same_objects() -> None:
    """Grid cells have a size in metres, not in pixels."""
    depth, labels = render(SCENE)
    camera = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
    scene = found(frame_of(np.ascontiguousarray(depth[::2, ::2]), camera))
    assert len(scene.candidates) == 4
    assert min(overlaps(scene, labels[::2, ::2], [1, 2, 3, 4])) > 0.8


def test_unorganized_cloud_gives_same_objects_as_image() -> None:
    """Its points may have any order and any coordinate frame."""
    depth, _ = render(SCENE)
    frame = frame_of(depth)
    scene = found(frame)
    order = np.random.default_rng(1).permutation(depth.size)
    base_from_camera = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    points = (frame.xyz() @ base_from_camera.T)[order]
    cloud = found(Frame("cloud", 0, 0, 0, "base", points=points))
    np.testing.assert_allclose(cloud.up, base_from_camera @ scene.up, atol=0.01)
    assert len(cloud.candidates) == len(scene.candidates) == 4
    for candidate in scene.candidates:
        scores = [
            2 * np.intersect1d(order[c.indices], candidate.indices).size
            / (c.indices.size + candidate.indices.size)
            for c in cloud.candidates
        ]  # fmt: skip
        twin = cloud.candidates[int(np.argmax(scores))]
        assert max(scores) > 0.97
        np.testing.assert_allclose(
            twin.box.center, base_from_camera @ candidate.box.center, atol=0.005
        )
        np.testing.assert_array_equal(twin.indices, np.sort(twin.indices))


def test_given_up_direction_excludes_walls() -> None:
    depth, _ = render([table(2, 2)], tilt_deg=5)
    assert len(found(frame_of(depth), (0, -1, -0.1)).planes) == 1
    assert found(frame_of(depth), (0, 0, -1)).planes == ()


def test_detection_is_reproducible() -> None:
    depth, _ = render(SCENE)
    a, b = found(frame_of(depth)), found(frame_of(depth))
    for x, y in zip(a.candidates, b.candidates, strict=True):
        np.testing.assert_array_equal(x.indices, y.indices)
        np.testing.assert_array_equal(x.box.orientation, y.box.orientation)


def test_stacked_boxes_are_one_without_steps_beyond_thesis() -> None:
    """Otherwise the ablation benchmark would measure nothing."""
    depth, _ = render([table(), box((0, 0, 0), (0.22, 0.18, 0.08)),
                       box((0, 0.01, 0.08), (0.1, 0.08, 0.1))])  # fmt: skip
    with without(*STEPS):
        scene = found(frame_of(depth))
    assert len(scene.candidates) == 1


@pytest.mark.parametrize("up", [(0, 0, 0), (np.nan, 0, 1), (0, 1)])
def test_invalid_up_direction_raises(up: tuple[float, ...]) -> None:
    frame = frame_of(np.zeros((480, 640)))
    with pytest.raises(ValueError, match="direction"):
        detect(frame, up=up, settings=DEFAULTS, rng=np.random.default_rng(0))


@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 1e-30, 0.3, 1.0, 1e5, 1e30, np.inf, np.nan]),
)
@example(1, 2, 1, 0.0)  # one sample, which fits no plane
@settings(deadline=None, max_examples=60)
def test_any_image_gives_a_scene(h: int, w: int, seed: int, odd: float) -> None:
    """Tiny images, garbage and invalid depths must not crash."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.2, 2, (h, w)) if seed % 2 else np.full((h, w), 1.0)
    depth[rng.random((h, w)) < 0.3] = odd
    scene = found(frame_of(depth, Camera(w, h, 30, 30, w / 2, h / 2)))
    assert np.isfinite(scene.up).all()


def test_rounded_points_stay_within_occupancy_grid() -> None:
    """For a point rounded to beyond the grid, compiled code would write outside the array."""
    place = np.array([[0.3, 0.3], [0.3 + 2e-6, 0.3 - 1e-6]], np.float32)

    assert _count_occupied.py_func(place, 0.3, 0.3, 1024 / 1e-6 * 0.999, 1024) == 2


@given(
    st.integers(0, 3000),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 1e-30, 1.0, 1e5, 1e30, np.inf, np.nan]),
    st.sampled_from([0.0, 1e-6, 1.0]),
)
@settings(deadline=None, max_examples=60)
def test_any_cloud_gives_a_scene(n: int, seed: int, odd: float, spread: float) -> None:
    """Empty clouds, coincident points and invalid coordinates must not crash."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (n, 3)) * spread + [0, 0, 1]
    points[rng.random((n, 3)) < 0.05] = odd
    scene = found(Frame("cloud", 0, 0, 0, "base", points=points))
    assert np.isfinite(scene.up).all()


def _named(node: Node) -> str:
    return f"{node.kind} {node.index}"


def test_hierarchy_puts_stacked_object_below_its_support() -> None:
    """An object on another one is not a child of the plane (thesis 4.5)."""
    shapes = [
        table(),
        box((-0.2, 0, 0), (0.15, 0.15, 0.08)),
        box((-0.2, 0, 0.08), (0.07, 0.07, 0.1)),
        can(0.15, 0.15, 0, 0.04, 0.14),
        box((0.1, -0.15, 0), (0.1, 0.08, 0.05)),
    ]
    depth, labels = render(shapes)
    scene = found(frame_of(depth))
    name = {
        int(np.bincount(labels.ravel()[c.indices]).argmax()): k
        for k, c in enumerate(scene.candidates)
    }
    assert len(scene.candidates) == len(name) == 4
    lower, upper = f"  object {name[1]}", f"    object {name[2]}"
    tree = format_tree(scene, _named).splitlines()
    assert tree[0] == "plane 0"
    assert {*tree[1:]} == {lower, upper, f"  object {name[3]}", f"  object {name[4]}"}
    assert tree.index(upper) == tree.index(lower) + 1


def test_hierarchy_of_bare_table_has_only_its_plane() -> None:
    depth, _ = render([table()])
    assert format_tree(found(frame_of(depth)), _named) == "plane 0"


@pytest.mark.parametrize("turn", [1, -1])
def test_hierarchy_puts_each_board_on_the_one_below(turn: int) -> None:
    """Otherwise all boards of a shelf would seem to stand on the lowest one.

    The up direction is tilted; corners are in clockwise or counterclockwise order.
    """
    axes = np.array([[0.6, 0.64, 0.48], [0.8, -0.48, -0.36], [0, 0.6, -0.8]])  # right, away, up

    def plane(place: tuple[float, float, float], size: tuple[float, float]) -> Plane:
        corners = [np.add(place, (i * size[0], j * size[1], 0)) for i, j in SQUARE[::turn]]
        return Plane(axes[2], place[2], np.array(corners) @ axes, size[0] * size[1], place[2] + 0.7)

    def candidate(
        place: tuple[float, float, float], size: tuple[float, float, float], on: int
    ) -> Candidate:
        turned = Rotation.from_matrix(axes.T).as_quat()
        box = Box(np.array(place) @ axes, np.array(size), turned)
        return Candidate(np.arange(60), box, on, None, 0.0, touches_border=False, occluded=False)

    planes = (
        plane((0.0, 0.0, -0.7), (3.0, 2.0)),  # a floor
        plane((-0.9, 0.2, -0.42), (0.3, 0.3)),  # the top of a stool
        plane((0.2, 0.1, -0.3), (0.9, 0.35)),
        plane((1.2, 0.1, -0.1), (0.4, 0.6)),  # a table beside the shelf
        plane((0.25, 0.12, 0.05), (0.8, 0.3)),
        plane((0.3, 0.05, 0.4), (0.7, 0.25)),
    )
    candidates = (
        candidate((0.25, 0.12, 0.06), (0.1, 0.2, 0.02), 4),  # flat, in the middle of its board
        candidate((-0.5, 0.2, -0.56), (0.3, 0.3, 0.28), 0),  # as high as the stool, beside it
        candidate((-0.9, 0.2, -0.555), (0.32, 0.32, 0.29), 0),  # the stool
        candidate((-0.9, 0.2, -0.35), (0.08, 0.06, 0.14), 1),
        candidate((0.2, 0.1, -0.62), (0.2, 0.25, 0.16), 0),  # below a board
    )

    tree = format_tree(Scene(axes[2], planes, candidates), _named)

    assert tree.splitlines() == [
        "plane 0",
        "  plane 2",
        "    plane 4",
        "      plane 5",
        "      object 0",
        "  plane 3",
        "  object 1",
        "  object 2",
        "    plane 1",
        "      object 3",
        "  object 4",
    ]


def test_object_on_plane_and_on_object_is_below_both() -> None:
    """A lid that leans on a pot also stands on the table; a mug on the lid is printed once."""
    box = Box(np.zeros(3), np.ones(3), np.array([0, 0, 0, 1]))
    below = ((0, None, 0.0), (0, 0, 0.0), (0, 1, 0.2), (None, None, 0.0))
    candidates = [
        Candidate(np.arange(60), box, plane, on, support, touches_border=False, occluded=False)
        for plane, on, support in below
    ]
    up = np.array([0.0, 0.0, 1.0])
    top = Plane(up, 0.0, np.zeros((3, 3)), 1.0, 0.7)

    tree = format_tree(Scene(up, (top,), tuple(candidates)), _named)

    assert tree.splitlines() == [
        "plane 0",
        "  object 0",
        "    object 1",
        "      object 2",
        "  = object 1",
        "object 3",
    ]


def test_can_is_supported_by_microwave_oven() -> None:
    """The top of a closed body is not a supporting plane."""
    shapes = [
        table(0.6, 0.5),
        box((0, 0.1, 0), (0.45, 0.32, 0.26)),
        can(0.05, 0.05, 0.26, 0.035, 0.12),
    ]
    scene = check(shapes, [1, 2], distance=1.2)
    oven, on_oven = sorted(range(2), key=lambda k: scene.candidates[k].support_m)
    assert scene.candidates[on_oven].on_candidate == oven
    assert abs(scene.candidates[on_oven].support_m - 0.26) < 0.01


def test_top_of_small_table_is_a_supporting_plane() -> None:
    """Unlike a box, it is open below its edge."""
    legs = [box((x, y, -0.5), (0.03, 0.03, 0.49)) for x in (-0.2, 0.2) for y in (-0.12, 0.12)]
    shapes = [table(2, 2, -0.5), box((0, 0, -0.02), (0.44, 0.3, 0.02)), *legs,
              box((0.05, 0, 0), (0.08, 0.08, 0.1))]  # fmt: skip
    depth, labels = render(shapes, distance=1.1)
    scene = found(frame_of(depth))
    assert len(scene.planes) == 2
    assert overlaps(scene, labels, [6])[0] > 0.85
    on_table = [c for c in scene.candidates if c.plane == 1]
    assert len(on_table) == 1


def world_points(shapes: list[Shape], turn_deg: float, seed: int) -> Array:
    """Return the points (n, 3) of a camera turned by ``turn_deg`` about z, in the world frame."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])

    def rotate(shape: Shape) -> Shape:
        return lambda origin, rays: shape(rotation @ origin, rays @ rotation.T)

    depth, _ = render([rotate(shape) for shape in shapes], tilt_deg=45, seed=seed)
    points = frame_of(depth).xyz()
    t = np.radians(45)
    forward = np.array([0, np.cos(t), -np.sin(t)])
    world_from_camera = np.stack([[1.0, 0, 0], np.cross(forward, [1.0, 0, 0]), forward], axis=1)
    visible = points[np.isfinite(points[:, 0])] @ world_from_camera.T - 0.9 * forward
    return np.asarray(visible @ rotation.T)


def test_objects_are_detected_in_fused_cloud_of_two_sides() -> None:
    """The origin of such a cloud is no viewpoint, and no viewpoint sees all of its points."""
    shapes = [table(), box((-0.12, 0, 0), (0.1, 0.1, 0.12)), can(0.12, 0.05, 0, 0.04, 0.14)]
    points = np.concatenate([world_points(shapes, 0, 0), world_points(shapes, 180, 1)])
    scene = found(Frame("cloud", 0, 0, 0, "table", points=points))
    np.testing.assert_allclose(scene.up, [0, 0, 1], atol=0.02)
    assert len(scene.planes) == 1
    assert abs(scene.planes[0].offset) < 0.005
    assert len(scene.candidates) == 2
    for x, candidate in zip((-0.12, 0.12), sorted(scene.candidates, key=lambda c: c.box.center[0]),
                            strict=True):  # fmt: skip
        own = points[candidate.indices]
        assert (abs(own[:, 0] - x) < 0.075).all()
        assert own[:, 1].max() - own[:, 1].min() > 0.07  # both sides


def test_hidden_wall_in_fused_cloud_is_not_an_object() -> None:
    """The size limits also apply to what the virtual camera does not see."""
    shapes = [table(), box((-0.12, 0, 0), (0.1, 0.1, 0.12)), box((0, 0.3, 0), (0.9, 0.03, 0.25))]
    points = np.concatenate([world_points(shapes, 0, 0), world_points(shapes, 180, 1)])
    scene = found(Frame("cloud", 0, 0, 0, "table", points=points))
    assert [round(c.box.center[0], 1) for c in scene.candidates] == [-0.1]


@pytest.mark.parametrize("share", [0.9, 1.05])
def test_cloud_beyond_the_range_has_no_objects(share: float) -> None:
    """It makes no difference whether a few points are within the range, or none."""
    points = frame_of(render(SCENE)[0]).xyz()
    near = np.nanquantile(np.linalg.norm(points, axis=1), 0.02)
    settings = DetectionSettings(max_range_m=float(share * near))
    cloud = Frame("cloud", 0, 0, 0, "camera", points=points)
    assert detect(cloud, settings=settings, rng=np.random.default_rng(0)).candidates == ()


@pytest.mark.parametrize("distance", [0.28, 0.34, 0.42])
def test_objects_close_to_the_camera_stay_whole(distance: float) -> None:
    """For a camera at the wrist of a robot, inverse depth changes fast on slanted faces."""
    shapes = [table(), box((-0.06, 0, 0), (0.06, 0.05, 0.05), yaw=0.6), ball((0.06, 0, 0.03), 0.03)]
    check(shapes, [1, 2], distance=distance, tilt_deg=50)


def test_objects_are_detected_from_directly_above() -> None:
    """The view direction has no horizontal part."""
    check([table(), box((-0.1, 0, 0), (0.1, 0.1, 0.1)), can(0.12, 0, 0, 0.04, 0.1)], [1, 2],
          tilt_deg=89.9)  # fmt: skip


@pytest.mark.parametrize("yaw", [0.3, 0.8, 1.3])
@pytest.mark.parametrize("tilt_deg", [30, 60, 80])
def test_top_of_distant_carton_is_not_a_table(tilt_deg: float, yaw: float) -> None:
    """At 1.6 m, the side of a box is hardly farther away than the edge of its top."""
    check([table(0.7, 0.5), box((0, 0, 0), (0.3, 0.2, 0.15), yaw=yaw)], [1],
          tilt_deg=tilt_deg, distance=1.6)  # fmt: skip


@pytest.mark.parametrize("distance", [0.9, 1.4])
def test_carton_right_below_the_camera_is_not_a_table(distance: float) -> None:
    """Its top is larger than a small table, and hides its sides."""
    check([table(0.7, 0.5), box((0, 0, 0), (0.4, 0.3, 0.25))], [1], tilt_deg=87, distance=distance)


def test_platform_right_below_the_camera_supports_objects() -> None:
    shapes = [table(0.7, 0.5), box((0, 0, 0), (0.4, 0.4, 0.15)),
              box((-0.09, 0, 0.15), (0.1, 0.1, 0.1)), can(0.1, 0, 0.15, 0.04, 0.1)]  # fmt: skip
    check(shapes, [2, 3], tilt_deg=87)


@pytest.mark.parametrize("tilt_deg", [20, 35, 50])
def test_wall_behind_a_counter_is_not_a_table(tilt_deg: float) -> None:
    """It covers several times as much of the image as the counter."""
    counter = [table(0.9, 0.2), box((0, 0.21, -0.05), (1.8, 0.02, 0.9))]
    objects = [box((-0.2, -0.05, 0), (0.1, 0.1, 0.1)), can(0.05, 0, 0, 0.04, 0.12)]
    check([*counter, *objects], [2, 3], tilt_deg=tilt_deg)


def test_can_flush_with_box_below_is_separated() -> None:
    """Only the strip of the box's top face that is visible beside the can separates them."""
    shapes = [table(), box((0, 0, 0), (0.2, 0.1, 0.1)), can(0, -0.005, 0.1, 0.045, 0.09)]
    scene = check(shapes, [1, 2], 0.8)
    on = [c.on_candidate for c in scene.candidates]
    assert sum(o is not None for o in on) == 1


def test_bottle_with_wide_neck_is_one_object() -> None:
    """A sloping shoulder is not a top face."""

    def cone(origin: Array, rays: Array) -> Array:
        best = np.full(rays.shape[:2], np.inf)
        for k in range(24):
            radius = 0.045 - 0.018 * k / 23
            hit = can(0, 0, 0.14 + 0.03 * k / 24, radius, 0.03 / 24 + 1e-4)(origin, rays)
            best = np.minimum(best, hit)
        return best

    def bottle(origin: Array, rays: Array) -> Array:
        parts = [can(0, 0, 0, 0.045, 0.14), cone, can(0, 0, 0.17, 0.027, 0.05)]
        return np.asarray(np.minimum.reduce([part(origin, rays) for part in parts]))

    check([table(), bottle], [1])


def test_tilted_top_face_does_not_replace_the_table() -> None:
    """Extended to below the camera, its plane is the lower of the two."""

    def wedge(origin: Array, rays: Array) -> Array:
        """Return the depth of a face that rises at 4 degrees, from 3 cm above the table."""
        t = (0.037 + 0.07 * origin[1] - origin[2]) / (rays[..., 2] - 0.07 * rays[..., 1])
        point = origin + t[..., None] * rays
        return np.where((abs(point[..., :2]) < 0.11).all(axis=-1), t, np.inf)

    scene = check([table(), wedge, can(0.25, 0, 0, 0.04, 0.12)], [1, 2])
    assert [plane.area_m2 > 0.3 for plane in scene.planes] == [True]


def test_posts_of_rack_are_not_objects() -> None:
    """Posts extend through the height of a board, unlike a tall box that ends below it."""
    rack = [table(0.4, 0.2), table(0.4, 0.2, 0.32)]
    posts = [box((x, -0.19, 0), (0.03, 0.03, 0.6)) for x in (-0.38, 0.38)]
    check([*rack, *posts, box((0, 0, 0.32), (0.1, 0.1, 0.1))], [4], tilt_deg=25, distance=1.3)


def test_cut_objects_are_flagged_in_clouds() -> None:
    """The cloud of an image has the same border as the image."""
    shapes = [table(), box((0.43, 0, 0), (0.12, 0.1, 0.1)), box((-0.1, 0, 0), (0.1, 0.1, 0.1))]
    depth, labels = render(shapes)
    frame = frame_of(depth)
    points = frame.xyz()
    points = points[np.isfinite(points[:, 2]) & (points[:, 2] > 0)]
    cloud = found(Frame("points", 0, 0, 0, "camera", points=points))
    flags = {round(float(c.box.center[0]), 1): c.touches_border for c in cloud.candidates}
    assert sorted(flags.values()) == [False, True]
    assert flags[max(flags)]
    assert sum(c.touches_border for c in found(frame).candidates) == 1
    assert labels.max() == 2


@pytest.mark.parametrize("board", [0.42, 0.45, 0.46])
def test_object_on_board_at_grazing_angle_is_found(board: float) -> None:
    """A board 5 to 9 cm below the camera covers only a few image rows."""
    shapes = [table(0.45, 0.3), table(0.4, 0.2, board), box((0, -0.05, board), (0.1, 0.1, 0.08))]
    depth, labels = render(shapes, tilt_deg=20, distance=1.5)
    scene = found(frame_of(depth))
    np.testing.assert_allclose([p.height_m for p in scene.planes], [0, board], atol=0.02)
    assert min(overlaps(scene, labels, [2])) > 0.8


def test_box_top_at_grazing_angle_is_not_a_plane() -> None:
    """Unlike a board at this height, it is small and closed below."""
    shapes = [table(0.6, 0.4), box((0, 0, 0), (0.3, 0.25, 0.46))]
    depth, _ = render(shapes, tilt_deg=20, distance=1.5)
    np.testing.assert_allclose([p.height_m for p in found(frame_of(depth)).planes], [0], atol=0.01)


def test_post_above_maximum_height_is_not_an_object() -> None:
    """Its lower part, which is all that is segmented, stands on the table as an object does."""
    post, tall_box = box((-0.25, 0.1, 0), (0.04, 0.04, 0.9)), box((0.1, 0, 0), (0.1, 0.1, 0.45))
    check([table(0.6, 0.4), post, tall_box], [2], tilt_deg=25, distance=1.5)


def test_overhang_belongs_to_box_at_table_edge() -> None:
    """The box extends beyond the near edge."""
    check([table(0.5, 0.3), box((0, -0.28, 0), (0.1, 0.12, 0.1))], [1], least=0.93)


@pytest.mark.parametrize(("n", "width", "gap"), [(5, 0.11, 0.05), (6, 0.12, 0.02), (4, 0.2, 0.04)])
def test_row_of_boxes_is_not_a_wall(n: int, width: float, gap: float) -> None:
    """Their fronts lie in one upright plane, at least 0.75 m wide, and some are large."""
    pitch = width + gap
    row = [box(((k - (n - 1) / 2) * pitch, 0, 0), (width, 0.08, 0.16)) for k in range(n)]
    check([table(0.6, 0.4), *row], list(range(1, n + 1)), tilt_deg=25, distance=1.2)


def test_tops_of_equal_boxes_are_not_a_plane() -> None:
    """Together they are as large as a table, but there is floor between them."""
    places = [(x, y) for y in (-0.3, -0.1, 0.1, 0.3) for x in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    shapes = [box((x, y, 0), (0.15, 0.15, 0.12)) for x, y in places]
    depth, _ = render([table(3, 3), *shapes], tilt_deg=50, distance=1.7)
    assert len(found(frame_of(depth)).planes) == 1


@pytest.mark.parametrize("width", [0.4, 0.45])
@pytest.mark.parametrize("y", [0.1, -0.2])
def test_large_box_before_empty_background_is_not_a_wall(width: float, y: float) -> None:
    """Depth ends at its large flat front, although the image does not."""
    large = box((-0.28, y, 0), (width, 0.06, 0.3), 0.15)
    check([table(0.5, 0.35), large], [1], tilt_deg=25, distance=1.6)


@pytest.mark.parametrize("columns", [1, 3, 213, 320, 641, 1999])
def test_row_and_column_of_flat_index_are_exact(columns: int) -> None:
    """A product replaces a division: rounding must not move a cell to the row above."""
    for i in (0, 1, 7, 199, 1999):
        assert row_and_column(i * columns, columns) == (i, 0)
        assert row_and_column(i * columns + columns - 1, columns) == (i, columns - 1)


def test_frames_hold_arrays_row_by_row() -> None:
    """For a mirrored image, detection would compile its kernels again, for half a minute."""
    depth = np.linspace(0.5, 2.5, 24, dtype=np.float32).reshape(4, 6)
    mirrored = frame_of(depth[:, ::-1], Camera(6, 4, 525.0, 525.0, 2.5, 1.5)).depth
    points = Frame("cloud", 0, 0, 0, "base", points=np.arange(15.0).reshape(3, 5).T).points

    assert mirrored is not None
    assert points is not None
    assert mirrored.flags.c_contiguous
    assert points.flags.c_contiguous
    np.testing.assert_array_equal(mirrored, depth[:, ::-1])
    np.testing.assert_array_equal(points, np.arange(15).reshape(3, 5).T)
