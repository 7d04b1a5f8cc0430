"""The sensor pose and the first detection of each frame of a run."""

from collections import Counter
from collections.abc import Collection, Sequence
from functools import cached_property
from itertools import compress
from pathlib import Path

import numpy as np
import pyarrow as pa

from shapecat.arrays import F8, I4, Bool
from shapecat.runs.tables.reading import (
    frame_rows,
    keys_of,
    numbers,
    numbers_or_nan,
    read_row_groups,
    topic_codes,
)

__all__ = ["PlacedFrames", "count_poses", "streams_with_poses"]


class PlacedFrames:
    """The frames of a run as columns in table order, with a look-up by topic and number."""

    COLUMNS = ("topic", "frame", "fixed_translation", "fixed_rotation")

    def __init__(self, placed: Collection[str]) -> None:
        """Start without frames; the topics ``placed`` are tracked in the fixed frame."""
        self._placed = placed
        self._codes: dict[str, int] = {}
        self._keys, self._first, self._poses = bytearray(), bytearray(), bytearray()

    def add(self, frames: pa.Table, detections: pa.Table, count: int) -> None:
        """Append a row group; ``count`` is the number of detections in earlier ones."""
        topics, codes = topic_codes(frames)
        codes_of_topics = [self._codes.setdefault(topic, len(self._codes)) for topic in topics]
        keys = _keys(np.array(codes_of_topics, np.int64)[codes], numbers(frames["frame"]))
        starts = {key: count + rows.start for key, rows in frame_rows(detections).items()}
        first = np.array([starts.get(key, -1) for key in keys_of(frames)], np.int64)
        self._keys += keys.tobytes()
        self._first += first.tobytes()
        self._poses += _poses(
            frames, np.isin(np.array(topics), list(self._placed))[codes]
        ).tobytes()

    @cached_property
    def first(self) -> I4:
        """Return the row (f,) of each frame's first detection; -1 if it has none."""
        return np.frombuffer(self._first, np.int64)

    @cached_property
    def poses(self) -> F8:
        """Return ``fixed_from_sensor`` (f, 3, 4), metres; the identity if not known or not used."""
        return np.frombuffer(self._poses, np.float64).reshape(-1, 3, 4)

    @cached_property
    def _order(self) -> I4:
        return np.argsort(np.frombuffer(self._keys, np.int64), kind="stable")

    def find(self, topics: Sequence[str], frames: I4) -> I4:
        """Return the row (n,) of each frame, given the topics and frame numbers (n,)."""
        codes = np.fromiter(map(self._codes.__getitem__, topics), np.int64, len(topics))
        keys = np.frombuffer(self._keys, np.int64)
        positions = np.searchsorted(keys, _keys(codes, frames), sorter=self._order)
        return np.asarray(self._order[positions])


def _keys(codes: I4, frames: I4) -> I4:
    return np.asarray((codes << 32) + frames)


def _poses(frames: pa.Table, placed: Bool) -> F8:
    result = np.tile(np.eye(3, 4), (frames.num_rows, 1, 1))
    turns = numbers_or_nan(frames["fixed_rotation"]).reshape(-1, 3, 3)
    has_pose = placed & ~np.isnan(turns[:, 0, 0])
    result[has_pose, :, :3] = turns[has_pose]
    result[has_pose, :, 3] = numbers_or_nan(frames["fixed_translation"])[has_pose]
    return result


def streams_with_poses(folder: Path) -> set[str]:
    """Return the topics whose sensor pose in the fixed frame is known in most frames.

    Their detections in the other frames are not tracked.
    """
    return {topic for topic, (known, count) in count_poses(folder).items() if 2 * known > count}


def count_poses(folder: Path) -> dict[str, tuple[int, int]]:
    """Return, for each topic, the numbers of frames with a known sensor pose, and of all frames."""
    with_pose: Counter[str] = Counter()
    count: Counter[str] = Counter()
    for group in read_row_groups(folder / "frames.parquet", ["topic", "fixed_translation"]):
        has_pose = group["fixed_translation"].is_valid().to_pylist()
        topics = group["topic"].to_pylist()
        with_pose.update(compress(topics, has_pose))
        count.update(topics)
    return {topic: (with_pose[topic], count[topic]) for topic in count}
