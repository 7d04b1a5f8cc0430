"""Tests of fusing consecutive depth images: moving surfaces must not smear."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shapecat.arrays import F4
from shapecat.config import Settings, with_overrides
from shapecat.depth_fusion import Earlier, RecentFrames, fuse
from shapecat.depth_fusion.fusion import REACH
from shapecat.errors import ConfigError
from shapecat.geometry import AGREE, IDENTITY
from shapecat.perception import Perceiver, PerceptionInput
from shapecat.pipeline import process
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.simulation import KINECT, make_scene, render_frame
from shapecat.simulation.messages import MessageFactory
from shapecat.simulation.scenes.paths import looking_at
from shapecat.types import Camera, Frame, Pose
from tests.conftest import Guesser
from tests.messages import SECOND, write
from tests.scenes import record, stream
from tests.test_crash import assert_same_tables

CAMERA = Camera(160, 120, 131.0, 131.0, 79.5, 59.5)
EYE = (0.0, -0.8, 0.6)
BOX = ((-0.08, 0.08), (-0.05, 0.05), (0.0, 0.15))
RANGE_M = 2.0
TICK = SECOND // 30


def render_depth(pose: Pose, box: Any = BOX) -> F4:
    """Return the true depth (h, w) of a box on a floor; ``box`` is its limits (3, 2), or None."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1
    )
    direction, eye = rays @ pose.rotation.T, pose.translation
    with np.errstate(divide="ignore"):
        floor = np.where(direction[..., 2] < 0, -eye[2] / direction[..., 2], 0)
        if box is None:
            return floor.astype(np.float32)
        limits = np.sort((np.array(box).T[:, None, None] - eye) / direction, axis=0)
    near, far = limits[0].max(axis=-1), limits[1].min(axis=-1)
    return np.where((near < far) & (near > 0), near, floor).astype(np.float32)


def frame(depth: F4, stamp_ns: int = 0, **changes: Any) -> Frame:
    made = Frame("depth", 0, stamp_ns, 0, "camera", depth=depth, camera=CAMERA)
    return replace(made, **changes)


def noisy(depth: F4, rng: np.random.Generator, deviation: float = 0.0015) -> F4:
    """Add noise to the inverse depth, as a depth camera does."""
    with np.errstate(divide="ignore"):
        inverse = 1 / depth + rng.normal(0, deviation, depth.shape)
    return np.where(depth > 0, 1 / inverse, 0).astype(np.float32)


def errors(depth: F4, truth: F4) -> F4:
    """Return the errors of the inverse depth at valid pixels in range."""
    used = (depth > 0) & (truth < RANGE_M - 0.1)
    return np.asarray(1 / depth[used] - 1 / truth[used])


def fused(now: F4, *earlier: tuple[F4, Pose | None]) -> F4:
    others = [Earlier(frame(depth), pose) for depth, pose in earlier]
    result = fuse(frame(now), others, range_m=RANGE_M).depth
    if result is None:
        raise ValueError
    return result


def moved(pose: Pose, other: Pose) -> Pose:
    """Return the first pose in the frame of the other one."""
    turn = other.rotation.T
    return Pose(turn @ pose.rotation, turn @ (pose.translation - other.translation))


def home(*shift: float, gaze: tuple[float, ...] = (0.0, 0.0, 0.0), roll: float = 0.0) -> Pose:
    """Return the pose of a camera that looks at ``gaze`` from `EYE`, displaced by ``shift`` (m)."""
    return looking_at(np.add(EYE, shift), np.array(gaze), roll=roll)


HOME = home(0.0, 0.0, 0.0)


def test_single_frame_is_unchanged() -> None:
    """The default must not change a single bit."""
    alone = frame(render_depth(HOME))
    recent = RecentFrames(Settings().detection.fuse_frames)
    for stamp in (0, TICK):
        assert recent.before(replace(alone, stamp_ns=stamp), IDENTITY) == ()
    assert fuse(alone, (), range_m=RANGE_M) is alone


