"""The nearest-centroid tracker (thesis 7.5.2)."""

import dataclasses
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F8, I4, Bool, freeze
from shapecat.config import TrackingSettings
from shapecat.tracking.association import assign, posterior_difference, size_difference, size_key

__all__ = ["Tracker", "gate_radius"]

_SPEED_M_S = 0.15  # standard deviation of an object's velocity; most stand still
_SPEED_MEMORY_S = 1.0  # time constant with which a velocity decays
_NOISE_M = 0.012  # standard deviation of a centre, from noise, segmentation and viewpoint
_SURPRISE_M_S = 0.3  # speed at which a hand may set an object in motion between two frames
_LIMIT = 1.0  # cost above which a new track is likelier than a pair
_SIZE_WEIGHT, _POSTERIOR_WEIGHT, _TENTATIVE_COST = 0.8, 0.5, 0.2
_PATIENCE_S = 0.5  # shortest time without detections after which a track may end
_MEMORY_HITS = 10  # number of detections over which a track's size and posterior are averaged


def gate_radius(size_keys: F8, gate_m: float) -> F8:
    """Return the gate radius (m,), metres, of objects with a given `size_key` (m, 3).

    A change of view, or an occluder, can move the centre of the visible part by half the object's
    size. The radius is at most ``gate_m``.
    """
    return np.asarray(np.minimum(gate_m, 0.03 + 0.5 * np.exp(size_keys.max(axis=1))))


@dataclass
class _Active:
    """Tracks that have not ended, or that detections have just started; rows in order of birth.

    Positions (n, 3) are in metres, velocities (n, 3) in m/s.
    """

    ids: I4
    position: F8
    velocity: F8
    variance: F8  # var(position), cov(position, velocity), var(velocity); equal for x, y and z
    size: F8  # running mean of `size_key`
    posterior: F8
    hits: I4
    born_ns: I4
    seen_ns: I4
    missed: I4  # number of frames of ``last_topic`` since the last detection
    last_topic: I4  # number of the topic that saw it last

    def rows(self, which: Bool) -> Self:
        """Return the tracks selected by a mask."""
        columns = {f.name: getattr(self, f.name)[which] for f in dataclasses.fields(self)}
        return dataclasses.replace(self, **columns)

    def joined(self, other: Self) -> Self:
        """Return these tracks followed by those of ``other``."""
        columns = {
            f.name: np.concatenate([getattr(self, f.name), getattr(other, f.name)])
            for f in dataclasses.fields(self)
        }
        return dataclasses.replace(self, **columns)


