"""Tests of reusing earlier descriptions: the views that qualify, and those that do not."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation

import shapecat.pipeline
from shapecat.arrays import F8
from shapecat.config import Settings
from shapecat.errors import ConfigError
from shapecat.geometry import IDENTITY, compose, transform
from shapecat.perception import Perceiver, PerceptionInput
from shapecat.reuse import shows_the_same
from shapecat.reuse.views import KeyView, _similar, find_repeats, reused, view_object
from shapecat.runs.jobs import Job
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.simulation.recorder import record
from shapecat.simulation.scenes.worlds import World
from shapecat.types import Box, Candidate, Detection, Frame, FullBox, NeuralGas, Perception, Pose
from tests.conftest import Guesser
from tests.frame_detections import FrameDetections, gather

FRAMES, CHANGE = 6, 3
"""Frames of a scene, and the first one in which something is different."""


@cache
def table() -> World:
    return make_scene("tabletop", np.random.default_rng(11), frames=1)


def still_world(frames: int = FRAMES, **changes: Any) -> World:
    """Return a table with objects and a camera at rest."""
    return replace(table(), path=table().path * frames, turns=np.zeros(frames), **changes)


def shifted(track: int, shifts: Sequence[Any]) -> dict[int, F8]:
    """Return a motion by a shift (3,) per frame; None where the object is absent."""
    return {track: np.array([(np.nan,) * 3 if s is None else s for s in shifts])}


def alone(world: World) -> int:
    """Return the index of the object that is farthest from all others."""
    places = np.array([item.pose.translation for item in world.objects])
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + 9 * np.eye(len(places))
    return int(gaps.min(axis=1).argmax())


def perceive(world: World, **settings: Any) -> list[Perception]:
    """Perceive the frames of a world as one block, each with its own noise."""
    views = []
    for k in range(len(world)):
        frame, _ = render_frame(world, k, rng=np.random.default_rng(k), sensor=KINECT)
        frame = replace(frame, index=k, stamp_ns=1000 + 70 * k)
        views.append(PerceptionInput(frame, None, (), world.path[k]))
    guesser: Any = Guesser()
    return Perceiver(guesser, Settings(**settings), None)(views)


def detection_at(world: World, perceptions: Sequence[Perception], k: int, place: Any) -> Detection:
    """Return the detection of frame ``k`` nearest to a place in the world."""
    found = perceptions[k].detections
    gaps = [np.linalg.norm(transform(world.path[k], d.candidate.box.center) - place) for d in found]
    assert min(gaps) < 0.08
    return found[int(np.argmin(gaps))]


def test_still_scene_is_described_once() -> None:
    first, *others = perceive(still_world())
    assert len(first.detections) >= 6
    times = [(perception.index, perception.stamp_ns) for perception in (first, *others)]
    assert times == [(k, 1000 + 70 * k) for k in range(FRAMES)]
    assert first.reused_from is None
    assert {d.reused_from for d in first.detections} == {None}
    for other in others:
        assert other.reused_from == 0
        assert {d.reused_from for d in other.detections} == {0}
        for now, then in zip(other.detections, first.detections, strict=True):
            assert np.array_equal(now.posterior, then.posterior)
            assert np.array_equal(now.gas.neurons, then.gas.neurons)
            share = np.isin(now.candidate.indices, then.candidate.indices).mean()
            assert share == 1.0
            assert len(now.candidate.indices) > 0.9 * len(then.candidate.indices)


def test_reused_masks_leave_out_what_lies_behind_the_object() -> None:
    """The outline may have shifted by a pixel or two; crops would reach down to the floor."""
    world = still_world(2)
    aside = Pose(Rotation.from_euler("y", 0.1, degrees=True).as_matrix(), np.zeros(3))
    world = replace(world, path=(world.path[0], compose(world.path[1], aside)))
    _, repeated = perceive(world)
    frame, _ = render_frame(world, 1, rng=np.random.default_rng(1), sensor=KINECT)

    assert repeated.reused_from == 0
    for found in repeated.detections:
        box = found.candidate.box
        points = frame.xyz(found.candidate.indices) - box.center
        in_box = points @ Rotation.from_quat(box.orientation).as_matrix()
        assert len(points) > 50
        assert (np.abs(in_box) < box.size / 2 + 0.03).all()


def test_reused_masks_cover_only_depth_of_their_frame() -> None:
    """A repeated mask over a hole would paint and export points that do not exist."""
    world = still_world(2)
    perceptions = perceive(world)
    frame, _ = render_frame(world, 1, rng=np.random.default_rng(1), sensor=KINECT)
    assert frame.depth is not None
    for found in perceptions[1].detections:
        assert (frame.depth.reshape(-1)[found.candidate.indices] > 0).all()


def test_only_moved_object_is_described_again() -> None:
    world = still_world()
    track = alone(world)
    place = world.objects[track].pose.translation
    shift = np.array([*(0.05 * place[:2] / np.linalg.norm(place[:2])), 0])
    motion = shifted(track, [(0, 0, 0)] * CHANGE + [shift] * (FRAMES - CHANGE))
    world = replace(world, motions=motion)

    perceptions = perceive(world)

    moved = detection_at(world, perceptions, CHANGE, place + shift)
    assert perceptions[CHANGE].reused_from is None
    assert moved.reused_from is None
    assert detection_at(world, perceptions, CHANGE + 1, place + shift).reused_from == CHANGE
    others = [d.reused_from for d in perceptions[CHANGE].detections if d is not moved]
    assert others.count(0) >= len(others) - 1
    # A repeat must name the view that was described; otherwise that view would count twice.
    assert perceptions[CHANGE + 1].reused_from == CHANGE
    again = [d.reused_from for d in perceptions[CHANGE + 1].detections]
    origins = [d.reused_from for d in perceptions[CHANGE].detections]
    assert again == [CHANGE if origin is None else origin for origin in origins]


def test_another_object_at_same_place_is_described_again() -> None:
    """Otherwise it would inherit the label of the object that stood there before."""
    world = still_world()
    names = [item.category for item in world.objects]
    track, other = alone(world), names.index("plate" if names[alone(world)] != "plate" else "can")
    place = world.objects[track].pose.translation
    bottom = [item.mesh.vertices[:, 2].min() for item in world.objects]
    across = place - world.objects[other].pose.translation
    across[2] += bottom[track] - bottom[other]
    motions = {
        **shifted(track, [(0, 0, 0)] * CHANGE + [None] * (FRAMES - CHANGE)),
        **shifted(other, [None] * CHANGE + [across] * (FRAMES - CHANGE)),
    }

    perceptions = perceive(replace(world, motions=motions))

    assert detection_at(world, perceptions, CHANGE - 1, place).reused_from == 0
    assert detection_at(world, perceptions, CHANGE, place).reused_from is None


def test_partly_hidden_object_is_described_again() -> None:
    world = still_world()
    track = alone(world)
    cans = (k for k, item in enumerate(world.objects) if item.category == "can")
    blocker = next(k for k in cans if k != track)  # a floating bowl may seem to contain the object
    place, eye = world.objects[track].pose.translation, world.path[0].translation
    between = place + 0.12 * (eye - place) / np.linalg.norm(eye - place)
    shift = between - world.objects[blocker].pose.translation
    motion = shifted(blocker, [None] * CHANGE + [shift] * (FRAMES - CHANGE))

    perceptions = perceive(replace(world, motions=motion))

    near = [
        d.reused_from
        for d in perceptions[CHANGE].detections
        if np.linalg.norm(transform(world.path[0], d.candidate.box.center) - place) < 0.15
    ]
    assert perceptions[CHANGE].reused_from is None
    assert near
    assert set(near) == {None}


def test_slowly_moving_object_is_described_again() -> None:
    """Each step is within the noise; the motion since the description must count."""
    frames, step = 16, 0.003
    world = still_world(frames)
    track = alone(world)
    place = world.objects[track].pose.translation
    way = step * place[:2] / np.linalg.norm(place[:2])
    motion = shifted(track, [(*(k * way), 0) for k in range(frames)])

    perceptions = perceive(replace(world, motions=motion))

    origins = []
    for k in range(frames):
        found = detection_at(world, perceptions, k, place + np.array([*(k * way), 0]))
        origins.append(k if found.reused_from is None else found.reused_from)
    assert max(k - origin for k, origin in enumerate(origins)) * step <= 0.02
    assert len(set(origins)) >= 3


def placed(fixed_from_sensor: Pose, box: FullBox) -> tuple[Any, Rotation]:
    """Return the centre and the rotation of a box in the fixed frame."""
    turn = Rotation.from_matrix(fixed_from_sensor.rotation)
    return transform(fixed_from_sensor, box.center), turn * Rotation.from_quat(box.orientation)


def test_reused_surfaces_and_boxes_stay_in_place_while_camera_moves() -> None:
    """Copied without a change, repeated surfaces and boxes would follow the camera."""
    world = make_scene("tabletop", np.random.default_rng(11), frames=FRAMES, rate_hz=30.0)
    perceptions = perceive(world)
    assert all(p.reused_from is None for p in perceptions)
    first = [(k, d) for k, p in enumerate(perceptions) for d in p.detections]
    repeated = [(k, d) for k, d in first if d.reused_from is not None]
    assert len(repeated) > len(first) / 3
    for k, now in repeated:
        then = next(
            d
            for j, d in first
            if j == now.reused_from and np.array_equal(d.descriptor, now.descriptor)
        )
        here = transform(world.path[k], now.gas.neurons)
        there = transform(world.path[now.reused_from or 0], then.gas.neurons)
        assert np.allclose(here, there, atol=1e-5)
        assert now.full is not None
        assert then.full is not None
        assert np.allclose(now.full.size, then.full.size)
        (place, turn), (old_place, old_turn) = (
            placed(world.path[k], now.full), placed(world.path[now.reused_from or 0], then.full)
        )  # fmt: skip
        assert np.allclose(place, old_place, atol=1e-5)
        assert (turn.inv() * old_turn).magnitude() < 1e-5


@pytest.mark.parametrize(("pixels", "alike"), [(1350, True), (1400, False)])
def test_nearer_view_with_flipped_yaw_is_alike_up_to_noise(pixels: int, *, alike: bool) -> None:
    """At the earlier distance, 1350 and 1400 pixels would be 1.22 and 1.27 times 1000."""
    center, sights = np.array([0.1, -0.2, 1.0]), []
    half = np.sqrt(0.5)
    for share, count, sides, turn in (
        (1.0, 1000, (0.2, 0.12, 0.3), (0, 0, 0, 1)),
        (0.951, pixels, (0.12, 0.2, 0.3), (0, 0, half, half)),
    ):
        box = Box(share * center, np.array(sides), np.array(turn))
        found = Candidate(np.arange(count), box, 0, None, 0.0, False, False)
        pose = Pose(np.eye(3), (1 - share) * center)
        sights.append(view_object(rendered(), pose, found, np.array([0, 0, 1.0]), 0.15).summary)

    assert _similar(sights[1], sights[0]) == alike


PLACE, EYE = np.array([0.7, -0.4, 0.5]), np.array([0.1, 0.3, 1.3])
"""Positions of an object and of the sensor, in the fixed frame."""
LOOK = Rotation.from_euler("xyz", [-130, 12, 35], degrees=True)


def summary_of(
    *,
    eye: Any = EYE,
    look: Rotation = LOOK,
    moved: Any = (0, 0, 0),
    up: Any = (0, 0, 1),
    sides: Any = (0.2, 0.12, 0.3),
    height_m: float = 0.15,
    pixels: int = 1000,
    posed: bool = True,
    **flags: bool,
) -> Any:
    """Return the summary of an object; ``moved`` and ``up`` are vectors in the fixed frame."""
    box = Box(look.inv().apply(PLACE + moved - eye), np.array(sides), np.array([0, 0, 0, 1.0]))
    flags = {"touches_border": False, "occluded": False, **flags}
    found = Candidate(np.arange(pixels), box, 0, None, 0.0, **flags)
    pose = Pose(look.as_matrix(), eye) if posed else None
    return view_object(rendered(), pose, found, look.inv().apply(up), height_m).summary


def circled(*turn_deg: float) -> dict[str, Any]:
    """Return eye and look of a sensor turned about the object by a rotation vector, degrees."""
    turn = Rotation.from_rotvec(turn_deg, degrees=True)
    return {"eye": PLACE + turn.apply(EYE - PLACE), "look": turn * LOOK}


@pytest.mark.parametrize(
    ("changes", "alike"),
    [
        *(({"look": Rotation.from_rotvec(pan, degrees=True) * LOOK}, True)
          for pan in ([25, 0, 0], [0, -25, 0], [0, 0, 25])),
        *((circled(*turn), True) for turn in ((5, 0, 0), (0, -5, 0), (0, 0, 5))),
        *((circled(*turn), False) for turn in ((15, 0, 0), (0, -15, 0), (0, 0, 15))),
        *(({"eye": EYE + share * (PLACE - EYE), "pixels": pixels}, alike)
          for share, pixels, alike in ((0.04, 1085, True), (-0.04, 925, True),
                                       (0.06, 1132, False), (-0.06, 890, False))),
        *(({"moved": sign * 0.01 * m * axis}, m < 1.5)
          for m, sign in ((1.4, 1), (1.6, 1), (1.6, -1)) for axis in np.eye(3)),
        *(({"up": (np.sin(a), 0, np.cos(a))}, abs(a) < 0.03) for a in (0.025, 0.045, -0.045)),
        *(({"up": (0, np.sin(a), np.cos(a))}, abs(a) < 0.03) for a in (0.025, 0.045, -0.045)),
        *(({"sides": np.add((0.2, 0.12, 0.3), change * axis)}, abs(change) < 0.02)
          for change in (0.018, 0.022, -0.022) for axis in np.eye(3)),
        *(({"height_m": 0.15 + change}, abs(change) < 0.01) for change in (0.009, 0.011, -0.011)),
        *(({"pixels": pixels}, 750 <= pixels <= 1250) for pixels in (1240, 1260, 760, 740)),
        ({"touches_border": True}, False),
        ({"occluded": True}, False),
    ],
)  # fmt: skip
def test_views_are_alike_up_to_noise_in_the_fixed_frame(
    changes: dict[str, Any], *, alike: bool
) -> None:
    """A sensor that pans sees the same side; one that circles an object sees another one."""
    assert _similar(summary_of(**changes), summary_of()) == alike


def test_views_of_another_kind_are_not_alike() -> None:
    """A view cut by the border is unlike an occluded one; one without a pose is unlike others."""
    start: dict[str, Any] = {"eye": np.zeros(3), "look": Rotation.identity()}
    assert not _similar(summary_of(touches_border=True), summary_of(occluded=True))
    assert _similar(summary_of(**start, posed=False), summary_of(**start, posed=False))
    assert not _similar(summary_of(**start, posed=False), summary_of(**start))


@pytest.mark.parametrize(
    ("before", "now", "repeated"),
    [
        ((40,), 46, None),
        ((46,), 40, None),
        ((40, 40), 40, 1),  # the newest, which may differ least
        ((40, 40, 46), 40, 1),
        ((40, 46, 46), 40, 0),  # a mask may flicker
        ((40, 46, 46, 46), 40, None),  # each comparison takes time
    ],
)
def test_object_with_a_part_more_or_less_is_described_again(
    before: tuple[int, ...], now: int, repeated: int | None
) -> None:
    """A handle that comes into view, or leaves it, is another shape in a box as large as before."""
    *earlier, view = (view_of_width(k, width) for k, width in enumerate((*before, now)))
    assert all(_similar(each.summary, view.summary) for each in earlier)
    described: Any = None
    (repeat,) = find_repeats([view], [KeyView(each, described) for each in earlier])

    assert (repeat.key.view.frame.index if repeat else None) == repeated


def view_of_width(index: int, width: int) -> Any:
    """Return the view of an object of this width, pixels, in a frame of its own."""
    mask = np.zeros((480, 640), np.bool_)
    mask[200:240, 300 : 300 + width] = True
    depth = np.where(mask, 1.0, 1.3).astype(np.float32)
    box = Box(np.array([0, 0, 1.0]), np.array([0.1, 0.07, 0.05]), np.array([0, 0, 0, 1.0]))
    found = Candidate(np.flatnonzero(mask), box, 0, None, 0.0, False, False)
    frame = replace(blank(index), depth=depth)
    return view_object(frame, IDENTITY, found, np.array([0, -1.0, 0]), 0.03)


ASIDE = 4 / KINECT.camera.fx
"""A shift in metres, or a turn in radians, by which a point 1 m away moves by 4 pixels."""


@pytest.mark.parametrize(
    ("pose", "moved_px"),
    [
        (Pose(np.eye(3), np.array([ASIDE, 0, 0])), 4),
        (Pose(Rotation.from_rotvec([0, ASIDE, 0]).as_matrix(), np.zeros(3)), 4),
        (IDENTITY, 0),
    ],
)
def test_reused_surface_and_box_follow_a_shift_or_turn_alone(pose: Pose, moved_px: int) -> None:
    """A camera on a rail only shifts, and one that pans only turns; each alone must count."""
    sights = []
    for k, (placed_at, left) in enumerate(((IDENTITY, 300), (pose, 300 - moved_px))):
        mask = np.zeros((480, 640), np.bool_)
        mask[200:240, left : left + 40] = True
        depth = np.where(mask, 1.0, 1.3).astype(np.float32)
        center = np.array([-moved_px * k / KINECT.camera.fx, -0.04, 1.0])
        box = Box(center, np.array([0.1, 0.07, 0.05]), np.array([0, 0, 0, 1.0]))
        found = Candidate(np.flatnonzero(mask), box, 0, None, 0.0, False, False)
        frame = replace(blank(k), depth=depth)
        sights.append(view_object(frame, placed_at, found, np.array([0, -1.0, 0]), 0.03))
    neurons = np.array([[0.01, -0.05, 1.0], [-0.02, -0.03, 1.02]])
    turn = Rotation.from_euler("xyz", [0.3, -0.2, 0.5]).as_quat()
    full = FullBox(np.array([0.01, -0.04, 1.05]), np.ones(3), turn, np.ones(3), np.ones(96))
    known = Detection(
        sights[0].candidate,
        NeuralGas(neurons, np.array([[0, 1]])),
        np.zeros(3),
        np.array([0.3, 0.7]),
        0.5,
        0.0,
        full,
    )
    (repeat,) = find_repeats(sights[1:], [KeyView(sights[0], known)])

    assert repeat is not None
    again = reused(repeat, sights[1])
    assert again.candidate is sights[1].candidate
    np.testing.assert_allclose(transform(pose, again.gas.neurons), neurons, atol=1e-6)
    assert again.full is not None
    place, now = placed(pose, again.full)
    np.testing.assert_allclose(place, full.center, atol=1e-6)
    assert (now.inv() * Rotation.from_quat(turn)).magnitude() < 1e-6


def test_wrong_pose_prevents_reuse() -> None:
    """If poses stay constant while the camera moves, other views' descriptions must not be used."""
    world = make_scene("tabletop", np.random.default_rng(11), frames=12, rate_hz=3.0)
    still = replace(world, path=(world.path[0],) * 12)
    guesser: Any = Guesser()
    views = [
        PerceptionInput(
            replace(
                render_frame(world, k, rng=np.random.default_rng(k), sensor=KINECT)[0], index=k
            ),
            None,
            (),
            still.path[k],
        )
        for k in (0, 11)
    ]
    second = Perceiver(guesser, Settings(), None)(views)[1]
    assert {d.reused_from for d in second.detections} == {None}


