"""Which tracks of two runs are the same object.

Two runs of one recording have frames in common, in which detections of the same object are each
other's nearest. Two recordings of one place share a fixed frame alone, in which only what stood
still in both can be found again. What is ambiguous is told, not guessed.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.parquet as pq

from shapecat.arrays import F4, F8, I4
from shapecat.errors import OutputError
from shapecat.runs.folder import read_run
from shapecat.runs.tables import frame_rows, numbers, read_row_groups
from shapecat.runs.track_table import TrackRow

__all__ = ["Group", "Match", "Matches", "match_in_place", "match_in_time"]

_MOST_REACH_M = 0.10
"""Detections of one object in one frame are no farther apart, however they were segmented."""
_MAJORITY = 0.6
"""Share of the common frames in which two tracks are each other's nearest."""
_RIVAL = 0.25
"""With such a share another track has a claim too."""
_STILL_M = 0.04
"""The centres of what stands still scatter less, though it is seen from elsewhere."""
_REACH = 0.5
"""Centres of what two views show of an object are closer than this part of its width."""
_LEAST_REACH_M = 0.04
_CLEAR_M = 0.03
"""The next object is farther than the nearest by at least this, or the place is ambiguous."""
_SIZE_RATIO = 1.8
"""The largest extents of an object in two recordings differ by less."""
_SAMPLES = 40
"""Detections per track whose size is read."""


Group = Callable[[int], int]
"""Returns a number that tracks have in common if a person has merged them."""


class Match(NamedTuple):
    """A track of the target, and how far its centre is from that of the other, metres."""

    track: int
    distance_m: float


@dataclass(frozen=True)
class Matches:
    """By track of the source, those of the target that are it too, or why there are none."""

    found: Mapping[int, Sequence[Match]]
    reasons: Mapping[int, str]


class _Tracks(NamedTuple):
    """Where tracks were seen: arrays (n,), in the order of topic and stamp; centres (n, 3)."""

    tracks: I4
    frames: list[tuple[str, int]]
    numbers: I4
    detections: I4
    centers: F8
    keys: dict[tuple[str, int], slice]


def _read_tracks(folder: Path) -> _Tracks:
    """Read where the tracks of a run were seen, without the frames in which they coast."""
    columns = ["track", "topic", "frame", "stamp_ns", "detection", "center_fixed"]
    with pq.ParquetFile(folder / "tracks.parquet") as file:
        table = file.read(columns=columns)
    table = table.filter(table["detection"].is_valid())
    table = table.sort_by([("topic", "ascending"), ("stamp_ns", "ascending")])
    keys = list(zip(table["topic"].to_pylist(), table["stamp_ns"].to_pylist(), strict=True))
    starts = [k for k, key in enumerate(keys) if not k or key != keys[k - 1]]
    rows = map(slice, starts, [*starts[1:], len(keys)])
    return _Tracks(
        numbers(table["track"]),
        keys,
        numbers(table["frame"]),
        numbers(table["detection"]),
        numbers(table["center_fixed"]).reshape(-1, 3).astype(np.float64),
        dict(zip((keys[k] for k in starts), rows, strict=True)),
    )


def match_in_time(source: Path, target: Path, group: Group) -> Matches:
    """Match tracks that are each other's nearest in most of the frames that both runs have.

    Parameters
    ----------
    group : says of which object a track of the source is: tracks that were merged are one.
    """
    old, new = _read_tracks(source), _read_tracks(target)
    old_widths, new_widths = _widths(source, old), _widths(target, new)
    votes: Counter[tuple[int, int]] = Counter()
    apart: defaultdict[tuple[int, int], float] = defaultdict(float)
    seen: Counter[int] = Counter()
    for key in old.keys.keys() & new.keys.keys():
        here, there = old.keys[key], new.keys[key]
        seen.update(new.tracks[there].tolist())
        reach = _reach_at_once(old_widths[here], new_widths[there])
        for a, b, distance in _mutual_nearest(old.centers[here], new.centers[there], reach):
            pair = int(old.tracks[here][a]), int(new.tracks[there][b])
            votes[pair] += 1
            apart[pair] += distance
    return _by_majority(votes, apart, seen, group)


