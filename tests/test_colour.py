"""Tests of masks on colour images: position, density, and visibility from the colour camera."""

import itertools
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy import ndimage

from shapecat.arrays import freeze
from shapecat.cameras.colour import ColourImage, ColourView, LensCamera
from shapecat.cameras.lenses import distort, undistorted_rays
from shapecat.colour.image_masks import box_of, find_masks, mask_of
from shapecat.colour.masks import EMPTY_MASK, Mask, dense_masks, union
from shapecat.colour.projection import project, rectified
from shapecat.colour.snapping import snapped
from shapecat.colour.splatting import splat_depth
from shapecat.geometry import IDENTITY, rotation_from_quaternion
from shapecat.types import Camera, Frame, ImageMasks, Pose

DEPTH = Camera(160, 120, 140.0, 141.0, 80.3, 58.9)
LENS = LensCamera(
    Camera(240, 200, 205.0, 207.0, 121.4, 96.2), "plumb_bob", (0.11, -0.24, 0.002, -0.001, 0.08)
)
TURNED = Pose(rotation_from_quaternion((0.03, -0.05, 0.02, 1.0)), np.array([-0.05, 0.02, 0.01]))


def test_projection_matches_worked_example() -> None:
    """A wrong order of rotation, translation and distortion would move every mask."""
    quarter = Pose(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), np.array([0.1, 0.2, 0.5]))
    lens = LensCamera(
        Camera(640, 480, 400.0, 300.0, 310.0, 250.0), "plumb_bob", (0.2, 0, 0.01, 0, 0)
    )
    # (0.3, -0.4, 1.5) turns to (-0.4, -0.3, 1.5), shifts to (-0.3, -0.1, 2.0): x = -.15, y = -.05.
    # r = .025, radial = 1.005: x' = -.15075 + .02 * .0075 = -.1506;
    # y' = -.05025 + .01 * (.025 + .005) = -.04995.
    expected = [[310 - 0.1506 * 400, 250 - 0.04995 * 300, 2.0]]

    np.testing.assert_allclose(
        project(np.array([[0.3, -0.4, 1.5]]), lens, quarter), expected, rtol=1e-6
    )


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant"])
def test_distortion_inverts_undistortion(model: str) -> None:
    """Depth images use one of the two directions, masks the other."""
    coefficients = (0.1, -0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003)
    rays = undistorted_rays(LENS.pinhole, model, coefficients)
    assert rays is not None
    distorted = distort(rays, model, coefficients)
    v, u = np.mgrid[:200, :240]
    pixels = distorted * (205.0, 207.0) + (121.4, 96.2)
    np.testing.assert_allclose(pixels, np.stack([u, v], axis=-1), atol=1e-3)


def test_points_outside_lens_model_are_not_projected() -> None:
    """Far from the axis, the polynomial turns back and would paint walls onto the table."""
    lens = LensCamera(LENS.pinhole, "plumb_bob", (-0.4, 0.0, 0.0, 0.0, 0.0))
    points = np.array([[0.2, 0, 1.0], [2.5, 0, 1.0], [0, 0, -1.0], [np.nan, 0, 1]])
    projected = project(points, lens, IDENTITY)
    assert np.isfinite(projected[:, 0]).tolist() == [True, False, False, False]


@pytest.mark.parametrize(
    ("model", "coefficients", "slope", "visible"),
    [
        # x - 0.4 x^3 turns back at x = sqrt(1 / 1.2) = 0.913.
        ("plumb_bob", (-0.4, 0.0, 0.0, 0.0, 0.0), 0.90, True),
        ("plumb_bob", (-0.4, 0.0, 0.0, 0.0, 0.0), 0.93, False),
        ("equidistant", (0.0, 0.0, 0.0, 0.0), 2.9, True),  # 71 degrees off the axis
        ("equidistant", (0.0, 0.0, 0.0, 0.0), 3.1, False),
    ],
)
def test_points_are_projected_up_to_turning_point_of_lens(
    model: str, coefficients: tuple[float, ...], slope: float, *, visible: bool
) -> None:
    """If the limit were taken for its square, points near it would be lost, or be misplaced."""
    lens = LensCamera(LENS.pinhole, model, coefficients)
    points = np.array([[slope, 0, 1], [0.6 * slope, -0.8 * slope, 1]])
    projected = project(points, lens, IDENTITY)
    assert np.isfinite(projected[:, 0]).tolist() == [visible, visible]


