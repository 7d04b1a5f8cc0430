"""Ground truth of a frame."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from shapecat.arrays import F8, U1
from shapecat.geometry import compose, inverse, transform, upright_box
from shapecat.simulation.camera.render import Geometry, alone_pixels
from shapecat.simulation.camera.sensors import Sensor
from shapecat.simulation.scenes.worlds import PlacedObject, World

__all__ = ["AMBIGUOUS_PIXELS", "AMBIGUOUS_SHARE", "LISTED_PIXELS", "Truth", "frame_truth"]

LISTED_PIXELS = 100
"""Objects with fewer visible depth pixels than this are listed as hidden."""
AMBIGUOUS_PIXELS = 250
"""Objects with fewer visible depth pixels than this have an ambiguous category."""
AMBIGUOUS_SHARE = 0.4
"""The category is also ambiguous if less than this fraction of the side that faces the camera is
visible."""


@dataclass(frozen=True)
class Truth:
    """The ground truth of one frame, as JSON values."""

    objects: list[dict[str, Any]]
    hidden: list[dict[str, Any]]
    planes: list[dict[str, Any]]


def frame_truth(world: World, frame: int, labels: U1, sensor: Sensor) -> Truth:
    """Return the ground truth of a frame.

    Parameters
    ----------
    labels : (h, w) uint8 pixel labels of the frame, from `render_frame`.
    """
    geometry = world.geometry(frame)
    pose = world.path[frame]
    counts = np.bincount(labels.reshape(-1), minlength=256)
    objects: list[dict[str, Any]] = []
    hidden: list[dict[str, Any]] = []
    for mesh_id, item in enumerate(world.objects, start=len(world.supports)):
        if not world.present(item, frame):
            continue
        pixels = int(counts[item.label])
        entry = _object_truth(world, frame, item, pixels, geometry, mesh_id, sensor)
        (objects if pixels >= LISTED_PIXELS else hidden).append(entry)
    camera_from_world = inverse(pose)
    planes = []
    for support in world.supports:
        if support.holds_objects:
            normal = camera_from_world.rotation[:, 2]
            point = transform(camera_from_world, support.outline[0])
            planes.append(
                {
                    "label": support.label,
                    "name": support.name,
                    "normal": _rounded(normal),
                    "offset": round(float(normal @ point), 6),
                    "height": round(support.height, 6),
                    "pixels": int(counts[support.label]),
                }
            )
    return Truth(objects, hidden, planes)


def _object_truth(
    world: World,
    frame: int,
    item: PlacedObject,
    pixels: int,
    geometry: Geometry,
    mesh_id: int,
    sensor: Sensor,
) -> dict[str, Any]:
    camera_from_world = inverse(world.path[frame])
    pose = world.pose_of(item, frame)
    camera_from_mesh = compose(camera_from_world, pose)
    carried = pose.translation[2] > item.pose.translation[2]
    points = transform(camera_from_mesh, item.mesh.vertices).astype(np.float32)
    box = upright_box(points, camera_from_world.rotation[:, 2])
    total = alone_pixels(geometry, mesh_id, sensor.camera, world.path[frame])
    share = min(1.0, pixels / total) if total else 0.0
    few = pixels < AMBIGUOUS_PIXELS or share < AMBIGUOUS_SHARE
    return {
        "label": item.label,
        "parts": [item.label],
        "category": item.category,
        "ambiguous": bool(few or item.indistinct),
        "pixels": pixels,
        "track": item.track,
        "kind": item.kind,
        "center": _rounded(transform(world.path[frame], box.center)),
        "box": {
            "center": _rounded(box.center),
            "size": _rounded(box.size),
            "orientation": _rounded(box.orientation),
        },
        "lying": item.lying,
        "upside_down": item.upside_down,
        "tilted": item.tilted,
        "on_support": None if carried else item.on_support,
        "on_track": None if carried else item.on_track,
        "visible": round(share, 4),
    }


def _rounded(values: F8) -> list[float]:
    return [round(float(value), 5) for value in values]