@pytest.mark.parametrize("pose", [IDENTITY, None])
@pytest.mark.parametrize("count", [2, 4])
def test_noise_falls_with_root_of_number_of_frames(pose: Pose | None, count: int) -> None:
    rng = np.random.default_rng(1)
    truth = render_depth(HOME)
    now, *others = (noisy(truth, rng) for _ in range(count))

    result = fused(now, *((depth, pose) for depth in others))

    ratio = errors(result, truth).std() / errors(now, truth).std()
    assert ratio == pytest.approx(1 / np.sqrt(count), rel=0.1)
    assert np.array_equal(result[now > RANGE_M], now[now > RANGE_M])


shifts = st.floats(-0.03, 0.03)
turns = st.floats(-0.05, 0.05)


@settings(deadline=None, max_examples=20)
@given(shifts, shifts, shifts, turns, turns, turns)
def test_fusion_compensates_for_camera_motion(
    x: float, y: float, z: float, right: float, up: float, roll: float
) -> None:
    """A wrong direction or order of the transforms would displace every surface."""
    other = home(x, y, z, gaze=(right, 0.0, up), roll=roll)
    now, before = render_depth(HOME), render_depth(other)

    result = fused(now, (before, moved(HOME, other)))

    # Between pixels, the edge of the box may be mistaken for a slope of less than AGREE.
    assert np.abs(errors(result, now)).max() <= 0.55 * AGREE
    assert np.percentile(np.abs(errors(result, now)), 95) < 2e-4


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("slide", [0.004, -0.004])
def test_sliding_camera_is_not_taken_for_still(axis: int, slide: float) -> None:
    """On a linear axis, a camera does not turn: taken for still, it would smear surfaces."""
    other = home(0.0, 0.0, 0.0, roll=0.6)  # no surface is parallel to an axis of the camera
    pose = Pose(other.rotation, other.translation + slide * other.rotation[:, axis])
    now, before = render_depth(pose), render_depth(other)

    result = fused(now, (before, moved(pose, other)))

    assert np.percentile(np.abs(errors(before, now)), 50) > 5e-4  # or there was nothing to notice
    assert np.percentile(np.abs(errors(result, now)), 95) < 2e-4


def test_noise_falls_while_camera_moves() -> None:
    """Fusing nothing would pass the other tests."""
    rng = np.random.default_rng(2)
    recent = RecentFrames(3)
    for k in range(3):
        pose = home(0.02 * k, 0.01, -0.01 * k, roll=0.01 * k)
        truth = render_depth(pose)
        now = noisy(truth, rng)
        earlier = recent.before(frame(now, k * TICK), pose)

    result = fused(now, *((other.depth, p) for other, p in earlier if other.depth is not None))

    assert len(earlier) == 2
    assert errors(result, truth).std() < 0.67 * errors(now, truth).std()


def test_image_that_contradicts_its_pose_is_not_fused() -> None:
    """Without poses, or with wrong ones, a moving camera would smear everything."""
    other = home(0.05, 0.0, -0.04)
    now = render_depth(HOME)

    for pose in (None, IDENTITY, moved(other, HOME)):
        assert np.array_equal(fused(now, (render_depth(other), pose)), now)
    assert not np.array_equal(fused(now, (render_depth(other), moved(HOME, other))), now)


def shifted_box(x: float) -> Any:
    (left, right), *others = BOX
    return ((left + x, right + x), *others)


@pytest.mark.parametrize("box", [shifted_box(0.03), shifted_box(-0.06), shifted_box(0.2), None])
def test_moved_or_new_object_does_not_smear(box: Any) -> None:
    """No pixel may mix two surfaces, neither at the object's new nor at its old position."""
    now, before = render_depth(HOME), render_depth(HOME, box)

    for depth, others in ((now, before), (before, now)):
        result = fused(depth, (others, IDENTITY), (others, IDENTITY))
        same = np.abs(1 / now - 1 / before) < 1e-6
        assert np.allclose(result[same], depth[same], rtol=1e-6)
        assert np.abs(errors(result, depth)).max() <= AGREE
        assert np.count_nonzero(np.abs(errors(result, depth)) > 1e-6) < 0.005 * depth.size


