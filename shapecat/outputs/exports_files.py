"""The old place of `png`, `safe_name` and the level clouds."""

from shapecat.outputs.level_clouds import finite_points, upward
from shapecat.outputs.png import png
from shapecat.outputs.wording import safe_name

__all__ = ["finite_points", "png", "safe_name", "upward"]