def _by_majority(
    votes: Mapping[tuple[int, int], int],
    apart: Mapping[tuple[int, int], float],
    seen: Counter[int],
    group: Group,
) -> Matches:
    """Let each track of the target be the object of the source it is nearest to most often."""
    found: dict[int, list[Match]] = {}
    reasons: dict[int, str] = {}
    claims: dict[int, dict[int, list[int]]] = {}
    for old, new in sorted(votes):
        claims.setdefault(new, {}).setdefault(group(old), []).append(old)
    for new, objects in claims.items():
        shares = {k: sum(votes[old, new] for old in o) / seen[new] for k, o in objects.items()}
        best, *others = sorted(shares, key=lambda k: (-shares[k], k))
        rivals = [k for k in others if shares[k] >= _RIVAL]
        if shares[best] < _MAJORITY or rivals:
            for old in (old for k in (best, *rivals) for old in objects[k]):
                reasons[old] = f"track {new} is it only part of the time"
            continue
        for old in objects[best]:
            mean = apart[old, new] / votes[old, new]
            found.setdefault(old, []).append(Match(new, round(mean, 4)))
    return Matches(found, reasons)


def _widths(folder: Path, seen: _Tracks) -> F8:
    """Return the width of each row's track (n,), metres."""
    extents = _extents(folder, seen)
    return np.array([extents[track][0] for track in seen.tracks.tolist()])


def _reach_at_once(a: F8, b: F8) -> F8:
    """Return how near (n, m) things of some widths are to each other only if they are the same.

    Two that stand side by side are farther apart than half of their mean width.
    """
    mean = (a[:, None] + b[None]) / 2
    return np.clip(_REACH * mean, _LEAST_REACH_M, _MOST_REACH_M)


def _mutual_nearest(a: F8, b: F8, reach: F8) -> Iterator[tuple[int, int, float]]:
    """Yield the indices of points (n, 3) and (m, 3) that are each other's nearest, and how near.

    ``reach`` (n, m) says how near they must be.
    """
    apart = np.linalg.norm(a[:, None] - b[None], axis=2)
    nearest = apart.argmin(axis=1)
    for k, j in enumerate(nearest.tolist()):
        if apart[k, j] <= reach[k, j] and int(apart[:, j].argmin()) == k:
            yield k, j, float(apart[k, j])


class _Standing(NamedTuple):
    """The place (3,), width and extent of a standing track; NaN if unknown."""

    track: int
    center: F8
    width_m: float
    extent_m: float


def match_in_place(
    rows: Sequence[TrackRow], source: Path | None, target: Path, group: Group
) -> Matches:
    """Match objects that stand still at one place in both recordings.

    Parameters
    ----------
    rows : the tracks of the source, and their places if there are no tables.
    group : as for `match_in_time`.
    """
    _require_one_frame(source, target)
    new, _ = _standing(target)
    if source is None:
        old = [_Standing(row.track, _place_of(row), np.nan, np.nan) for row in rows]
        reasons: dict[int, str] = {}
    else:
        old, gone = _standing(source)
        reasons = dict.fromkeys(gone, "it was moved, so that its place says nothing")
    found: dict[int, list[Match]] = {}
    taken: dict[int, int] = {}
    for thing in old:
        others = [other for other in old if group(other.track) != group(thing.track)]
        match, reason = _nearest_there(thing, others, new)
        if match is None:
            reasons[thing.track] = reason
        elif group(taken.get(match.track, thing.track)) != group(thing.track):
            reasons[thing.track] = f"track {match.track} may also be track {taken[match.track]}"
        else:
            taken[match.track] = thing.track
            found[thing.track] = [match]
    return Matches(found, reasons)


