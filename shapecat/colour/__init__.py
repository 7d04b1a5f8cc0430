"""What belongs to which pixel of a colour image: projection, occlusion, masks."""

from shapecat.colour.masks import Mask, dense_masks
from shapecat.colour.projection import project

__all__ = ["Mask", "dense_masks", "project"]
