"""Worked examples of tracking against textbook formulas and libraries, with distinct numbers."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from shapecat.arrays import F8
from shapecat.config import TrackingSettings
from shapecat.tracking import tracker
from shapecat.tracking.association import size_key
from shapecat.tracking.common_motion import CommonMotion, _fit, _in_space, _level
from shapecat.tracking.detection_table import DetectionTable
from shapecat.tracking.false_tracks import _in_box
from shapecat.tracking.pieces import _fit as fit_pieces
from shapecat.tracking.pieces import _joint, _largest
from shapecat.tracking.recording import _describe, _hits_to_confirm, _line
from shapecat.tracking.stitching import Fragments, _contradiction, _distances
from shapecat.tracking.tracker import Tracker
from tests.frame_detections import frame, gather, track_frames

SETTINGS = TrackingSettings()
SECOND = 1_000_000_000
TURNED = Rotation.from_euler("zyx", [0.7, -0.4, 0.3]).as_matrix()


def two_tracks(**changes: Any) -> tracker._Active:
    """Return two tracks, one that moves; the variances are not multiples of each other."""
    found = tracker._Active(
        ids=np.array([4, 9], np.int32),
        position=np.array([[0.11, -0.42, 0.83], [0.34, -0.15, 0.79]]),
        velocity=np.array([[0.21, -0.07, 0.05], [0.0, 0.0, 0.0]]),
        variance=np.array([[4e-4, 3e-4, 9e-3], [1e-4, 0.0, 2e-2]]),
        size=np.log([[0.14, 0.10, 0.08], [0.31, 0.12, 0.05]]),
        posterior=np.array([[0.7, 0.3], [0.2, 0.8]]),
        hits=np.array([5, 2]),
        born_ns=np.array([0, 3 * SECOND]),
        seen_ns=np.array([4 * SECOND, 4 * SECOND + 70_000_000]),
        missed=np.array([0, 1]),
        last_topic=np.array([0, 0]),
    )
    return replace(found, **changes)


# ---- the tracker


def test_prediction_is_exact_for_decaying_velocity(monkeypatch: pytest.MonkeyPatch) -> None:
    """Van Loan's matrix exponential integrates the same stochastic equation."""
    monkeypatch.setattr(tracker, "_SPEED_MEMORY_S", 1.7)  # its powers differ, unlike those of 1 s
    elapsed, decay, speed = 0.37, 1 / 1.7, tracker._SPEED_M_S
    drift = np.array([[0.0, 1.0], [0.0, -decay]])
    noise = np.diag([0.0, 2 * decay * speed**2])
    block = expm(np.block([[-drift, noise], [np.zeros((2, 2)), drift.T]]) * elapsed)
    step, process = block[2:, 2:].T, block[2:, 2:].T @ block[:2, 2:]
    before = two_tracks()
    after = tracker._predict(before, elapsed)

    for k, (pp, pv, vv) in enumerate(before.variance):
        expected = step @ [[pp, pv], [pv, vv]] @ step.T + process
        assert_allclose(after.variance[k], expected[np.triu_indices(2)], rtol=1e-9)
    state = np.stack([before.position, before.velocity])
    moved = np.einsum("ij,jkx->ikx", step, state)
    assert_allclose([after.position, after.velocity], moved, rtol=1e-12)


def test_correction_is_kalman_update_with_running_means() -> None:
    """Textbook form, with the noise of a partial view of another size."""
    tracks, before = two_tracks(), two_tracks()
    found = tracker._seed(
        np.array([[0.0, 0.0, 0.5], [0.13, -0.40, 0.86]]),
        np.log([[0.5, 0.4, 0.3], [0.17, 0.09, 0.11]]),
        np.array([[0.5, 0.5], [0.4, 0.6]]),
    )
    found.seen_ns[:], found.last_topic[:] = 5 * SECOND, 3
    size_difference = np.abs(before.size[0] - found.size[1]).mean()
    tracker._correct(tracks, found, np.array([[0, 1]]), np.array([False, True]))

    pp, pv, vv = before.variance[0]
    covariance = np.array([[pp, pv], [pv, vv]])
    noise = tracker._NOISE_M**2 * (1 + 10 * size_difference + 3)
    gain = covariance[:, 0] / (pp + noise)
    surprise = found.position[1] - before.position[0]
    left = covariance - np.outer(gain, covariance[0])
    assert_allclose(tracks.position[0], before.position[0] + gain[0] * surprise)
    assert_allclose(tracks.velocity[0], before.velocity[0] + gain[1] * surprise)
    assert_allclose(tracks.variance[0], left[np.triu_indices(2)])
    rate = 0.25 / 6  # of a partial view, the sixth of its track
    size = before.size[0] + rate * (found.size[1] - before.size[0])
    assert_allclose(tracks.size[0], size)
    assert_allclose(tracks.posterior[0], [0.7 - rate * 0.3, 0.3 + rate * 0.3])
    assert tracks.hits.tolist() == [6, 2]
    assert tracks.missed.tolist() == [0, 1]
    assert tracks.last_topic.tolist() == [3, 0]
    assert tracks.seen_ns.tolist() == [5 * SECOND, before.seen_ns[1]]
    assert_allclose(tracks.position[1], before.position[1])


