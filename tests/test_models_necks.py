"""Tests of splitting segments at necks; the merging trees are trained on these segments."""

import numpy as np
import pytest

from shapecat.arrays import I4, Bool
from shapecat.detection.connected_components import DOWN, RIGHT, spans_of
from shapecat.detection.segmentation.connectivity import SurfaceGraph
from shapecat.detection.segmentation.settings import SEGMENTATION
from shapecat.models.necks import split_necks


def disks(*circles: tuple[int, int, int]) -> Bool:
    """Return a mask (80, 120) of disks, each a row, a column and a radius, in cells."""
    y, x = np.mgrid[:80, :120]
    inside: Bool = np.any(
        [(y - r) ** 2 + (x - c) ** 2 <= size**2 for r, c, size in circles], axis=0
    )
    return inside


def split(mask: Bool, *, step_at: int | None = None) -> tuple[I4, int]:
    """Return the labels of a split mask, and their number.

    ``step_at`` is a column with a depth discontinuity in rows 20 to 51.
    """
    blank, links = np.zeros((0, 3, 0), np.float32), np.full(mask.shape, RIGHT | DOWN, np.uint8)
    if step_at is not None:
        links[20:52, step_at] = DOWN
    flat, labels = np.zeros(mask.shape, np.uint8), mask.astype(np.int16)
    graph = SurfaceGraph(blank, blank, links, flat, spans_of(mask.astype(np.int8)))
    return labels, split_necks(graph, labels, 1)


def test_touching_disks_are_split_at_the_necks_between_them() -> None:
    """The level tops of three cans, of which the middle one touches both others."""
    mask = disks((25, 20, 15), (40, 46, 18), (30, 74, 14))

    labels, n = split(mask)

    assert n == 3
    assert ((labels > 0) == mask).all()
    largest, others = labels[40, 46], [labels[25, 20], labels[30, 74]]
    assert (largest, others) == (1, [2, 3])  # the largest keeps its label
    for circle, label in {(25, 20, 9): 2, (40, 46, 12): 1, (30, 74, 8): 3}.items():
        assert (labels[disks(circle)] == label).all()


@pytest.mark.parametrize(
    "mask",
    [
        disks(*((40, k, 12) for k in range(20, 80))),
        disks((40, 30, 15), *((40, k, 4) for k in range(40, 70))),
        disks((40, 30, 15), (40, 47, 2)),
        disks((40, 30, 15), (42, 38, 14)),
    ],
    ids=["lying can", "narrow end", "knob", "no neck"],
)
def test_surface_without_a_neck_between_wide_parts_stays_whole(mask: Bool) -> None:
    labels, n = split(mask)
    assert n == 1
    assert (labels == mask).all()


def test_depth_discontinuity_makes_a_neck() -> None:
    """A depth discontinuity narrows a surface as its border does."""
    mask = np.zeros((80, 120), np.bool_)
    mask[20:60, 20:100] = True
    labels, n = split(mask, step_at=55)
    assert n == 2
    assert labels[30, 40] != labels[30, 80]


def test_crowded_image_gets_no_more_segments_than_fit() -> None:
    mask, links = disks((25, 20, 15), (40, 46, 18)), np.full((80, 120), RIGHT | DOWN, np.uint8)
    labels = (mask * SEGMENTATION.max_segments).astype(np.int16)
    blank, flat = np.zeros((0, 3, 0), np.float32), np.zeros(mask.shape, np.uint8)
    graph = SurfaceGraph(blank, blank, links, flat, spans_of(mask.astype(np.int8)))
    assert split_necks(graph, labels, SEGMENTATION.max_segments) == SEGMENTATION.max_segments
    assert np.unique(labels).tolist() == [0, SEGMENTATION.max_segments]