def test_holes_are_filled_from_earlier_images() -> None:
    rng = np.random.default_rng(3)
    truth = render_depth(HOME)
    now, *others = (np.where(rng.random(truth.shape) < 0.3, 0, truth) for _ in range(3))

    result = fused(now, *((depth, IDENTITY) for depth in others))

    near = truth < RANGE_M
    assert np.mean(now[near] == 0) > 0.25
    assert np.mean(result[near] == 0) < 0.04
    assert np.abs(errors(result, truth)).max() < 1e-5


def test_removed_object_does_not_fill_the_hole_it_left() -> None:
    """Where it stood, the sensor may briefly measure nothing; the object must not reappear."""
    empty = render_depth(HOME, None)
    removed = np.abs(empty - render_depth(HOME)) > 1e-6
    now = np.where(removed, 0, empty)

    result = fused(now, (render_depth(HOME), IDENTITY), (render_depth(HOME), IDENTITY))

    ghost = removed & (result > 0)
    edge = np.argwhere(~removed)
    far = [np.abs(edge - pixel).sum(axis=1).min() > REACH for pixel in np.argwhere(ghost)]
    assert not any(far)
    assert np.count_nonzero(ghost) < 0.1 * np.count_nonzero(removed)
    assert np.abs(errors(np.where(ghost, result, 0), empty)).max(initial=0) < 0.05


def kept(frames: Sequence[tuple[Frame, Pose | None]], count: int = 3) -> list[int]:
    recent = RecentFrames(count)
    return [len(recent.before(*item)) for item in frames]


def test_recent_frames_are_newest_first_and_limited() -> None:
    """Memory must not grow with the recording."""
    recent, depth = RecentFrames(4), render_depth(HOME)
    for k in range(9):
        found = recent.before(frame(depth, k * TICK, index=k), IDENTITY)
        assert [f.index for f, _ in found] == list(range(k - 1, max(k - 3, 0) - 1, -1))


SMALL = Camera(80, 60, 65.0, 65.0, 39.5, 29.5)


@pytest.mark.parametrize(
    "change",
    [
        {"stamp_ns": TICK},
        {"stamp_ns": 0},
        {"stamp_ns": 3 * SECOND},
        {"frame_id": "other"},
        {"depth": np.ones((60, 80), np.float32), "camera": SMALL},
        {"camera": replace(CAMERA, fx=140.0)},
        {"depth": None, "camera": None, "points": np.ones((5, 3), np.float32)},
    ],
    ids=["same stamp", "clock back", "gap", "frame", "resolution", "lens", "cloud"],
)
def test_discontinuity_drops_earlier_frames(change: Any) -> None:
    """Frames before a clock jump or from another camera show something else."""
    *two, third = (frame(render_depth(HOME), k * TICK) for k in range(3))

    assert kept([(f, IDENTITY) for f in (*two, third)]) == [0, 1, 2]
    assert kept([(f, IDENTITY) for f in (*two, replace(third, **change))]) == [0, 1, 0]


@pytest.mark.parametrize(("apart_ms", "most"), [(200, 5), (500, 5), (501, 0)])
def test_only_a_gap_before_the_newest_image_restarts_fusion(apart_ms: int, most: int) -> None:
    """A slow camera would be fused from fewer images than the user asked for."""
    apart_ns = apart_ms * SECOND // 1000
    slow = [(frame(render_depth(HOME), k * apart_ns), IDENTITY) for k in range(9)]

    assert kept(slow, 6) == [min(k, most) for k in range(9)]


def test_topics_are_separate_and_lost_pose_drops_frames() -> None:
    depth = render_depth(HOME)
    ticks = [frame(depth, k * TICK) for k in range(4)]
    turns = [(replace(f, topic=t), IDENTITY) for f in ticks for t in ("left", "right")]

    assert kept(turns) == [0, 0, 1, 1, 2, 2, 2, 2]
    assert kept(list(zip(ticks, (IDENTITY, None, None, IDENTITY), strict=True))) == [0, 0, 1, 0]


