"""Ground truth of a simulated frame."""

from typing import Any

import numpy as np

from shapecat.arrays import F8, U1
from shapecat.geometry import compose, inverse, transform, upright_box
from shapecat.simulation.camera.render import pixels_if_unoccluded
from shapecat.simulation.scenes.worlds import PlacedObject, Support, World
from shapecat.types import Camera, Pose

__all__ = ["AMBIGUOUS_PIXELS", "AMBIGUOUS_SHARE", "LISTED_PIXELS", "frame_truth"]

LISTED_PIXELS = 100
"""Objects with fewer visible depth pixels than this are listed as hidden."""
AMBIGUOUS_PIXELS = 250
"""Objects with fewer visible depth pixels than this have an ambiguous category."""
AMBIGUOUS_SHARE = 0.4
"""The category is also ambiguous if an object has less than this fraction of the pixels that it
would have if nothing occluded it."""


def frame_truth(world: World, frame: int, labels: U1, camera: Camera) -> dict[str, Any]:
    """Return the ground truth of a frame as JSON values.

    The keys are ``objects``, ``hidden`` (objects with fewer than `LISTED_PIXELS` depth pixels) and
    ``planes`` (the supports that hold objects). Absent objects are left out. Boxes and planes are
    in the optical frame; the ``center`` of an object and the ``height`` of a plane are in the world
    frame; metres.

    Parameters
    ----------
    labels : (h, w) uint8 pixel labels of the frame, from `render_frame`.
    camera : intrinsics of the frame.
    """
    geometry, world_from_camera = world.geometry(frame), world.path[frame]
    counts = np.bincount(labels.reshape(-1), minlength=256)
    objects: list[dict[str, Any]] = []
    hidden: list[dict[str, Any]] = []
    for mesh_id, item in enumerate(world.objects, start=len(world.supports)):
        if world.present(item, frame):
            pixels = int(counts[item.label])
            total = pixels_if_unoccluded(geometry, mesh_id, camera, world_from_camera)
            share = min(1.0, pixels / total) if total else 0.0
            entry = _object_truth(world, frame, item, pixels, share)
            (objects if pixels >= LISTED_PIXELS else hidden).append(entry)
    camera_from_world = inverse(world_from_camera)
    planes = [
        _plane_truth(support, camera_from_world, int(counts[support.label]))
        for support in world.supports
        if support.holds_objects
    ]
    return {"objects": objects, "hidden": hidden, "planes": planes}


def _object_truth(
    world: World, frame: int, item: PlacedObject, pixels: int, share: float
) -> dict[str, Any]:
    """Return the truth of an object: ``pixels`` of its pixels, the fraction ``share``, are visible.

    While the object is lifted, nothing supports it.
    """
    world_from_camera, pose = world.path[frame], world.pose_of(item, frame)
    camera_from_world = inverse(world_from_camera)
    carried = pose.translation[2] > item.pose.translation[2]
    points = transform(compose(camera_from_world, pose), item.mesh.vertices).astype(np.float32)
    box = upright_box(points, camera_from_world.rotation[:, 2])
    few = pixels < AMBIGUOUS_PIXELS or share < AMBIGUOUS_SHARE
    return {
        "label": item.label,
        "parts": [item.label],
        "category": item.category,
        "ambiguous": bool(few or item.indistinct),
        "pixels": pixels,
        "track": item.track,
        "kind": item.kind,
        "center": _rounded(transform(world_from_camera, box.center)),
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


def _plane_truth(support: Support, camera_from_world: Pose, pixels: int) -> dict[str, Any]:
    """Return the truth of a support's surface, of which ``pixels`` pixels are visible."""
    normal = camera_from_world.rotation[:, 2]
    point = transform(camera_from_world, support.outline[0])
    return {
        "label": support.label,
        "name": support.name,
        "normal": _rounded(normal),
        "offset": round(float(normal @ point), 6),
        "height": round(support.height, 6),
        "pixels": pixels,
    }


def _rounded(values: F8) -> list[float]:
    return [round(float(value), 5) for value in values]
