"""Readers of KITTI files, written from the specification of the format."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

__all__ = ["KittiLabel", "projected_points", "read_calibration", "read_labels", "read_points"]


class KittiLabel(NamedTuple):
    """A line of label_2; ``box`` is left, top, right, bottom, and ``size`` height, width, length.

    ``place`` is the middle of the bottom, in the rectified camera.
    """

    kind: str
    truncated: float
    occluded: int
    alpha: float
    box: list[float]
    size: list[float]
    place: list[float]
    yaw: float

    @property
    def corners(self) -> Any:
        """The corners (8, 3) in the rectified camera, whose y axis points down."""
        h, w, l = self.size
        xs = np.array([l, l, -l, -l, l, l, -l, -l]) / 2
        ys = np.array([0, 0, 0, 0, -h, -h, -h, -h])
        zs = np.array([w, -w, -w, w, w, -w, -w, w]) / 2
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return (np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ [xs, ys, zs]).T + self.place


def read_labels(folder: Path, number: str = "000000") -> list[KittiLabel]:
    """Return the labels of a frame."""
    found = []
    for line in (folder / "label_2" / f"{number}.txt").read_text().splitlines():
        kind, truncated, occluded, *words = line.split(" ")
        alpha, *rest, yaw = map(float, words)
        assert len(rest) == 10
        assert -np.pi <= alpha <= np.pi
        parts = rest[:4], rest[4:7], rest[7:]
        found.append(KittiLabel(kind, float(truncated), int(occluded), alpha, *parts, yaw))
    return found


def read_calibration(folder: Path, number: str = "000000") -> dict[str, Any]:
    """Return the matrices of a frame by name."""
    lines = (folder / "calib" / f"{number}.txt").read_text().splitlines()
    matrices = {name: text.split() for name, text in (line.split(": ") for line in lines if line)}
    return {name: np.array(words, float).reshape(3, -1) for name, words in matrices.items()}


def read_points(folder: Path, number: str = "000000") -> Any:
    """Return the points of a frame (n, 4): x, y, z and intensity."""
    return np.fromfile(folder / "velodyne" / f"{number}.bin", "<f4").reshape(-1, 4)


def projected_points(folder: Path) -> Any:
    """Return the pixels (n, 2) of the points of the first frame on its image, as specified."""
    matrices, points = read_calibration(folder), read_points(folder)
    one = np.ones((len(points), 1))
    rectified = (
        np.hstack([points[:, :3], one]) @ matrices["Tr_velo_to_cam"].T @ matrices["R0_rect"].T
    )
    pixels = np.hstack([rectified, one]) @ matrices["P2"].T
    return pixels[:, :2] / pixels[:, 2:]
