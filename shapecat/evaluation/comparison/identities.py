"""Tracking metrics: MOTA, IDF1 and HOTA."""

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from shapecat.arrays import F8, I4, Bool

__all__ = ["FrameIdentities", "Identities", "compute_tracking_metrics"]

_ALPHAS = np.arange(0.05, 0.99, 0.05)
"""Thresholds of similarity over which HOTA is averaged."""
_FORBIDDEN = 1e6
"""Cost of a pair that may not match."""


class FrameIdentities(NamedTuple):
    """The true and the found objects of a frame, and their similarity.

    Attributes
    ----------
    true, found : identities of the objects, without duplicates.
    similarity : (true, found) from 0 to 1; 0 for pairs that cannot be the same object.
    """

    true: Sequence[Hashable]
    found: Sequence[Hashable]
    similarity: F8


class Identities(NamedTuple):
    """Tracking metrics over all frames; NaN if they are undefined.

    ``objects`` is the number of true objects, summed over the frames.
    """

    idf1: float
    mota: float
    hota: float
    detection_accuracy: float
    association_accuracy: float
    switches: int
    misses: int
    false_positives: int
    objects: int


class _Occurrences(NamedTuple):
    """Occurrences of numbered identities in all frames.

    Attributes
    ----------
    true, found : (t,) and (f,) number of frames with each true and with each found identity.
    frames : for each frame, the numbers of its true and found identities, and their similarity.
    """

    true: F8
    found: F8
    frames: list[tuple[I4, I4, F8]]


def compute_tracking_metrics(
    frames: Iterable[FrameIdentities], *, threshold: float = 0.5
) -> Identities:
    """Compute tracking metrics.

    Source: Bernardin 2008 (MOTA), Ristani 2016 (IDF1), Luiten 2020 (HOTA).

    Parameters
    ----------
    frames : the frames in temporal order.
    threshold : lowest similarity of a pair that counts as the same object, for MOTA and IDF1; HOTA
        averages over thresholds from 0.05 to 0.95.
    """
    frames = list(frames)
    counts = _clear_mot(frames, threshold)
    occurrences = _occurrences(frames)
    hota, detection, association = _hota(occurrences)
    errors = counts["misses"] + counts["false_positives"] + counts["switches"]
    return Identities(
        idf1=_idf1(occurrences, threshold),
        mota=1 - errors / counts["objects"] if counts["objects"] else float("nan"),
        hota=hota,
        detection_accuracy=detection,
        association_accuracy=association,
        **counts,
    )


def _clear_mot(frames: Iterable[FrameIdentities], threshold: float) -> Counter[str]:
    """Count objects, misses, false positives and switches.

    A pair stays matched while its similarity is at least ``threshold``.
    """
    last: dict[Hashable, Hashable] = {}
    counts = Counter(switches=0, misses=0, false_positives=0, objects=0)
    for frame in frames:
        true, found, similarity = frame
        pairs = _pairs(frame, np.asarray(similarity) >= threshold, last)
        matched = {true[i]: found[j] for i, j in pairs}
        counts["switches"] += sum(last.get(t, f) != f for t, f in matched.items())
        counts["misses"] += len(true) - len(matched)
        counts["false_positives"] += len(found) - len(matched)
        counts["objects"] += len(true)
        last.update(matched)
    return counts


def _pairs(
    frame: FrameIdentities, allowed: Bool, last: Mapping[Hashable, Hashable]
) -> list[tuple[int, int]]:
    """Match a frame: first the previous pairs that are still ``allowed``, then the most similar.

    ``allowed`` (true, found) says which pairs may match; ``last`` is the found identity that each
    true one had before. Returns pairs of indices, true and found.
    """
    true, found, similarity = frame
    place = {name: j for j, name in enumerate(found)}
    pairs: dict[int, int] = {}
    for i, name in enumerate(true):
        j = place.get(last.get(name), -1) if name in last else -1
        if j >= 0 and allowed[i, j] and j not in pairs.values():
            pairs[i] = j
    rows = [i for i in range(len(true)) if i not in pairs]
    columns = [j for j in range(len(found)) if j not in pairs.values()]
    cost = np.where(allowed, 1 - np.asarray(similarity), _FORBIDDEN)[np.ix_(rows, columns)]
    rest = zip(*linear_sum_assignment(cost), strict=True)
    new = [(rows[i], columns[j]) for i, j in rest if cost[i, j] < _FORBIDDEN]
    return [*pairs.items(), *new]


