"""Find merged tracks that are in different places in the same frames: not parts of one object."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from shapecat.arrays import F8
from shapecat.geometry import rotation_from_quaternion
from shapecat.runs.labelled_tracks import LabelledTracks, read_annotation_frames
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.types import AnnotationBox

__all__ = ["Gap", "far_merges"]

_FAR_M = 0.05
"""Smallest mean gap between tracks that are not parts of one object; parts mostly touch."""


class Gap(NamedTuple):
    """The mean gap between two tracks, the lower number first, over ``frames`` common frames.

    Gaps are measured between full boxes, or visible boxes where full boxes are unknown, and may be
    smaller than the true distance (`_distances`).
    """

    tracks: tuple[int, int]
    frames: int
    distance_m: float

    @property
    def is_far(self) -> bool:
        """Whether the tracks are too far apart to touch each other."""
        return self.distance_m > _FAR_M


def far_merges(folder: Path, labels: Mapping[int, TrackLabel]) -> list[Gap]:
    """Return the gaps between merged tracks that are too far apart to be one object.

    Tracks that touch, directly or through other merged tracks, may be one object.

    Parameters
    ----------
    labels : the final label of each track of the run.

    Raises
    ------
    OutputError : a table of the run is unreadable, or the tables do not fit together.
    """
    groups: dict[int, list[int]] = {}
    for track, label in labels.items():
        groups.setdefault(label.track, []).append(track)
    merged = [track for group in groups.values() if len(group) > 1 for track in group]
    if not merged:
        return []
    gaps = _read_gaps(folder, {track: labels[track].track for track in merged})
    bodies = {track: {track} for track in merged}
    for a, b in (gap.tracks for gap in gaps if not gap.is_far):
        bodies[a] |= bodies[b]
        bodies |= dict.fromkeys(bodies[a], bodies[a])
    return [gap for gap in gaps if gap.tracks[1] not in bodies[gap.tracks[0]]]


def _read_gaps(folder: Path, objects: Mapping[int, int]) -> list[Gap]:
    """Return the gap between every two tracks of one object that have common frames.

    ``objects`` maps each track to the number of its object.
    """
    unmerged = {track: TrackLabel(track, "", 0.0) for track in objects}
    sums: dict[tuple[int, int], tuple[int, float]] = {}
    for frame in read_annotation_frames(folder, LabelledTracks.read(folder, unmerged)):
        boxes = sorted(frame.objects)
        if len(boxes) < 2:
            continue
        distances = _distances(boxes)
        for (i, a), (j, b) in combinations(enumerate(boxes), 2):
            if objects[a.track] == objects[b.track]:
                count, total = sums.get((a.track, b.track), (0, 0.0))
                sums[a.track, b.track] = count + 1, total + float(distances[i, j])
    return [Gap(pair, count, total / count) for pair, (count, total) in sorted(sums.items())]


def _distances(boxes: Sequence[AnnotationBox]) -> F8:
    """Return the gap between every two boxes, (n, n), metres.

    It is the largest gap along a face normal of either box, and 0 if no face normal separates
    them; never more than their true distance.
    """
    centers = np.array([box.center for box in boxes])
    halves = np.array([box.size for box in boxes]) / 2
    normals = np.array([rotation_from_quaternion(box.orientation).T for box in boxes])
    # Project each box k onto each normal a of each box i.
    reach = np.einsum("iakb,kb->iak", np.abs(np.einsum("iac,kbc->iakb", normals, normals)), halves)
    offset = np.abs(np.einsum("iac,ikc->iak", normals, centers - centers[:, None]))
    gaps = (offset - reach - halves[:, :, None]).max(axis=1)
    return np.asarray(np.maximum(gaps, gaps.T).clip(0))
