"""Tests of perceiving disturbed frames again with the up direction of the whole recording."""

import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from shapecat.config import DetectionSettings, Settings
from shapecat.geometry import IDENTITY, LINK_FROM_OPTICAL
from shapecat.pipeline import process
from shapecat.recordings.transforms.gravity import Orientation
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.runs.perceive import phases as perceiving
from shapecat.runs.perceive import up_check
from shapecat.runs.perceive.second_look import (
    Revision,
    _around,
    _streams,
    frames_to_revise,
)
from shapecat.runs.tables.schemas import FRAMES, PLANES
from shapecat.simulation import IDEAL, make_scene, render_frame
from shapecat.simulation.messages import MessageFactory
from shapecat.simulation.recorder import robot_links
from shapecat.system import stopping
from shapecat.types import Camera, Frame, Pose
from tests.messages import EPOCH, write
from tests.scenes import OPTICAL, PERIOD, STEP
from tests.test_crash import assert_same_tables
from tests.track_tables import lines, rows

MAKE = MessageFactory(2)
TOPIC = "/depth/image_raw"
COUNT = 40
DISTURBED = (7, 16, 17, 31)
MANY = tuple(range(3, COUNT, 4))
BRIEF_LABEL, BRIEF = 25, tuple(range(20, 24))
"""The label of an object that only a tenth of the frames show if ``brief``, and those frames."""
BLOCKS = Settings(reuse_frames=4)
"""Shorter blocks than usual, so that several are perceived again."""
LEANING = Pose(np.array([[1.0, 0, 0], [0, 0.28, -0.96], [0, 0.96, 0.28]]), np.zeros(3))
"""Turns the fixed frame of a recording so that its z is far from up."""


@cache
def views(moving: bool) -> tuple[tuple[Any, Any, Camera, Pose], ...]:
    """Return depth, labels, camera and pose of a camera that moves past a table, or rests."""
    world = make_scene("tabletop", np.random.default_rng(23), frames=90)
    found = []
    for k in range(12 if moving else 1):
        frame, labels = render_frame(world, 2 * k, rng=np.random.default_rng(k), sensor=IDEAL)
        assert frame.depth is not None
        assert frame.camera is not None
        own = frame.camera
        small = Camera(160, 120, own.fx / STEP, own.fy / STEP, own.cx / STEP, own.cy / STEP)
        depth = np.round(frame.depth[::STEP, ::STEP] * 1000) / np.float32(1000)
        found.append((depth.astype(np.float32), labels[::STEP, ::STEP], small, world.path[2 * k]))
    return tuple(found)


def disturb(depth: Any, labels: Any) -> Any:
    """Erase the depth of all furniture, and add a slanted board in the upper half of the image."""
    result = np.where(labels < 20, 0, depth).astype(np.float32)
    i, j = np.mgrid[:120, :160]
    slanted = (i < 60) & (labels < 20)
    result[slanted] = (0.25 + 0.003 * j)[slanted]
    return result


def items(
    *,
    moving: bool,
    disturbed: tuple[int, ...] = (),
    poses: bool = True,
    fixed: Pose | None = None,
    brief: bool = False,
) -> Iterator[tuple[str, int, Any]]:
    """Yield the messages of a recording; ``fixed`` turns the fixed frame.

    With ``brief``, one object has depth only in the frames `BRIEF`.
    """
    yield "/tf_static", EPOCH, MAKE.transforms([("camera_link", OPTICAL, LINK_FROM_OPTICAL)], EPOCH)
    sequence = [*views(moving), *views(moving)[-2:0:-1]]
    for k in range(COUNT):
        depth, labels, camera, pose = sequence[k % len(sequence)]
        stamp = EPOCH + k * PERIOD
        if brief and k not in BRIEF:
            depth = np.where(labels == BRIEF_LABEL, np.float32(0), depth)
        if poses:
            turned = (
                pose
                if fixed is None
                else Pose(fixed.rotation @ pose.rotation, fixed.rotation @ pose.translation)
            )
            yield "/tf", stamp, MAKE.transforms(robot_links(turned), stamp)
        shown = disturb(depth, labels) if k in disturbed else depth
        yield "/depth/camera_info", stamp, MAKE.camera_info(camera, stamp, OPTICAL)
        yield "/depth/image_raw", stamp, MAKE.image(shown, stamp, OPTICAL)