def test_cost_of_pair_is_sum_of_differences() -> None:
    """It adds the squared distance in gates, sizes, posteriors, and a penalty for young tracks."""
    found = tracker._seed(
        np.array([[0.13, -0.40, 0.86], [0.34, -0.15, 0.60]]),
        np.log([[0.21, 0.10, 0.05], [0.31, 0.12, 0.05]]),
        np.array([[0.4, 0.6], [0.2, 0.8]]),
    )
    costs = tracker._costs(two_tracks(), found, 4 * SECOND + 100_000_000, SETTINGS)

    gate = 0.03 + 0.5 * 0.14 + 0.3 * 0.1  # half the width, and a tenth of a second unseen
    away = np.sqrt(0.02**2 + 0.02**2 + 0.03**2)
    sizes = (np.log(0.21 / 0.14) + np.log(0.08 / 0.05)) / 3
    assert gate > SETTINGS.gate_m  # the largest gate
    assert costs[0, 0] == pytest.approx((away / 0.12) ** 2 + 0.8 * sizes + 0.5 * 0.3)
    assert np.isinf(costs[0, 1])
    assert np.isinf(costs[1]).all()  # 0.19 m below, and on the other side
    near = replace(SETTINGS, gate_m=0.3)
    young = tracker._costs(two_tracks(), found, 4 * SECOND + 100_000_000, near)
    limit = 0.03 + 0.5 * 0.31 + 0.3 * 0.03
    assert young[1, 1] == pytest.approx((0.19 / limit) ** 2 + 0.2)


def test_size_key_ignores_quarter_turn() -> None:
    """The two sides swap; the height does not, although it is between the two."""
    expected = np.log([0.20, 0.06, 0.13])  # each a centimetre longer

    assert_allclose(size_key(np.array([[0.05, 0.19, 0.12], [0.19, 0.05, 0.12]])), [expected] * 2)


@pytest.mark.parametrize(
    ("changes", "clock_s", "alive"),
    [
        # Confirmed and 4 s old: survives 4 s unseen. The other one is 1.07 s old.
        ({"missed": np.array([9, 9])}, 5.0, [4, 9]),
        ({"missed": np.array([9, 9])}, 5.2, [4]),
        ({"missed": np.array([9, 9])}, 7.9, [4]),
        ({"missed": np.array([9, 9])}, 8.1, []),
        # A late frame: missed once, or twice if it is not confirmed.
        ({"missed": np.array([0, 1])}, 60.0, [4, 9]),
        ({"missed": np.array([1, 2])}, 60.0, []),
        # Just born: half a second.
        ({"missed": np.array([9, 9]), "born_ns": np.array([4 * SECOND] * 2)}, 4.45, [4, 9]),
        ({"missed": np.array([9, 9]), "born_ns": np.array([4 * SECOND] * 2)}, 4.53, [9]),
    ],
)
def test_track_survives_unseen_as_long_as_it_was_seen(
    changes: dict[str, Any], clock_s: float, alive: list[int]
) -> None:
    following = Tracker(SETTINGS)
    following._clock_ns = round(clock_s * 1e9)

    assert following._survivors(two_tracks(**changes)).ids.tolist() == alive


# ---- fragments


