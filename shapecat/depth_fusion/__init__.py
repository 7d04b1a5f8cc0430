"""Depth fusion: consecutive depth images become one, before detection (thesis 4.2).

`fuse` joins a frame with the earlier ones that `RecentFrames` keeps.
"""

from shapecat.depth_fusion.fusion import fuse, keep_same_surface
from shapecat.depth_fusion.recent import Earlier, RecentFrames

__all__ = ["Earlier", "RecentFrames", "fuse", "keep_same_surface"]