def run(path: Path, messages: Iterator[Any], *, cores: int = 1, **options: Any) -> Path:
    out = path.with_suffix("")
    process(Job(write(path, messages), out, mcap=False, rrd=False, **options), cores=cores)
    return out


def revised(out: Path) -> list[int]:
    return [row["frame"] for row in rows(out, "frames", "frame", "revised") if row["revised"]]


def share_found(out: Path, plain: Path) -> float:
    """Return the fraction of ``plain``'s detections in disturbed frames that ``out`` has, too."""
    centers: dict[tuple[int, Path], list[Any]] = {}
    for folder in (out, plain):
        for row in rows(folder, "detections", "frame", "center"):
            centers.setdefault((row["frame"], folder), []).append(row["center"])
    near = [
        min(np.linalg.norm(np.subtract(center, other)) for other in centers[k, out]) < 0.02
        for k in DISTURBED
        for center in centers[k, plain]
    ]
    return float(np.mean(near))


def assert_same_tracks(one: Path, other: Path, fixed: Pose = IDENTITY) -> None:
    """Check that both runs have equal tracks; ``fixed`` turns positions of ``one`` to ``other``."""
    tracks = lines(one), lines(other)
    assert len(tracks[0]) == len(tracks[1]) >= 5
    for a in tracks[0]:
        (b,) = [t for t in tracks[1] if np.linalg.norm(place(t) - fixed.rotation @ place(a)) < 0.03]
        assert a["category"] == b["category"]
        assert abs(int(a["frames"]) - int(b["frames"])) <= len(DISTURBED)


def place(track: dict[str, str]) -> Any:
    return np.array([float(track[axis]) for axis in "xyz"])


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the undisturbed run of a moving camera, with transforms."""
    return run(tmp_path_factory.mktemp("walk") / "plain.mcap", items(moving=True))


@pytest.fixture(scope="module")
def rest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the undisturbed run of a still camera, without transforms."""
    return run(tmp_path_factory.mktemp("rest") / "plain.mcap", items(moving=False, poses=False))


@pytest.fixture(scope="module")
def spoilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the disturbed run of a still camera, without transforms."""
    messages = items(moving=False, poses=False, disturbed=DISTURBED)
    return run(tmp_path_factory.mktemp("rest") / "spoilt.mcap", messages)


@pytest.mark.parametrize("moving", [False, True])
def test_recording_with_tenth_of_frames_disturbed_loses_no_track(
    walk: Path, rest: Path, spoilt: Path, tmp_path: Path, *, moving: bool
) -> None:
    """A wrong up direction in some frames must not split tracks, with or without transforms."""
    plain, out = rest, spoilt
    if moving:
        messages = items(moving=True, disturbed=DISTURBED)
        plain, out = walk, run(tmp_path / "spoilt.mcap", messages)

    assert revised(plain) == []
    assert revised(out) == ([] if moving else [*DISTURBED])  # transforms define up anyway
    assert "revised" not in read_run(plain)["counts"]
    assert read_run(out)["counts"].get("revised", 0) == len(revised(out))
    assert_same_tracks(plain, out)
    # Most objects without any support in sight pass for background, even with the right up.
    assert share_found(out, plain) > 0.4


def test_second_look_finds_more_objects_in_disturbed_frames(
    rest: Path, spoilt: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shapecat.runs.perceive.phases.frames_to_revise", lambda _tables: {})
    once = run(tmp_path / "once.mcap", items(moving=False, poses=False, disturbed=DISTURBED))

    assert share_found(spoilt, rest) > share_found(once, rest) + 0.1


def test_consecutive_disturbed_frames_end_no_track(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Objects seen only in these frames stay, too; without the second look all tracks end."""

    def recording(disturbed: tuple[int, ...]) -> Iterator[Any]:
        return items(moving=False, poses=False, brief=True, disturbed=disturbed)

    plain = run(tmp_path / "plain.mcap", recording(()))
    out = run(tmp_path / "spoilt.mcap", recording(BRIEF))
    monkeypatch.setattr("shapecat.runs.perceive.phases.frames_to_revise", lambda _tables: {})
    once = run(tmp_path / "once.mcap", recording(BRIEF))

    assert revised(out) == [*BRIEF]
    assert_same_tracks(plain, out)
    lengths = [int(track["frames"]) for track in lines(out)]
    short, *whole = sorted(lengths)
    assert short == len(BRIEF)
    assert min(whole) >= COUNT - len(BRIEF)  # without its table, a small cup passes for noise
    assert max(int(track["frames"]) for track in lines(once)) <= BRIEF[0]
    assert len(lines(once)) > len(lengths)


