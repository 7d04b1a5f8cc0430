"""What is hidden of an object: its whole box, from the sides that are seen."""

from shapecat.completion.fused import BoxViews, FusedBoxes, fuse_boxes
from shapecat.completion.outline import DIRECTIONS
from shapecat.completion.whole import ENOUGH_POINTS, complete

__all__ = ["DIRECTIONS", "ENOUGH_POINTS", "BoxViews", "FusedBoxes", "complete", "fuse_boxes"]
