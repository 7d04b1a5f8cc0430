"""labelCloud projects: clouds, and boxes in each of its three JSON formats.

Clouds and boxes are in the level frame of the sensor (z up), since labelCloud rotates boxes about
z. Source: labelCloud 1.1, label formats ``centroid_rel``, ``centroid_abs`` and ``vertices``.
"""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.arrays import F8
from shapecat.geometry import box_corners, gravity_rotation, rotation_from_quaternion
from shapecat.outputs.colouring import PairedFrame
from shapecat.outputs.colours import hex_colour
from shapecat.outputs.level_clouds import write_pcd
from shapecat.runs.finished import FinishedRun
from shapecat.types import UNKNOWN, LabelledObject, Pose

__all__ = ["write_labelcloud"]

_FORMATS = ("centroid_rel", "centroid_abs", "vertices")


def write_labelcloud(out: Path, frames: Iterable[PairedFrame], finished: FinishedRun) -> int:
    """Write pointclouds/ and labels/ of a labelCloud project; return the number of objects.

    labels/ has the format ``centroid_rel``; labels_centroid_abs/ and labels_vertices/ hold the same
    boxes in the other formats.
    """
    (out / "pointclouds").mkdir()
    for kind in _FORMATS:
        _folder(out, kind).mkdir()
        (_folder(out, kind) / "_classes.json").write_text(_classes(finished, kind), "utf-8")
    count = 0
    for number, (labelled, frame, _) in enumerate(frames):
        level = gravity_rotation(labelled.up)
        cloud = out / "pointclouds" / f"{number:06d}.pcd"
        points = frame.finite_xyz() @ level.T
        write_pcd(cloud, points.astype(np.float32), viewpoint=Pose(level, np.zeros(3)))
        for kind in _FORMATS:
            objects = [_described(item, level, kind) for item in labelled.objects]
            content = {"folder": "pointclouds", "filename": cloud.name}
            text = json.dumps({**content, "path": f"pointclouds/{cloud.name}", "objects": objects})
            (_folder(out, kind) / f"{number:06d}.json").write_text(text, "utf-8")
        count += len(labelled.objects)
    return count


def _folder(out: Path, kind: str) -> Path:
    return out / ("labels" if kind == _FORMATS[0] else f"labels_{kind}")


def _classes(finished: FinishedRun, kind: str) -> str:
    names = (UNKNOWN, *finished.categories)
    classes = [{"name": name, "id": k, "color": hex_colour(name)} for k, name in enumerate(names)]
    made_by = {"name": "shapecat", "version": finished.info["versions"]["shapecat"]}
    content = {"classes": classes, "default": 0, "type": "object_detection", "format": kind}
    return json.dumps({**content, "created_with": made_by}, indent=1)


def _described(item: LabelledObject, level: F8, kind: str) -> dict[str, Any]:
    if kind == "vertices":
        corners = box_corners(item.box) @ level.T
        for face in (corners[:4], corners[4:]):
            face[:, 2] = face[:, 2].mean()  # labelCloud would read rounding errors as a tilt
        return {"name": item.category, "vertices": _rounded(corners)}
    heading = level @ rotation_from_quaternion(item.box.orientation)[:, 0]
    yaw = float(np.arctan2(heading[1], heading[0]))
    # Round first, since the remainder of a tiny negative angle would be 360 itself.
    turn = round(yaw, 8) if kind == "centroid_rel" else round(float(np.degrees(yaw)), 8) % 360
    sizes = _rounded(item.box.size)
    return {
        "name": item.category,
        "centroid": dict(zip("xyz", _rounded(level @ item.box.center), strict=True)),
        "dimensions": dict(zip(("length", "width", "height"), sizes, strict=True)),
        "rotations": {"x": 0.0, "y": 0.0, "z": turn},
    }


def _rounded(values: F8) -> Any:
    return np.round(np.asarray(values, np.float64), 8).tolist()