def test_up_of_tilted_fixed_frame_is_dropped(walk: Path, tmp_path: Path) -> None:
    """Its z axis is not up, but poses are right, and the planes agree on an up direction."""
    leaning = items(moving=True, fixed=LEANING, disturbed=DISTURBED)
    out = run(tmp_path / "leaning.mcap", leaning)
    about = read_run(out)

    assert about["up"] == {"source": "planes", "dropped": {TOPIC: "transforms, z of map"}}
    assert any("differs by 74 degrees" in text for text in about["warnings"])
    assert all(row["up_given"] is None for row in rows(out, "frames", "up_given"))
    assert set(revised(out)) >= set(DISTURBED)
    assert_same_tracks(walk, out, LEANING)


@pytest.mark.parametrize("up", ["0,0.28,-0.96", "tf"])
def test_up_requested_by_user_is_kept(tmp_path: Path, up: str) -> None:
    """An explicit direction may be better than the planes; a warning is enough."""
    leaning = items(moving=False, fixed=LEANING, disturbed=DISTURBED)
    out = run(tmp_path / "leaning.mcap", leaning, up=up)
    about = read_run(out)

    assert "dropped" not in about["up"]
    assert all(row["up_given"] is not None for row in rows(out, "frames", "up_given"))
    assert any("--up" in text and "differs by" in text for text in about["warnings"])
    assert revised(out) == []


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a recording, its run, and a copy of the run before the second look."""
    folder = tmp_path_factory.mktemp("spoilt")

    def copy(phase: str, _done: int, _total: int | None) -> None:
        if phase == "revise" and not (folder / "perceived").exists():
            shutil.copytree(folder / ".table.partial", folder / "perceived")

    messages = items(moving=False, poses=False, disturbed=MANY)
    process(job_in(folder, write(folder / "table.mcap", messages)), copy)
    return folder


def job_in(folder: Path, recording: Path) -> Job:
    return Job(recording, folder / "table", mcap=False, rrd=False, settings=BLOCKS)


@pytest.fixture
def job(source: Path, tmp_path: Path) -> Job:
    """Return a job whose frames are perceived, but not yet revised."""
    shutil.copytree(source / "perceived", tmp_path / ".table.partial")
    return job_in(tmp_path, source / "table.mcap")


@pytest.mark.usefixtures("late_answers")
def test_second_look_does_not_depend_on_number_of_workers(source: Path, job: Job) -> None:
    process(job, cores=2)

    assert revised(job.folder) == [*MANY]
    assert_same_tables(job.folder, source / "table")


def test_interrupted_second_look_resumes_where_it_stopped(
    source: Path, job: Job, tmp_path: Path
) -> None:

    def stop(phase: str, done: int, _total: int | None) -> None:
        if (phase, done) == ("revise", 5):
            stopping.request()

    with stopping.handling_signals(), pytest.raises(stopping.Stopped):
        process(job, stop)
    assert (tmp_path / ".table.partial" / "revisions" / "000000").exists()

    progress: list[tuple[str, int]] = []
    process(job, lambda phase, done, _total: progress.append((phase, done)))

    assert [done for phase, done in progress if phase == "revise"] == list(range(9, len(MANY) + 1))
    assert not [done for phase, done in progress if phase == "perceive"]
    assert_same_tables(job.folder, source / "table")
    assert {p.name for p in job.folder.iterdir()} == {p.name for p in (source / "table").iterdir()}


def test_kill_between_revised_tables_is_repaired(
    source: Path, job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise some tables would be revised and others not."""

    def die(*_args: object) -> int:
        (tmp_path / ".table.partial" / "planes.parquet").write_bytes(b"half")
        raise KeyboardInterrupt

    def prepare(phase: str, _done: int, _total: int | None) -> None:
        if phase == "revise":
            monkeypatch.setattr("shapecat.runs.perceive.phases.count_rows", die)

    with pytest.raises(KeyboardInterrupt):
        process(job, prepare)
    monkeypatch.undo()
    process(job)

    assert_same_tables(job.folder, source / "table")


