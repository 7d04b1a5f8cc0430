"""Tests of boxes, image borders and upsampled labels on synthetic data."""

import numpy as np
import pytest

from shapecat.detection.depth_grid import find_borders
from shapecat.detection.output.occluded_points import label_occluded_points
from shapecat.detection.output.pixel_runs import pixels_by_label, split_by_label
from shapecat.geometry import rotation_from_quaternion, upright_box


def test_runs_are_listed_by_label() -> None:
    runs = np.array([[2, 3, 5], [1, 7, 9], [2, 11, 12]], np.int32)
    lists = split_by_label(*pixels_by_label(runs, 4))
    assert [each.tolist() for each in lists] == [[7, 8], [3, 4, 11], []]


def test_occluded_points_join_adjacent_object() -> None:
    """A row of points continues from a labelled one; another row lies apart."""
    along = np.arange(10) * 0.008
    points = np.zeros((20, 3), np.float32)
    points[:10, 0], points[10:, 0], points[10:, 1] = along, along, 0.3
    labels = np.zeros(20, np.int64)
    labels[0] = 5
    found = label_occluded_points(points, labels, 9)
    assert found.tolist() == [5] * 10 + [9] * 10


@pytest.mark.parametrize(("rows", "expected"), [(range(4, 40), 4), (range(20, 40), 0)])
def test_border_is_found_behind_blank_strip(rows: range, expected: int) -> None:
    """Samples that begin in the middle of the image are the top of an object."""
    inv_depth = np.zeros((40, 30), np.float32)
    inv_depth[list(rows), 5:25] = 1
    assert find_borders(inv_depth, 2).tolist()[0] == expected
    assert find_borders(np.ascontiguousarray(inv_depth[::-1]), 2).tolist()[1] == expected
    assert find_borders(np.ascontiguousarray(inv_depth.T), 2).tolist()[2] == expected


def test_border_is_straight_in_first_lines_with_samples() -> None:
    """The narrow top of an object is not a border."""
    inv_depth = np.zeros((40, 30), np.float32)
    inv_depth[4:, 10:14] = 1
    inv_depth[6, 2] = 1
    assert find_borders(inv_depth, 2).tolist()[0] == 0
    assert find_borders(inv_depth, 3).tolist()[0] == 4


def test_upright_box_of_rotated_box_has_its_size() -> None:
    """The corners are rotated by 30 degrees about an oblique up direction."""
    size = np.array([0.2, 0.1, 0.05])
    corners = (np.array(np.meshgrid(*[(-0.5, 0.5)] * 3)).reshape(3, -1).T) * size
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    up = np.array([0.0, -np.sqrt(0.5), -np.sqrt(0.5)])
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    axes = np.stack([[1, 0, 0], np.cross(up, [1, 0, 0]), up], 1)
    box = upright_box((corners @ rotation.T @ axes.T + [0, 0, 1]).astype(np.float32), up)
    np.testing.assert_allclose(np.sort(box.size[:2]), [0.1, 0.2], atol=2e-3)
    assert box.size[2] == pytest.approx(0.05, abs=1e-4)
    np.testing.assert_allclose(box.center, [0, 0, 1], atol=1e-4)
    np.testing.assert_allclose(rotation_from_quaternion(box.orientation)[:, 2], up, atol=1e-6)