def test_splatted_labels_agree_with_projected_points() -> None:
    """The kernel and the plain projection must agree on the place of each pixel."""
    depth = np.zeros((120, 160), np.float32)
    labels = np.zeros((120, 160), np.int32)
    rng = np.random.default_rng(3)
    rows, columns = np.mgrid[8:112:13, 8:152:13]
    depth[rows, columns] = rng.uniform(0.5, 1.5, rows.shape)
    labels[rows, columns] = 1 + np.arange(rows.size).reshape(rows.shape)
    objects = [np.array([index], np.uint32) for index in (rows * 160 + columns).ravel()]
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
    left, top, splat, _ = splat_depth(freeze(depth, "v u", "f4"), DEPTH, objects, LENS, TURNED)

    projected = project(frame.xyz(), LENS, TURNED)
    found = 0
    for label, index in zip(
        labels[rows, columns].ravel(), (rows * 160 + columns).ravel(), strict=True
    ):
        v, u = np.nonzero(splat == label)
        if v.size and 3 < projected[index, 0] < 236 and 3 < projected[index, 1] < 196:
            assert abs(u.mean() + left - projected[index, 0]) <= 0.51
            assert abs(v.mean() + top - projected[index, 1]) <= 0.51
            found += 1
    assert found > 40


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("plumb_bob", (0.11, -0.24, 0.012, -0.021, 0.08)),
        ("rational_polynomial", (0.21, -0.14, 0.012, -0.021, 0.08, 0.3, -0.05, 0.07)),
        ("equidistant", (0.03, -0.02, 0.05, -0.04)),
        ("fisheye", (0.03, -0.02, 0.05, -0.04)),  # another name of the same model
    ],
)
def test_projection_follows_lens_model(model: str, coefficients: tuple[float, ...]) -> None:
    """Masks and images are rectified by different code; both must use all coefficients."""
    lens = LensCamera(LENS.pinhole, model, coefficients)
    points = np.random.default_rng(4).uniform((-0.4, -0.3, 0.8), (0.4, 0.3, 1.2), (50, 3))
    moved = points @ TURNED.rotation.T + TURNED.translation
    distorted = distort(moved[:, :2] / moved[:, 2:], model, coefficients)
    expected = np.column_stack([distorted * (205.0, 207.0) + (121.4, 96.2), moved[:, 2]])

    np.testing.assert_allclose(project(points, lens, TURNED), expected, rtol=1e-4)


@pytest.mark.parametrize("k1", [-0.2, 0.2])
def test_rectified_image_matches_bilinear_interpolation(k1: float) -> None:
    """Colours are random, so that swapped axes are noticed.

    A lens that bends outward needs pixels from beyond each border, which are black.
    """
    lens = LensCamera(Camera(24, 18, 20.0, 21.0, 11.3, 8.8), "plumb_bob", (k1, 0, 0.02, 0.01, 0))
    pixels = np.random.default_rng(7).integers(0, 256, (18, 24, 3)).astype(np.uint8)
    v, u = np.mgrid[:18, :24]
    rays = np.stack([(u - 11.3) / 20, (v - 8.8) / 21], axis=-1)
    x, y = np.moveaxis(distort(rays, lens.model, lens.coefficients), -1, 0)
    source = [y * 21 + 8.8, x * 20 + 11.3]
    inside = (source[0] >= 0) & (source[0] <= 17) & (source[1] >= 0) & (source[1] <= 23)
    expected = [
        ndimage.map_coordinates(one, source, order=1) for one in pixels.T.swapaxes(1, 2) * 1.0
    ]

    difference = rectified(pixels, lens) - np.where(inside, expected, 0).transpose(1, 2, 0)
    assert inside.mean() > 0.8
    assert np.abs(difference).max() <= 0.51