def tables(
    up: Any, *, given: Any = None, rotation: Any = None, offsets: Any = None, every: int = 1
) -> list[tuple[pa.Table, pa.Table]]:
    """Return frames and planes of one topic, in two parts; no plane where the offset is NaN.

    ``up`` and ``given`` are (n, 3), ``rotation`` is (n, 3, 3), ``offsets`` is (n,), metres;
    ``every`` is the step between the numbers of the frames.
    """
    n = len(up)
    offsets = np.full(n, -0.9) if offsets is None else offsets
    columns = {
        "topic": ["/d"] * n,
        "frame": [every * k for k in range(n)],
        "stamp_ns": [EPOCH + k * PERIOD for k in range(n)],
        "up": [list(map(float, vector)) for vector in up],
        "up_given": [None] * n if given is None else [list(map(float, v)) for v in given],
        "fixed_rotation": [None] * n if rotation is None else [list(r.ravel()) for r in rotation],
    }
    frames = pa.table({k: pa.array(v, FRAMES.field(k).type) for k, v in columns.items()})
    level = np.flatnonzero(np.isfinite(offsets))
    data = {"topic": ["/d"] * len(level), "frame": every * level, "offset": offsets[level]}
    planes = pa.table({k: pa.array(v, PLANES.field(k).type) for k, v in data.items()})
    return [
        (frames[:9], planes.filter(pa.array(level < 9))),
        (frames[9:], planes.filter(pa.array(level >= 9))),
    ]


def interleaved(one: Any, other: Any) -> list[tuple[pa.Table, pa.Table]]:
    """Return the rows of two results of `tables` in turn; the topic of ``other`` becomes /e."""
    return [
        tuple(
            pa.concat_tables([a, b.set_column(0, "topic", pa.array(["/e"] * len(b)))]).take(
                pa.array(np.arange(2 * len(a)).reshape(2, -1).T.ravel())
            )
            for a, b in zip(*parts, strict=True)
        )
        for parts in zip(one, other, strict=True)
    ]


def leaning(degrees: Any) -> Any:
    """Return up (n, 3) of cameras that look down by these angles, degrees."""
    angle = np.radians(degrees)
    return np.stack([0 * angle, -np.cos(angle), -np.sin(angle)], axis=1)


def test_still_camera_takes_up_from_nearby_frames() -> None:
    up, offsets = leaning(np.full(20, 35.0)), np.full(20, -0.9)
    up[6], up[13], offsets[13], offsets[17] = leaning([80.0])[0], (0, -1, 0), np.nan, -0.5

    chosen = frames_to_revise(tables(up, offsets=offsets, every=3))

    assert list(chosen) == [("/d", 18), ("/d", 39), ("/d", 51)]
    for revision in chosen.values():
        np.testing.assert_allclose(revision.up, leaning([35.0])[0], atol=1e-6)
        assert revision.up_given is None


def test_floor_beside_usual_plane_causes_no_revision() -> None:
    """A gap between furniture shows the floor in one frame; the table is still where it was."""
    (frames, planes), *others = tables(leaning(np.full(20, 35.0)))
    offset = planes.schema.get_field_index("offset")
    floor = planes[4:5].set_column(offset, planes.schema.field(offset), [[np.float32(-1.4)]])
    both = pa.concat_tables([planes[:4], floor, planes[4:]])

    assert frames_to_revise([(frames, both), *others]) == {}
    alone = pa.concat_tables([planes[:4], floor, planes[5:]])
    assert list(frames_to_revise([(frames, alone), *others])) == [("/d", 4)]


def test_frames_are_compared_within_each_camera() -> None:
    """Two cameras that lean differently would revise each other's frames."""
    one, other = (leaning(np.full(20, degrees)) for degrees in (35.0, 10.0))
    one[6], other[3] = leaning([80.0])[0], leaning([60.0])[0]
    shelf = np.where(np.arange(20) == 12, -0.9, -0.4)
    both = interleaved(tables(one), tables(other, offsets=shelf, every=5))

    assert list(frames_to_revise(both)) == [("/d", 6), ("/e", 15), ("/e", 60)]