@cache
def rendered() -> Frame:
    return render_frame(still_world(1), 0, rng=np.random.default_rng(0), sensor=KINECT)[0]


def blank(index: int = 0) -> Frame:
    return replace(rendered(), index=index)


@pytest.mark.parametrize(
    "change", [{"frame_id": "other"}, {"camera": replace(KINECT.camera, fx=9)}]
)
def test_frame_of_another_camera_is_not_the_same(change: Any) -> None:
    frame = blank()

    assert shows_the_same(frame, None, frame, None, range_m=2.0)
    assert not shows_the_same(replace(frame, **change), None, frame, None, range_m=2.0)


def test_nothing_is_reused_across_topics_or_up_directions() -> None:
    """Two sensors may begin with equal images; heights depend on the up direction."""
    frame = replace(blank(), topic="/left")
    up = np.asarray(still_world(1).path[0].rotation[2], np.float32)
    tilted = up + np.float32(0.04) * np.array([1, 0, 0], np.float32)
    tilted /= np.linalg.norm(tilted)
    ups = {"/left": (up, tilted, None, up), "/right": (up,)}
    views = [
        PerceptionInput(replace(frame, topic=topic), up)
        for topic, given in ups.items()
        for up in given
    ]
    guesser: Any = Guesser()
    perceptions = Perceiver(guesser, Settings(), None)(views)

    assert [perception.topic for perception in perceptions] == [*["/left"] * 4, "/right"]
    assert all(perception.reused_from is None for perception in perceptions)
    assert {d.reused_from for d in perceptions[4].detections} == {None}