def test_rectified_image_ends_at_turning_point_of_lens() -> None:
    """Farther out the polynomial leads back into the image, and would show it again."""
    camera = Camera(41, 31, 15.0, 16.0, 20.0, 15.0)
    white = np.full((31, 41, 3), 255, np.uint8)
    rectified_white = rectified(white, LensCamera(camera, "plumb_bob", (-0.4, 0.0, 0.0, 0.0, 0.0)))
    v, u = np.mgrid[:31, :41]
    slope = np.hypot((u - 20) / 15, (v - 15) / 16)

    assert (rectified_white[slope < 0.905] == 255).all()  # x - 0.4 x^3 turns back at x = 0.913
    assert (rectified_white[slope > 0.92] == 0).all()


@pytest.mark.parametrize("ahead", [-0.6, 0.7])
def test_mask_is_dense_at_any_distance_of_colour_camera(ahead: float) -> None:
    """A depth pixel covers more of the image the nearer the colour camera is to the object."""
    depth = np.zeros((120, 160), np.float32)
    depth[40:70, 50:95] = 1.0
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
    lens = LensCamera(Camera(800, 600, 280.0, 282.0, 400.0, 300.0))
    (mask,) = dense_masks(
        frame, [np.flatnonzero(depth)], lens, Pose(np.eye(3), np.array([0, 0, -ahead]))
    )

    # The border pixels end half a pixel beyond their centres.
    width, height = 280 * 45 / 140 / (1 - ahead), 282 * 30 / 141 / (1 - ahead)
    left = 400 + (49.5 - 80.3) * 280 / 140 / (1 - ahead)
    assert abs(mask.left - 0.5 - left) <= 1.5
    assert np.abs(np.subtract(mask.box[2:], (width, height))).max() <= 2
    assert mask.area > 0.97 * mask.pixels.size


def test_closed_gaps_are_measured_in_depth_pixels() -> None:
    """In a colour image three times as fine, 3 depth pixels are a crack to close, 10 are a gap."""
    depth = np.zeros((120, 160), np.float32)
    depth[40:80, 40:55] = depth[40:80, 58:80] = depth[40:80, 90:110] = 1.0
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
    fine = LensCamera(Camera(480, 360, 420.0, 423.0, 241.4, 177.2))
    (mask,) = dense_masks(frame, [np.flatnonzero(depth)], fine, IDENTITY)

    row = mask.full(360, 480)[180]
    assert row[3 * 42 : 3 * 78].all()
    assert not row[3 * 80 + 3 : 3 * 90 - 3].any()
    assert row[3 * 92 : 3 * 108].all()


def test_slightly_nearer_surface_occludes_object() -> None:
    """A cloth 10 cm in front of a board hides from one camera what the other one sees."""
    depth = np.full((120, 160), 1.0, np.float32)
    depth[:, 30:70] = 0.9  # the cloth belongs to no object
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
    board = np.arange(depth.size).reshape(depth.shape)[40:90, 70:130].ravel()
    lens = LensCamera(Camera(320, 240, 140.0, 141.0, 80.3, 58.9))
    (mask,) = dense_masks(frame, [board], lens, Pose(np.eye(3), np.array([0.7, 0.0, 0.0])))

    # The cloth ends at column 69.5 + 98 / 0.9, the board begins at 69.5 + 98.
    row = mask.full(240, 320)[60]
    assert abs(np.flatnonzero(row)[0] - (69.5 + 98 / 0.9)) <= 4  # a cell of 4 pixels
    assert abs(np.flatnonzero(row)[-1] - (129.5 + 98)) <= 2


def test_surface_far_away_in_depth_image_may_occlude_object() -> None:
    """A post near the camera moves much farther between the two images than what it hides."""
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:, 10:40] = 0.5
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
    board = np.arange(depth.size).reshape(depth.shape)[40:90, 100:131].ravel()
    lens = LensCamera(Camera(320, 240, 140.0, 141.0, 80.3, 58.9))
    (mask,) = dense_masks(frame, [board], lens, Pose(np.eye(3), np.array([0.4, 0.0, 0.0])))

    # The post moves by 56 / 0.5 pixels, to columns 122 to 151; the board by 56 / 2, to 128 to 158.
    assert np.abs(np.subtract((mask.left, mask.left + mask.box[2]), (152, 159))).max() <= 4