def test_line_through_detections_is_ridge_regression() -> None:
    """Least squares with an additional row for zero velocity."""
    rng = np.random.default_rng(3)
    stamps = np.array([5.0, 5.1, 5.3, 5.32, 5.8])
    centers = rng.normal(size=(5, 3))
    hits = next(
        gather(
            frame(k, places, stamp_ns=round(stamps[k] * 1e9)) for k, places in enumerate(centers)
        )
    )
    for at in (0, -1):
        t = stamps - stamps[at]
        rows = np.column_stack([np.ones(5), t - t.mean()])
        design = np.vstack([rows, [0.0, np.sqrt(0.1)]])
        (mean, slope), *_ = np.linalg.lstsq(design, np.vstack([centers, np.zeros(3)]))
        place, velocity = _line(hits, np.arange(5), at)
        assert_allclose(velocity, slope, rtol=1e-6)
        assert_allclose(place, mean - t.mean() * slope, rtol=1e-6)


def test_needed_detections_depend_on_nearby_frames() -> None:
    """Nearby means within half a second on both sides and in the same scene."""
    stamps = np.array([0.0, 0.3, 0.45, 0.9, 2.0, 2.4, 2.6])
    frames = [frame(k, [], stamp_ns=round(s * 1e9)) for k, s in enumerate(stamps)]
    scenes = np.array([0, 0, 0, 1, 1, 1, 1])

    hits = next(gather(frames))
    one, two = (
        [_hits_to_confirm(hits, of_frames, row, 9) for row in range(len(frames))]
        for of_frames in (np.zeros_like(scenes), scenes)
    )

    assert one == [3, 3, 4, 2, 2, 3, 2]
    assert two == [3, 3, 3, 1, 2, 3, 2]
    assert _hits_to_confirm(hits, scenes, 2, 3) == 3
    assert _hits_to_confirm(hits, scenes, 1, 2) == 2


def test_fragment_summarises_its_detections() -> None:
    """The object enters the view cut off, moves on and stays whole."""
    places = [[[9.0, 9, 9], [0.1 * k, 0.02 * k, 0.7]] for k in range(4)]
    cut, lengths = [True, False, True, False], [0.13, 0.11, 0.16, 0.14]
    frames = [
        frame(k, place, partial=np.array([False, cut[k]]), sizes=np.full((2, 3), lengths[k]))
        for k, place in enumerate(places)
    ]
    hits = next(gather(frames))
    found = _describe(hits, [np.array([1, 3, 5]), np.array([7])], np.array([4, 4, 4, 5]))

    assert_allclose([found.first_ns, found.last_ns], [[0, 3e8], [2e8, 3e8]])
    assert found.cut.tolist() == [[True, True], [False, False]]
    assert _describe(hits, [np.array([1, 3])], np.zeros(4, int)).cut.tolist() == [[True, False]]
    assert found.whole_views.tolist() == [1, 1]
    assert found.scenes.tolist() == [4, 5]
    assert_allclose(found.sizes[:, 0], [0.11, 0.14], rtol=1e-6)  # of the whole views
    assert (found.start[0] < found.end[0])[:2].all()


def fragments(**changes: Any) -> Fragments:
    """Return a fragment and two later ones: one that moves, one that rests."""
    columns: dict[str, Any] = {
        "first_ns": np.array([0, 3 * SECOND, 30 * SECOND]),
        "last_ns": np.array([2 * SECOND, 9 * SECOND, 40 * SECOND]),
        "start": np.array([[0.0, 0.0, 0.0], [0.50, 0.2, 0.1], [0.9, -0.3, 0.4]]),
        "end": np.array([[0.4, 0.1, 0.1], [0.7, 0.3, 0.1], [0.9, -0.3, 0.5]]),
        "start_velocity": np.array([[0.0, 0, 0], [0.12, 0.06, 0.02], [0, 0, 0]]),
        "end_velocity": np.array([[0.1, 0.14, -0.04], [0, 0, 0], [0, 0, 0]]),
        "sizes": np.full((3, 3), 0.1),
        "whole_views": np.array([3, 9, 9]),
        "cut": np.zeros((3, 2), bool),
        "posteriors": np.full((3, 2), 0.5),
        "novelties": np.zeros(3),
        "scenes": np.zeros(3, int),
    }
    return Fragments(*(columns | changes).values())


def test_distance_of_fragments_is_shorter_of_two() -> None:
    """From end to start, or halfway along both motions."""
    found = _distances(fragments(), 0, np.array([1, 2]), SETTINGS)

    # Halfway through the second between them: (.45, .17, .08) and (.44, .17, .09).
    assert found[0] == pytest.approx(np.hypot(0.01, 0.01))
    # After 28 s a velocity means nothing.
    assert found[1] == pytest.approx(np.linalg.norm([0.5, -0.4, 0.3]))


