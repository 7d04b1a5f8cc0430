"""Objects over time: association, track stitching and fusion (thesis 7.5.2).

`track_recording` combines these steps: it turns the detections of each stream into tracks. In all
steps, ``track`` (n,) are the indices of a track's detections in the `DetectionTable`, ascending.
"""

from shapecat.tracking.detection_table import DetectionTable, TableBuilder
from shapecat.tracking.fusion import fuse, view_weights
from shapecat.tracking.recording import track_recording
from shapecat.tracking.records import Track

__all__ = [
    "DetectionTable",
    "TableBuilder",
    "Track",
    "fuse",
    "track_recording",
    "view_weights",
]
