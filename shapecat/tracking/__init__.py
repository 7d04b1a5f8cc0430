"""Objects over time: association, track stitching and fusion (thesis 7.5.2).

`track_recording` combines these steps: it turns the detections of each stream into tracks.
"""

from shapecat.tracking.detection_table import DetectionTable, TableBuilder
from shapecat.tracking.fusion import causal, fuse, view_weights
from shapecat.tracking.recording import track_recording
from shapecat.tracking.records import Track
from shapecat.tracking.stitching import Fragments, merge_fragments, scene_cuts
from shapecat.tracking.tracker import Tracker

__all__ = [
    "DetectionTable",
    "Fragments",
    "TableBuilder",
    "Track",
    "Tracker",
    "causal",
    "fuse",
    "merge_fragments",
    "scene_cuts",
    "track_recording",
    "view_weights",
]