@pytest.mark.parametrize(
    ("known", "others_known", "expected"),
    [
        (True, True, (0.4 + 0.3 + 0.1) / 3),
        (True, False, 0.3 / 3),  # the other one may be larger than it was seen
        (False, True, (0.4 + 0.1) / 3),
        (False, False, 0.0),
    ],
)
def test_partially_seen_object_may_be_larger(
    known: bool, others_known: bool, expected: float
) -> None:
    key, others = np.array([1.4, 1.0, 0.6]), np.array([[1.0, 1.3, 0.5]])
    found = _contradiction(key, others, np.array(known), np.array([others_known]))
    assert found == pytest.approx([expected])


# ---- several sensors


def test_frames_of_two_sensors_are_sorted_by_time() -> None:
    """The sensors are recorded one after the other; the frames of each one stay in order."""
    order = [
        ("/a", 0, [0.1, 0.2]),
        ("/a", 3, [0.3]),
        ("/b", 1, [0.5]),
        ("/b", 2, []),
        ("/b", 4, [0.7]),
    ]
    frames = [frame(k, [[x, 0, 1] for x in xs], topic=name) for name, k, xs in order]
    hits = next(gather(frames, ("/a", "/b")))

    assert hits.frames.tolist() == [0, 1, 2, 3, 4]
    assert [hits.names[k] for k in hits.topics] == ["/a", "/b", "/b", "/a", "/b"]
    assert hits.first.tolist() == [0, 2, 3, 3, 4, 5]
    assert_allclose(hits.centers[:, 0], [0.1, 0.2, 0.5, 0.3, 0.7])
    assert hits.rows.tolist() == [0, 0, 1, 3, 4]


def test_tracks_of_all_sensors_are_numbered_by_birth() -> None:
    """Users expect #1 to be the first object that appears."""
    late = [frame(k, [0.3, 0.1, 1.0], topic="/a") for k in range(5, 15)]
    early = [frame(k, [0.6, 0.2, 1.1], topic="/b") for k in range(10)]
    found = list(track_frames([*late, *early], SETTINGS))

    assert [(track.id, track.topic) for track in found] == [(1, "/b"), (2, "/a")]
    assert_allclose(found[0].centers[0], [0.6, 0.2, 1.1], atol=1e-6)


# ---- pieces


def turned_table() -> DetectionTable:
    """Return two detections in one frame whose boxes have different yaws."""
    other = Rotation.from_euler("z", 0.5).as_matrix() @ TURNED
    places = [[0.31, -0.12, 0.83], [0.42, -0.05, 0.79]]
    sizes = np.array([[0.12, 0.05, 0.2], [0.07, 0.16, 0.09]])
    turns = Rotation.from_matrix(np.stack([TURNED, other])).as_quat()
    return next(gather([frame(0, places, sizes=sizes, orientations=turns), frame(1, [])]))


def test_joint_box_encloses_corners_of_both_pieces() -> None:
    """The joint box has the axes of the first: longer side, shorter side, height."""
    hits = turned_table()
    signs = np.array(np.meshgrid(*[[-0.5, 0.5]] * 3)).reshape(3, -1).T
    axes = hits.axes(slice(None))
    corners = [
        hits.centers[k] + (signs * hits.sizes[k]) @ axes[k].T for k in range(2)
    ]  # of either box
    for i, j in ((0, 1), (1, 0)):
        lengths = np.ptp(np.concatenate(corners) @ axes[i], axis=0)
        expected = [*sorted(lengths[:2], reverse=True), lengths[2]]
        assert_allclose(_joint(hits, np.array([[i, j]])), [expected], rtol=1e-6)


def test_pieces_fit_into_whole_that_neither_fills() -> None:
    hits = turned_table()
    pair = np.array([[0, 1]])
    both = np.minimum(*(_joint(hits, each) for each in (pair, pair[:, ::-1])))[0]

    def fits(whole: F8, other: F8) -> bool:
        return bool(fit_pieces(hits, pair, np.array([[whole, other]]))[0])

    nothing = np.zeros(3)
    assert fits(both, nothing)
    assert fits(nothing, both)
    assert fits((both - 0.0099) / 1.1, nothing)
    assert not fits((both - 0.0101) / 1.1, nothing)
    assert not fits(both * [1, 1, 0.85], nothing)
    # One of them is as long, as wide and as high as the whole: something lies in a bowl.
    largest = np.array([0.16, 0.07, 0.2])
    assert not fits(np.maximum(largest, 0), nothing)


