"""Objects on a colour image: projection, occlusion, masks."""

from shapecat.colour.masks import Mask, dense_masks
from shapecat.colour.projection import project

__all__ = ["Mask", "dense_masks", "project"]