def _nearest_there(
    thing: _Standing, old: Sequence[_Standing], new: Sequence[_Standing]
) -> tuple[Match | None, str]:
    """Return the only object at the place of another, or the reason why there is none.

    ``old`` are the other things that stood around.
    """
    near = sorted((_apart(thing, other), k) for k, other in enumerate(new))
    reached = [(d, k) for d, k in near if d <= _reach(thing, new[k])]
    if not reached:
        return None, "nothing was found there"
    (distance, first), *others = reached
    here = new[first]
    if others and others[0][0] - distance < _CLEAR_M:
        return None, f"tracks {here.track} and {new[others[0][1]].track} are both there"
    rivals = [other.track for other in old if _apart(other, here) < distance + _CLEAR_M]
    if rivals:
        return None, f"track {here.track} may also be track {rivals[0]}"
    ratio = max(thing.extent_m, here.extent_m) / min(thing.extent_m, here.extent_m)
    if ratio > _SIZE_RATIO:
        return None, f"track {here.track} stands there, which has another size"
    return Match(here.track, round(distance, 4)), ""


def _apart(a: _Standing, b: _Standing) -> float:
    return float(np.linalg.norm(a.center - b.center))


def _reach(a: _Standing, b: _Standing) -> float:
    return max(_LEAST_REACH_M, _REACH * float(np.fmax(a.width_m, b.width_m)))


def _require_one_frame(source: Path | None, target: Path) -> None:
    """Refuse places that cannot be compared.

    Raises
    ------
    OutputError : a run has no fixed frame, or they have different ones.
    """
    names = [_fixed_frame(folder) for folder in (source, target) if folder is not None]
    if len(set(names)) > 1:
        found = " and ".join(names)
        msg = f"{target}: the fixed frames differ ({found}); process with --fixed-frame"
        raise OutputError(msg)


def _fixed_frame(folder: Path) -> str:
    name = read_run(folder)["fixed_frame"]
    if name is None:
        msg = f"{folder}: has no fixed frame, in which objects could be found again by place"
        raise OutputError(msg)
    return name


def _place_of(row: TrackRow) -> F8:
    """Return the place (3,) in a line of tracks.csv, metres.

    Raises
    ------
    OutputError : it tells none.
    """
    try:
        place = [float(row.cells[name].strip().replace(",", ".")) for name in "xyz"]
    except (KeyError, ValueError) as error:
        msg = f"line {row.line}: no place x, y, z of track {row.track}"
        raise OutputError(msg) from error
    return np.array(place)


def _standing(folder: Path) -> tuple[list[_Standing], list[int]]:
    """Return where the tracks of a run stand, and the tracks that were moved."""
    seen = _read_tracks(folder)
    extents = _extents(folder, seen)
    still, moved = [], []
    for track in np.unique(seen.tracks).tolist():
        centers = seen.centers[seen.tracks == track]
        middle = np.median(centers, axis=0)
        spread = float(np.median(np.linalg.norm(centers - middle, axis=1)))
        width, extent = extents.get(track, (np.nan, np.nan))
        if spread > max(_STILL_M, _REACH / 2 * width):
            moved.append(track)
        else:
            still.append(_Standing(track, middle, width, extent))
    return still, moved


def _extents(folder: Path, seen: _Tracks) -> dict[int, tuple[float, float]]:
    """Return the width and the largest extent of each track, metres, medians of some views."""
    wanted: dict[tuple[str, int], list[int]] = {}
    for track in np.unique(seen.tracks):
        rows = np.flatnonzero(seen.tracks == track)
        for row in rows[:: max(1, len(rows) // _SAMPLES)].tolist():
            wanted.setdefault((seen.frames[row][0], int(seen.numbers[row])), []).append(row)
    sizes: dict[int, list[F4]] = {}
    for group in read_row_groups(folder / "detections.parquet", ["topic", "frame", "size"]):
        size = numbers(group["size"]).reshape(-1, 3)
        for key, span in frame_rows(group).items():
            for row in wanted.get(key, ()):
                found = size[span][seen.detections[row]]
                sizes.setdefault(int(seen.tracks[row]), []).append(found)
    middles = {track: np.median(np.stack(found), axis=0) for track, found in sizes.items()}
    return {t: (float(max(m[:2])), float(max(m))) for t, m in middles.items()}
