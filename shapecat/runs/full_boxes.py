"""Full boxes of tracks, fused from those of single views."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute
from scipy.spatial.transform import Rotation

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.completion import DIRECTIONS, BoxViews, FusedBoxes, fuse_boxes
from shapecat.runs.tables import Key, frame_rows, numbers, read_row_groups
from shapecat.tracking import Track, view_weights

__all__ = ["FULL_WIDTHS", "FullBoxes", "full_columns", "numbers_or_nan"]

FULL_WIDTHS = {"center_full": 3, "size_full": 3, "orientation_full": 4, "size_full_std": 3}
"""Columns of full boxes, and how many numbers they have."""
_WIDTH = sum(FULL_WIDTHS.values())


@dataclass(frozen=True)
class FullBoxes:
    """The full boxes of all detections of a run, estimated from single views.

    Attributes
    ----------
    starts : by frame, the row of its first detection.
    rows : (n, 13) the columns of `FULL_WIDTHS` side by side; NaN where they are null.
    outlines : (n, 96) float32, how far what is seen reaches.
    partial : (n,) whether the object is cut.
    poses : by frame, ``fixed_from_sensor`` as (3, 4), where the frame of the tracks is fixed.
    """

    starts: Mapping[Key, int]
    rows: F8
    outlines: F4
    partial: Bool
    poses: Mapping[Key, F8]

    @classmethod
    def read(cls, folder: Path, placed: Collection[str]) -> "FullBoxes":
        """Read the full boxes of a run; the topics ``placed`` are tracked in the fixed frame."""
        starts: dict[Key, int] = {}
        rows, partial, count = [np.zeros((0, _WIDTH))], [np.zeros(0, np.bool_)], 0
        outlines = [np.zeros((0, DIRECTIONS), np.float32)]
        cut = ("touches_border", "occluded")
        wanted = ["topic", "frame", *cut, *FULL_WIDTHS, "outline_full"]
        for table in read_row_groups(folder / "detections.parquet", wanted):
            of_frames = frame_rows(table)
            starts |= {key: count + found.start for key, found in of_frames.items()}
            rows.append(numbers_or_nan(table))
            around = np.full((table.num_rows, DIRECTIONS), np.nan, np.float32)
            around[~np.isnan(rows[-1][:, 0])] = numbers(table["outline_full"]).reshape(
                -1, DIRECTIONS
            )
            outlines.append(around)
            partial.append(np.logical_or(*(table[name].to_numpy() for name in cut)))
            count += table.num_rows
        return cls(
            starts,
            np.concatenate(rows),
            np.concatenate(outlines),
            np.concatenate(partial),
            _poses(folder, placed),
        )

    def of_track(self, track: Track, categories: Sequence[str]) -> F8:
        """Return the fused boxes (k, 13) in the frames of a track, NaN if unknown."""
        result = np.full((len(track.frames), _WIDTH), np.nan)
        seen = np.flatnonzero(np.asarray(track.detections) >= 0)
        keys = [(track.topics[k], int(track.frames[k])) for k in seen]
        first = [self.starts[key] for key in keys]
        rows = np.array(first, np.int64) + track.detections[seen]
        known = ~np.isnan(self.rows[rows, 0])
        if known.any():
            poses = self._poses_of([key for key, has in zip(keys, known, strict=True) if has])
            views = _views(self.rows[rows[known]], self.outlines[rows[known]], poses)
            weights = view_weights(self.partial[rows[known]])
            fused = fuse_boxes(views, weights, track.posterior, categories)
            result[seen[known]] = _rows(fused, poses)
        return result

    def _poses_of(self, keys: Sequence[Key]) -> F8:
        return np.array([self.poses.get(key, np.eye(3, 4)) for key in keys])


def _views(rows: F8, outlines: F4, poses: F8) -> BoxViews:
    """Return the rows (k, 13) of one object in the fixed frame."""
    turns, places = poses[:, :, :3], poses[:, :, 3]
    axes = turns @ Rotation.from_quat(rows[:, 6:10]).as_matrix()
    centers = np.einsum("kij,kj->ki", turns, rows[:, :3]) + places
    return BoxViews(centers, axes, rows[:, 3:6], rows[:, 10:], outlines, places)


def _rows(fused: FusedBoxes, poses: F8) -> F8:
    """Return (k, 13) boxes of the fixed frame, each in its sensor frame."""
    turns, places = poses[:, :, :3], poses[:, :, 3]
    back = np.einsum("kji,kj->ki", turns, fused.centers - places)
    own = Rotation.from_matrix(np.swapaxes(turns, 1, 2) @ fused.axes).as_quat()
    return np.hstack([back, fused.sizes, own, fused.stds])


def _poses(folder: Path, placed: Collection[str]) -> dict[Key, F8]:
    """Return ``fixed_from_sensor`` of the frames of some topics that have one."""
    names = ["topic", "frame", "fixed_translation", "fixed_rotation"]
    return {
        (row["topic"], row["frame"]): np.hstack(
            [
                np.reshape(row["fixed_rotation"], (3, 3)),
                np.reshape(row["fixed_translation"], (3, 1)),
            ]
        )
        for table in read_row_groups(folder / "frames.parquet", names)
        for row in table.to_pylist()
        if row["topic"] in placed and row["fixed_rotation"] is not None
    }


def numbers_or_nan(table: pa.Table, widths: Mapping[str, int] = FULL_WIDTHS) -> F8:
    """Return the columns of full boxes side by side, NaN where they are null."""
    return np.hstack([_filled(table[name], width) for name, width in widths.items()])


def _filled(column: pa.ChunkedArray, width: int) -> F8:
    result = np.full((len(column), width), np.nan)
    known = pa.compute.is_valid(column).to_numpy()
    if known.any():
        result[known] = numbers(column.drop_null()).reshape(-1, width)
    return result


def full_columns(rows: F8) -> dict[str, Any]:
    """Return rows (n, 13) as columns of a table; null where they are NaN."""
    missing = pa.array(np.isnan(rows[:, 0]))
    return dict(_columns(rows, missing))


def _columns(rows: F8, missing: pa.Array) -> Iterator[tuple[str, Any]]:
    stop: I4 = np.cumsum(list(FULL_WIDTHS.values()))
    for (name, width), end in zip(FULL_WIDTHS.items(), stop.tolist(), strict=True):
        values = np.ascontiguousarray(rows[:, end - width : end], np.float32).ravel()
        yield name, pa.FixedSizeListArray.from_arrays(values, width, mask=missing)
