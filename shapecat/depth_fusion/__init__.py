"""Depth fusion: consecutive depth images become one, before detection (thesis 4.2).

`fuse` joins a frame with the earlier ones that `RecentFrames` keeps.
"""

from shapecat.depth_fusion.fusion import drop_missing_depth, fuse
from shapecat.depth_fusion.recent import Earlier, RecentFrames

__all__ = ["Earlier", "RecentFrames", "drop_missing_depth", "fuse"]
