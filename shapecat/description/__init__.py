"""Shape description (thesis ch. 6): the graph of a surface becomes a vector of features."""

from shapecat.description.blocks import BLOCKS, DESCRIPTOR_NAMES
from shapecat.description.descriptor import describe

__all__ = ["BLOCKS", "DESCRIPTOR_NAMES", "describe"]
