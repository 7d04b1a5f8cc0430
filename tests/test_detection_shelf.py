"""Shelves: pieces of furniture that are no objects, and objects that are not in pieces."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.geometry import inverse
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.simulation.scenes import SceneKind
from shapecat.types import Camera, Frame

FIRST_THING = 20
"""Lower pixel labels are those of furniture."""


@cache
def seen(kind: SceneKind, seed: int) -> tuple[NDArray[Any], list[NDArray[Any]]]:
    """Return the pixel labels of a scene, and those of each object found."""
    rng = np.random.default_rng(seed)
    frame, labels = render_frame(make_scene(kind, rng, frames=1), 0, rng=rng, sensor=KINECT)
    scene = detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0))
    flat = labels.reshape(-1)
    return flat, [flat[c.indices] for c in scene.candidates]


@pytest.mark.parametrize("seed", [377, 507])
def test_wall_beyond_the_floor_is_no_object(seed: int) -> None:
    """Of a wall at the end of the range only a corner is above what is seen of the floor."""
    assert seen("empty", seed)[1] == []


def test_corner_of_a_wall_beside_the_table_is_no_object() -> None:
    """Most of the wall is behind the table, higher above the floor than objects are looked for."""
    assert seen("empty", 410029)[1] == []


@pytest.mark.parametrize("seed", [370775, 380981])
def test_wall_in_a_corner_of_the_image_is_no_object(seed: int) -> None:
    """Little of it is seen, but the image cuts it off on two sides."""
    assert seen("empty", seed)[1] == []


@pytest.mark.parametrize("seed", [313, 336, 581])
def test_side_of_a_shelf_seen_edge_on_is_no_object(seed: int) -> None:
    """Too narrow in the image to be fitted as a wall, and cut off by a board or the border."""
    assert all(np.median(part) >= FIRST_THING for part in seen("shelf", seed)[1])


@pytest.mark.parametrize("seed", [556, 567])
def test_front_of_the_side_of_a_shelf_is_no_object(seed: int) -> None:
    """Cut off by the border of the image; the side that it goes on in is known as a wall."""
    assert all(np.median(part) >= FIRST_THING for part in seen("shelf", seed)[1])


def test_speckled_side_of_a_shelf_is_no_object() -> None:
    """Where a surface is seen edge on many readings fail, and those left are not so steep."""
    assert all(np.median(part) >= FIRST_THING for part in seen("shelf", 335)[1])


@pytest.mark.parametrize(("seed", "label"), [(419, 20), (547, 23)])
def test_patch_of_the_back_between_objects_is_no_part_of_them(seed: int, label: int) -> None:
    """It is smaller than a part of a wall usually is, but lies in it exactly."""
    labels, parts = seen("shelf", seed)
    best = max(parts, key=lambda part: np.count_nonzero(part == label))
    assert np.mean(best == label) > 0.8
    assert np.count_nonzero(best == label) > 0.5 * np.count_nonzero(labels == label)


@pytest.mark.parametrize("seed", [653, 683])
def test_sliver_beside_the_side_of_a_shelf_is_no_object(seed: int) -> None:
    """The noise of an upright side smears into its foot, which rises from the board."""
    assert all(np.median(part) >= FIRST_THING for part in seen("shelf", seed)[1])


@pytest.mark.parametrize(("seed", "label"), [(430, 31), (434, 28), (651, 22)])
def test_plate_at_the_level_of_the_camera_is_found(seed: int, label: int) -> None:
    """Its far side stands out against the wall behind, not against its board."""
    labels, parts = seen("shelf", seed)
    best = max(parts, key=lambda part: np.count_nonzero(part == label))
    common = np.count_nonzero(best == label)
    assert common > 0.5 * (len(best) + np.count_nonzero(labels == label) - common)


@pytest.mark.parametrize(
    ("seed", "label"),
    [
        pytest.param(330, 26, id="lying bottle"),
        pytest.param(9, 24, id="handle"),
        pytest.param(639, 24, id="waist"),
        pytest.param(600, 22, id="foot"),
        pytest.param(673, 31, id="far rim"),
        pytest.param(663, 21, id="near wall"),
        pytest.param(126, 30, id="foot under a rim"),
        pytest.param(683, 24, id="neck on the board"),
        pytest.param(301, 20, id="handle on the board"),
        pytest.param(29, 23, id="handle half hidden"),
    ],
)
def test_object_is_in_one_piece(seed: int, label: int) -> None:
    """What hangs on an object or bears it, and what is seen of its other side, is part of it."""
    labels, parts = seen("shelf", seed)
    (one,) = (part for part in parts if np.median(part) == label)
    assert np.count_nonzero(one == label) > 0.75 * np.count_nonzero(labels == label)


@pytest.mark.parametrize(
    ("kind", "seed", "quarters"),
    [("shelf", 9, 2), ("shelf", 35, 2), ("clutter", 111, 2), ("clutter", 624, 1)],
)
def test_wall_is_no_ground_in_a_turned_image(kind: SceneKind, seed: int, quarters: int) -> None:
    """More of the back of a shelf is seen than of its boards; what hides a wall divides it."""
    rng = np.random.default_rng(seed)
    world = make_scene(kind, rng, frames=1)
    frame, _ = render_frame(world, 0, rng=rng, sensor=KINECT)
    assert frame.depth is not None
    depth = np.ascontiguousarray(np.rot90(frame.depth, quarters))
    h, w = depth.shape
    camera = Camera(w, h, 525.0, 525.0, (w - 1) / 2, (h - 1) / 2)
    turned = Frame("t", 0, 0, 0, "c", depth=depth, camera=camera)
    scene = detect(turned, settings=DetectionSettings(), rng=np.random.default_rng(0))
    x, y, z = inverse(world.path[0]).rotation[:, 2]
    up = np.array([y, -x, z]) if quarters == 1 else np.array([-x, -y, z])
    assert scene.up @ up > np.cos(np.radians(5))


def overlap_in_shelf(seed: int, label: int) -> float:
    """Return the IoU of a thing and of the candidate that holds most of it."""
    labels, parts = seen("shelf", seed)
    best = max(parts, key=lambda part: np.count_nonzero(part == label))
    common = np.count_nonzero(best == label)
    return common / (np.count_nonzero(labels == label) + best.size - common)


@pytest.mark.parametrize(("seed", "label"), [(116, 29), (117, 20)])
def test_halves_of_a_small_thing_are_no_objects(seed: int, label: int) -> None:
    """A bottle that lies and a cup, far away: neither half is much smaller than the other."""
    assert overlap_in_shelf(seed, label) > 0.8


@pytest.mark.parametrize("label", [25, 28])
def test_small_plate_on_a_small_box_is_no_half_of_it(label: int) -> None:
    """They meet along much of their outlines; but the box stands, and the plate does not."""
    assert overlap_in_shelf(53, label) > 0.7


@pytest.mark.parametrize(("seed", "label"), [(280, 25), (290, 22)])
def test_near_and_far_side_of_a_plate_are_one(seed: int, label: int) -> None:
    """They hardly touch, and the floor is so near to the rim that it seems to be a lid."""
    assert overlap_in_shelf(seed, label) > 0.8


def test_bottle_with_a_level_shoulder_is_no_can_under_its_neck() -> None:
    """Much of a flat shoulder faces up; but things hardly ever stand axis on axis."""
    assert overlap_in_shelf(346, 21) > 0.95


def test_lid_is_part_of_its_box() -> None:
    """The seam around it shows as a ledge, along a third of the outlines of both and more."""
    assert overlap_in_shelf(263, 30) > 0.8


@pytest.mark.parametrize(("seed", "label"), [(739, 20), (786, 25)])
def test_small_top_of_an_object_is_no_board(seed: int, label: int) -> None:
    """It is as large as what is seen of some floors, but lies above another plane."""
    labels, parts = seen("shelf", seed)
    most = max(np.count_nonzero(part == label) for part in parts)
    assert most > 0.9 * np.count_nonzero(labels == label)


@pytest.mark.parametrize("seed", [29, 121, 189])
def test_strip_of_floor_beside_a_table_is_a_plane(seed: int) -> None:
    """Less of it is seen than of most boards."""
    rng = np.random.default_rng(seed)
    world = make_scene("empty", rng, frames=1)
    frame, _ = render_frame(world, 0, rng=rng, sensor=KINECT)
    planes = detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0)).planes
    table = max(support.height for support in world.supports if support.level)
    np.testing.assert_allclose([p.height_m for p in planes], [0, table], atol=0.02)


@pytest.mark.parametrize(
    ("kind", "seed", "quarters"),
    [("clutter", 25, 2), ("shelf", 135, 0), ("shelf", 1374, 2)],
)
def test_wall_is_no_table_however_the_camera_is_turned(
    kind: SceneKind, seed: int, quarters: int
) -> None:
    """More is seen of the wall or of the back of the shelf than of what bears objects."""
    rng = np.random.default_rng(seed)
    world = make_scene(kind, rng, frames=1)
    frame, _ = render_frame(world, 0, rng=rng, sensor=KINECT)
    assert frame.depth is not None
    assert frame.camera is not None
    depth, camera = np.rot90(frame.depth, quarters), frame.camera
    up = inverse(world.path[0]).rotation[:, 2]
    for _ in range(quarters):
        camera = Camera(
            camera.height, camera.width, camera.fy, camera.fx,
            camera.cy, camera.width - 1 - camera.cx,
        )  # fmt: skip
        up = np.array([up[1], -up[0], up[2]])
    turned = Frame("turned", 0, 0, 0, "c", depth=np.ascontiguousarray(depth), camera=camera)
    scene = detect(turned, settings=DetectionSettings(), rng=np.random.default_rng(0))

    assert scene.planes[0].normal @ up > 0.99