def test_slit_stays_open_if_background_is_visible() -> None:
    """Missing depth between two parts is a gap to be closed; a wall between them is not."""
    closed, opened = np.full((2, 120, 160), 1.0, np.float32)
    inside = np.zeros((120, 160), bool)
    inside[30:90, 40:110] = True
    inside[:, 70:73] = False
    closed[:, 70:73], opened[:, 70:73] = 0, 1.4
    found = []
    for depth in (closed, opened):
        frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
        (mask,) = dense_masks(frame, [np.flatnonzero(inside)])
        found.append(mask.full(120, 160)[35:85, 70:73])

    assert found[0].all()
    assert not found[1].any()


@pytest.mark.parametrize(
    "part", [np.s_[:, :30], np.s_[:, 120:], np.s_[:20, 30:90], np.s_[95:, 40:70], np.s_[:, :]]
)
def test_mask_extends_to_image_border(part: tuple[slice, slice]) -> None:
    """Objects cut off by the border would lose their edge, or the whole mask."""
    inside = np.zeros((120, 160), bool)
    inside[part] = True
    depth = np.full((120, 160), 1.0, np.float32)
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
    (mask,) = dense_masks(frame, [np.flatnonzero(inside)])

    wrong = mask.full(120, 160) ^ inside
    assert wrong.sum() <= 12  # corners inside the image are rounded
    assert not wrong[[0, -1]].any()
    assert not wrong[:, [0, -1]].any()


def two_boards() -> tuple[Frame, Any, Any]:
    """Return a frame of a wall and two boards, and the pixel indices of the near and the far board.

    The near board hides the left end of the far one.
    """
    depth = np.full((120, 160), 2.0, np.float32)
    depth[30:90, 40:120] = 1.0  # far board
    depth[40:80, 20:60] = 0.6  # near board
    pixels = np.arange(depth.size, dtype=np.uint32).reshape(depth.shape)
    near = pixels[40:80, 20:60].ravel()
    far = np.setdiff1d(pixels[30:90, 40:120], near)
    return Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH), near, far


def test_surface_hidden_from_colour_camera_has_no_mask() -> None:
    """From 20 cm to the left, the near board hides more of the far one: no mask there."""
    frame, near, far = two_boards()
    lens = LensCamera(Camera(320, 240, 280.0, 282.0, 160.6, 117.8))
    shift = Pose(np.eye(3), np.array([0.2, 0.0, 0.0]))  # the colour camera is to the left
    front, back = dense_masks(frame, (near, far), lens, shift)

    assert not (front.full(240, 320) & back.full(240, 320)).any()
    # Their left and right ends by the pinhole: 140 px / 0.6 m and 140 px / 1 m, twice as fine.
    shift_near, shift_far = 280 * 0.2 / 0.6, 280 * 0.2 / 1.0
    assert abs(front.left - (2 * 19.5 + shift_near)) <= 1.5
    assert abs(front.left + front.box[2] - (2 * 59.5 + shift_near)) <= 1.5
    row = back.full(240, 320)[120]
    assert abs(np.flatnonzero(row)[0] - (2 * 59.5 + shift_near)) <= 1.5
    assert abs(np.flatnonzero(row)[-1] - (2 * 119.5 + shift_far)) <= 1.5


def test_object_outside_colour_image_has_no_mask() -> None:
    """Masks are stored by detection number, and here the first detection has none."""
    frame, near, far = two_boards()
    lens = LensCamera(Camera(320, 240, 280.0, 282.0, 20.6, 117.8))
    image = ColourImage("/color", 1, 2, "color", "rgb8", 320, 240, 0, b"")
    masks = find_masks(frame, ColourView(image, lens, IDENTITY), (near, far))

    assert masks.boxes.keys() == masks.counts.keys() == {1}
    assert mask_of(masks, [0]).area == 0
    whole = mask_of(masks, [1]).full(240, 320)
    (_, far_mask) = dense_masks(frame, (near, far), lens, IDENTITY)
    np.testing.assert_array_equal(whole, far_mask.full(240, 320))


def test_unorganized_cloud_has_no_masks() -> None:
    """Its points have no pixels to project; the recording must be processed nevertheless."""
    cloud = Frame("", 0, 0, 0, "", points=np.array([[0.1, 0.2, 1.0], [0.2, 0.1, 1.1]], np.float32))
    image = ColourImage("/color", 1, 2, "color", "rgb8", 320, 240, 0, b"")
    masks = find_masks(cloud, ColourView(image, LENS, TURNED), [np.array([1], np.uint32)])

    assert (masks.boxes, masks.counts, masks.width, masks.height) == ({}, {}, 320, 240)