def test_interleaved_sensors_each_reuse_their_own_frames() -> None:
    """With several cameras, nothing would be reused, and runs would take far longer."""
    left = replace(blank(), topic="/left")
    assert left.depth is not None
    right = replace(left, topic="/right", depth=left.depth[:, ::-1])
    views = [
        PerceptionInput(replace(frame, index=start + k, stamp_ns=100 * k + start), None)
        for k in range(3)
        for start, frame in ((3, left), (8, right))
    ]
    guesser: Any = Guesser()
    perceptions = Perceiver(guesser, Settings(), None)(views)

    assert [p.reused_from for p in perceptions] == [None, None, 3, 8, 3, 8]
    assert [(p.topic, p.index) for p in perceptions] == [
        (v.frame.topic, v.frame.index) for v in views
    ]
    for now, first in zip(perceptions[2:], perceptions[:2] * 2, strict=True):
        assert len(now.detections) == len(first.detections) >= 3
        for again, described in zip(now.detections, first.detections, strict=True):
            assert np.array_equal(again.posterior, described.posterior)


def test_change_as_small_as_smallest_object_is_noticed() -> None:
    """60 points are an object: if 8 by 8 pixels change, the frame must not count as repeated."""
    frame = blank()
    assert frame.depth is not None
    for row, column in ((240, 320), (241, 323), (101, 77)):
        depth = frame.depth.copy()
        depth[row : row + 8, column : column + 8] = 0.8
        other = replace(frame, depth=depth)
        assert not shows_the_same(other, None, frame, None, range_m=2.0)
        assert not shows_the_same(frame, None, other, None, range_m=2.0)


