"""Tests of shelves: their structure is rejected, and their objects stay whole."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from shapecat.config import DetectionSettings
from shapecat.detection import detect
from shapecat.geometry import inverse
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.types import Camera, Frame

FIRST_OBJECT = 20
"""Smaller pixel labels belong to the background."""


@cache
def scene_labels(kind: SceneKind, seed: int) -> tuple[NDArray[Any], list[NDArray[Any]]]:
    """Return the pixel labels of a scene, and those of each candidate."""
    rng = np.random.default_rng(seed)
    frame, labels = render_frame(make_scene(kind, rng, frames=1), 0, rng=rng, sensor=KINECT)
    scene = detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0))
    flat = labels.reshape(-1)
    return flat, [flat[c.indices] for c in scene.candidates]


@pytest.mark.parametrize("seed", [377, pytest.param(507, marks=pytest.mark.many)])
def test_wall_beyond_the_floor_is_not_an_object(seed: int) -> None:
    """Only a corner of a wall at the range limit is above the visible floor."""
    assert scene_labels("empty", seed)[1] == []


def test_corner_of_wall_beside_table_is_not_an_object() -> None:
    """Most of the wall is behind the table, above the maximum height of objects."""
    assert scene_labels("empty", 410029)[1] == []


@pytest.mark.parametrize("seed", [370775, pytest.param(380981, marks=pytest.mark.many)])
def test_wall_in_image_corner_is_not_an_object(seed: int) -> None:
    """Little of it is visible, but the image border cuts it on two sides."""
    assert scene_labels("empty", seed)[1] == []


@pytest.mark.parametrize("seed", [313, 581])
def test_edge_on_side_of_shelf_is_not_an_object(seed: int) -> None:
    """It is too narrow in the image to be found as a wall, and cut by a board or the border."""
    assert all(np.median(candidate) >= FIRST_OBJECT for candidate in scene_labels("shelf", seed)[1])


@pytest.mark.parametrize("seed", [556, 567])
def test_front_of_shelf_side_is_not_an_object(seed: int) -> None:
    """The image border cuts it; the side behind it is detected as a wall."""
    assert all(np.median(candidate) >= FIRST_OBJECT for candidate in scene_labels("shelf", seed)[1])


def test_speckled_side_of_shelf_is_not_an_object() -> None:
    """Many samples of an edge-on surface are missing, and the rest look less steep."""
    assert all(np.median(candidate) >= FIRST_OBJECT for candidate in scene_labels("shelf", 335)[1])


@pytest.mark.parametrize(("seed", "label"), [(419, 20), (547, 23)])
def test_patch_of_shelf_back_is_not_merged_with_objects(seed: int, label: int) -> None:
    """It is smaller than most parts of walls, but exactly in the plane of the back."""
    labels, candidates = scene_labels("shelf", seed)
    best = max(candidates, key=lambda candidate: np.count_nonzero(candidate == label))
    assert np.mean(best == label) > 0.8
    assert np.count_nonzero(best == label) > 0.5 * np.count_nonzero(labels == label)


@pytest.mark.parametrize("seed", [653, 683])
def test_sliver_beside_shelf_side_is_not_an_object(seed: int) -> None:
    """The noise of an upright side spreads to its base, which seems to rise from the board."""
    assert all(np.median(candidate) >= FIRST_OBJECT for candidate in scene_labels("shelf", seed)[1])


@pytest.mark.parametrize(
    ("seed", "label"),
    [(430, 31), *(pytest.param(*case, marks=pytest.mark.many) for case in ((434, 28), (651, 22)))],
)
def test_plate_at_camera_height_is_found(seed: int, label: int) -> None:
    """Its far edge contrasts with the wall behind, not with its board."""
    labels, candidates = scene_labels("shelf", seed)
    best = max(candidates, key=lambda candidate: np.count_nonzero(candidate == label))
    common = np.count_nonzero(best == label)
    assert common > 0.5 * (len(best) + np.count_nonzero(labels == label) - common)


@pytest.mark.parametrize(
    ("seed", "label"),
    [
        pytest.param(330, 26, id="lying bottle", marks=pytest.mark.many),
        pytest.param(9, 24, id="handle"),
        pytest.param(639, 24, id="waist", marks=pytest.mark.many),
        pytest.param(600, 22, id="foot"),
        pytest.param(673, 31, id="far rim", marks=pytest.mark.many),
        pytest.param(663, 21, id="near wall"),
        pytest.param(126, 30, id="foot under a rim", marks=pytest.mark.many),
        pytest.param(683, 24, id="neck on the board"),
        pytest.param(301, 20, id="handle on the board", marks=pytest.mark.many),
        pytest.param(29, 23, id="handle half hidden", marks=pytest.mark.many),
    ],
)
def test_object_is_not_split(seed: int, label: int) -> None:
    """Handles, bases and the visible far side are parts of an object."""
    labels, candidates = scene_labels("shelf", seed)
    (one,) = (candidate for candidate in candidates if np.median(candidate) == label)
    assert np.count_nonzero(one == label) > 0.75 * np.count_nonzero(labels == label)


@pytest.mark.parametrize(
    ("kind", "seed", "quarters"),
    [
        ("shelf", 9, 2),
        pytest.param("shelf", 35, 2, marks=pytest.mark.many),
        pytest.param("clutter", 111, 2, marks=pytest.mark.many),
        ("clutter", 624, 1),
    ],
)
def test_wall_is_not_a_supporting_plane_in_rotated_image(
    kind: SceneKind, seed: int, quarters: int
) -> None:
    """More of the back of a shelf is visible than of its boards, and objects divide a wall."""
    rng = np.random.default_rng(seed)
    world = make_scene(kind, rng, frames=1)
    frame, _ = render_frame(world, 0, rng=rng, sensor=KINECT)
    assert frame.depth is not None
    depth = np.ascontiguousarray(np.rot90(frame.depth, quarters))
    h, w = depth.shape
    camera = Camera(w, h, 525.0, 525.0, (w - 1) / 2, (h - 1) / 2)
    rotated = Frame("t", 0, 0, 0, "c", depth=depth, camera=camera)
    scene = detect(rotated, settings=DetectionSettings(), rng=np.random.default_rng(0))
    x, y, z = inverse(world.path[0]).rotation[:, 2]
    up = np.array([y, -x, z]) if quarters == 1 else np.array([-x, -y, z])
    assert scene.up @ up > np.cos(np.radians(5))


def overlap_in_shelf(seed: int, label: int) -> float:
    """Return the IoU of an object and the candidate that contains most of it."""
    labels, candidates = scene_labels("shelf", seed)
    best = max(candidates, key=lambda candidate: np.count_nonzero(candidate == label))
    common = np.count_nonzero(best == label)
    return common / (np.count_nonzero(labels == label) + best.size - common)


@pytest.mark.parametrize(("seed", "label"), [(116, 29), (117, 20)])
def test_small_far_object_is_not_split(seed: int, label: int) -> None:
    """The halves of a lying bottle and of a cup have similar sizes."""
    assert overlap_in_shelf(seed, label) > 0.8


@pytest.mark.parametrize("label", [25, 28])
def test_small_plate_is_not_merged_with_small_box_below(label: int) -> None:
    """They touch along much of their outlines, but only the box stands on the board."""
    assert overlap_in_shelf(53, label) > 0.6


@pytest.mark.parametrize(("seed", "label"), [(280, 25), (290, 22)])
def test_near_and_far_side_of_plate_are_merged(seed: int, label: int) -> None:
    """They hardly touch, and the floor is so close to the rim that it looks like a top face."""
    assert overlap_in_shelf(seed, label) > 0.8


def test_bottle_with_flat_shoulder_is_not_split() -> None:
    """Much of the shoulder faces up, but stacked objects hardly ever share an axis."""
    assert overlap_in_shelf(346, 21) > 0.95


def test_lid_is_merged_with_its_box() -> None:
    """Along a third or more of both outlines, their seam looks like the edge of a top face."""
    assert overlap_in_shelf(263, 30) > 0.8


@pytest.mark.parametrize(("seed", "label"), [(739, 20), (786, 25)])
def test_small_top_of_object_is_not_a_supporting_plane(seed: int, label: int) -> None:
    """It is as large as the visible part of some floors, but lies above another plane."""
    labels, candidates = scene_labels("shelf", seed)
    most = max(np.count_nonzero(candidate == label) for candidate in candidates)
    assert most > 0.9 * np.count_nonzero(labels == label)


@pytest.mark.parametrize("seed", [29, 121, 189])
def test_floor_strip_beside_table_is_a_plane(seed: int) -> None:
    """Less of the floor is visible than of most boards, but it must not be left out."""
    rng = np.random.default_rng(seed)
    world = make_scene("empty", rng, frames=1)
    frame, _ = render_frame(world, 0, rng=rng, sensor=KINECT)
    planes = detect(frame, settings=DetectionSettings(), rng=np.random.default_rng(0)).planes
    table = max(support.height for support in world.supports if support.holds_objects)
    np.testing.assert_allclose([p.height_m for p in planes], [0, table], atol=0.02)


@pytest.mark.parametrize(
    ("kind", "seed", "quarters"),
    [
        ("clutter", 25, 2),
        ("shelf", 135, 0),
        pytest.param("shelf", 1374, 2, marks=pytest.mark.many),
    ],
)
def test_wall_is_not_a_table_for_rotated_camera(kind: SceneKind, seed: int, quarters: int) -> None:
    """More of the wall or of the shelf's back is visible than of the supporting planes."""
    rng = np.random.default_rng(seed)
    world = make_scene(kind, rng, frames=1)
    frame, _ = render_frame(world, 0, rng=rng, sensor=KINECT)
    rotated, up = turned(frame, inverse(world.path[0]).rotation[:, 2], quarters)
    scene = detect(rotated, settings=DetectionSettings(), rng=np.random.default_rng(0))

    assert scene.planes[0].normal @ up > 0.99


