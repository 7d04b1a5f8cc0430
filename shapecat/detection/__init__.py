"""Detection: supporting planes, objects and the support graph of a scene (thesis ch. 4).

`detect` turns a frame into a `shapecat.types.Scene`; `Hierarchy` is the support graph.
"""

from shapecat.detection.pipeline import detect
from shapecat.detection.scene_graph import Hierarchy, Node, format_tree

__all__ = ["Hierarchy", "Node", "detect", "format_tree"]
