"""Find the tracks of two runs that are the same object.

Two runs of one recording usually have common frames, in which detections of the same object are
mutual nearest neighbours. Others have only a fixed frame in common, in which only objects at rest
can be found again. Ambiguous cases are reported, not guessed.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8
from shapecat.errors import OutputError
from shapecat.runs.folder import read_identity
from shapecat.runs.labels.track_detections import TrackDetections, extents_of, read_track_detections
from shapecat.runs.labels.track_table import TrackRow, parse_number

__all__ = ["Group", "Match", "Matches", "match_in_place", "match_in_time"]

_MOST_REACH_M = 0.10
"""Largest distance between the detections of one object in two runs, in the same frame."""
_MAJORITY = 0.6
"""Smallest fraction of common frames in which matching tracks are mutual nearest neighbours."""
_RIVAL = 0.25
"""A match is ambiguous if another source object matches in at least this fraction of frames."""
_STILL_M = 0.04
"""Largest scatter of the centres of a small object at rest, seen from several places."""
_REACH = 0.5
"""Largest distance between the centres of one object in two views, relative to its width."""
_LEAST_REACH_M = 0.04
"""Lower limit of that distance, for small objects."""
_CLEAR_M = 0.03
"""A match is ambiguous unless the second nearest object is farther away by at least this."""
_SIZE_RATIO = 1.8
"""Largest ratio between the largest extents of an object in two recordings."""

Group = Callable[[int], int]
"""Maps a track to a number that is the same for tracks that a person merged."""


class Match(NamedTuple):
    """A track of the target, and the distance of its centre from the source track, metres.

    The distance is a mean over the frames in which they match, if they were matched in time.
    """

    track: int
    distance_m: float


@dataclass(frozen=True)
class Matches:
    """The matches of source tracks in the target, and the reasons why others have none.

    Both are by source track. A track without either has no detection near it in the target.
    """

    found: Mapping[int, Sequence[Match]]
    reasons: Mapping[int, str]


def match_in_time(source: Path, target: Path, group: Group) -> Matches | None:
    """Match tracks that are mutual nearest neighbours in most of the frames that both runs have.

    The result is None if both runs have tracks, but no frames in common.

    Parameters
    ----------
    source, target : run folders of the same recording.
    group : returns the same number for tracks of the source that a person merged.

    Raises
    ------
    OutputError : a table of a run is unreadable.
    """
    old, new = read_track_detections(source), read_track_detections(target)
    common = sorted(old.rows.keys() & new.rows.keys())
    if not common and old.rows and new.rows:
        return None
    old_widths, new_widths = _widths(source, old), _widths(target, new)
    votes: Counter[tuple[int, int]] = Counter()
    apart: defaultdict[tuple[int, int], float] = defaultdict(float)
    counts: Counter[int] = Counter()
    for key in common:
        here, there = old.rows[key], new.rows[key]
        counts.update(new.tracks[there].tolist())
        max_distance = _max_distance_at_once(old_widths[here], new_widths[there])
        for a, b, distance in _mutual_nearest(old.centers[here], new.centers[there], max_distance):
            pair = int(old.tracks[here][a]), int(new.tracks[there][b])
            votes[pair] += 1
            apart[pair] += distance
    return _by_majority(votes, apart, counts, group)


def _by_majority(
    votes: Mapping[tuple[int, int], int],
    apart: Mapping[tuple[int, int], float],
    counts: Counter[int],
    group: Group,
) -> Matches:
    """Match each track of the target with the source object that it matches in most frames.

    ``votes`` counts, for each pair of source and target track, the frames in which they match, and
    ``apart`` sums their distances, metres; ``counts`` counts the frames of each target track. All
    are frames that both runs have.
    """
    matches_of: dict[int, list[Match]] = {}
    reasons: dict[int, str] = {}
    claims: dict[int, dict[int, list[int]]] = {}
    for old, new in sorted(votes):
        claims.setdefault(new, {}).setdefault(group(old), []).append(old)
    for new, objects in claims.items():
        shares = {k: sum(votes[old, new] for old in o) / counts[new] for k, o in objects.items()}
        best, *others = sorted(shares, key=lambda k: (-shares[k], k))
        rivals = [k for k in others if shares[k] >= _RIVAL]
        if shares[best] < _MAJORITY or rivals:
            for old in (old for k in (best, *rivals) for old in objects[k]):
                reasons[old] = f"track #{new} matches it only part of the time"
            continue
        for old in objects[best]:
            mean = apart[old, new] / votes[old, new]
            matches_of.setdefault(old, []).append(Match(new, round(mean, 4)))
    return Matches(matches_of, reasons)


def _widths(folder: Path, tracks: TrackDetections) -> F8:
    """Return the width (n,), the larger horizontal size, of the track of each detection, metres."""
    extents = extents_of(folder, tracks)
    return np.array([extents[track][0] for track in tracks.tracks.tolist()])


def _max_distance_at_once(a: F8, b: F8) -> F8:
    """Return the largest distance (n, m) at which detections with these widths may be one object.

    The widths are ``a`` (n,) and ``b`` (m,), all in metres. The distance is half of their mean
    width, since two objects side by side are farther apart, but at least 4 cm and at most 10 cm.
    """
    mean_width = (a[:, None] + b[None]) / 2
    return np.clip(_REACH * mean_width, _LEAST_REACH_M, _MOST_REACH_M)


def _mutual_nearest(a: F8, b: F8, max_distance: F8) -> Iterator[tuple[int, int, float]]:
    """Yield index pairs and distances of mutual nearest neighbours in ``a`` and ``b``.

    Both are points, (n, 3) and (m, 3); ``max_distance`` (n, m) is the largest distance of each
    pair, metres.
    """
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    nearest = apart.argmin(axis=1)
    for k, j in enumerate(nearest.tolist()):
        if apart[k, j] <= max_distance[k, j] and int(apart[:, j].argmin()) == k:
            yield k, j, float(apart[k, j])


class _Standing(NamedTuple):
    """Centre (3,), width and largest extent of a track at rest, metres; NaN if unknown."""

    track: int
    center: F8
    width_m: float
    extent_m: float


def match_in_place(
    rows: Sequence[TrackRow], source: Path | None, target: Path, group: Group
) -> Matches:
    """Match objects that are at rest at the same place in two recordings.

    Parameters
    ----------
    rows : the tracks of the source; their positions are used if ``source`` is None.
    source : folder of the source run; None if only its tracks.csv exists.
    target : folder of the other run.
    group : as for `match_in_time`.

    Raises
    ------
    OutputError : the fixed frames are missing or differ, a table of a run is unreadable, or a row
        whose position is used has none.
    """
    _require_one_frame(source, target)
    new, _ = _standing(target)
    if source is None:
        old = [_Standing(row.track, _place_of(row), np.nan, np.nan) for row in rows]
        reasons: dict[int, str] = {}
    else:
        old, gone = _standing(source)
        reasons = dict.fromkeys(gone, "it was moved, so it cannot be found by its place")
    matches_of: dict[int, list[Match]] = {}
    for item in old:
        other_objects = [other for other in old if group(other.track) != group(item.track)]
        match, reason = _nearest_there(item, other_objects, new)
        if match is None:
            reasons[item.track] = reason
        else:  # no other object has this match, since the two would be ambiguous
            matches_of[item.track] = [match]
    return Matches(matches_of, reasons)


def _nearest_there(
    item: _Standing, old: Sequence[_Standing], new: Sequence[_Standing]
) -> tuple[Match | None, str]:
    """Return the only object at the place of ``item``, or the reason why there is none.

    ``old`` are the other objects of the source, ``new`` the objects of the target.
    """
    by_distance = sorted((_apart(item, other), k) for k, other in enumerate(new))
    reached = [(d, k) for d, k in by_distance if d <= _match_radius(item, new[k])]
    if not reached:
        return None, "nothing was found there"
    (distance, first), *others = reached
    nearest = new[first]
    if others and others[0][0] - distance < _CLEAR_M:
        return None, f"tracks #{nearest.track} and #{new[others[0][1]].track} are both there"
    rivals = [other.track for other in old if _apart(other, nearest) < distance + _CLEAR_M]
    if rivals:
        return None, f"track #{nearest.track} could also be track #{rivals[0]}"
    ratio = max(item.extent_m, nearest.extent_m) / min(item.extent_m, nearest.extent_m)
    if ratio > _SIZE_RATIO:
        return None, f"track #{nearest.track} is there, but has a different size"
    return Match(nearest.track, round(distance, 4)), ""


def _apart(a: _Standing, b: _Standing) -> float:
    return float(np.linalg.norm(a.center - b.center))


def _match_radius(a: _Standing, b: _Standing) -> float:
    return max(_LEAST_REACH_M, _REACH * float(np.fmax(a.width_m, b.width_m)))


def _require_one_frame(source: Path | None, target: Path) -> None:
    """Check that positions in two runs can be compared.

    Raises
    ------
    OutputError : a run has no fixed frame, or the fixed frames differ.
    """
    names = [_fixed_frame(folder) for folder in (source, target) if folder is not None]
    if len(set(names)) > 1:
        frame_names = " and ".join(names)
        hint = "process both with the same --fixed-frame"
        msg = f"{target}: the fixed frames differ ({frame_names}); {hint}"
        raise OutputError(msg)


def _fixed_frame(folder: Path) -> str:
    name = read_identity(folder)["fixed_frame"]
    if name is None:
        msg = (
            f"{folder}: has no fixed frame, which is needed to find objects by place; record "
            "transforms, or label tracks.csv by hand"
        )
        raise OutputError(msg)
    return name


def _place_of(row: TrackRow) -> F8:
    """Return the position (3,) in a line of tracks.csv, metres.

    Raises
    ------
    OutputError : the line has no position.
    """
    try:
        place = [parse_number(row.cells[name]) for name in "xyz"]
    except (KeyError, ValueError) as error:
        msg = f"line {row.line}: no position x, y, z of track #{row.track}"
        raise OutputError(msg) from error
    return np.array(place)


def _standing(folder: Path) -> tuple[list[_Standing], list[int]]:
    """Return the tracks of a run that are at rest, and the numbers of the tracks that moved."""
    tracks = read_track_detections(folder)
    extents = extents_of(folder, tracks)
    still, moved = [], []
    for track in np.unique(tracks.tracks).tolist():
        centers = tracks.centers[tracks.tracks == track]
        middle = np.median(centers, axis=0)
        spread = float(np.median(np.linalg.norm(centers - middle, axis=1)))
        width, extent = extents[track]
        if spread > max(_STILL_M, _REACH / 2 * width):
            moved.append(track)
        else:
            still.append(_Standing(track, middle, width, extent))
    return still, moved