def _occurrences(frames: Iterable[FrameIdentities]) -> _Occurrences:
    numbers: tuple[dict[Hashable, int], dict[Hashable, int]] = ({}, {})
    numbered: list[tuple[I4, I4, F8]] = []
    for true, found, similarity in frames:
        places = [
            np.array([known.setdefault(name, len(known)) for name in names], np.int64)
            for known, names in zip(numbers, (true, found), strict=True)
        ]
        numbered.append((places[0], places[1], np.asarray(similarity, np.float64)))
    counts = [np.zeros(len(known)) for known in numbers]
    for true_places, found_places, _ in numbered:
        counts[0][true_places] += 1
        counts[1][found_places] += 1
    return _Occurrences(counts[0], counts[1], numbered)


def _idf1(occurrences: _Occurrences, threshold: float) -> float:
    """Return IDF1, the F1 score of the best one-to-one assignment of found to true identities."""
    together = np.zeros((occurrences.true.size, occurrences.found.size))
    for true, found, similarity in occurrences.frames:
        together[np.ix_(true, found)] += similarity >= threshold
    matched = together[linear_sum_assignment(-together)].sum()
    total = occurrences.true.sum() + occurrences.found.sum()
    return float(2 * matched / total) if total else float("nan")


def _hota(occurrences: _Occurrences) -> tuple[float, float, float]:
    """Return HOTA, detection accuracy and association accuracy, averaged over thresholds.

    They are NaN without true objects, and 0 if nothing was found.
    """
    if not (occurrences.true.sum() and occurrences.found.sum()):
        return (0.0, 0.0, 0.0) if occurrences.true.sum() else (float("nan"),) * 3
    alignment = _alignment(occurrences)
    pairs, similar = [], []  # few of all pairs of identities ever match
    for true, found, similarity in occurrences.frames:
        score = alignment[np.ix_(true, found)] * similarity
        rows, columns = linear_sum_assignment(-score)
        pairs.append(true[rows] * occurrences.found.size + found[columns])
        similar.append(similarity[rows, columns])
    matches, trues, founds = _count_matches(pairs, similar, occurrences.found.size)
    total = occurrences.true.sum() + occurrences.found.sum()
    hits = matches.sum(axis=1)
    ever = occurrences.true[trues] + occurrences.found[founds] - matches
    association = (matches * matches / np.maximum(ever, 1)).sum(axis=1) / np.maximum(hits, 1)
    detection = hits / (total - hits)
    hota = np.sqrt(detection * association)
    return float(hota.mean()), float(detection.mean()), float(association.mean())


def _count_matches(
    pairs: Sequence[I4], similar: Sequence[F8], found_count: int
) -> tuple[F8, I4, I4]:
    """Count the matches of each pair of identities that occurs, at each threshold of HOTA.

    Parameters
    ----------
    pairs : for each frame, its matched pairs (p,), as the number of the true identity times
        ``found_count``, plus the number of the found one.
    similar : for each frame, the similarity (p,) of these pairs.

    Returns
    -------
    The matches (thresholds, pairs), and the index of the true and of the found identity of each
    pair (pairs,).
    """
    distinct, places = np.unique(np.concatenate(pairs), return_inverse=True)
    similarity = np.concatenate(similar)
    matches = [
        np.bincount(places, similarity >= alpha - 1e-9, minlength=distinct.size)
        for alpha in _ALPHAS
    ]
    return np.array(matches), *np.divmod(distinct, found_count)


def _alignment(occurrences: _Occurrences) -> F8:
    """Return how well each pair of identities coincides over all frames, (true, found), 0 to 1."""
    together = np.zeros((occurrences.true.size, occurrences.found.size))
    for true, found, similarity in occurrences.frames:
        beside = similarity.sum(axis=0) + similarity.sum(axis=1)[:, None] - similarity
        share = np.where(beside > 1e-9, similarity / np.maximum(beside, 1e-9), 0)
        together[np.ix_(true, found)] += share
    return np.asarray(together / (occurrences.true[:, None] + occurrences.found - together))
