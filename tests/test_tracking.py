"""Unit tests of the tracker and the fusion."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike

from shapecat.arrays import F8
from shapecat.config import TrackingSettings
from shapecat.tracking import (
    Fragments,
    FrameDetections,
    Tracker,
    causal,
    fuse,
    merge_fragments,
    scene_cuts,
    track_recording,
)
from shapecat.tracking.association import assign, size_key
from shapecat.tracking.common_motion import find_common_motion
from shapecat.tracking.fusion import fuse_novelty, view_weights
from shapecat.tracking.hits import gather
from shapecat.tracking.recording import _without_gaps
from shapecat.tracking.surplus import without_shadows

SETTINGS = TrackingSettings()
SECOND = 1_000_000_000
CUP, BOX = np.array([0.9, 0.1]), np.array([0.1, 0.9])


def frame(
    k: int,
    centers: Any,
    *,
    stamp_ns: int | None = None,
    size: ArrayLike = (0.1, 0.1, 0.1),
    posterior: F8 = CUP,
    topic: str = "/depth",
) -> FrameDetections:
    """Return a frame (ten per second by default) of equal objects at given positions."""
    points = np.reshape(np.asarray(centers, float), (-1, 3))
    n = len(points)
    return FrameDetections(
        topic,
        k,
        k * SECOND // 10 if stamp_ns is None else stamp_ns,
        np.arange(n),
        points,
        np.broadcast_to(size, (n, 3)),
        np.broadcast_to(posterior, (n, 2)),
        np.zeros(n),
        np.full(n, 0.5),
        np.broadcast_to(np.eye(3), (n, 3, 3)),
    )


def step(tracker: Tracker, k: int, centers: ArrayLike, **options: Any) -> list[int]:
    one = frame(k, centers, **options)
    ids = tracker.step(one.stamp_ns, one.centers, one.sizes, one.posteriors)
    return [int(i) for i in ids]


def test_ids_count_births_and_births_are_ordered_by_position() -> None:
    """Guard against identities that depend on the order a detector happens to report."""
    assert step(Tracker(SETTINGS), 0, [[0.5, 0, 0], [0.1, 0, 0], [0.3, 0, 0]]) == [3, 1, 2]


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["hungarian", "greedy"]))
def test_result_does_not_depend_on_the_order_of_detections(seed: int, method: str) -> None:
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


def test_a_fragment_beside_the_object_does_not_steal_its_identity() -> None:
    tracker = Tracker(SETTINGS)
    for k in range(5):
        assert step(tracker, k, [0, 0, 0]) == [1]
    whole, piece = tracker.step(
        SECOND // 2, [[0.005, 0, 0], [-0.02, 0, 0]], [[0.1] * 3, [0.03] * 3], [CUP, CUP]
    )
    assert (whole, piece) == (1, 2)
    assert step(tracker, 6, [-0.01, 0, 0]) == [1]


def test_a_new_object_next_to_a_missed_one_is_not_forced_into_its_track() -> None:
    """A plain assignment would use the free row at any cost."""
    tracker = Tracker(SETTINGS)
    for k in range(5):
        step(tracker, k, [[0, 0, 0], [1, 0, 0]])
    other = {"size": (0.3, 0.02, 0.02), "posterior": BOX}
    assert step(tracker, 5, [0.07, 0, 0], **other) == [3]


def test_a_moving_object_is_followed_through_an_occlusion() -> None:
    tracker = Tracker(SETTINGS)
    for k in range(20):
        step(tracker, k, [0.03 * k, 0, 0])
    for k in range(20, 26):
        step(tracker, k, [])
    assert step(tracker, 26, [0.03 * 26, 0, 0]) == [1]


def test_an_unseen_track_ends_and_ended_tracks_cost_nothing() -> None:
    tracker = Tracker(SETTINGS)
    for k in range(1000):
        step(tracker, k, [k // 10, 0, 0])
    assert tracker._active is not None
    assert len(tracker._active.ids) < 10
    assert step(tracker, 2000, [5, 0, 0]) == [101]


def test_a_late_frame_does_not_end_a_track() -> None:
    """Time-lapse recordings have longer frame intervals than any timeout."""
    tracker = Tracker(SETTINGS)
    assert [step(tracker, k, [0, 0, 0], stamp_ns=k * 60 * SECOND) for k in range(4)] == [[1]] * 4


def test_a_clock_that_jumps_back_starts_anew_and_jitter_does_not() -> None:
    tracker = Tracker(SETTINGS)
    stamps = [100 * SECOND, 101 * SECOND, 100 * SECOND, 50 * SECOND]
    ids = [step(tracker, k, [0, 0, 0], stamp_ns=s)[0] for k, s in enumerate(stamps)]
    assert ids == [1, 1, 1, 2]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_centre_that_is_not_finite_is_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        step(Tracker(SETTINGS), 0, [bad, 0, 0])


def test_the_first_frames_may_be_empty_and_not_know_the_categories() -> None:
    tracker = Tracker(SETTINGS)
    assert tracker.step(0, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0))).size == 0
    assert step(tracker, 1, [0, 0, 0]) == [1]
    assert tracker.step(SECOND, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0))).size == 0
    assert step(tracker, 11, [0, 0, 0]) == [1]


def test_hungarian_takes_the_best_whole_and_greedy_the_best_pair() -> None:
    costs = np.array([[0.1, 0.2], [0.2, 0.9]])
    assert assign(costs, 1.0, "hungarian").tolist() == [[0, 1], [1, 0]]
    assert assign(costs, 1.0, "greedy").tolist() == [[0, 0], [1, 1]]
    assert assign(costs, 0.5, "greedy").tolist() == [[0, 0]]
    assert assign(np.full((2, 2), np.inf), 1.0, "hungarian").shape == (0, 2)


def test_a_recording_of_single_pictures_keeps_every_detection() -> None:
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
            np.zeros(4),
            np.zeros(4),
        )
        for k in range(30)
    ]
    tracks = tuple(track_recording(frames, SETTINGS))
    assert sum(track.hits for track in tracks) == 120
    assert len(tracks) >= 115
    assert scene_cuts(next(gather(frames)), SETTINGS)[1:].mean() > 0.9


def test_one_frame_is_enough_and_none_is_no_error() -> None:
    one = track_recording([frame(0, [[0, 0, 0], [1, 0, 0]])], SETTINGS)
    assert [track.id for track in one] == [1, 2]
    assert list(track_recording([], SETTINGS)) == []
    assert list(track_recording([frame(0, []), frame(1, [])], SETTINGS)) == []


def test_a_false_detection_gets_no_track() -> None:
    frames = [frame(k, [[0, 0, 0], [0.5, 0, 0]] if k == 7 else [0, 0, 0]) for k in range(20)]
    (track,) = track_recording(frames, SETTINGS)
    assert track.hits == 20


def test_one_odd_frame_is_no_cut() -> None:
    """One frame with all objects missed and two false ones must not break the tracks."""
    seen = [[0, 0, 0], [0.3, 0, 0]]
    frames = [frame(k, [[0.1, 0.1, 0], [0.2, 0.1, 0]] if k == 9 else seen) for k in range(20)]
    assert not scene_cuts(next(gather(frames)), SETTINGS).any()
    assert [track.hits for track in track_recording(frames, SETTINGS)] == [19, 19]


def test_a_gap_is_filled_by_rows_on_the_line_and_a_long_one_is_left_out() -> None:
    seen = {k: [0.01 * min(k, 14), 0, 0] for k in [*range(10), 14, *range(101, 110)]}
    (track,) = track_recording([frame(k, seen.get(k, [])) for k in range(110)], SETTINGS)
    assert track.detections[9:15].tolist() == [0, -1, -1, -1, -1, 0]
    assert track.centers[12, 0] == pytest.approx(0.12)
    assert track.frames[14:17].tolist() == [14, 101, 102]
    assert track.hits == 20


def test_a_track_moves_on_to_its_very_last_detection() -> None:
    """The last position, and those in a gap before it, must not be that of an earlier detection."""
    frames = [frame(k, [] if 12 <= k < 15 else [[0.01 * k, 0, 0]]) for k in range(16)]
    (track,) = track_recording(frames, SETTINGS)
    assert track.detections[11:].tolist() == [0, -1, -1, -1, 0]
    assert track.centers[:, 0] == pytest.approx(0.01 * np.arange(16))


def test_a_track_in_a_gap_does_not_know_the_view_after_it() -> None:
    """A posterior that is causal only where there is a detection tells the future in the gap."""
    views = {0: CUP, 1: CUP, 2: CUP, 6: BOX, 7: BOX}
    frames = [
        frame(k, [[0, 0, 0]] if k in views else [], posterior=views.get(k, CUP)) for k in range(8)
    ]
    (track,) = track_recording(frames, SETTINGS)
    assert track.detections[3:6].tolist() == [-1, -1, -1]
    assert np.allclose(track.causal[2:6], CUP)
    assert track.causal[6, 0] < 0.9


def test_an_object_that_comes_back_to_its_place_keeps_its_track() -> None:
    """It is out of view longer than any timeout, so only hindsight can join its tracks."""
    frames = [frame(k, [0, 0, 0] if k < 20 or k >= 200 else [2, 0, 0]) for k in range(220)]
    tracks = tuple(track_recording(frames, SETTINGS))
    assert [track.hits for track in tracks] == [40, 180]


def test_an_object_that_is_hidden_again_and_again_stays_one_track() -> None:
    """Four parts are joined through the parts between them, which two of them do not touch."""
    frames = [frame(k, [] if k // 50 % 2 else [0, 0, 0]) for k in range(350)]
    assert [track.hits for track in track_recording(frames, SETTINGS)] == [200]


@pytest.mark.parametrize(
    ("options", "joined"),
    [
        ({}, True),
        ({"start": [[0, 0, 0], [0.3, 0, 0]]}, False),
        ({"sizes": [[0.1, 0.1, 0.1], [0.3, 0.3, 0.3]]}, False),
        ({"posteriors": [[1, 0], [0, 1]]}, False),
        ({"scenes": [0, 1]}, False),
        ({"sizes": [[0.1, 0.1, 0.1], [0.2, 0.2, 0.1]], "whole": [3, 20]}, True),  # seen in part
        ({"sizes": [[0.2, 0.2, 0.1], [0.1, 0.1, 0.1]], "whole": [3, 20]}, False),  # larger than it
        ({"posteriors": [[1, 0], [0, 1]], "whole": [0, 20]}, True),  # cut, it looks like anything
        ({"posteriors": [[1, 0], [0, 1]], "novelties": [0.5, 1.2]}, True),  # as an unknown does
        ({"posteriors": [[1, 0], [0.3, 0.7]], "whole": [20, 3]}, True),  # at the very place
        ({"posteriors": [[1, 0], [0.3, 0.7]]}, False),
        (
            {
                "posteriors": [[1, 0], [0.3, 0.7]],
                "whole": [20, 3],
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
        ({"start": [[0, 0, 0], [0.3, 0, 0]], "rest": [[0.3, 0, 0], [np.nan] * 3]}, True),
        ({"first_ns": [0, SECOND]}, False),  # the first one lasts until 2 s: they overlap
    ],
)
def test_fragments_are_joined_only_when_nothing_speaks_against_it(
    options: dict[str, Any], joined: bool
) -> None:
    columns: dict[str, Any] = {
        "first_ns": [0, 20 * SECOND],
        "last_ns": [2 * SECOND, 30 * SECOND],
        "start": np.zeros((2, 3)),
        "end": np.zeros((2, 3)),
        "start_velocity": np.zeros((2, 3)),
        "end_velocity": np.zeros((2, 3)),
        "sizes": np.full((2, 3), 0.1),
        "whole": [20, 20],
        "rest": np.full((2, 3), np.nan),
        "posteriors": [[0.8, 0.2], [0.7, 0.3]],
        "cut": [[False, False], [False, False]],
        "novelties": [0.5, 0.5],
        "scenes": [0, 0],
    }
    fragments = Fragments(**(columns | options))
    assert merge_fragments(fragments, SETTINGS).tolist() == ([0, 0] if joined else [0, 1])


def test_one_wrong_view_does_not_keep_what_comes_back_apart() -> None:
    """Objects enter the view partly visible, and may be split once they are whole."""
    cup, other = np.array([0.999, 0.001]), np.array([0.05, 0.95])
    before = [frame(k, [0, 0, 0], posterior=cup) for k in range(20)]
    away = [frame(k, []) for k in range(20, 100)]
    cut = [frame(k, [0, 0, 0], posterior=cup) for k in range(100, 103)]
    back = [replace(seen, partial=np.ones(1, bool)) for seen in cut]
    whole = frame(103, [0, 0, 0], posterior=other)
    tracks = tuple(track_recording([*before, *away, *back, whole], SETTINGS))
    assert [track.hits for track in tracks] == [24]


def test_streams_are_tracked_apart_and_numbered_together() -> None:
    frames = [frame(k, [0, 0, 0], topic=topic) for k in range(5) for topic in ("/a", "/b")]
    tracks = tuple(track_recording(frames, SETTINGS))
    assert [(track.id, track.topic, track.hits) for track in tracks] == [(1, "/a", 5), (2, "/b", 5)]


def test_long_recordings_keep_their_tracks_whole() -> None:
    """A thousand frames; the benchmarks measure their duration."""
    random = np.random.default_rng(0)
    places = np.column_stack([np.arange(6) * 0.2, np.zeros((6, 2))])
    frames = [frame(k, places + random.normal(0, 0.01, (6, 3))) for k in range(1000)]
    tracks = tuple(track_recording(frames, SETTINGS))
    assert [track.hits for track in tracks] == [1000] * 6


VIEWS = st.integers(0, 2**32 - 1).map(
    lambda seed: np.random.default_rng(seed).dirichlet(np.full(4, 0.3), 1 + seed % 9)
)


@settings(max_examples=40, deadline=None)
@given(VIEWS, st.sampled_from(["mean", "product", "vote"]))
def test_fusion_is_a_distribution_and_every_prefix_is_a_fusion(views: F8, method: str) -> None:
    running = causal(views, method)  # type: ignore[arg-type]  # one of the three
    assert np.allclose(running.sum(axis=1), 1)
    for k in range(len(views)):
        assert np.allclose(running[k], fuse(views[: k + 1], method))  # type: ignore[arg-type]  # the same


def test_a_track_of_many_blocks_is_fused_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the third block on, about an hour, early views could count twice."""
    views = np.random.default_rng(0).dirichlet(np.full(4, 0.3), 7)
    whole = causal(views)
    monkeypatch.setattr("shapecat.tracking.fusion._BLOCK", 2)

    assert np.allclose(causal(views), whole)


