"""Tests of the tracker, of stitching its tracks, and of fusing posteriors."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from shapecat.arrays import F8
from shapecat.config import TrackingSettings
from shapecat.tracking.association import assign, size_key
from shapecat.tracking.common_motion import find_common_motion
from shapecat.tracking.fusion import causal, fuse, fuse_novelty, view_weights
from shapecat.tracking.recording import _without_gaps
from shapecat.tracking.stitching import Fragments, merge_fragments, scene_cuts
from shapecat.tracking.tracker import Tracker
from tests.frame_detections import FrameDetections, frame, gather, track_frames

SETTINGS = TrackingSettings()
SECOND = 1_000_000_000
CUP, BOX = np.array([0.9, 0.1]), np.array([0.1, 0.9])


def step(tracker: Tracker, k: int, centers: ArrayLike, **options: Any) -> list[int]:
    one = frame(k, centers, **options)
    ids = tracker.step(one.stamp_ns, one.centers, one.sizes, one.posteriors)
    return [int(i) for i in ids]


def test_new_tracks_are_numbered_by_position() -> None:
    """Identities must not depend on the order in which a detector reports."""
    assert step(Tracker(SETTINGS), 0, [[0.5, 0, 0], [0.1, 0, 0], [0.3, 0, 0]]) == [3, 1, 2]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["hungarian", "greedy"]))
def test_result_does_not_depend_on_order_of_detections(seed: int, method: str) -> None:
    random = np.random.default_rng(seed)
    options = replace(SETTINGS, association=method)  # type: ignore[arg-type]  # one of the two
    plain, shuffled = Tracker(options), Tracker(options)
    for k in range(6):
        n = int(random.integers(0, 9))
        centers, sizes = random.uniform(0, 0.4, (n, 3)), random.uniform(0.03, 0.2, (n, 3))
        posteriors, order = random.dirichlet(np.ones(3), n), random.permutation(n)
        ids = plain.step(k * SECOND // 5, centers, sizes, posteriors)
        again = shuffled.step(k * SECOND // 5, centers[order], sizes[order], posteriors[order])
        assert ids[order].tolist() == again.tolist()
        assert len(set(ids.tolist())) == n


def test_fragment_beside_object_does_not_take_its_identity() -> None:
    tracker = Tracker(SETTINGS)
    for k in range(5):
        assert step(tracker, k, [0, 0, 0]) == [1]
    whole, fragment = tracker.step(
        SECOND // 2, [[0.005, 0, 0], [-0.02, 0, 0]], [[0.1] * 3, [0.03] * 3], [CUP, CUP]
    )
    assert (whole, fragment) == (1, 2)
    assert step(tracker, 6, [-0.01, 0, 0]) == [1]


def test_new_object_beside_missed_one_starts_new_track() -> None:
    """Assignment without a limit would give it to the missed object's track at any cost."""
    tracker = Tracker(SETTINGS)
    for k in range(5):
        step(tracker, k, [[0, 0, 0], [1, 0, 0]])
    other = {"size": (0.3, 0.02, 0.02), "posterior": BOX}
    assert step(tracker, 5, [0.07, 0, 0], **other) == [3]


def test_moving_object_is_tracked_through_occlusion() -> None:
    tracker = Tracker(SETTINGS)
    for k in range(20):
        step(tracker, k, [0.03 * k, 0, 0])
    for k in range(20, 26):
        step(tracker, k, [])
    assert step(tracker, 26, [0.03 * 26, 0, 0]) == [1]


def test_ended_tracks_are_discarded() -> None:
    tracker = Tracker(SETTINGS)
    for k in range(300):
        step(tracker, k, [k // 10, 0, 0])
    assert tracker._active is not None
    assert len(tracker._active.ids) < 10
    assert step(tracker, 2000, [5, 0, 0]) == [31]


def test_late_frame_does_not_end_track() -> None:
    """Frames of time-lapse recordings are farther apart than any timeout."""
    tracker = Tracker(SETTINGS)
    assert [step(tracker, k, [0, 0, 0], stamp_ns=k * 60 * SECOND) for k in range(4)] == [[1]] * 4


def test_backward_clock_jump_starts_new_tracks_but_jitter_does_not() -> None:
    tracker = Tracker(SETTINGS)
    stamps = [100 * SECOND, 101 * SECOND, 100 * SECOND, 50 * SECOND]
    ids = [step(tracker, k, [0, 0, 0], stamp_ns=s)[0] for k, s in enumerate(stamps)]
    assert ids == [1, 1, 1, 2]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_non_finite_centre_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        step(Tracker(SETTINGS), 0, [bad, 0, 0])


def test_empty_frames_may_lack_categories() -> None:
    tracker = Tracker(SETTINGS)
    assert tracker.step(0, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0))).size == 0
    assert step(tracker, 1, [0, 0, 0]) == [1]
    assert tracker.step(SECOND, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0))).size == 0
    assert step(tracker, 11, [0, 0, 0]) == [1]


def test_hungarian_minimizes_total_and_greedy_takes_best_pair() -> None:
    costs = np.array([[0.1, 0.2], [0.2, 0.9]])
    assert assign(costs, 1.0, "hungarian").tolist() == [[0, 1], [1, 0]]
    assert assign(costs, 1.0, "greedy").tolist() == [[0, 0], [1, 1]]
    assert assign(costs, 0.5, "greedy").tolist() == [[0, 0]]
    assert assign(np.full((2, 2), np.inf), 1.0, "hungarian").shape == (0, 2)