def test_masks_keep_only_holes_of_the_object() -> None:
    """A colour image finer than the depth has gaps to close; a hole in a handle is not a gap."""
    depth = np.full((120, 160), 1.0, np.float32)
    ring = np.zeros(depth.shape, bool)
    ring[30:90, 40:110] = True
    ring[50:70, 60:90] = False  # a window through which the wall is seen
    depth[50:70, 60:90] = 1.3
    rng = np.random.default_rng(0)
    lost = rng.random(depth.shape) < 0.05
    depth[lost] = 0
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=DEPTH)
    (mask,) = dense_masks(frame, (np.flatnonzero(ring & ~lost),), LENS, TURNED)

    middle = project(np.array([[-0.04, 0.01, 1.3], [-0.2, 0.01, 1.0]]), LENS, TURNED)
    full = mask.full(200, 240)
    (hole_u, hole_v), (on_u, on_v) = np.rint(middle[:, :2]).astype(int)
    assert not full[hole_v - 4 : hole_v + 5, hole_u - 4 : hole_u + 5].any()
    assert full[on_v - 6 : on_v + 7, on_u - 6 : on_u + 7].all()
    (registered,) = dense_masks(frame, (np.flatnonzero(ring & ~lost),))
    solid = registered.full(120, 160)
    assert solid[32:48, 42:108].all()
    assert not solid[55:65, 65:85].any()


def masks_of_labels(labels: Any) -> tuple[Mask, ...]:
    """Return the masks of objects 1 and 2 in a registered image; at label -1, depth is missing."""
    depth, camera = np.where(labels < 0, 0, 1).astype(np.float32), Camera(40, 20, 50, 50, 20, 10)
    frame = Frame("", 0, 0, 0, "", depth=depth, camera=camera)
    return dense_masks(frame, [np.flatnonzero(labels == number) for number in (1, 2)])


def test_masks_of_two_objects_do_not_overlap() -> None:
    """Closing gaps must not extend objects over the table or into each other."""
    labels = np.zeros((20, 40), np.int32)
    labels[5:15, 5:15], labels[5:15, 17:27] = 1, 2
    labels[9, 10] = labels[10, 20] = 0  # a pixel each
    labels[:, 30:] = -1
    one, two = masks_of_labels(labels)
    assert (one.box, two.box) == ((5, 5, 10, 10), (17, 5, 10, 10))
    assert one.area == two.area == 88  # of squares, whose corners are rounded


def test_masks_of_a_merged_track_are_united() -> None:
    labels = np.zeros((20, 40), np.int32)
    labels[2:6, 3:9], labels[10:13, 20:31] = 1, 2
    one, two = masks_of_labels(labels)
    both = union((one, EMPTY_MASK, two))
    np.testing.assert_array_equal(both.full(20, 40), one.full(20, 40) | two.full(20, 40))
    assert both.box == (4, 2, 25, 11)
    assert union(()).area == 0
    assert Mask(0, 0, np.zeros((0, 0), bool)).box == (0, 0, 0, 0)


def test_union_of_masks_with_overlapping_boxes_keeps_all_pixels() -> None:
    """The boxes of the parts of a chair overlap; a later part must not clear an earlier one."""
    rng = np.random.default_rng(6)
    masks = [
        Mask(left, top, rng.random(size) < 0.4)
        for left, top, size in ((3, 4, (9, 12)), (8, 2, (7, 5)), (5, 9, (6, 20)))
    ]
    expected = np.any([mask.full(20, 30) for mask in masks], axis=0)

    for order in itertools.permutations(masks):
        np.testing.assert_array_equal(union(order).full(20, 30), expected)


def test_box_of_several_detections_encloses_all() -> None:
    """Boxes are left, top, width and height; taken for corners, they would be drawn wrong."""
    boxes = {0: (30, 4, 5, 6), 2: (7, 21, 9, 8), 3: (0, 0, 99, 99)}
    masks = ImageMasks("/color", 1, 2, "color", 200, 100, boxes, {})

    assert box_of(masks, [0, 1, 2]) == (7, 4, 28, 25)
    assert box_of(masks, [2]) == (7, 21, 9, 8)
    assert box_of(masks, [1]) is None


