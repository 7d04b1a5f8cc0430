"""Point clouds in the level frame, and PCD files."""

from pathlib import Path

import numpy as np

from shapecat.arrays import F4
from shapecat.geometry import level_from_sensor, quaternion_from_rotation, transform
from shapecat.types import Frame, LabelledFrame, LabelledObject, Pose

__all__ = ["support_offset", "upright_cloud", "write_pcd"]


def write_pcd(path: Path, points: F4, *, viewpoint: Pose) -> None:
    """Write points (n, 3), metres, as a binary PCD file, version 0.7.

    ``viewpoint`` is the pose of the sensor in the frame of the points.
    """
    x, y, z, w = quaternion_from_rotation(viewpoint.rotation)
    place = " ".join(f"{value:.6f}" for value in (*viewpoint.translation, w, x, y, z))
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\n"
        f"TYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT {place}\n"
        f"POINTS {len(points)}\nDATA binary\n"
    )
    path.write_bytes(header.encode("ascii") + np.ascontiguousarray(points, "<f4").tobytes())


def support_offset(item: LabelledObject, up: F4) -> float:
    """Return the height of an object's support above the sensor, along ``up`` (3,), metres.

    If the support is unknown, the bottom of the object's box takes its place.
    """
    middle = float(np.dot(np.asarray(up, np.float64), item.box.center))
    half = float(item.box.size[2]) / 2
    return middle - (item.height_m if np.isfinite(item.height_m) else half)


def upright_cloud(
    labelled: LabelledFrame, frame: Frame, item: LabelledObject
) -> tuple[F4, Pose] | None:
    """Return the points (n, 3) of an object in the level frame, and the sensor's pose in it.

    Points are in metres, with the support at z = 0. The result is None if no point has depth.
    """
    points = frame.finite_xyz(item.indices)
    if not len(points):
        return None
    level = level_from_sensor(labelled.up, support_offset(item, labelled.up), points)
    return transform(level, points).astype(np.float32), level