def test_recording_of_unrelated_frames_keeps_every_detection() -> None:
    """Stamps are a second apart, and each frame has other objects at the same places."""
    random = np.random.default_rng(4)
    frames = [
        FrameDetections(
            "/depth",
            k,
            k * SECOND,
            np.arange(4),
            np.column_stack([np.arange(4) * 0.12 + random.normal(0, 0.03, 4), np.zeros((4, 2))]),
            random.uniform(0.03, 0.25, (4, 3)),
            random.dirichlet(np.full(7, 0.2), 4),
            np.zeros(4, bool),
            np.zeros(4),
        )
        for k in range(30)
    ]
    tracks = tuple(track_frames(frames, SETTINGS))
    assert sum(track.hits for track in tracks) == 120
    assert len(tracks) >= 115
    assert scene_cuts(next(gather(frames)), SETTINGS)[1:].mean() > 0.9


def test_recording_may_have_one_frame_or_none() -> None:
    tracks = track_frames([frame(0, [[0, 0, 0], [1, 0, 0]])], SETTINGS)
    assert [track.id for track in tracks] == [1, 2]
    assert list(track_frames([], SETTINGS)) == []
    assert list(track_frames([frame(0, []), frame(1, [])], SETTINGS)) == []


def cameras(count: int, *, frames: int, apart: float) -> list[FrameDetections]:
    """Return the frames of cameras that take turns; each sees two objects of its own.

    The objects of one camera are ``apart`` metres from those of the next.
    """
    random, stamp = np.random.default_rng(3), 0
    found = []
    for k in range(frames):
        for camera in range(count):
            places = np.array([[camera * apart, y, 0.05] for y in (0.0, 0.7)])
            sizes = np.array([[0.05, 0.05, 0.1], [0.2, 0.2, 0.05]]) * (1 + camera)
            posteriors = np.eye(7)[[(2 * camera) % 7, (2 * camera + 1) % 7]] * 0.9 + 0.1 / 7
            noisy = places + random.normal(0, 0.002, places.shape)
            columns = (np.arange(2), noisy, sizes, posteriors, np.zeros(2, bool), np.zeros(2))
            found.append(FrameDetections(f"/cam{camera}", k, stamp, *columns))
            stamp += SECOND // 60
    return found


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_cameras_that_see_different_objects_are_not_scene_cuts(count: int) -> None:
    """If cameras take turns, consecutive frames show different objects without a scene cut."""
    frames = cameras(count, frames=30, apart=0.15)
    together = {frame.topic for frame in frames}
    (hits,) = gather(frames, together)

    assert not scene_cuts(hits, SETTINGS).any()
    tracks = list(track_frames(frames, SETTINGS, together=together))
    assert [track.hits for track in tracks] == [30] * (2 * count)


def test_frames_of_fast_camera_do_not_end_tracks_of_slow_one() -> None:
    """Each deviating view of a camera with one image per second would get its own track."""
    fast = [frame(k, [0, 0, 0], topic="/fast") for k in range(200)]
    slow = [
        frame(k, [1, 0, 0], stamp_ns=k * SECOND + 7, posterior=BOX if k % 4 == 2 else CUP)
        for k in range(20)
    ]
    tracks = track_frames([*fast, *slow], SETTINGS, together={"/fast", "/depth"})

    assert [track.hits for track in tracks] == [200, 20]


@pytest.mark.parametrize("frames", [1, 2])
def test_single_images_of_several_cameras_keep_every_detection(frames: int) -> None:
    """Images of other cameras must not count as missed chances to confirm an object."""
    found = cameras(3, frames=frames, apart=0.6)
    tracks = track_frames(found, SETTINGS, together={frame.topic for frame in found})

    assert sum(track.hits for track in tracks) == 6 * frames


def test_false_detection_gets_no_track() -> None:
    frames = [frame(k, [[0, 0, 0], [0.5, 0, 0]] if k == 7 else [0, 0, 0]) for k in range(20)]
    (track,) = track_frames(frames, SETTINGS)
    assert track.hits == 20


def test_one_bad_frame_is_not_a_scene_cut() -> None:
    """One frame with all objects missed and two false ones must not break the tracks."""
    places = [[0, 0, 0], [0.3, 0, 0]]
    frames = [frame(k, [[0.1, 0.1, 0], [0.2, 0.1, 0]] if k == 9 else places) for k in range(20)]
    assert not scene_cuts(next(gather(frames)), SETTINGS).any()
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [19, 19]


def test_one_of_two_objects_moved_is_not_a_scene_cut() -> None:
    """At one image per second, a cut would give the object that stayed a new track."""
    places = [[[0, 0, 0], [0.4, 0, 0]]] * 5 + [[[0, 0, 0], [0.4, 0.2, 0]]] * 5
    frames = [frame(k, both, stamp_ns=k * SECOND) for k, both in enumerate(places)]

    assert not scene_cuts(next(gather(frames)), SETTINGS).any()