def test_larger_of_two_pieces_is_kept() -> None:
    """By volume: the longer one, or the first one, may be the smaller."""
    flat, cube = (0.21, 0.04, 0.05), (0.09, 0.08, 0.07)
    frames = [
        frame(0, [[0.1, 0.2, 0.3]] * 2, sizes=[flat, cube]),
        frame(1, [[0.1, 0.2, 0.3]] * 2, sizes=[cube, flat]),
        frame(2, [[0.1, 0.2, 0.3]], sizes=[flat]),
    ]

    assert _largest(next(gather(frames)), np.array([4, 0, 3, 1, 2])).tolist() == [1, 2, 4]


def test_point_in_box_is_tested_along_axes_of_box() -> None:
    hits = turned_table()
    (axes,) = hits.axes(slice(1))
    offsets = np.array([0.0599, -0.0249, 0.0999]) * [1, -1, -1]
    inside = hits.centers[0] + axes @ offsets
    outside = [hits.centers[0] + axes @ (offsets * k) for k in np.eye(3) * 0.01 + 1]

    assert _in_box(hits, np.array([0]), inside[None]).tolist() == [True]
    assert _in_box(hits, np.zeros(3, int), np.array(outside)).tolist() == [False] * 3


# ---- the common motion


def test_level_frame_is_upright_and_right_handed() -> None:
    turns = np.stack([TURNED, Rotation.from_euler("x", 0.02).as_matrix() @ TURNED])
    orientations = Rotation.from_matrix(turns).as_quat()
    level = _level(next(gather([frame(0, np.zeros((2, 3)), orientations=orientations)])))

    assert_allclose(level @ level.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(level) == pytest.approx(1)
    assert level[2] @ TURNED[:, 2] > 0.999


def test_rotation_in_plane_is_rotation_about_up() -> None:
    """It must move points in the plane, keep their heights, and turn boxes along with them."""
    tilts = np.random.default_rng(6).normal(size=(7, 3))
    tilted = Rotation.from_rotvec(tilts)
    turned = Rotation.from_matrix(TURNED[None]).as_quat()
    level = _level(next(gather([frame(0, [0.1, 0.2, 0.9], orientations=turned)])))
    turn, shift = np.exp(1j * np.array([0.4, -1.1])), np.array([0.3 - 0.2j, 0.05 + 0.7j])
    motion = _in_space(level, turn, shift)
    points = np.random.default_rng(5).normal(size=(7, 3))
    for k in range(2):
        flat = points @ level.T
        moved = turn[k] * (flat[:, 0] + 1j * flat[:, 1]) + shift[k]
        expected = np.column_stack([moved.real, moved.imag, flat[:, 2]]) @ level
        still = points @ motion.rotations[k].T + motion.translations[k]
        assert_allclose(still, expected, atol=1e-12)
        assert_allclose(motion.unstabilised(np.full(7, k), still), points, atol=1e-12)
        alone = CommonMotion(motion.rotations[k : k + 1], motion.translations[k : k + 1])
        boxes = frame(0, points, orientations=tilted.as_quat())
        back = alone.stabilised(next(gather([boxes])))
        assert_allclose(back.centers, expected, atol=1e-6)  # kept in single precision
        turns = (Rotation.from_matrix(motion.rotations[k]) * tilted).as_matrix()
        assert_allclose(back.axes(slice(None)), turns, atol=1e-6)


def test_rotation_and_shift_are_fitted_per_frame() -> None:
    """A frame with a single point keeps its transform; points of weight zero have no effect."""
    turn, shift = np.exp(0.6j), 0.2 - 0.5j
    seen = np.array([0.1 + 0.2j, -0.3 + 0.1j, 0.4 - 0.6j, 2.0 + 1.0j, 0.7 + 0.7j])
    still = turn * seen + shift
    still[3] += 5  # an outlier
    rows, weights = np.array([0, 0, 0, 0, 1]), np.array([1.0, 0.5, 2.0, 0.0, 1.0])
    kept = np.exp(1j * np.array([0.1, 0.2])), np.array([0.01j, 0.02])
    found_turn, found_shift = _fit(seen, still, rows, weights, *kept)

    assert_allclose(found_turn, [turn, kept[0][1]])
    assert_allclose(found_shift, [shift, kept[1][1]], atol=1e-12)