@pytest.mark.parametrize("count", [1, 3])
def test_only_topics_with_a_problem_give_a_warning(count: int) -> None:
    """Other sensors are fused as usual and not named; without fusion, there is no warning."""
    recent, points = RecentFrames(count), np.ones((5, 3), np.float32)
    for k, pose in enumerate((IDENTITY, None, None)):
        depth = frame(render_depth(HOME), k * TICK)
        recent.before(replace(depth, topic="/placed"), IDENTITY)
        recent.before(replace(depth, topic="/lost"), pose)
        recent.before(replace(depth, topic="/cloud", depth=None, camera=None, points=points), pose)

    warnings = [text.partition("):")[0] for text in recent.warnings()]
    assert warnings == [
        "/cloud: clouds are not fused, only depth images (frames: 3)",
        "/lost: the pose of the sensor is unknown (frames: 2",
    ] * (count > 1)


@pytest.mark.parametrize("count", [0, 31])
def test_fuse_frames_out_of_bounds_is_refused(count: int) -> None:
    with pytest.raises(ConfigError, match=r"detection\.fuse_frames must be from 1 to 30"):
        with_overrides(Settings(), [f"detection.fuse_frames={count}"])


def with_missing_depth(count: int) -> Iterator[Frame]:
    """Yield frames of a table in which a fifth of the depth is missing."""
    world = make_scene("tabletop", np.random.default_rng(4), frames=1)
    for k in range(count):
        rng = np.random.default_rng(k)
        full, _ = render_frame(world, world.path[0], rng=rng, sensor=KINECT)
        if full.depth is not None:
            depth = np.where(rng.random(full.depth.shape) < 0.2, 0, full.depth)
            yield replace(full, depth=depth, stamp_ns=k * TICK)


def test_indices_refer_to_depth_of_the_frame_itself() -> None:
    """Exports look up indices in the recording, where a filled hole is still a hole."""
    *others, now = with_missing_depth(3)
    earlier = tuple(Earlier(other, IDENTITY) for other in others)
    guesser: Any = Guesser()

    given = PerceptionInput(now, None, earlier)
    (perception,) = Perceiver(guesser, Settings(), None)([given])

    assert len(perception.detections) >= 5
    for found, candidate in zip(perception.detections, perception.scene.candidates, strict=True):
        assert found.candidate is candidate
        assert candidate.indices.size >= 60
        assert np.isfinite(now.xyz(candidate.indices)).all()


@pytest.fixture
def job(tmp_path: Path) -> Job:
    """Return a job that fuses three frames, with a setting that must reach other processes."""
    settings = with_overrides(
        Settings(), ["detection.fuse_frames=3", "surface.neurons=30", "reuse_frames=4"]
    )
    source = record(tmp_path / "table.mcap", 24)
    return Job(source, tmp_path / "one", settings=settings, mcap=False, rrd=False)


@pytest.mark.usefixtures("late_answers")
def test_tables_do_not_depend_on_processes_or_interruptions(job: Job) -> None:
    """Frames are fused with earlier ones, even if another process or run perceived those."""

    def stop(phase: str, done: int, _total: int | None) -> None:
        if (phase, done) == ("perceive", 12):
            raise KeyboardInterrupt

    other = replace(job, folder=job.folder.with_name("other"))
    process(job)
    with pytest.raises(KeyboardInterrupt):
        process(other, stop)
    process(other, cores=2)

    assert 12 <= read_run(other.folder)["counts"]["resumed"] < 24  # or nothing was left to fuse
    assert_same_tables(job.folder, other.folder)
    single = with_overrides(job.settings, ["detection.fuse_frames=1"])
    process(replace(job, folder=job.folder.with_name("single"), settings=single))
    with pytest.raises(AssertionError, match="frames"):  # or nothing was fused
        assert_same_tables(job.folder, job.folder.with_name("single"))


def test_frames_that_cannot_be_fused_are_reported(job: Job, tmp_path: Path) -> None:
    make = MessageFactory(2)
    items = [item for item in stream(make, 4) if "tf" not in item[0]]
    source = write(tmp_path / "still.mcap", items)
    process(replace(job, source=source))

    warning, of_surface = read_run(job.folder)["warnings"]
    assert "the pose of the sensor is unknown (frames: 4)" in warning
    assert of_surface.startswith("changed surface.neurons")
