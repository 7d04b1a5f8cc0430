"""Tests of connected components on small images."""

import numpy as np
import pytest
from scipy import ndimage

from shapecat.detection.connected_components import connected_components, span_of, spans_of

BOTH = 3
"""Links to the right and down."""


def full_spans(shape: tuple[int, int]) -> np.ndarray:
    return np.tile(np.array([[0, shape[1]]], np.int32), (shape[0], 1))


@pytest.mark.parametrize("share", [0.0, 0.3, 0.55, 0.7, 1.0])
def test_components_match_scipy(share: float) -> None:
    rng = np.random.default_rng(7)
    inside = rng.random((40, 50)) < share
    component = np.full(inside.shape, -1, np.int32)
    links = np.full(inside.shape, BOTH, np.uint8)
    sizes = connected_components(inside, links, full_spans(inside.shape), component)
    expected, count = ndimage.label(inside)
    np.testing.assert_array_equal(component, expected)
    np.testing.assert_array_equal(sizes[1:], np.bincount(expected.ravel())[1:])
    assert sizes.size == count + 1


def test_missing_links_separate_components() -> None:
    """The arms of a U are connected only at the bottom."""
    inside = np.ones((4, 3), bool)
    inside[:3, 1] = False
    component, links = np.zeros((4, 3), np.int32), np.full((4, 3), BOTH, np.uint8)
    assert connected_components(inside, links, full_spans((4, 3)), component).tolist() == [0, 9]
    links[3, 0] = 0
    assert connected_components(inside, links, full_spans((4, 3)), component).tolist() == [0, 4, 5]
    assert component[3].tolist() == [1, 2, 2]


def test_cells_outside_spans_are_not_written() -> None:
    inside = np.zeros((3, 6), bool)
    inside[0, :2] = inside[1, 4:] = True
    component, links = np.full((3, 6), 77, np.int32), np.full((3, 6), BOTH, np.uint8)
    spans = np.array([[0, 2], [4, 6], [0, 0]], np.int32)
    assert connected_components(inside, links, spans, component).tolist() == [0, 2, 2]
    assert component[2].tolist() == [77] * 6


def test_speckle_stays_within_arrays() -> None:
    """Without links, every cell is a component: arrays must be large enough for so many."""
    inside, links = np.ones((9, 8), bool), np.zeros((9, 8), np.uint8)
    component = np.zeros((9, 8), np.int32)
    # Plain Python checks array bounds, which compiled code does not.
    sizes = connected_components.py_func(inside, links, full_spans((9, 8)), component)
    assert sizes.tolist() == [0] + [1] * 72


def test_spans_enclose_positive_labels() -> None:
    assert span_of(np.array([0, -1, 3, 0, 2, 0], np.int16)) == (2, 5)
    assert span_of(np.zeros(4, np.int16)) == (0, 0)
    assert spans_of(np.array([[0, 1], [0, 0]], np.int16)).tolist() == [[1, 2], [0, 0]]
