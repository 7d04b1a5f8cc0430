"""Choose the frames that the report reads again: good views of each track, and an overview strip.

Both are chosen from the tables alone, before the recording is opened.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shapecat.outputs.report.tracks import Detected, Timeline
from shapecat.runs.tables.masks import masks_in
from shapecat.runs.tables.reading import Key, read_stamps, read_together
from shapecat.types import ImageMasks

__all__ = ["Choice", "choose_frames"]

_CANDIDATES = 4
"""Number of views of a track that are read again: a large one from each quarter of the track."""
_RANK = 0.8
"""Quantile, by size, of the chosen view in its quarter. It is below 1 because the largest masks
often include a neighbour or a piece of the table."""
_STRIP = 12
"""Largest number of frames in the overview strip."""
_PARTIAL = 0.2
"""Weight of a view that is cut off by the image border or partly occluded."""
_COLOURLESS = 0.05
"""Weight of a view without a mask on a colour image; its size is then its number of points."""


@dataclass(frozen=True)
class Choice:
    """The chosen frames.

    Attributes
    ----------
    candidates : for each frame, the tracks that it shows well.
    strip : the frames of the overview strip, with their time in seconds since the first frame.
    """

    candidates: Mapping[Key, frozenset[int]]
    strip: Mapping[Key, float]

    @property
    def frames(self) -> frozenset[Key]:
        """All chosen frames."""
        return frozenset({*self.candidates, *self.strip})


class _View(NamedTuple):
    """A detection of a track; ``worth`` is its size in pixels, less if it is not complete."""

    key: Key
    worth: float
    complete: bool


def choose_frames(folder: Path, timelines: Mapping[int, Timeline]) -> Choice:
    """Choose good views of each track, and frames that give an overview of the run."""
    owner = {key: track for track, line in timelines.items() for key in line.keys if key[2] >= 0}
    candidates: dict[Key, set[int]] = {}
    for track, views in _views(folder, owner).items():
        for view in _representative_views(views):
            candidates.setdefault(view.key, set()).add(track)
    tracks_of: dict[Key, set[int]] = {}
    for (topic, frame, _), track in owner.items():
        tracks_of.setdefault((topic, frame), set()).add(track)
    stamps = sorted((stamp_ns, key) for key, stamp_ns in read_stamps(folder))
    strip = _strip(stamps, tracks_of)
    return Choice({key: frozenset(tracks) for key, tracks in candidates.items()}, strip)


def _views(folder: Path, owner: Mapping[Detected, int]) -> dict[int, list[_View]]:
    """Return the views of each track in table order, rated by size and completeness.

    ``owner`` is the track of each detection.
    """
    columns = ["topic", "frame", "detection", "points", "touches_border", "occluded"]
    tables: dict[str, list[str] | None] = {"detections": columns}
    if (folder / "masks.parquet").exists():
        tables["masks"] = None
    views: dict[int, list[_View]] = {}
    for detections, *masks in read_together(folder, tables):
        areas = _areas(chain.from_iterable(map(masks_in, masks)))
        cells = (detections[name].to_pylist() for name in columns)
        for topic, frame, detection, points, border, occluded in zip(*cells, strict=True):
            key = (topic, frame, detection)
            if key not in owner:
                continue
            area, cut = areas.get(key, (_COLOURLESS * points, False))
            complete = not (border or occluded or cut)
            view = _View((topic, frame), area * (1.0 if complete else _PARTIAL), complete)
            views.setdefault(owner[key], []).append(view)
    return views


def _areas(masks: Iterable[tuple[Key, ImageMasks]]) -> dict[Detected, tuple[float, bool]]:
    """Return the area of each mask in pixels, and whether it touches the image border."""
    areas = {}
    for key, frame in masks:
        for number, (left, top, width, height) in frame.boxes.items():
            right, bottom = frame.width - left - width, frame.height - top - height
            area = float(np.sum(frame.counts[number][1::2]))
            areas[*key, number] = (area, min(left, top, right, bottom) <= 0)
    return areas


def _representative_views(views: Sequence[_View]) -> list[_View]:
    """Return a large view from each of `_CANDIDATES` parts of a track.

    The view is complete if the part has a complete one. Among equal views, the first is taken.
    """
    ends = np.linspace(0, len(views), min(_CANDIDATES, len(views)) + 1).astype(int)
    chosen = []
    for a, b in pairwise(ends):
        eligible = [view for view in views[a:b] if view.complete] or views[a:b]
        worth = np.quantile([view.worth for view in eligible], _RANK, method="higher")
        chosen.append(next(view for view in eligible if view.worth == worth))
    return chosen


def _strip(
    stamps: Sequence[tuple[int, Key]], tracks_of: Mapping[Key, set[int]]
) -> dict[Key, float]:
    """Return a frame of each of `_STRIP` parts of a run, with its seconds since the first frame.

    It is the frame with the most tracks that no earlier frame of its topic in the strip shows.
    Among equal frames, the one with the most tracks is taken, then the one nearest to the middle.
    ``stamps`` are the stamp (ns) and the key of each frame, sorted by time; ``tracks_of`` are the
    tracks detected in each frame.
    """
    covered: set[tuple[str, int]] = set()
    strip = {}
    for part in np.array_split(np.arange(len(stamps)), min(_STRIP, len(stamps)) or 1):
        best, best_worth = None, (-1, -1, 0.0)
        for k in part.tolist():
            key = stamps[k][1]
            tracks = {(key[0], track) for track in tracks_of.get(key, ())}
            worth = (len(tracks - covered), len(tracks), -abs(k - float(part.mean())))
            if worth > best_worth or best is None:
                best, best_worth = k, worth
        if best is not None:
            stamp, key = stamps[best]
            strip[key] = (stamp - stamps[0][0]) * 1e-9
            covered |= {(key[0], track) for track in tracks_of.get(key, ())}
    return strip