def image_of_a_box(colour: tuple[int, int, int]) -> tuple[Any, Any]:
    """Return a grainy image of a coloured box, rows 20 to 59 and columns 30 to 69, and its mask."""
    rng = np.random.default_rng(1)
    inside = np.zeros((80, 100), bool)
    inside[20:60, 30:70] = True
    grain = rng.integers(-9, 10, (80, 100, 3))
    return (np.where(inside[..., None], colour, (120, 130, 140)) + grain).astype(np.uint8), inside


@pytest.mark.parametrize(("top", "left"), [(18, 32), (22, 28), (18, 27)])
def test_outlines_snap_to_colour_edges(top: int, left: int) -> None:
    """A mask two or three pixels off its object teaches a wrong outline."""
    pixels, inside = image_of_a_box((170, 90, 60))
    (mask,) = snapped([Mask(left, top, np.ones((40, 40), bool))], pixels)
    wrong = mask.full(80, 100) ^ inside
    assert wrong.sum() <= 8  # of 160 and more; corners may be rounded
    (finer,) = snapped([Mask(left, top, np.ones((40, 40), bool))], pixels, 2.0)
    assert (finer.full(80, 100) ^ inside).sum() <= 16


def test_outlines_snap_to_faint_edges_in_fine_images() -> None:
    """At three times the resolution of the depth, 7 pixels are a small error."""
    inside = np.zeros((110, 130), bool)
    inside[25:85, 35:95] = True
    pixels = np.where(inside[..., None], (128, 138, 148), (120, 130, 140)).astype(np.uint8)
    (mask,) = snapped([Mask(28, 25, np.ones((60, 60), bool))], pixels, 3.0)

    assert (mask.full(110, 130) ^ inside).sum() <= 160  # of 840


@pytest.mark.parametrize("turned", [False, True])
def test_outline_of_long_object_snaps_at_both_ends(*, turned: bool) -> None:
    """The window around a mask must be as wide and as high as the mask."""
    rng = np.random.default_rng(2)
    inside = np.zeros((50, 180), bool)
    inside[20:32, 20:160] = True
    grain = rng.integers(-9, 10, (50, 180, 3))
    pixels = (np.where(inside[..., None], (170, 90, 60), (120, 130, 140)) + grain).astype(np.uint8)
    before = Mask(22, 20, np.ones((12, 140), bool))
    if turned:
        inside, pixels = inside.T, pixels.swapaxes(0, 1)
        before = Mask(20, 22, before.pixels.T)
    (mask,) = snapped([before], pixels)

    assert (mask.full(*inside.shape) ^ inside).sum() <= 10  # of 48


def test_outlines_stay_without_colour_edges() -> None:
    """Depth separates a white cup from a white table; colour noise must not move its outline."""
    pixels, _ = image_of_a_box((120, 130, 140))
    before = Mask(28, 22, np.ones((40, 40), bool))
    (mask,) = snapped([before], pixels)
    assert (mask.full(80, 100) ^ before.full(80, 100)).sum() <= 40  # a quarter of a pixel
    assert snapped([before], np.zeros((80, 100, 3), np.uint8))[0].box == before.box


def test_snapped_neighbouring_masks_do_not_overlap() -> None:
    """Outlines move independently, so two masks could claim the same pixel."""
    pixels, inside = image_of_a_box((170, 90, 60))
    left = Mask(30, 20, np.ones((40, 17), bool))
    right = Mask(47, 20, np.ones((40, 23), bool))
    pixels[20:60, 50:70] = np.where(inside[20:60, 50:70, None], (60, 90, 170), 0)
    one, nothing, two = snapped([left, EMPTY_MASK, right], pixels)
    assert nothing.area == 0
    assert not (one.full(80, 100) & two.full(80, 100)).any()
    # The right one gives up what it had beyond the edge at column 50.
    assert abs(two.left - 50) <= 1
    (whole,) = snapped([Mask(0, 0, np.ones((80, 100), bool))], pixels)
    assert whole.area == 8000


