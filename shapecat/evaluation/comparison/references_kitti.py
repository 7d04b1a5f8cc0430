"""KITTI 3D labels: label_2 and calib, as `shapecat export --format kitti` writes them."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from shapecat.arrays import F8
from shapecat.errors import RecordingError
from shapecat.evaluation.comparison.labellings import (
    UNREADABLE,
    LabelledItem,
    Labelling,
    Place,
    Reference,
    finite_box,
)
from shapecat.geometry import quaternion_from_rotation
from shapecat.outputs.exports.kitti import kitti_type
from shapecat.types import Box

__all__ = ["KittiLabels"]


class KittiLabels(Reference[str]):
    """Boxes of KITTI labels, without masks and identities.

    ``frames.csv`` gives the timestamp of each label file, its frame number where timestamps
    repeat, and its topic where there are several; without ``frames.csv``, the number in a label
    file's name is the frame number. Boxes are in the rectified camera frame; the row
    ``Tr_rect_to_sensor`` of the calibration rotates them into the sensor frame. Without this row,
    as in KITTI's own data, or without a calibration file, both frames are taken to be the same.

    A KITTI type cannot hold spaces, which are written as ``_``. A type stands for the first of
    ``categories`` that is written like it; if there is none, each ``_`` is read as a space.
    """

    kind = "KITTI labels"

    def __init__(self, folder: Path, categories: Sequence[str] = ()) -> None:
        self._categories = {kitti_type(name): name for name in reversed(categories)}
        numbers = sorted(path.stem for path in (folder / "label_2").glob("*.txt"))
        try:
            names = _listed(folder / "frames.csv")
            self.numbered = not names
            names = names or [((None, int(name), None), name) for name in numbers]
        except (csv.Error, *UNREADABLE) as error:
            msg = f"{folder}: not a folder of KITTI labels ({error})"
            raise RecordingError(msg) from error
        super().__init__(folder, names)

    def labelling(self, entry: str) -> Labelling:
        """Return the objects in the label file ``entry``.txt, without those of type DontCare.

        Raises
        ------
        RecordingError : the label file is missing or damaged, or the calibration is damaged.
        """
        path = self.path / "label_2" / f"{entry}.txt"
        try:
            turn = _sensor_from_rectified(self.path / "calib" / f"{entry}.txt")
            lines = path.read_text("utf-8").splitlines()
            items = [self._item(line.split(), turn) for line in lines if line.strip()]
        except UNREADABLE as error:
            msg = f"{path}: not a KITTI label file ({error})"
            raise RecordingError(msg) from error
        return Labelling(tuple(item for item in items if item.category != "DontCare"))

    def _item(self, words: list[str], turn: F8) -> LabelledItem:
        """Return the object in a line; ``turn`` (3, 3) is from `_sensor_from_rectified`."""
        category = self._categories.get(words[0], words[0].replace("_", " "))
        return LabelledItem(track=None, category=category, box=_box(words, turn))


def _listed(path: Path) -> list[tuple[Place, str]]:
    """Return the frame and the name of each label file; none without ``frames.csv``.

    Labels of a single topic match any topic, since the recording may use another name.
    """
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    several = len({row.get("topic") for row in rows}) > 1
    return [(_place(row, several=several), row["number"]) for row in rows]


def _place(row: Mapping[str, str], *, several: bool) -> Place:
    """Return the `Place` of a row of frames.csv; its topic is None unless there are ``several``."""
    frame = row.get("frame")
    return row["topic"] if several else None, int(row["stamp_ns"]), int(frame) if frame else None


def _sensor_from_rectified(path: Path) -> F8:
    """Return the rotation (3, 3) from a calibration file; the identity if none is stated."""
    text = path.read_text("utf-8") if path.is_file() else ""
    lines = dict(line.split(":", 1) for line in text.splitlines() if ":" in line)
    transform = lines.get("Tr_rect_to_sensor", "1 0 0 0 0 1 0 0 0 0 1 0")
    return np.array(transform.split(), np.float64).reshape(3, 4)[:, :3]


def _box(words: list[str], turn: F8) -> Box:
    """Return the box of a label, in the sensor frame.

    The words of its line are type truncated occluded alpha bbox(4) h w l x y z rotation_y; ``turn``
    is from `_sensor_from_rectified`.
    """
    height, width, length, x, y, z, yaw = map(float, words[8:15])
    c, s = math.cos(yaw), math.sin(yaw)
    axes = np.array([[c, s, 0.0], [0.0, 0.0, -1.0], [-s, c, 0.0]])  # columns: along, across, up
    return finite_box(
        turn @ np.array([x, y - height / 2, z]),
        np.array([length, width, height]),
        quaternion_from_rotation(turn @ axes),
    )