@pytest.mark.parametrize(
    "quarters", [0, 1, *(pytest.param(n, marks=pytest.mark.many) for n in (2, 3))]
)
def test_board_at_grazing_angle_is_found_by_rotated_camera(quarters: int) -> None:
    """One of four boards is just below the camera, which may be mounted in any way."""
    rng = np.random.default_rng(3019)
    world = make_scene("shelf", rng, frames=1)
    frame, _ = render_frame(world, 0, rng=rng, sensor=KINECT)
    rotated, up = turned(frame, inverse(world.path[0]).rotation[:, 2], quarters)
    scene = detect(rotated, up=up, settings=DetectionSettings(), rng=np.random.default_rng(0))

    assert len(scene.planes) == 4
    assert scene.planes[-1].offset > -0.15


def turned(frame: Frame, up: NDArray[Any], quarters: int) -> tuple[Frame, NDArray[Any]]:
    """Return the frame of a camera turned about its optical axis, and the up direction there."""
    assert frame.depth is not None
    assert frame.camera is not None
    depth, camera = np.rot90(frame.depth, quarters), frame.camera
    for _ in range(quarters):
        camera = Camera(
            camera.height, camera.width, camera.fy, camera.fx,
            camera.cy, camera.width - 1 - camera.cx,
        )  # fmt: skip
        up = np.array([up[1], -up[0], up[2]])
    return Frame("turned", 0, 0, 0, "c", depth=np.ascontiguousarray(depth), camera=camera), up
