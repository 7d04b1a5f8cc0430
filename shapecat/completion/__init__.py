"""What is hidden of an object: its whole box, from the side that is seen."""

from shapecat.completion.whole import ENOUGH_POINTS, complete

__all__ = ["ENOUGH_POINTS", "complete"]
