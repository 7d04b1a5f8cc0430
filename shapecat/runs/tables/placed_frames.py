"""The sensor poses of the frames of a run, and the rows of their detections."""

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa

from shapecat.arrays import F8, I4
from shapecat.runs.tables.reading import (
    frame_rows,
    keys_of,
    numbers_or_nan,
    read_by_topic,
    read_together,
    topic_codes,
)

__all__ = ["DetectedFrames", "count_poses", "sensor_poses", "streams_with_poses"]


@dataclass(frozen=True)
class DetectedFrames:
    """The frames of a run that have detections, in the order of the table of detections.

    Attributes
    ----------
    first : (f,) row of the first detection of each frame, ascending.
    poses : (f, 3, 4) ``fixed_from_sensor``, metres; the identity if unknown or not used.
    """

    first: I4
    poses: F8

    @classmethod
    def read(cls, folder: Path, placed: Collection[str]) -> "DetectedFrames":
        """Read the frames of a run; use only the poses of the topics in ``placed``."""
        columns = ("topic", "frame", "fixed_translation", "fixed_rotation")
        tables = {"frames": columns, "detections": ("topic", "frame")}
        first: list[I4] = [np.zeros(0, np.int64)]
        poses: list[F8] = [np.zeros((0, 3, 4))]
        count = 0
        for frames, detections in read_together(folder, tables):
            at = {key: k for k, key in enumerate(keys_of(frames))}
            rows = {key: rows for key, rows in frame_rows(detections).items() if key in at}
            first.append(np.array([count + span.start for span in rows.values()], np.int64))
            poses.append(sensor_poses(frames, placed)[[at[key] for key in rows]])
            count += detections.num_rows
        return cls(np.concatenate(first), np.concatenate(poses))

    def poses_of(self, rows: I4) -> F8:
        """Return the ``poses`` (n, 3, 4) for detections, given their table rows (n,)."""
        return np.asarray(self.poses[self._find(rows)])

    def numbers_of(self, rows: I4) -> I4:
        """Return the numbers (n,) of detections in their frames, given their table rows (n,)."""
        return np.asarray(rows - self.first[self._find(rows)])

    def _find(self, rows: I4) -> I4:
        """Return the indices (n,) in ``first`` for detections, given their table rows (n,)."""
        return np.asarray(np.searchsorted(self.first, rows, side="right") - 1)


def sensor_poses(frames: pa.Table, placed: Collection[str]) -> F8:
    """Return the poses (f, 3, 4) from sensor to fixed frame, one per row of ``frames``.

    They are the identity where the pose is unknown or the topic is not in ``placed``.
    """
    result = np.tile(np.eye(3, 4), (frames.num_rows, 1, 1))
    turns = numbers_or_nan(frames["fixed_rotation"]).reshape(-1, 3, 3)
    topics, codes = topic_codes(frames)
    is_placed = np.array([topic in placed for topic in topics], np.bool_)[codes]
    has_pose = is_placed & ~np.isnan(turns[:, 0, 0])
    result[has_pose, :, :3] = turns[has_pose]
    result[has_pose, :, 3] = numbers_or_nan(frames["fixed_translation"])[has_pose]
    return result


def streams_with_poses(folder: Path) -> set[str]:
    """Return the topics whose sensor pose in the fixed frame is known in most frames.

    Detections of these topics in frames without a pose are not tracked.
    """
    return {topic for topic, (known, count) in count_poses(folder).items() if 2 * known > count}


def count_poses(folder: Path) -> dict[str, tuple[int, int]]:
    """Return, by topic, how many frames have a known sensor pose, and how many there are."""
    has_pose = read_by_topic(
        folder,
        ["fixed_translation"],
        lambda frames: frames["fixed_translation"].is_valid().to_numpy(),
    )
    return {topic: (int(known.sum()), len(known)) for topic, known in has_pose.items()}