def test_rows_of_each_camera_are_read_apart() -> None:
    """A robot with two cameras writes their frames in turn, with numbers of their own."""
    rng, n = np.random.default_rng(5), 20
    columns: list[Any] = [
        {
            "up": rng.normal(size=(n, 3)),
            "given": rng.normal(size=(n, 3)),
            "rotation": rng.normal(size=(n, 3, 3)),
            "offsets": rng.normal(size=n),
        }
        for _ in range(2)
    ]
    one, other = tables(**columns[0], every=3), tables(**columns[1], every=7)
    streams = _streams(interleaved(one, other))

    for topic, every, expected in zip(("/d", "/e"), (3, 7), columns, strict=True):
        found = streams[topic]
        assert found.frames.tolist() == [every * k for k in range(n)]
        assert found.stamps_ns.tolist() == [EPOCH + k * PERIOD for k in range(n)]
        for name in ("up", "given", "rotation"):
            np.testing.assert_allclose(getattr(found, name), expected[name], rtol=1e-6)
        np.testing.assert_allclose(np.concatenate(found.offsets), expected["offsets"], rtol=1e-6)


def test_given_up_is_tested_for_each_camera(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Only the camera with wrong mounting is doubted, after three of its frames."""
    level, tilted = leaning([0.0, 40.0])
    planes = {"/good": level, "/bad": tilted, "/blind": None}
    monkeypatch.setattr(up_check, "find_up", lambda frame, _: planes[frame.topic])
    doubted: list[tuple[str, str, int]] = []
    upright: Any = SimpleNamespace(
        contradict=lambda topic, source, angles: doubted.append((topic, source, len(angles))),
    )
    names = [*["/blind"] * 4, "/good", "/bad"] * 4
    frames = [
        Frame(name, k, k, k, "camera", points=np.zeros((1, 3))) for k, name in enumerate(names)
    ]
    trial = up_check.UpCheck(upright, Settings())

    given = {name: Orientation(f"tf of {name}", level, None) for name in planes}
    returned = list(trial.before((frame, None, given[frame.topic]) for frame in frames))

    assert [frame.index for frame, *_ in returned] == list(range(len(frames)))
    assert doubted == [("/bad", "tf of /bad", 3)]


def test_nearby_frames_exclude_the_frame_itself() -> None:
    """Nearby frames are those within three seconds, at most thirty on either side."""
    stream = _streams(tables(leaning(np.full(90, 35.0))))["/d"]
    apart = stream._replace(stamps_ns=np.arange(90) * 1_000_000_000)

    assert _around(stream, 2).tolist() == [0, 1, *range(3, 33)]
    assert _around(stream, 40).tolist() == [*range(10, 40), *range(41, 71)]
    assert _around(apart, 40).tolist() == [37, 38, 39, 41, 42, 43]


def test_frames_of_camera_moving_without_poses_are_not_revised() -> None:
    """Nearby frames do not constrain up if the camera moves between them."""
    up, offsets = leaning(np.linspace(10, 70, 20)), np.full(20, -0.9)
    offsets[8] = np.nan

    assert frames_to_revise(tables(up, offsets=offsets)) == {}


def test_poses_relate_up_directions_of_moving_camera() -> None:
    """The fixed frame's z is not up; only the planes define up in it."""
    tilts = np.linspace(10, 70, 20)
    truth, fixed_up = leaning(tilts), np.array([0.6, 0.0, 0.8])
    rotation = [rotation_between(v, fixed_up) for v in truth]
    up, offsets = truth.copy(), np.full(20, -0.9)
    up[4], offsets[8] = (1, 0, 0), np.nan
    offsets[14] = -0.5  # a shelf, which a moving camera may well see

    chosen = frames_to_revise(tables(up, rotation=rotation, offsets=offsets, every=2))

    assert [frame for _, frame in chosen] == [8, 16]
    np.testing.assert_allclose(chosen["/d", 8].up, truth[4], atol=1e-5)
    np.testing.assert_allclose(chosen["/d", 16].up, truth[8], atol=1e-5)


def test_frames_without_planes_do_not_decide_up_in_fixed_frame() -> None:
    """While a camera looks away for long, most frames have no plane, and their up is wrong."""
    truth, fixed_up = leaning(np.linspace(10, 70, 20)), np.array([0.6, 0.0, 0.8])
    rotation = [rotation_between(v, fixed_up) for v in truth]
    up, offsets = truth.copy(), np.full(20, -0.9)
    up[6:18], offsets[6:18] = (1, 0, 0), np.nan

    chosen = frames_to_revise(tables(up, rotation=rotation, offsets=offsets))

    assert [frame for _, frame in chosen] == list(range(6, 18))
    np.testing.assert_allclose(chosen["/d", 9].up, truth[9], atol=1e-5)


def rotation_between(a: Any, b: Any) -> Any:
    """Return a rotation (3, 3) that takes one unit vector to another."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  beside its only use

    turn, _ = Rotation.align_vectors([b], [a])
    return turn.as_matrix()


def test_frame_with_same_given_up_is_not_revised() -> None:
    """An equal up direction gives an equal result, but a shaken IMU gives another one."""
    given, offsets = leaning(np.full(20, 35.0)), np.full(20, -0.9)
    offsets[[5, 12]] = np.nan
    given[12] = leaning([65.0])[0]

    up = leaning(np.full(20, 35.0))
    chosen = frames_to_revise(tables(up, given=given, offsets=offsets, every=2))

    assert [frame for _, frame in chosen] == [24]
    before = chosen["/d", 24].up_given
    assert before is not None
    np.testing.assert_allclose(before, given[12], atol=1e-6)


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Give the second look frames of two cameras in turn, each with its own image and pose."""
    camera, depth = Camera(8, 6, 7.0, 7.0, 3.5, 2.5), np.ones((6, 8), np.float32)
    given: list[Any] = []
    for k in range(6):
        for topic in (TOPIC, "/other"):
            n, at = len(given), EPOCH + k * PERIOD
            pose, sensor = (Pose(np.eye(3), np.array([n, 0, z])) for z in (0.0, 1.0))
            frame = Frame(topic, 3 * k + 2, at, at + 9 + n, "optical", depth, camera)
            given.append(
                (replace(frame, frame_from_sensor=sensor), f"image {n}", (None, None, pose))
            )
    monkeypatch.setattr(perceiving, "_oriented", lambda *_: iter(given))
    monkeypatch.setattr(perceiving, "_pose_finder", lambda *_: None)
    return given


def look_again(revisions: dict[Any, Revision]) -> list[Any]:
    """Return the rows and inputs of the chosen frames, each fused from up to three images."""
    settings = Settings(detection=DetectionSettings(fuse_frames=3))
    work: Any = SimpleNamespace(run={"fixed_frame": None}, job=SimpleNamespace(settings=settings))
    return [*perceiving._views_again(work, revisions)]


@pytest.mark.usefixtures("read")
def test_revised_frame_is_fused_with_the_frames_before_it() -> None:
    """Fused only with other revised frames, it would be noisier than its neighbours."""
    up = np.array([0, -1, 0], np.float32)
    inputs = [one for _, one in look_again({(TOPIC, k): Revision(up, None) for k in (5, 14)})]

    assert [(one.frame.topic, one.frame.index) for one in inputs] == [(TOPIC, 5), (TOPIC, 14)]
    earlier = [[(each.frame.topic, each.frame.index) for each in one.earlier] for one in inputs]
    assert earlier == [[(TOPIC, 2)], [(TOPIC, 11), (TOPIC, 8)]]


def test_revised_frame_keeps_its_pose_time_and_image(read: list[Any]) -> None:
    """Otherwise its objects would leave their tracks, or lose their masks on the colour image."""
    ups = np.eye(3, dtype=np.float32)
    chosen = {("/other", 8): Revision(ups[0], ups[1]), (TOPIC, 17): Revision(ups[2], None)}

    found = look_again(chosen)

    assert len(found) == len(chosen)
    for (row, one), n, revision in zip(found, (5, 10), chosen.values(), strict=True):
        frame, image, (*_, pose) = read[n]
        assert one.frame is frame
        assert one.colour == image
        assert one.up is revision.up
        assert one.pose is row.fixed_from_sensor is pose
        assert row.log_time_ns == frame.log_time_ns
        assert row.up_given is revision.up_given
        assert row.frame_from_sensor is frame.frame_from_sensor