def test_pixels_between_snapped_masks_go_to_one_of_them() -> None:
    """The masks of a body and a bar of the same colour both grow into the gap between them."""
    pixels, _ = image_of_a_box((170, 90, 60))
    pixels[:36, 50:70] = pixels[44:, 50:70] = pixels[:36, :20].mean(axis=(0, 1))
    body, bar = Mask(30, 20, np.ones((40, 18), bool)), Mask(52, 36, np.ones((8, 18), bool))
    for order in ((body, bar), (bar, body)):
        one, two = (mask.full(80, 100) for mask in snapped(order, pixels))
        assert (one ^ two)[39:41, 33:67].all()
        assert not (one & two).any()


@pytest.mark.parametrize("border", [48, 52])
def test_pixels_released_by_a_mask_go_to_its_neighbour(border: int) -> None:
    """A gap between the masks of two objects that touch would be taught as an outline.

    Either of the masks may be the wider one: the order of the objects must not matter.
    """
    pixels, inside = image_of_a_box((170, 90, 60))
    pixels[20:60, 50:70] = np.where(inside[20:60, 50:70, None], (60, 90, 170), 0)
    left = Mask(30, 20, np.ones((40, border - 30), bool))
    right = Mask(border, 20, np.ones((40, 70 - border), bool))
    one, two = (mask.full(80, 100) for mask in snapped([left, right], pixels))
    assert (one ^ two)[23:57, 33:67].all()  # corners may be rounded
    assert one[23:57, 33:50].all()
    assert two[23:57, 50:67].all()


def test_third_object_nearby_does_not_free_the_pixels_of_its_neighbours() -> None:
    """Two boxes of one colour touch; the first of them would take the edge of the other."""
    pixels, _ = image_of_a_box((170, 90, 60))
    pixels[60:68, 44:56] = (60, 90, 170)
    left, right = Mask(30, 20, np.ones((40, 20), bool)), Mask(50, 20, np.ones((40, 20), bool))
    below = Mask(44, 60, np.ones((8, 12), bool))
    for place in range(3):
        masks = [left, right]
        masks.insert(place, below)
        snapped_masks = list(snapped(masks, pixels))
        snapped_masks.pop(place)
        one, two = (mask.full(80, 100) for mask in snapped_masks)
        assert one[23:57, 33:50].all()
        assert two[23:57, 50:67].all()


@pytest.mark.slow
@pytest.mark.parametrize("sensor", [pytest.param("kinect", marks=pytest.mark.many), "realsense"])
def test_masks_agree_with_simulated_colour_camera(
    tmp_path: Path, sensor: Literal["kinect", "realsense"]
) -> None:
    """Errors of lens, transform, occlusion and sensor may add up; the truth is rendered."""
    from shapecat.simulation import simulate  # noqa: PLC0415  slow to load

    scores = []
    for seed, scene in enumerate(("tabletop", "clutter"), start=21):
        path = tmp_path / f"{seed}.mcap"
        simulate(path, scene=scene, frames=1, seed=seed, sensor=sensor, color=True)  # type: ignore[arg-type]
        scores += overlaps(path)
    assert len(scores) > 12
    assert np.mean(scores) >= 0.9


def overlaps(path: Path) -> list[float]:
    """Return the intersection over union of the mask of each object with its true mask."""
    from shapecat.recordings import choose_streams, open_recording  # noqa: PLC0415  slow to load
    from shapecat.recordings.colour_frames import frames_with_colour  # noqa: PLC0415  the same
    from shapecat.recordings.colour_streams import pair_colours  # noqa: PLC0415  the same

    labels = np.load(path.with_suffix(".labels.npz"))["labels"]
    truth = np.load(path.with_suffix(".color_labels.npz"))["labels"]
    scores = []
    with open_recording(path) as recording:
        (stream,) = choose_streams(recording)
        colour = pair_colours(recording, [stream]).get(stream.topic)
        assert colour is not None
        colours = {stream.topic: colour}
        for frame, view in frames_with_colour(recording, [stream], colours):
            assert view is not None
            own, other = labels[frame.index].ravel(), truth[frame.index]
            ids = [int(i) for i in np.unique(own) if i >= 20 and (own == i).sum() >= 100]
            objects = [np.flatnonzero(own == i).astype(np.uint32) for i in ids]
            masks = dense_masks(frame, objects, view.lens, view.colour_from_depth)
            for i, mask in zip(ids, masks, strict=True):
                full = mask.full(*other.shape)
                scores.append(float((full & (other == i)).sum() / (full | (other == i)).sum()))
    return scores
