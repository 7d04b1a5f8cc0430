"""Detection: supporting planes, object candidates and their hierarchy (thesis ch. 4).

`detect` turns a frame into a `shapecat.types.Scene`; `Hierarchy` answers questions about it.
Before that, `fuse` may join a frame with those that `RecentFrames` remembers.
"""

from shapecat.detection.fusing import fuse, with_own_readings
from shapecat.detection.pipeline import detect
from shapecat.detection.recent import Earlier, RecentFrames
from shapecat.detection.scene_graph import Hierarchy, Node, format_tree

__all__ = [
    "Earlier",
    "Hierarchy",
    "Node",
    "RecentFrames",
    "detect",
    "format_tree",
    "fuse",
    "with_own_readings",
]
