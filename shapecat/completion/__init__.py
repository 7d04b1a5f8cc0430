"""The box of a whole object, estimated from its visible sides."""

from shapecat.completion.fused import BoxViews, FusedBox, fuse_boxes
from shapecat.completion.outline import DIRECTIONS
from shapecat.completion.whole import ENOUGH_POINTS, complete

__all__ = [
    "DIRECTIONS",
    "ENOUGH_POINTS",
    "BoxViews",
    "FusedBox",
    "complete",
    "fuse_boxes",
]