class Tracker:
    """Assigns a track number to every detection of a stream of frames.

    A detection continues a track with a near predicted centre and a similar size and posterior;
    confirmed tracks are preferred. The detections of a frame are assigned to tracks jointly. A
    Kalman filter with decaying velocity (an Ornstein-Uhlenbeck process) predicts the positions, so
    that a rolling object is followed through an occlusion while a standing one keeps its position.

    The result does not depend on the order of the detections in a frame: they are sorted by centre,
    size, posterior and ``partial``, and new tracks get their numbers in this order. Detections
    equal in all of these are interchangeable.
    """

    def __init__(self, settings: TrackingSettings) -> None:
        """Start without tracks."""
        self._settings = settings
        self._born = 0
        self._stamp_ns: int | None = None
        self._clock_ns = 0
        self._active: _Active | None = None

    def reset(self) -> None:
        """End all tracks; their numbers are not reused."""
        self._active = None

    def step(
        self,
        stamp_ns: int,
        centers: ArrayLike,
        sizes: ArrayLike,
        posteriors: ArrayLike,
        *,
        partial: ArrayLike | None = None,
        topic: int = 0,
    ) -> I4:
        """Associate the detections of the next frame.

        Parameters
        ----------
        stamp_ns : time of the frame. If it is before the previous frame, no time is assumed to have
            passed; if by more than ``max_missed_s``, all tracks end.
        centers : (n, 3) metres, in the same coordinate frame for all frames.
        sizes : (n, 3) metres; the third length is along the up direction.
        posteriors : (n, c) posteriors of the single views.
        partial : (n,) whether the image border or an occluder cuts the object; none by default.
        topic : number of the topic. An object can be missed only on the topic that saw it last.

        Returns
        -------
        The track number (n,) of each detection; numbers start at 1, in order of birth.

        Raises
        ------
        ValueError : shapes do not match, or a centre or size is not finite.
        """
        shape_sizes: dict[str, int] = {}
        points = freeze(centers, "n 3", "f8", shape_sizes)
        lengths = freeze(sizes, "n 3", "f8", shape_sizes)
        beliefs = freeze(posteriors, "n c", "f8", shape_sizes)
        cut = freeze(np.zeros(len(points)) if partial is None else partial, "n", "?", shape_sizes)
        if not (np.isfinite(points).all() and np.isfinite(lengths).all()):
            msg = f"centres and sizes must be finite, got {centers!r} and {sizes!r}"
            raise ValueError(msg)
        if len(points) == 0 and self._active is not None:
            beliefs = self._active.posterior[:0]  # an empty frame may lack the categories
        order = np.lexsort(np.column_stack([points, lengths, beliefs, cut]).T[::-1])
        detections = _seed(points[order], size_key(lengths[order]), beliefs[order])
        result = np.zeros(len(points), np.int32)
        result[order] = self._advance(stamp_ns, detections, cut[order], topic)
        return result

    def _advance(self, stamp_ns: int, detections: _Active, partial: Bool, topic: int) -> I4:
        """Associate the detections of a frame, sorted; return their track numbers (n,).

        ``partial`` (n,) says which detections are partial views.
        """
        elapsed_s = self._tick(stamp_ns)
        detections.born_ns[:] = detections.seen_ns[:] = self._clock_ns
        detections.last_topic[:] = topic
        if self._active is None or not len(self._active.ids):
            self._active = detections.rows(np.zeros(len(detections.ids), bool))
        active = _predict(self._active, elapsed_s)
        pairs = assign(
            _costs(active, detections, self._clock_ns, self._settings),
            _LIMIT,
            self._settings.association,
        )
        active.missed[active.last_topic == topic] += 1
        _correct(active, detections, pairs, partial)
        new = np.ones(len(detections.ids), bool)
        new[pairs[:, 1]] = False
        detections.ids[new] = self._born + 1 + np.arange(int(new.sum()))
        self._born += int(new.sum())
        detections.ids[pairs[:, 1]] = active.ids[pairs[:, 0]]
        self._active = self._survivors(active).joined(detections.rows(new))
        return detections.ids

    def _tick(self, stamp_ns: int) -> float:
        """Advance the clock, never backwards; return the elapsed seconds.

        If the stamp is more than ``max_missed_s`` before the last one, end all tracks.
        """
        elapsed = 0 if self._stamp_ns is None else stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        if elapsed < -self._settings.max_missed_s * 1e9:
            self.reset()
        self._clock_ns += max(elapsed, 0)
        return max(elapsed, 0) * 1e-9

    def _survivors(self, active: _Active) -> _Active:
        """Return the tracks except those missed for longer than they had been seen before.

        The limit is at least half a second and at most ``max_missed_s``. A track must also be
        missed in at least one frame, or in two if it is not confirmed, so that a long interval
        between frames does not end it.
        """
        proved = active.hits >= self._settings.min_hits
        longest_s = max(self._settings.max_missed_s, _PATIENCE_S)
        patience_s = np.clip((active.seen_ns - active.born_ns) * 1e-9, _PATIENCE_S, longest_s)
        unseen_s = (self._clock_ns - active.seen_ns) * 1e-9
        return active.rows((active.missed < np.where(proved, 1, 2)) | (unseen_s <= patience_s))