@pytest.mark.parametrize("step_m", [0.06, 0.09])
def test_objects_that_move_together_are_not_a_scene_cut(step_m: float) -> None:
    """On a belt, at two images per second, each object would get a new track in each image."""
    random = np.random.default_rng(6)
    frames = []
    for k in range(12):
        along = np.arange(-12, 12) * 0.25 + k * step_m
        places = np.column_stack([along, np.zeros((24, 2))])[np.abs(along) < 0.6]
        noise = random.normal(0, 0.004, places.shape)
        frames.append(frame(k, places + noise, stamp_ns=k * SECOND // 2))

    assert not scene_cuts(next(gather(frames)), SETTINGS).any()
    places_of_tracks = [
        track.centers[:, 0] - step_m / 0.5 * track.stamps_ns / SECOND
        for track in track_frames(frames, SETTINGS)
    ]
    assert max(np.ptp(places) for places in places_of_tracks) < 0.05
    assert len(places_of_tracks) >= 6


def test_unrelated_images_of_equal_objects_are_scene_cuts() -> None:
    """Among many equal objects, some always seem to have moved together."""
    random = np.random.default_rng(6)
    grid = np.array([[x, y, 0.0] for x in (0.0, 0.22, 0.44) for y in (0.0, 0.22)])
    frames = [
        frame(k, grid + random.uniform(-0.1, 0.1, (6, 3)) * [1, 1, 0], stamp_ns=k * SECOND)
        for k in range(20)
    ]
    assert scene_cuts(next(gather(frames)), SETTINGS)[1:].mean() > 0.8


def test_scene_cut_seen_by_two_cameras_is_one() -> None:
    """Counted twice, it would leave a scene of one image, in which any detection is confirmed."""
    frames = []
    for k in range(8):
        look: Any = {"posterior": CUP} if k < 4 else {"size": (0.3, 0.2, 0.04), "posterior": BOX}
        for topic, y, late in (("/left", 0.0, 0), ("/right", 1.0, SECOND // 20)):
            stamp = k * SECOND // 10 + late
            places = [[0.04 * (k > 3), y, 0], [0.4 + 0.03 * (k > 3), y, 0]]
            frames.append(frame(k, places, stamp_ns=stamp, topic=topic, **look))
    (hits,) = gather(frames, {"/left", "/right"})

    assert np.flatnonzero(scene_cuts(hits, SETTINGS)).tolist() == [8]


def test_takes_joined_without_a_pause_are_a_scene_cut() -> None:
    """Between two frames at full rate, all objects are exchanged for others."""
    before, after = [[0, 0, 0], [0.4, 0, 0]], [[0.05, 0.02, 0], [0.43, -0.04, 0]]
    frames = [frame(k, before) for k in range(10)]
    frames += [frame(k, after, size=(0.3, 0.2, 0.04), posterior=BOX) for k in range(10, 20)]

    assert np.flatnonzero(scene_cuts(next(gather(frames)), SETTINGS)).tolist() == [10]
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [10, 10, 10, 10]


def test_short_gap_is_interpolated_and_long_gap_is_left_out() -> None:
    places = {k: [0.01 * min(k, 14), 0, 0] for k in [*range(10), 14, *range(101, 110)]}
    (track,) = track_frames([frame(k, places.get(k, [])) for k in range(110)], SETTINGS)
    assert track.detections[9:15].tolist() == [0, -1, -1, -1, -1, 0]
    assert track.centers[12, 0] == pytest.approx(0.12)
    assert track.frames[14:17].tolist() == [14, 101, 102]
    assert track.hits == 20


def test_track_ends_at_its_last_detection() -> None:
    """Otherwise the last position, and those in a gap before it, would repeat an earlier one."""
    frames = [frame(k, [] if 12 <= k < 15 else [[0.01 * k, 0, 0]]) for k in range(16)]
    (track,) = track_frames(frames, SETTINGS)
    assert track.detections[11:].tolist() == [0, -1, -1, -1, 0]
    assert track.centers[:, 0] == pytest.approx(0.01 * np.arange(16))


def test_causal_posterior_in_gap_ignores_later_views() -> None:
    """A view after the gap must not affect rows within the gap."""
    views = {0: CUP, 1: CUP, 2: CUP, 6: BOX, 7: BOX}
    frames = [
        frame(k, [[0, 0, 0]] if k in views else [], posterior=views.get(k, CUP)) for k in range(8)
    ]
    (track,) = track_frames(frames, SETTINGS)
    assert track.detections[3:6].tolist() == [-1, -1, -1]
    assert np.allclose(track.causal[2:6], CUP)
    assert track.causal[6, 0] < 0.9


def test_object_returning_to_its_place_keeps_its_track() -> None:
    """It is out of view longer than any timeout; only stitching can join its tracks."""
    frames = [frame(k, [0, 0, 0] if k < 20 or k >= 200 else [2, 0, 0]) for k in range(220)]
    tracks = tuple(track_frames(frames, SETTINGS))
    assert [track.hits for track in tracks] == [40, 180]


def test_repeatedly_hidden_object_is_one_track() -> None:
    """Its four fragments are stitched in a chain."""
    frames = [frame(k, [] if k // 50 % 2 else [0, 0, 0]) for k in range(350)]
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [200]


@pytest.mark.parametrize(
    ("options", "joined"),
    [
        ({}, True),
        ({"start": [[0, 0, 0], [0.3, 0, 0]]}, False),
        ({"sizes": [[0.1, 0.1, 0.1], [0.3, 0.3, 0.3]]}, False),
        ({"posteriors": [[1, 0], [0, 1]]}, False),
        ({"scenes": [0, 1]}, False),
        (
            {"sizes": [[0.1, 0.1, 0.1], [0.2, 0.2, 0.1]], "whole_views": [3, 20]},
            True,
        ),  # seen partially
        (
            {"sizes": [[0.2, 0.2, 0.1], [0.1, 0.1, 0.1]], "whole_views": [3, 20]},
            False,
        ),  # but larger
        ({"posteriors": [[1, 0], [0, 1]], "whole_views": [0, 20]}, True),  # partial views vary
        ({"posteriors": [[1, 0], [0, 1]], "novelties": [0.5, 1.2]}, True),  # so do unknowns
        (
            {"posteriors": [[1, 0], [0.3, 0.7]], "whole_views": [20, 3]},
            True,
        ),  # at the same position
        (  # but larger than the whole one
            {
                "posteriors": [[1, 0], [0.3, 0.7]],
                "whole_views": [20, 3],
                "sizes": [[0.1, 0.1, 0.1], [0.16, 0.1, 0.1]],
            },
            False,
        ),
        ({"posteriors": [[1, 0], [0.3, 0.7]]}, False),
        (
            {
                "posteriors": [[1, 0], [0.3, 0.7]],
                "whole_views": [20, 3],
                "start": [[0, 0, 0], [0.05, 0, 0]],
            },
            False,
        ),
        ({"start": [[0, 0, 0], [0.15, 0, 0]], "first_ns": [0, 3 * SECOND]}, False),  # too far
        (  # behind something on one side, and out on the other
            {
                "start": [[0, 0, 0], [0.15, 0, 0]],
                "first_ns": [0, 3 * SECOND],
                "cut": [[False, True], [True, False]],
            },
            True,
        ),
        (  # farther than its size
            {
                "start": [[0, 0, 0], [0.25, 0, 0]],
                "first_ns": [0, 3 * SECOND],
                "cut": [[False, True], [True, False]],
            },
            False,
        ),
        ({"first_ns": [0, SECOND]}, False),  # the first one lasts until 2 s: they overlap
    ],
)
def test_contradicting_fragments_are_not_joined(options: dict[str, Any], joined: bool) -> None:
    columns: dict[str, Any] = {
        "first_ns": [0, 20 * SECOND],
        "last_ns": [2 * SECOND, 30 * SECOND],
        "start": np.zeros((2, 3)),
        "end": np.zeros((2, 3)),
        "start_velocity": np.zeros((2, 3)),
        "end_velocity": np.zeros((2, 3)),
        "sizes": np.full((2, 3), 0.1),
        "whole_views": [20, 20],
        "posteriors": [[0.8, 0.2], [0.7, 0.3]],
        "cut": [[False, False], [False, False]],
        "novelties": [0.5, 0.5],
        "scenes": [0, 0],
    }
    fragments = Fragments(**(columns | options))
    assert merge_fragments(fragments, SETTINGS).tolist() == ([0, 0] if joined else [0, 1])


def test_one_wrong_view_does_not_prevent_stitching() -> None:
    """Objects enter the view partly visible, and may be split once they are whole."""
    cup, other = np.array([0.999, 0.001]), np.array([0.05, 0.95])
    before = [frame(k, [0, 0, 0], posterior=cup) for k in range(20)]
    absent = [frame(k, []) for k in range(20, 100)]
    cut = [frame(k, [0, 0, 0], posterior=cup) for k in range(100, 103)]
    partial_views = [replace(seen, partial=np.ones(1, bool)) for seen in cut]
    whole = frame(103, [0, 0, 0], posterior=other)
    tracks = tuple(track_frames([*before, *absent, *partial_views, whole], SETTINGS))
    assert [track.hits for track in tracks] == [24]


def test_streams_are_tracked_separately_and_numbered_together() -> None:
    frames = [frame(k, [0, 0, 0], topic=topic) for k in range(5) for topic in ("/a", "/b")]
    tracks = tuple(track_frames(frames, SETTINGS))
    assert [(track.id, track.topic, track.hits) for track in tracks] == [(1, "/a", 5), (2, "/b", 5)]


def test_tracks_of_long_recording_stay_whole() -> None:
    """Noise over hundreds of frames must not break a track of an object at rest."""
    random = np.random.default_rng(0)
    places = np.column_stack([np.arange(6) * 0.2, np.zeros((6, 2))])
    frames = [frame(k, places + random.normal(0, 0.01, (6, 3))) for k in range(400)]
    tracks = tuple(track_frames(frames, SETTINGS))
    assert [track.hits for track in tracks] == [400] * 6


VIEWS = st.integers(0, 2**32 - 1).map(
    lambda seed: np.random.default_rng(seed).dirichlet(np.full(4, 0.3), 1 + seed % 9)
)


@settings(max_examples=40, deadline=None)
@given(VIEWS, st.sampled_from(["mean", "product", "vote"]))
def test_causal_posteriors_are_fusions_of_all_prefixes(views: F8, method: str) -> None:
    running = causal(views, method)  # type: ignore[arg-type]  # one of the three
    assert np.allclose(running.sum(axis=1), 1)
    for k in range(len(views)):
        assert np.allclose(running[k], fuse(views[: k + 1], method))  # type: ignore[arg-type]  # the same


def test_fusion_does_not_depend_on_block_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the third block on, about an hour, early views could count twice."""
    views = np.random.default_rng(0).dirichlet(np.full(4, 0.3), 7)
    whole = causal(views)
    monkeypatch.setattr("shapecat.tracking.fusion._BLOCK", 2)

    assert np.allclose(causal(views), whole)


@pytest.mark.parametrize("method", ["mean", "product", "vote"])
def test_equal_views_do_not_sharpen_posterior(method: str) -> None:
    """Views of one placement share their errors: thirty equal ones count as one."""
    single = fuse([[0.6, 0.4]], method)  # type: ignore[arg-type]  # one of the three
    assert np.allclose(fuse([[0.6, 0.4]] * 30, method), single)  # type: ignore[arg-type]  # the same


def test_fusion_uses_weights_and_no_view_has_a_veto() -> None:
    assert fuse([[1, 0], [0, 1]], "mean", weights=[3, 1]).tolist() == [0.75, 0.25]
    assert fuse([[0.0, 1.0], *[[0.95, 0.05]] * 9], "product")[0] > 0.5
    with pytest.raises(ValueError, match="at least one view"):
        fuse(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="unknown fusion method"):
        fuse([[1.0]], "sum")  # type: ignore[arg-type]  # under test


def test_fused_novelty_tolerates_scatter_and_partial_views() -> None:
    """Known objects whose novelty scatters around the limit must not become unknown."""
    assert fuse_novelty([1.05], [1.0]) == pytest.approx(1.05)
    assert fuse_novelty([1.05] * 9, [1.0] * 9) < 1 < fuse_novelty([1.1] * 9, [1.0] * 9)
    assert fuse_novelty([0.5, 2.0], view_weights(np.array([False, True]))) < 1
    # A whole view, a partial one, and one that repeats another: 1.25 views by weight.
    mean, limit = (1.2 + 0.25 * 0.9) / 1.25, 1 + 0.08 * (1 - 1 / 1.25)
    assert fuse_novelty([1.2, 0.9, 0.7], [1.0, 0.25, 0.0]) == pytest.approx(mean / limit)


def boxed(frames: list[list[tuple[float, float]]]) -> list[FrameDetections]:
    """Return frames of upright boxes 0.1 m deep and high, each from one x to another."""
    found = []
    for k, spans in enumerate(frames):
        middle = [[(a + b) / 2, 0, 0] for a, b in spans]
        size = [[b - a, 0.1, 0.1] for a, b in spans]
        found.append(frame(k, middle, size=size))
    return found


def test_fragments_of_repeatedly_split_object_get_no_tracks() -> None:
    whole, split = [(0.0, 0.2)], [(0.0, 0.12), (0.12, 0.2)]
    tracks = tuple(track_frames(boxed(([whole] * 3 + [split] * 3) * 6), SETTINGS))
    assert [track.hits for track in tracks] == [36]


def test_object_that_is_mostly_split_is_one_track() -> None:
    """Its size is known from the minority of frames that show it whole."""
    whole, split = [(0.0, 0.2)], [(0.0, 0.12), (0.12, 0.2)]
    tracks = tuple(track_frames(boxed(([whole] * 3 + [split] * 7) * 4), SETTINGS))
    assert [track.hits for track in tracks] == [40]


def test_burst_of_splits_gets_no_track() -> None:
    """The fragment is never missed while the burst lasts; only other frames reveal it."""
    whole, split = [(0.0, 0.2)], [(0.0, 0.12), (0.12, 0.2)]
    tracks = tuple(track_frames(boxed([whole] * 20 + [split] * 6 + [whole] * 20), SETTINGS))
    assert [track.hits for track in tracks] == [46]


def test_pieces_are_joined_after_hours(monkeypatch: pytest.MonkeyPatch) -> None:
    """Detections are compared in blocks; later blocks must not be mistaken for the first."""
    monkeypatch.setattr("shapecat.tracking.detection_table._BLOCK", 8)
    other = (1.0, 1.1)
    whole, split = [(0.0, 0.2), other], [(0.0, 0.08), (0.08, 0.2), other]
    frames = boxed([[other]] * 20 + [split] * 12 + [whole] * 30)
    assert sorted(track.hits for track in track_frames(frames, SETTINGS)) == [42, 62]


@pytest.mark.parametrize("before", [20, 2])
def test_piece_that_stands_out_of_its_object_gets_no_track(before: int) -> None:
    """With the piece, the object would be too large, but it encloses the centre of the piece."""
    whole, split = [(0.0, 0.2)], [(0.0, 0.2), (0.13, 0.25)]
    frames = boxed([whole] * before + [split] * 6 + [whole] * 20)
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [before + 26]


def test_neighbours_merged_in_some_frames_stay_two_tracks() -> None:
    one, two = [(0.0, 0.2)], [(0.0, 0.1), (0.1, 0.2)]
    tracks = tuple(track_frames(boxed(([two] * 9 + [one]) * 4), SETTINGS))
    assert [track.hits for track in tracks][1] >= 36
    assert len(tracks) == 2


def test_objects_merged_by_one_sensor_stay_two_tracks() -> None:
    one, two = boxed([[(0.0, 0.2)]])[0], boxed([[(0.0, 0.1), (0.1, 0.2)]])[0]
    frames = [
        replace(seen, topic=topic, frame=k, stamp_ns=k * SECOND // 10 + delay_ns)
        for k in range(20)
        for topic, seen, delay_ns in (("/a", two, 0), ("/b", one, 5))
    ]
    tracks = tuple(track_frames(frames, SETTINGS, together={"/a", "/b"}))
    assert len(tracks) == 2
    assert min(track.hits for track in tracks) >= 20


@pytest.mark.parametrize("count", [4, 8])
def test_object_put_into_bowl_gets_own_track(count: int) -> None:
    """Objects that are added just before the recording ends must not be taken for pieces."""
    bowl, filled = [(0.0, 0.2)], [(0.0, 0.2), (0.1, 0.16)]
    tracks = tuple(track_frames(boxed([bowl] * 30 + [filled] * count), SETTINGS))
    assert sorted(track.hits for track in tracks) == [count, 30 + count]


def test_object_in_bowl_keeps_its_track_if_it_is_missed_once() -> None:
    """One more frame that shows only the bowl there must not discard all of its detections."""
    bowl, filled = [(0.0, 0.2)], [(0.0, 0.2), (0.1, 0.16)]
    frames = [bowl] * 30 + [filled] * 4 + [bowl] + [filled] * 4
    tracks = tuple(track_frames(boxed(frames), SETTINGS))
    assert sorted(track.hits for track in tracks) == [8, 39]


def test_object_in_bowl_whose_size_varies_keeps_its_track() -> None:
    """In every other frame the far rim is missing, so that the bowl is smaller than it was."""
    small, bowl, inside = (0.0, 0.18), (0.0, 0.2), (0.1, 0.16)
    tracks = track_frames(boxed([[small, inside], [bowl, inside]] * 15), SETTINGS)
    assert [track.hits for track in tracks] == [30, 30]


def test_object_put_onto_plate_on_tray_gets_own_track() -> None:
    """Plate and tray enclose its place only in earlier frames, but that of a piece later, too."""
    empty = [(0.0, 0.4), (0.08, 0.26)]
    tracks = track_frames(boxed([empty] * 30 + [[*empty, (0.1, 0.16)]] * 8), SETTINGS)
    assert sorted(track.hits for track in tracks) == [8, 38, 38]


def test_object_entering_view_in_fragments_is_one_track() -> None:
    """Only the later size of the object shows that the first detections are fragments."""
    whole, split = [(0.0, 0.2)], [(0.0, 0.08), (0.08, 0.2)]
    tracks = tuple(track_frames(boxed([split] * 12 + [whole] * 30), SETTINGS))
    assert [track.hits for track in tracks] == [42]


def test_object_reappearing_after_gap_may_be_another() -> None:
    """A track survives 0.8 s unseen; all of its views decide whether it came back."""
    before = [frame(k, [0, 0, 0], posterior=CUP) for k in range(20)]
    after = [frame(k, [0.02, 0, 0], posterior=BOX, size=(0.14, 0.14, 0.1)) for k in range(28, 50)]
    tracks = tuple(
        track_frames([*before, *(frame(k, []) for k in range(20, 28)), *after], SETTINGS)
    )
    assert [track.hits for track in tracks] == [20, 22]


def turning(*, speed: float, hidden: range, frames: int = 80) -> list[FrameDetections]:
    """Return a table that rotates at ``speed`` rad/s; one object is hidden for some frames."""
    random = np.random.default_rng(1)
    angle, radius = np.array([0.0, 1.3, 2.4, 3.9, 5.2]), np.array([0.3, 0.2, 0.35, 0.25, 0.3])
    found = []
    for k in range(frames):
        turned = angle + speed * k / 10
        places = np.column_stack([radius * np.cos(turned), radius * np.sin(turned), 0 * angle])
        places += random.normal(0, 0.004, places.shape)
        visible = [i for i in range(5) if i != 0 or k not in hidden]
        found.append(frame(k, places[visible]))
    return found


def test_hidden_object_on_turntable_keeps_its_track() -> None:
    """Only the other objects show how far it moves: the table turns by 1.2 rad, which is 35 cm."""
    frames = turning(speed=0.4, hidden=range(25, 55))
    tracks = tuple(track_frames(frames, SETTINGS))
    assert sorted(track.hits for track in tracks) == [50, 80, 80, 80, 80]
    interrupted = next(track for track in tracks if track.hits == 50)
    radius = np.linalg.norm(interrupted.centers[:, :2], axis=1)
    assert radius == pytest.approx(0.3, abs=0.02)  # interpolated along the rotation


@pytest.mark.parametrize("speed", [-0.4, 0.4])
def test_common_motion_stabilises_detections_and_can_be_inverted(speed: float) -> None:
    frames = turning(speed=speed, hidden=range(0))
    hits = next(gather(frames))
    motion = find_common_motion(hits, [np.arange(k, 400, 5) for k in range(5)])
    assert motion is not None
    still = motion.stabilised(hits).centers.reshape(80, 5, 3)
    assert still.std(axis=0).max() < 0.01
    back = motion.unstabilised(hits.rows, still.reshape(-1, 3))
    assert back == pytest.approx(hits.centers, abs=1e-6)


def test_objects_at_rest_or_moving_independently_have_no_common_motion() -> None:
    members = [np.arange(k, 400, 5) for k in range(5)]
    assert find_common_motion(next(gather(turning(speed=0.0, hidden=range(0)))), members) is None
    random = np.random.default_rng(2)
    velocities = random.normal(0, 0.1, (5, 3)) * [1, 1, 0]
    apart = [frame(k, np.arange(5)[:, None] * 0.5 + velocities * k / 10) for k in range(80)]
    assert find_common_motion(next(gather(apart)), members) is None


def test_backward_clock_jump_is_scene_cut() -> None:
    """Two sessions in one recording, the second with earlier stamps, must not share tracks."""
    stamps = [*range(100, 105), *range(50, 55)]
    frames = [frame(k, [0, 0, 0], stamp_ns=s * SECOND // 5) for k, s in enumerate(stamps)]
    assert scene_cuts(next(gather(frames)), SETTINGS).tolist() == [k == 5 for k in range(10)]
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [5, 5]


def test_late_message_is_not_a_scene_cut() -> None:
    """A message that arrives after a newer one must not end the tracks of all objects."""
    stamps = [*range(20), 21, 20, *range(22, 40)]
    frames = [frame(k, [0, 0, 0], stamp_ns=s * SECOND // 10) for k, s in enumerate(stamps)]
    assert not scene_cuts(next(gather(frames)), SETTINGS).any()
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [40]


def test_late_messages_of_one_sensor_do_not_put_it_behind_the_other() -> None:
    """All its later frames would be placed after the last frame of the other sensor."""
    late = [*range(10), 12, 13, 10, 11, *range(14, 60)]
    frames = [
        frame(k, [0, 0, 0], stamp_ns=(s * SECOND + half) // 10, topic=topic)
        for topic, stamps, half in (("/a", range(60), 0), ("/b", late, SECOND // 2))
        for k, s in enumerate(stamps)
    ]
    (track,) = track_frames(frames, SETTINGS, together={"/a", "/b"})
    assert track.hits == 120
    assert np.diff(track.stamps_ns).min() >= -3 * SECOND // 10


@pytest.mark.parametrize("wrong", [20, 0, 1, 48, 49])
@pytest.mark.parametrize("sensor", ["/a", "/b"])
@pytest.mark.parametrize("ahead_s", [3, -5])
def test_single_odd_stamp_does_not_put_a_sensor_behind_the_other(
    wrong: int, sensor: str, ahead_s: int
) -> None:
    """Taken for a clock that was set back, it would divide the tracks of both sensors."""
    frames = [
        frame(k, [0, 0, 0], stamp_ns=k * SECOND // 10 + after_ns + odd_s * SECOND, topic=topic)
        for topic, after_ns in (("/a", 0), ("/b", SECOND // 30))
        for k in range(50)
        for odd_s in [ahead_s * (k == wrong and topic == sensor)]
    ]
    assert [track.hits for track in track_frames(frames, SETTINGS, together={"/a", "/b"})] == [100]


@pytest.mark.parametrize("single", [False, True])
def test_two_sensors_share_tracks_despite_clock_jump(single: bool) -> None:
    """Even after a single wrong stamp, neither sensor may lag behind."""
    frames = []
    for k in range(40):
        for topic, delay_ns in (("/a", 0), ("/b", SECOND // 30)):
            wrong = (k == 20 and topic == "/b") if single else k >= 20
            stamp = k * SECOND // 10 + delay_ns - (1000 * SECOND if wrong else 0)
            frames.append(frame(k, [0, 0, 0], stamp_ns=stamp, topic=topic))
    tracks = tuple(track_frames(frames, SETTINGS, together={"/a", "/b"}))
    assert [track.hits for track in tracks] == [40, 40]
    assert all(track.topics.count("/b") == 20 for track in tracks)


@pytest.mark.parametrize("per_s", [10, 2])
def test_scraps_at_image_border_are_not_a_scene_cut(per_s: int) -> None:
    """When a camera pans away or back, only an edge of the last or first object is visible."""
    whole, scrap = (0.08, 0.07, 0.07), (0.04, 0.02, 0.07)
    sizes = [whole] * 10 + [scrap] + [None] * 20 + [scrap] + [whole] * 10
    frames = [
        replace(
            frame(k, [] if size is None else [0, 0, 0], size=size or whole),
            stamp_ns=k * SECOND // per_s,
            partial=np.full(int(size is not None), size == scrap),
        )
        for k, size in enumerate(sizes)
    ]
    assert not scene_cuts(next(gather(frames)), SETTINGS).any()
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [22]


def test_slow_views_past_an_occluder_are_not_a_scene_cut() -> None:
    """A camera that moves on between two frames may see only parts of all objects."""
    places = np.arange(3)[:, None] * [0.4, 0, 0]
    whole = [frame(k, places, stamp_ns=k * SECOND) for k in range(3)]
    parts = [
        replace(
            frame(k, places + np.array([0.05, 0, 0]), posterior=0.25 * CUP + 0.75 * BOX),
            stamp_ns=k * SECOND,
            partial=np.ones(3, np.bool_),
        )
        for k in range(3, 6)
    ]
    assert not scene_cuts(next(gather([*whole, *parts])), SETTINGS).any()


def test_gap_is_interpolated_in_time_not_frames() -> None:
    """A robot that drops a second of frames would otherwise place the object halfway."""
    seconds = [*np.arange(11) / 10, 1.8, *np.arange(20, 30) / 10]
    frames = [
        frame(k, [] if s == 1.8 else [0.2 * s, 0.0, 0.1], stamp_ns=round(s * SECOND))
        for k, s in enumerate(seconds)
    ]
    (track,) = track_frames(frames, SETTINGS)
    assert track.detections[11] == -1
    np.testing.assert_allclose(track.centers[:, 0], 0.2 * np.array(seconds), atol=1e-6)


def test_unlimited_timeout_is_allowed() -> None:
    """A time beyond 64 bits of nanoseconds must not end in an error."""
    frames = [frame(k, [0, 0, 0] if k % 20 < 10 else []) for k in range(60)]
    (track,) = track_frames(frames, replace(SETTINGS, max_missed_s=1e12))
    assert track.hits == 30


def test_partial_view_changes_its_track_less() -> None:
    """A partial view is off-centre and too small."""

    def after(*, partial: bool) -> Any:
        tracker = Tracker(SETTINGS)
        for k in range(5):
            found = frame(k, [[0.0, 0, 0]])
            tracker.step(found.stamp_ns, found.centers, found.sizes, found.posteriors)
        found = frame(5, [[0.02, 0, 0]], size=(0.08, 0.08, 0.1), posterior=BOX)
        cut = np.array([partial])
        tracker.step(found.stamp_ns, found.centers, found.sizes, found.posteriors, partial=cut)
        assert tracker._active is not None
        return tracker._active

    whole, cut = after(partial=False), after(partial=True)
    assert 0 < cut.position[0, 0] < 0.8 * whole.position[0, 0]
    for name in ("size", "posterior"):
        before = size_key(frame(0, [0, 0, 0]).sizes) if name == "size" else CUP[None]
        moved = [np.abs(getattr(tracks, name) - before).max() for tracks in (whole, cut)]
        assert moved[1] == pytest.approx(0.25 * moved[0], rel=1e-5)


def test_posterior_after_each_view_uses_fusion_of_settings() -> None:
    """The last posterior must be that of the track, in the report and in the table."""
    views = [np.array(view) for view in ((0.9, 0.1), (0.4, 0.6), (0.45, 0.55))]
    frames = [frame(k, [0, 0, 0], posterior=view) for k, view in enumerate(views)]
    (track,) = track_frames(frames, replace(SETTINGS, fusion="vote"))

    np.testing.assert_allclose(track.causal, [[1.0, 0.0], [0.5, 0.5], [1 / 3, 2 / 3]])
    np.testing.assert_allclose(track.posterior, [1 / 3, 2 / 3])


def test_track_posterior_uses_view_weights() -> None:
    """Three whole views say cup, three partial ones box; the cup must win.

    The table of tracks and the report show the posterior after each view.
    """
    frames = [
        replace(
            frame(k, [[0.0, 0, 0]], posterior=BOX if k % 2 else CUP), partial=np.array([k % 2 == 1])
        )
        for k in range(6)
    ]
    (track,) = track_frames(frames, SETTINGS)

    share = (3 * np.log(CUP) + 0.75 * np.log(BOX)) / 3.75
    np.testing.assert_allclose(track.posterior, np.exp(share) / np.exp(share).sum(), atol=1e-9)
    assert track.posterior[0] > 0.75
    after_two = CUP**0.8 * BOX**0.2
    np.testing.assert_allclose(track.causal[1], after_two / after_two.sum(), atol=1e-6)
    np.testing.assert_allclose(track.causal[-1], track.posterior, atol=1e-6)


@pytest.mark.parametrize(
    ("period_s", "missing", "parts"),
    [
        (1.0, 0, 1),  # a frame per second: slow, but nothing was missed
        (0.05, 8, 1),  # eight frames of a fast camera are less than half a second
        (0.1, 8, 2),
    ],
)
def test_only_long_gap_of_several_frames_splits_track(
    period_s: float, missing: int, parts: int
) -> None:
    seen = [k for k in range(20) if not 6 <= k < 6 + missing]
    frames = [
        frame(k, [[0.0, 0, 0]] if k in seen else [], stamp_ns=round(k * period_s * SECOND))
        for k in range(20)
    ]
    found = _without_gaps(next(gather(frames)), np.arange(len(seen)))

    assert [len(part) for part in found] == ([20 - missing] if parts == 1 else [6, 14 - missing])


@pytest.mark.parametrize(("hits", "alive"), [(2, 1), (3, 0)])
def test_confirmed_track_ends_by_elapsed_time_alone(hits: int, alive: int) -> None:
    """A track is confirmed after ``min_hits`` detections."""
    tracker = Tracker(replace(SETTINGS, min_hits=3))
    for k in range(hits):
        step(tracker, k, [[0.0, 0, 0]], stamp_ns=2 * k * SECOND)
    step(tracker, hits, np.zeros((0, 3)), stamp_ns=(2 * (hits - 1) + 5) * SECOND)

    assert tracker._active is not None
    assert len(tracker._active.ids) == alive


@pytest.mark.parametrize("start_ns", [0, 1_700_200_000_000_000_000])
def test_detection_of_two_frames_makes_no_track(start_ns: int) -> None:
    """By any clock, three frames confirm a track; in a recording of two frames, two are enough."""
    seen = [[[0.0, 0, 0], [0.5, 0, 0]] if k in {7, 8} else [[0.0, 0, 0]] for k in range(20)]
    frames = [
        frame(k, places, stamp_ns=start_ns + k * SECOND // 10) for k, places in enumerate(seen)
    ]
    settings = replace(SETTINGS, min_hits=3)

    assert [track.hits for track in track_frames(frames, settings)] == [20]
    assert [track.hits for track in track_frames(frames[7:9], settings)] == [2, 2]


def test_cup_shown_briefly_beside_tall_bottle_keeps_its_track() -> None:
    """Only what is near the middle of a narrow object may count as a piece of it."""
    bottle, cup = (0.07, 0.08, 0.31), (0.08, 0.09, 0.1)
    frames = []
    for k in range(40):
        seen = [[0.0, 0, 0.155], [0.1, 0, 0.05]] if 20 <= k < 24 else [[0.0, 0, 0.155]]
        frames.append(frame(k, seen, size=[bottle, cup][: len(seen)]))
    assert [track.hits for track in track_frames(frames, SETTINGS)] == [40, 4]


def test_fragment_is_joined_to_only_one_of_two_predecessors() -> None:
    """A track with two detections in one frame would give two boxes the same number."""
    columns: dict[str, Any] = {
        "first_ns": [0, 0, 20 * SECOND],
        "last_ns": [2 * SECOND, 2 * SECOND, 30 * SECOND],
        "start": [[0, 0, 0], [0.02, 0, 0], [0, 0, 0]],
        "end": [[0, 0, 0], [0.02, 0, 0], [0, 0, 0]],
        "start_velocity": np.zeros((3, 3)),
        "end_velocity": np.zeros((3, 3)),
        "sizes": np.full((3, 3), 0.1),
        "whole_views": [20, 20, 20],
        "posteriors": [[0.8, 0.2]] * 3,
        "cut": [[False, False]] * 3,
        "novelties": [0.5] * 3,
        "scenes": [0] * 3,
    }

    assert merge_fragments(Fragments(**columns), SETTINGS).tolist() == [0, 1, 0]
