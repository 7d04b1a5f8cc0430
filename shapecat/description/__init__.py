"""Shape description (thesis ch. 6): the graph of a surface becomes a fixed list of numbers."""

from shapecat.description.descriptor import BLOCKS, DESCRIPTOR_NAMES, describe

__all__ = ["BLOCKS", "DESCRIPTOR_NAMES", "describe"]