@pytest.mark.parametrize("method", ["mean", "product", "vote"])
def test_more_views_of_the_same_kind_do_not_sharpen(method: str) -> None:
    """Views of one placement share their errors: thirty equal ones count as one."""
    one = fuse([[0.6, 0.4]], method)  # type: ignore[arg-type]  # one of the three
    assert np.allclose(fuse([[0.6, 0.4]] * 30, method), one)  # type: ignore[arg-type]  # the same


def test_fusion_weighs_and_no_view_has_a_veto() -> None:
    assert fuse([[1, 0], [0, 1]], "mean", weights=[3, 1]).tolist() == [0.75, 0.25]
    assert fuse([[0.0, 1.0], *[[0.95, 0.05]] * 9], "product")[0] > 0.5
    with pytest.raises(ValueError, match="at least one view"):
        fuse(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="unknown fusion method"):
        fuse([[1.0]], "sum")  # type: ignore[arg-type]  # what is tested


def test_many_views_reject_less_and_a_cut_view_counts_less() -> None:
    """Known objects whose novelty scatters around the limit must not become unknown."""
    assert fuse_novelty([1.05], [1.0]) == pytest.approx(1.05)
    assert fuse_novelty([1.05] * 9, [1.0] * 9) < 1 < fuse_novelty([1.1] * 9, [1.0] * 9)
    assert fuse_novelty([0.5, 2.0], view_weights(np.array([False, True]))) < 1
    # A whole view, a cut one, and one that repeats another: 1.25 views by weight.
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