def test_single_pixels_and_distant_surfaces_are_not_a_change() -> None:
    frame = blank()
    assert frame.depth is not None
    depth = frame.depth.copy()
    depth[::7, ::5] = 0
    assert shows_the_same(replace(frame, depth=depth), None, frame, None, range_m=2.0)
    far = replace(frame, depth=np.full_like(frame.depth, 3.0))
    farther = replace(frame, depth=np.full_like(frame.depth, 4.0))
    assert shows_the_same(far, None, farther, None, range_m=2.0)
    assert not shows_the_same(far, None, farther, None, range_m=3.5)


@pytest.mark.parametrize(
    ("pose", "then", "same"),
    [
        (IDENTITY, IDENTITY, True),
        (Pose(np.eye(3), np.array([0.002, 0, 0])), IDENTITY, True),
        (Pose(np.eye(3), np.array([0.01, 0, 0])), IDENTITY, False),
        (Pose(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.zeros(3)), IDENTITY, False),
        (None, IDENTITY, False),
        (IDENTITY, None, False),
    ],
)
def test_same_scene_requires_known_and_equal_poses(
    pose: Pose | None, then: Pose | None, same: bool
) -> None:
    assert shows_the_same(blank(), pose, blank(), then, range_m=2.0) is same


def test_tables_record_reuse_within_each_block(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks have fixed starts, so that any worker and any resumed run reuses the same frames."""
    monkeypatch.setattr(shapecat.pipeline, "load_model", lambda _path: Guesser())
    source = record(still_world(10), tmp_path / "still.mcap", seed=1, sensor=KINECT)
    out = tmp_path / "out"
    shapecat.pipeline.process(
        Job(source, out, mcap=False, rrd=False, settings=Settings(reuse_frames=4))
    )
    frames = pq.read_table(out / "frames.parquet").to_pylist()
    detections = pq.read_table(out / "detections.parquet").to_pylist()
    starts = [None, 0, 0, 0, None, 4, 4, 4, None, 8]
    assert [row["reused_from"] for row in frames] == starts
    assert {(row["frame"], row["reused_from"]) for row in detections} == set(enumerate(starts))
    for row in detections:
        first = next(
            other
            for other in detections
            if other["frame"] == (row["frame"] // 4) * 4 and other["detection"] == row["detection"]
        )
        for name in ("posterior", "novelty", "descriptor", "neurons", "edges", "category"):
            assert row[name] == first[name]


def test_frame_has_same_result_whatever_its_number() -> None:
    """A recording cut at its beginning has the same frames, with other numbers."""
    guesser: Any = Guesser()
    perceiver = Perceiver(guesser, Settings(), None)
    neurons = []
    for index, stamp_ns in ((0, 500), (7, 500), (0, 501)):
        frame = replace(blank(index), stamp_ns=stamp_ns)
        (perception,) = perceiver([PerceptionInput(frame, None)])
        neurons.append(np.concatenate([d.gas.neurons for d in perception.detections]))

    assert np.array_equal(neurons[0], neurons[1])
    assert not np.array_equal(neurons[0], neurons[2])


def test_blocks_of_one_frame_reuse_nothing() -> None:
    guesser: Any = Guesser()
    perceiver = Perceiver(guesser, Settings(), None)
    frame = blank()
    for k in range(2):
        (perception,) = perceiver([PerceptionInput(replace(frame, index=k), None, (), IDENTITY)])
        assert {d.reused_from for d in perception.detections} == {None}


@pytest.mark.parametrize("count", [0, 65])
def test_reuse_frames_out_of_bounds_is_refused(count: int) -> None:
    with pytest.raises(ConfigError, match="reuse_frames must be from 1 to 64"):
        Settings(reuse_frames=count)


def test_repeated_views_add_no_evidence() -> None:
    """Thirty repeats of one wrong view must not outvote three right ones."""
    described = [0, 0, 0, 0, 0, 5, 6, 7]
    frames = [
        FrameDetections(
            topic="/d",
            frame=k,
            stamp_ns=k,
            detections=np.array([0]),
            centers=np.zeros((1, 3)),
            sizes=np.ones((1, 3)),
            posteriors=np.array([[0.5, 0.5]]),
            partial=np.array([k == 6]),
            novelties=np.zeros(1),
            described=np.array([origin]),
        )
        for k, origin in enumerate(described)
    ]
    hits = next(gather(frames))
    assert hits.weights(np.arange(8)).tolist() == [1, 0, 0, 0, 0, 1, 0.25, 1]
    # A track that begins with a repeat has no other view.
    assert hits.weights(np.arange(2, 8)).tolist() == [1, 0, 0, 1, 0.25, 1]
    plain = next(gather([replace(frame, described=None) for frame in frames]))
    assert plain.weights(np.arange(8)).tolist() == [1, 1, 1, 1, 1, 1, 0.25, 1]


def test_frames_of_two_topics_are_separate_views() -> None:
    frames = [
        FrameDetections(
            topic=topic,
            frame=0,
            stamp_ns=k,
            detections=np.array([0]),
            centers=np.zeros((1, 3)),
            sizes=np.ones((1, 3)),
            posteriors=np.array([[0.5, 0.5]]),
            partial=np.array([False]),
            novelties=np.zeros(1),
            described=np.array([0]),
        )
        for k, topic in enumerate(("/a", "/b"))
    ]
    assert next(gather(frames, ("/a", "/b"))).weights(np.arange(2)).tolist() == [1, 1]
