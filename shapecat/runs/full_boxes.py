"""Full boxes of tracks, fused from the full boxes of their detections."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from scipy.spatial.transform import Rotation

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.completion import DIRECTIONS, BoxViews, FusedBox, fuse_boxes
from shapecat.runs.tables.placed_frames import DetectedFrames
from shapecat.runs.tables.reading import full_boxes_of, numbers, opened, partial_of, read_rows
from shapecat.runs.tables.schemas import BOX_WIDTH, FULL_BOX, FULL_WIDTHS
from shapecat.tracking import Track, view_weights

__all__ = ["FullBoxes", "full_columns"]

_BLOCK = 2**16  # views whose boxes are transformed at once
_WIDTH = sum(FULL_WIDTHS.values())
_MOST_VIEWS = 1000
"""Maximum number of views from which the box of a track is fused, spread over its time span."""
_AT_ONCE = 8  # row groups
_NO_ROWS = np.zeros(0, np.int64)


class _Selection(NamedTuple):
    """Columns to read from a table, and a function that joins them to an array (n, width)."""

    columns: list[str]
    width: int
    of: Callable[[pa.Table], F4]


def _boxes_of(table: pa.Table) -> F4:
    """Return the values of `_BOXES` (n, 11): full boxes, and 1 for partial views."""
    return np.column_stack([full_boxes_of(table), partial_of(table)])


def _details_of(table: pa.Table) -> F4:
    """Return the values of `_DETAILS` (n, 3 + `DIRECTIONS`), metres."""
    columns = [numbers(table[name]).reshape(len(table), -1) for name in _DETAILS.columns]
    return np.hstack(columns)


_BOXES = _Selection([*FULL_BOX, "touches_border", "occluded"], BOX_WIDTH + 1, _boxes_of)
"""Centre, size (metres) and orientation (x y z w) of a detection's full box, NaN if unknown; and
whether the view is partial: occluded, or cut off by the image border."""
_DETAILS = _Selection(["size_full_std", "outline_full"], 3 + DIRECTIONS, _details_of)
"""The standard deviations and the outline of the full box of a detection."""


@dataclass(frozen=True)
class FullBoxes:
    """The full boxes of all detections of a run, each estimated from a single view.

    They are read from the table when they are needed.

    Attributes
    ----------
    table : path of the detections table.
    frames : the frames of the run that have detections.
    """

    table: Path
    frames: DetectedFrames

    def of_tracks(self, tracks: Sequence[Track], categories: Sequence[str]) -> F4:
        """Fuse the full boxes of each track; return the result in each of its frames.

        Parameters
        ----------
        tracks : their ``detections`` are row numbers of the table.
        categories : names of the categories in the posteriors.

        Returns
        -------
        (k, 13) float32, a row for each frame of each track in turn: the columns of `FULL_WIDTHS`,
        in the sensor frame; NaN if unknown.

        Raises
        ------
        OutputError : the table of detections is unreadable.
        """
        seen_tracks = self._track_views(tracks)
        chosen = [_spread(len(seen.rows)) for seen in seen_tracks]
        rows = [seen.rows[picked] for seen, picked in zip(seen_tracks, chosen, strict=True)]
        lengths = [len(track.frames) for track in tracks]
        result = np.full((sum(lengths), _WIDTH), np.nan, np.float32)
        for track, seen, picked, details, part in zip(
            tracks,
            seen_tracks,
            chosen,
            self._read(rows, _DETAILS),
            _split(result, lengths),
            strict=True,
        ):
            if len(picked):
                views = self._views(seen, picked, details)
                fused = fuse_boxes(
                    views, view_weights(seen.partial[picked]), track.posterior, categories
                )
                self._write_in_views(fused, seen, part)
        return result

    def _track_views(self, tracks: Sequence[Track]) -> "list[_TrackViews]":
        """Return, for each track, its detections that have a full box."""
        detected = [np.flatnonzero(track.detections >= 0) for track in tracks]
        rows = [track.detections[at] for track, at in zip(tracks, detected, strict=True)]
        result = []
        for at, of_track, boxes in zip(detected, rows, self._read(rows, _BOXES), strict=True):
            known = ~np.isnan(boxes[:, 0])
            partial = boxes[known, BOX_WIDTH] > 0
            result.append(
                _TrackViews(at[known], of_track[known], boxes[known, :BOX_WIDTH], partial)
            )
        return result

    def _views(self, seen: "_TrackViews", picked: I4, details: F4) -> BoxViews:
        """Return the views with the indices ``picked`` (k,) in ``seen``, in the fixed frame.

        ``details`` are their values of `_DETAILS` (k, 3 + `DIRECTIONS`).
        """
        boxes, poses = seen.boxes[picked], self.frames.poses_of(seen.rows[picked])
        centers, axes = _placed(boxes, poses)
        sizes, stds = boxes[:, 3:6].astype(np.float64), details[:, :3].astype(np.float64)
        return BoxViews(centers, axes, sizes, stds, details[:, 3:], poses[:, :, 3])

    def _write_in_views(self, fused: FusedBox, seen: "_TrackViews", result: F4) -> None:
        """Write the fused box of a track to ``result``, in the sensor frame of each of its views.

        ``result`` (frames, 13) holds the rows of the track in `of_tracks`.
        """
        for first in range(0, len(seen.rows), _BLOCK):
            block = slice(first, first + _BLOCK)
            boxes, poses = seen.boxes[block], self.frames.poses_of(seen.rows[block])
            centers, axes = fused.in_views(*_placed(boxes, poses), boxes[:, 3:6])
            turns, places = poses[:, :, :3], poses[:, :, 3]
            back = np.einsum("kji,kj->ki", turns, centers - places)
            quaternions = Rotation.from_matrix(np.swapaxes(turns, 1, 2) @ axes).as_quat()
            size, std = (np.broadcast_to(values, back.shape) for values in (fused.size, fused.std))
            result[seen.at[block]] = np.hstack([back, size, quaternions, std])

    def _read(self, rows: Sequence[I4], values: _Selection) -> list[F4]:
        """Return, for each track, the ``values`` (n, width) of its ``rows`` (n,) of the table."""
        together = np.concatenate([_NO_ROWS, *rows])
        result = np.zeros((len(together), values.width), np.float32)
        with opened(self.table) as file:
            for at, table in read_rows(file, values.columns, together, at_once=_AT_ONCE):
                result[at] = values.of(table)
        return _split(result, list(map(len, rows)))


class _TrackViews(NamedTuple):
    """The views of a track that have a full box.

    Attributes
    ----------
    at, rows : (k,) indices of the views in the track and in the table of detections.
    boxes : (k, 10) float32 centre and size (metres) and orientation (x y z w) in the sensor frame.
    partial : (k,) whether the object is occluded or cut off by the image border.
    """

    at: I4
    rows: I4
    boxes: F4
    partial: Bool


def _split(values: F4, lengths: Sequence[int]) -> list[F4]:
    """Split an array along its first axis into consecutive parts of the given lengths."""
    return np.split(values, np.cumsum(lengths, dtype=np.int64))[:-1]


def _spread(count: int) -> I4:
    """Return the indices of at most `_MOST_VIEWS` of ``count`` views, evenly spread over all."""
    return np.linspace(0, count - 1, min(count, _MOST_VIEWS)).round().astype(np.int64)


def _placed(boxes: F4, poses: F8) -> tuple[F8, F8]:
    """Return the centres (k, 3) and axes (k, 3, 3) of boxes in the fixed frame.

    ``boxes`` (k, 10) are in the sensor frame, ``poses`` (k, 3, 4) are ``fixed_from_sensor``.
    """
    turns, places = poses[:, :, :3], poses[:, :, 3]
    axes = turns @ Rotation.from_quat(boxes[:, 6:10]).as_matrix()
    return np.einsum("kij,kj->ki", turns, boxes[:, :3].astype(np.float64)) + places, axes


def full_columns(rows: F4) -> dict[str, Any]:
    """Return full boxes (n, 13) as columns of a table; NaN rows become null."""
    missing = pa.array(np.isnan(rows[:, 0]))
    ends = np.cumsum(list(FULL_WIDTHS.values()))
    return {
        name: pa.FixedSizeListArray.from_arrays(
            np.ascontiguousarray(rows[:, end - width : end], np.float32).ravel(),
            width,
            mask=missing,
        )
        for (name, width), end in zip(FULL_WIDTHS.items(), ends.tolist(), strict=True)
    }