def _seed(centers: F8, size_keys: F8, posteriors: F8) -> _Active:
    """Return new tracks at detections, with numbers and times of 0.

    ``centers`` are (n, 3) metres, ``size_keys`` (n, 3) from `size_key`, ``posteriors`` (n, c).
    """
    n = len(centers)
    variance = np.tile([_NOISE_M**2, 0.0, _SPEED_M_S**2], (n, 1))
    return _Active(
        ids=np.zeros(n, np.int32),
        position=centers,
        velocity=np.zeros((n, 3)),
        variance=variance,
        size=size_keys,
        posterior=posteriors,
        hits=np.ones(n, np.int64),
        born_ns=np.zeros(n, np.int64),
        seen_ns=np.zeros(n, np.int64),
        missed=np.zeros(n, np.int64),
        last_topic=np.zeros(n, np.int64),
    )


def _predict(tracks: _Active, elapsed_s: float) -> _Active:
    """Predict the tracks after ``elapsed_s`` seconds, with the exact variance of the process."""
    tau = _SPEED_MEMORY_S
    keep = np.exp(-elapsed_s / tau)
    horizon = tau * (1 - keep)
    pp, pv, vv = tracks.variance.T
    drift = tau**2 * max(2 * elapsed_s / tau - 3 + 4 * keep - keep**2, 0.0)
    speed2 = _SPEED_M_S**2
    variance = [
        pp + 2 * horizon * pv + horizon**2 * vv + speed2 * drift,
        keep * (pv + horizon * vv) + speed2 * tau * (1 - keep) ** 2,
        keep**2 * vv + speed2 * (1 - keep**2),
    ]
    return dataclasses.replace(
        tracks,
        position=tracks.position + horizon * tracks.velocity,
        velocity=keep * tracks.velocity,
        variance=np.column_stack(variance),
    )


def _costs(tracks: _Active, detections: _Active, clock_ns: int, settings: TrackingSettings) -> F8:
    """Return the costs (m, n) of pairs, from their distance, sizes and posteriors.

    ``clock_ns`` is the present time. Tracks that are not confirmed cost more; pairs beyond the gate
    cost infinity.
    """
    distance = np.linalg.norm(tracks.position[:, None] - detections.position[None], axis=2)
    unseen_s = np.minimum((clock_ns - tracks.seen_ns) * 1e-9, 0.2)
    gate = np.minimum(
        gate_radius(tracks.size, settings.gate_m) + _SURPRISE_M_S * unseen_s, settings.gate_m
    )[:, None]
    costs = (
        (distance / np.maximum(gate, 1e-9)) ** 2
        + _SIZE_WEIGHT * size_difference(tracks.size, detections.size)
        + _POSTERIOR_WEIGHT * posterior_difference(tracks.posterior, detections.posterior)
        + _TENTATIVE_COST * (tracks.hits < settings.min_hits)[:, None]
    )
    return np.where(distance <= gate, costs, np.inf)


def _correct(tracks: _Active, detections: _Active, pairs: I4, partial: Bool) -> None:
    """Update tracks in place with their detections.

    ``pairs`` (p, 2) are the row of a track and that of its detection; ``partial`` (n,) says which
    detections are partial views.
    """
    i, j = pairs.T
    tracks.missed[i], tracks.last_topic[i] = 0, detections.last_topic[j]
    tracks.seen_ns[i] = detections.seen_ns[j]
    tracks.hits[i] += 1
    # A view of another size shows another part of the object, so its centre is less reliable.
    size_change = np.abs(tracks.size[i] - detections.size[j]).mean(axis=1)
    noise = _NOISE_M**2 * (1 + 10 * size_change + 3 * partial[j])
    pp, pv, vv = tracks.variance[i].T
    gain_p, gain_v = pp / (pp + noise), pv / (pp + noise)
    innovation = detections.position[j] - tracks.position[i]
    tracks.position[i] += gain_p[:, None] * innovation
    tracks.velocity[i] += gain_v[:, None] * innovation
    tracks.variance[i] = np.column_stack([(1 - gain_p) * pp, (1 - gain_p) * pv, vv - gain_v * pv])
    rate = np.where(partial[j], 0.25, 1.0) / np.minimum(tracks.hits[i], _MEMORY_HITS)
    tracks.size[i] += rate[:, None] * (detections.size[j] - tracks.size[i])
    tracks.posterior[i] += rate[:, None] * (detections.posterior[j] - tracks.posterior[i])