def test_pieces_of_an_object_that_is_split_now_and_then_are_no_tracks() -> None:
    whole, split = [(0.0, 0.2)], [(0.0, 0.12), (0.12, 0.2)]
    tracks = tuple(track_recording(boxed(([whole] * 3 + [split] * 3) * 6), SETTINGS))
    assert [track.hits for track in tracks] == [36]


def test_a_burst_of_splits_is_no_track() -> None:
    """It is never missed while it lasts; only the frames before and after reveal it."""
    whole, split = [(0.0, 0.2)], [(0.0, 0.12), (0.12, 0.2)]
    tracks = tuple(track_recording(boxed([whole] * 20 + [split] * 6 + [whole] * 20), SETTINGS))
    assert [track.hits for track in tracks] == [46]


def test_neighbours_that_are_taken_for_one_now_and_then_stay_two() -> None:
    one, two = [(0.0, 0.2)], [(0.0, 0.1), (0.1, 0.2)]
    tracks = tuple(track_recording(boxed(([two] * 9 + [one]) * 4), SETTINGS))
    assert [track.hits for track in tracks][1] >= 36
    assert len(tracks) == 2


def test_a_sensor_that_sees_two_objects_as_one_does_not_make_one_a_piece() -> None:
    one, two = boxed([[(0.0, 0.2)]])[0], boxed([[(0.0, 0.1), (0.1, 0.2)]])[0]
    frames = [
        replace(what, topic=topic, frame=k, stamp_ns=k * SECOND // 10 + late)
        for k in range(20)
        for topic, what, late in (("/a", two, 0), ("/b", one, 5))
    ]
    tracks = tuple(track_recording(frames, SETTINGS, together={"/a", "/b"}))
    assert len(tracks) == 2
    assert min(track.hits for track in tracks) >= 20


def test_what_is_put_into_a_bowl_is_not_a_piece_of_the_bowl() -> None:
    bowl, filled = [(0.0, 0.2)], [(0.0, 0.2), (0.1, 0.16)]
    tracks = tuple(track_recording(boxed([bowl] * 30 + [filled] * 8), SETTINGS))
    assert sorted(track.hits for track in tracks) == [8, 38]


def test_an_object_that_comes_into_view_in_pieces_is_one_track() -> None:
    """Before it is whole, only its later size shows that they are pieces."""
    whole, split = [(0.0, 0.2)], [(0.0, 0.08), (0.08, 0.2)]
    tracks = tuple(track_recording(boxed([split] * 12 + [whole] * 30), SETTINGS))
    assert [track.hits for track in tracks] == [42]


@pytest.mark.parametrize("partial", [True, False])
def test_what_passes_behind_a_narrow_thing_is_one_track(partial: bool) -> None:
    """For some frames both of its sides are visible, but never its whole width."""
    left, right = (0.0, 0.0, 0.0), (0.15, 0.0, 0.0)
    sides = [[left]] * 20 + [[left, right]] * 4 + [[right]] * 20
    frames = [
        replace(
            frame(k, places, size=(0.04, 0.18, 0.02)),
            partial=np.full(len(places), partial),
        )
        for k, places in enumerate(sides)
    ]
    tracks = tuple(track_recording(frames, SETTINGS))
    assert [track.hits for track in tracks] == ([44] if partial else [24, 24])


@pytest.mark.parametrize("in_one", [True, False])
def test_what_is_seen_in_one_between_its_two_sides_is_one_track(in_one: bool) -> None:
    """Nothing else shows its whole length: two objects could look like its two sides."""
    left, right = (0.0, 0.05), (0.1, 0.15)
    split, whole = [left, right], [(0.0, 0.15)]
    change = [split, whole if in_one else split, split, split, split, split]
    tracks = tuple(track_recording(boxed([[left]] * 18 + change + [[right]] * 14), SETTINGS))
    assert [track.hits for track in tracks] == ([38] if in_one else [24, 20])


def test_what_is_there_after_a_while_unseen_need_not_be_the_same() -> None:
    """A track survives 0.8 s unseen; all of its views decide whether it came back."""
    before = [frame(k, [0, 0, 0], posterior=CUP) for k in range(20)]
    after = [frame(k, [0.02, 0, 0], posterior=BOX, size=(0.14, 0.14, 0.1)) for k in range(28, 50)]
    tracks = tuple(
        track_recording([*before, *(frame(k, []) for k in range(20, 28)), *after], SETTINGS)
    )
    assert [track.hits for track in tracks] == [20, 22]


def turning(*, speed: float, hidden: range, frames: int = 80) -> list[FrameDetections]:
    """Return a table that rotates at ``speed`` rad/s; one object has no reading."""
    random = np.random.default_rng(1)
    angle, radius = np.array([0.0, 1.3, 2.4, 3.9, 5.2]), np.array([0.3, 0.2, 0.35, 0.25, 0.3])
    found = []
    for k in range(frames):
        turned = angle + speed * k / 10
        places = np.column_stack([radius * np.cos(turned), radius * np.sin(turned), 0 * angle])
        places += random.normal(0, 0.004, places.shape)
        seen = [i for i in range(5) if i != 0 or k not in hidden]
        found.append(frame(k, places[seen]))
    return found


def test_an_object_hidden_on_a_turning_table_is_known_where_it_comes_back() -> None:
    """The other objects show the rotation of the table: 1.2 rad, or 35 cm of its path."""
    frames = turning(speed=0.4, hidden=range(25, 55))
    tracks = tuple(track_recording(frames, SETTINGS))
    assert sorted(track.hits for track in tracks) == [50, 80, 80, 80, 80]
    whole = next(track for track in tracks if track.hits == 50)
    radius = np.linalg.norm(whole.centers[:, :2], axis=1)
    assert radius == pytest.approx(0.3, abs=0.02)  # coasting, it goes round with the table


@pytest.mark.parametrize("speed", [-0.4, 0.4])
def test_a_common_motion_brings_the_detections_to_rest_and_back(speed: float) -> None:
    frames = turning(speed=speed, hidden=range(0))
    hits = next(gather(frames))
    motion = find_common_motion(hits, [np.arange(k, 400, 5) for k in range(5)])
    assert motion is not None
    still = motion.still(hits).centers.reshape(80, 5, 3)
    assert still.std(axis=0).max() < 0.01
    back = motion.moved(hits.rows, still.reshape(-1, 3))
    assert back == pytest.approx(hits.centers, abs=1e-6)


def test_what_stands_still_or_goes_its_own_way_has_no_common_motion() -> None:
    members = [np.arange(k, 400, 5) for k in range(5)]
    assert find_common_motion(next(gather(turning(speed=0.0, hidden=range(0)))), members) is None
    random = np.random.default_rng(2)
    ways = random.normal(0, 0.1, (5, 3)) * [1, 1, 0]
    apart = [frame(k, np.arange(5)[:, None] * 0.5 + ways * k / 10) for k in range(80)]
    assert find_common_motion(next(gather(apart)), members) is None


def test_a_clock_that_jumps_back_is_a_cut() -> None:
    """Two sessions in one recording must not be joined by their equal time stamps."""
    stamps = [*range(100, 105), *range(50, 55)]
    frames = [frame(k, [0, 0, 0], stamp_ns=s * SECOND // 5) for k, s in enumerate(stamps)]
    assert scene_cuts(next(gather(frames)), SETTINGS).tolist() == [k == 5 for k in range(10)]
    assert [track.hits for track in track_recording(frames, SETTINGS)] == [5, 5]


@pytest.mark.parametrize("single", [False, True])
def test_two_sensors_share_tracks_after_their_clock_is_set_back(single: bool) -> None:
    """Before and after; and after a single wrong stamp, neither sensor may lag behind."""
    frames = []
    for k in range(40):
        for topic, late in (("/a", 0), ("/b", SECOND // 30)):
            wrong = (k == 20 and topic == "/b") if single else k >= 20
            stamp = k * SECOND // 10 + late - (1000 * SECOND if wrong else 0)
            frames.append(frame(k, [0, 0, 0], stamp_ns=stamp, topic=topic))
    tracks = tuple(track_recording(frames, SETTINGS, together={"/a", "/b"}))
    assert [track.hits for track in tracks] == [40, 40]
    assert all(track.topics.count("/b") == 20 for track in tracks)


def test_an_object_that_is_missed_moves_on_in_time() -> None:
    """Not by frames: a robot that drops a second of them would place it halfway."""
    seconds = [*np.arange(11) / 10, 1.8, *np.arange(20, 30) / 10]
    frames = [
        frame(k, [] if s == 1.8 else [0.2 * s, 0.0, 0.1], stamp_ns=round(s * SECOND))
        for k, s in enumerate(seconds)
    ]
    (track,) = track_recording(frames, SETTINGS)
    assert track.detections[11] == -1
    np.testing.assert_allclose(track.centers[:, 0], 0.2 * np.array(seconds), atol=1e-6)


def test_tracks_may_be_awaited_for_ever() -> None:
    """A time beyond 64 bits of nanoseconds must not end in an error."""
    frames = [frame(k, [0, 0, 0] if k % 20 < 10 else []) for k in range(60)]
    (track,) = track_recording(frames, replace(SETTINGS, max_missed_s=1e12))
    assert track.hits == 30


def test_a_cut_view_moves_its_track_less_and_teaches_it_less() -> None:
    """A partial view is off-centre and too small."""

    def after(*, partial: bool) -> Any:
        tracker = Tracker(SETTINGS)
        for k in range(5):
            one = frame(k, [[0.0, 0, 0]])
            tracker.step(one.stamp_ns, one.centers, one.sizes, one.posteriors)
        one = frame(5, [[0.02, 0, 0]], size=(0.08, 0.08, 0.1), posterior=BOX)
        cut = np.array([partial])
        tracker.step(one.stamp_ns, one.centers, one.sizes, one.posteriors, partial=cut)
        assert tracker._active is not None
        return tracker._active

    whole, cut = after(partial=False), after(partial=True)
    assert 0 < cut.position[0, 0] < 0.8 * whole.position[0, 0]
    for name in ("size", "posterior"):
        before = size_key(np.full((1, 3), 0.1)) if name == "size" else CUP[None]
        moved = [np.abs(getattr(tracks, name) - before).max() for tracks in (whole, cut)]
        assert moved[1] == pytest.approx(0.25 * moved[0], rel=1e-5)


def test_weights_of_views_reach_the_posterior_of_a_track() -> None:
    """Three whole views say cup, three cut ones box: the cup must win by a quarter's weight.

    The table of tracks and the report show the posterior after each view.
    """
    frames = [
        replace(
            frame(k, [[0.0, 0, 0]], posterior=BOX if k % 2 else CUP), partial=np.array([k % 2 == 1])
        )
        for k in range(6)
    ]
    (track,) = track_recording(frames, SETTINGS)

    share = (3 * np.log(CUP) + 0.75 * np.log(BOX)) / 3.75
    np.testing.assert_allclose(track.posterior, np.exp(share) / np.exp(share).sum(), atol=1e-9)
    assert track.posterior[0] > 0.75
    after_two = CUP**0.8 * BOX**0.2
    np.testing.assert_allclose(track.causal[1], after_two / after_two.sum(), atol=1e-6)
    np.testing.assert_allclose(track.causal[-1], track.posterior, atol=1e-6)


@pytest.mark.parametrize(
    ("period_s", "missing", "parts"),
    [
        (1.0, 0, 1),  # single pictures, one a second: slow, but nothing was missed
        (0.05, 8, 1),  # eight frames of a fast camera are not half a second
        (0.1, 8, 2),
    ],
)
def test_only_a_long_gap_of_several_frames_splits_a_track(
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
def test_a_track_that_has_proved_itself_ends_by_time_alone(hits: int, alive: int) -> None:
    """After ``min_hits`` detections, only the elapsed time ends a track."""
    tracker = Tracker(replace(SETTINGS, min_hits=3))
    for k in range(hits):
        step(tracker, k, [[0.0, 0, 0]], stamp_ns=2 * k * SECOND)
    step(tracker, hits, np.zeros((0, 3)), stamp_ns=(2 * (hits - 1) + 5) * SECOND)

    assert tracker._active is not None
    assert len(tracker._active.ids) == alive


@pytest.mark.parametrize(
    ("begin", "x", "kept"),
    [
        (10, 0.01, False),  # inside the host, while it is seen
        (10, 0.2, True),  # beside it
        (25, 0.01, False),  # and when it outlasts the host by a frame
        (2, 0.01, False),  # or comes a frame before it
        (27, 0.01, True),  # at its place, after it has gone
        (0, 0.01, True),  # and before it came
    ],
)
def test_a_short_track_inside_a_longer_one_is_its_shadow(
    begin: int, x: float, *, kept: bool
) -> None:
    host, shadow = range(3, 27), range(begin, begin + 3)
    members: tuple[list[int], list[int]] = ([], [])
    frames, count = [], 0
    for k in range(30):
        places = [[0.0, 0, 0]] * (k in host) + [[x, 0.0, 0]] * (k in shadow)
        frames.append(frame(k, places))
        for which, there in enumerate((k in host, k in shadow)):
            members[which].extend([count] * there)
            count += there
    tracks = [np.array(member) for member in members]

    found = without_shadows(next(gather(frames)), tracks)

    assert [len(member) for member in found] == ([24, 3] if kept else [24])


def test_only_one_fragment_goes_on_where_two_ended() -> None:
    """A track with two detections in one frame would number two boxes alike."""
    columns: dict[str, Any] = {
        "first_ns": [0, 0, 20 * SECOND],
        "last_ns": [2 * SECOND, 2 * SECOND, 30 * SECOND],
        "start": [[0, 0, 0], [0.02, 0, 0], [0, 0, 0]],
        "end": [[0, 0, 0], [0.02, 0, 0], [0, 0, 0]],
        "start_velocity": np.zeros((3, 3)),
        "end_velocity": np.zeros((3, 3)),
        "sizes": np.full((3, 3), 0.1),
        "whole": [20, 20, 20],
        "rest": np.full((3, 3), np.nan),
        "posteriors": [[0.8, 0.2]] * 3,
        "cut": [[False, False]] * 3,
        "novelties": [0.5] * 3,
        "scenes": [0] * 3,
    }

    assert merge_fragments(Fragments(**columns), SETTINGS).tolist() == [0, 1, 0]
