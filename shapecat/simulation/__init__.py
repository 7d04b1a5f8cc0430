"""Simulated depth cameras and scenes, for fixtures, demos and training data.

The seed alone determines the result, on every machine.
"""

from shapecat.simulation.camera.presets import IDEAL, KINECT, REALSENSE
from shapecat.simulation.camera.sensors import Sensor
from shapecat.simulation.camera.views import render_frame
from shapecat.simulation.recorder import record, simulate
from shapecat.simulation.scenes.kinds import make_scene
from shapecat.simulation.scenes.worlds import PlacedObject, Support, World

__all__ = [
    "IDEAL",
    "KINECT",
    "REALSENSE",
    "PlacedObject",
    "Sensor",
    "Support",
    "World",
    "make_scene",
    "record",
    "render_frame",
    "simulate",
]
