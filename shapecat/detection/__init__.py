"""Detection: supporting planes and the objects on them (thesis ch. 4).

`detect` turns a frame into a `shapecat.types.Scene`.
"""

from shapecat.detection.pipeline import detect

__all__ = ["detect"]
