"""Simulated depth cameras and scenes, for fixtures, demos and training data.

The seed alone determines the result, on every machine.
"""

from shapecat.simulation.layout import Piece, make_piece
from shapecat.simulation.measuring import measure
from shapecat.simulation.presets import IDEAL, KINECT, REALSENSE
from shapecat.simulation.recorder import record, simulate
from shapecat.simulation.scenes import make_scene
from shapecat.simulation.sensors import Sensor
from shapecat.simulation.views import render_frame
from shapecat.simulation.worlds import PlacedObject, Support, World

__all__ = [
    "IDEAL",
    "KINECT",
    "REALSENSE",
    "Piece",
    "PlacedObject",
    "Sensor",
    "Support",
    "World",
    "make_piece",
    "make_scene",
    "measure",
    "record",
    "render_frame",
    "simulate",
]
