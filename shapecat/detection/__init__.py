"""Detection: supporting planes, object candidates and their hierarchy (thesis ch. 4).

`detect` turns a frame into a `shapecat.types.Scene`; `Hierarchy` answers questions about it.
"""

from shapecat.detection.detector import detect
from shapecat.detection.hierarchy import Hierarchy, Node, format_tree

__all__ = ["Hierarchy", "Node", "detect", "format_tree"]
