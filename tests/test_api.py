"""Tests of the Python interface: imports, shapes of arrays, and the examples of its page."""

import io
import json
import os
import pydoc
import re
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from click.testing import Result
from PIL import Image

import shapecat
from shapecat import api
from shapecat.errors import ConfigError, ModelError, OutputError, RecordingError
from shapecat.learning import load_model, save_model
from shapecat.outputs.opened_run import Table
from shapecat.runs.labels.corrections import adopt_labels
from shapecat.types import Camera, Frame
from tests import messages
from tests.conftest import Guesser
from tests.loading import loaded_by
from tests.mcap_files import mcap_writer, read_ros
from tests.messages import EPOCH
from tests.scenes import record
from tests.test_docs_run import run_here
from tests.test_tables_rotated import all_of, frame_of

PAGE = Path(__file__).parents[1] / "docs" / "python.md"


def blocks(kind: str) -> list[str]:
    return re.findall(rf"^```{kind}\n(.*?)^```", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def page_folder(shapecat: Callable[..., Result], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the page in an empty folder: its commands, then its Python blocks as one script."""
    folder = tmp_path_factory.mktemp("python")
    (folder / "page.py").write_text("\n".join(blocks("python")), "utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for line in "".join(blocks("sh")).splitlines():
            run_here(line, shapecat)
        runpy.run_path("page.py", run_name="__main__")
    return folder


def test_posterior_times_start_at_first_frame(guessed_run: Path, tmp_path: Path) -> None:
    """Tracks start at different times; times since their own start could not be compared."""
    run = shapecat.open_run(guessed_run)
    rows = run.tracks.arrow()
    made = np.random.default_rng(0).random((len(rows), len(run.categories)), np.float32)
    at = rows.column_names.index("posterior")
    rows = rows.set_column(at, "posterior", pa.array(list(made)))
    pq.write_table(rows.filter(pc.greater_equal(rows["frame"], 3)), tmp_path / "late.parquet")
    run.tracks = Table(tmp_path / "late.parquet")
    stamps = run.frame_table.numpy("stamp_ns")

    seconds, posteriors = run.posterior(1)

    np.testing.assert_allclose(seconds, (stamps[3:] - stamps[0]) * 1e-9)
    np.testing.assert_array_equal(posteriors, made[rows["track"].to_numpy() == 1][3:])


def test_every_example_on_the_page_runs(page_folder: Path) -> None:
    text = PAGE.read_text("utf-8")
    assert len(blocks("python")) + len(blocks("sh")) == text.count("```") // 2
    assert (page_folder / "posterior.png").read_bytes().startswith(b"\x89PNG")
    (plot,) = (block for block in blocks("python") if "savefig" in block)
    assert len([line for line in plot.splitlines() if line.strip()]) <= 10


def test_frame_points_and_masks_match_tables(page_folder: Path) -> None:
    """A mask of the wrong frame, or a transposed one, would contradict the table."""
    run = shapecat.open_run(page_folder / "results" / "demo")
    rows = pq.read_table(run.folder / "detections.parquet").to_pylist()
    objects = 0
    for frame in run.frames(recording=page_folder / "demo.mcap"):
        assert frame.labels.shape == frame.shape == (480, 640)
        for item in frame.objects:
            objects += 1
            key = (frame.labelled.index, frame.stamp_ns, item.indices.tolist())
            matches = [r for r in rows if (r["frame"], r["stamp_ns"], r["indices"]) == key]
            assert len(matches) == 1
            assert frame.mask(item).ravel().nonzero()[0].tolist() == matches[0]["indices"]
            assert (frame.labels[frame.mask(item)] == item.track).all()
            points = frame.points_of(item)
            assert np.nanmax(np.abs(points.mean(axis=0) - item.box.center)) < item.box.size.max()
            assert item.category == run.labels[item.track]
    assert objects == run.tracks.arrow(["detection"])["detection"].drop_null().length() > 20


def test_colour_masks_cover_their_objects(page_folder: Path) -> None:
    """A shifted mask, or one of another object or frame, would cover something else."""
    run = shapecat.open_run(page_folder / "results" / "demo")
    with np.load(page_folder / "demo.color_labels.npz") as file:
        truth = file["labels"]
    shares, owners = [], set()
    for frame in run.frames(recording=page_folder / "demo.mcap"):
        number = frame.labelled.index
        assert frame.color is not None
        assert frame.color.shape == (*truth[number].shape, 3)
        for item in frame.objects:
            mask = frame.color_mask(item)
            assert mask is not None
            count = np.bincount(truth[number][mask], minlength=256)
            if count.sum() > 400:
                owners.add((item.track, int(count.argmax())))
                shares.append(count.max() / count.sum())
    assert len(shares) > 20
    assert np.median(shares) > 0.9
    assert len({track for track, _ in owners}) == len(owners)  # one object per track
    assert len({label for _, label in owners}) == len(owners)  # and one track per object


def test_frame_with_colour_can_be_sent_to_another_process(page_folder: Path) -> None:
    """A pool of processes refused frames with colour, since views of memory cannot be pickled."""
    run = shapecat.open_run(page_folder / "results" / "demo")
    frame = next(run.frames(recording=page_folder / "demo.mcap"))
    (_, message), *_ = read_ros(page_folder / "demo.mcap", "/camera/color/image_raw/compressed")

    sent = deepcopy(frame)  # as if it was pickled

    image = np.asarray(Image.open(io.BytesIO(bytes(message.data))))
    np.testing.assert_array_equal(frame.color, image)
    np.testing.assert_array_equal(sent.color, image)
    assert np.array_equal(sent.labels, frame.labels)


FIXTURE = Path(__file__).parents[1] / "fixtures" / "tabletop.mcap"


@pytest.fixture(scope="module")
def image() -> Any:
    """Return the first frame of the fixture."""
    with shapecat.open_recording(FIXTURE) as recording:
        return next(recording.frames())


def intrinsics(camera: Any) -> tuple[float, ...]:
    return camera.fx, camera.fy, camera.cx, camera.cy


def test_perceive_finds_same_objects_as_processing_recording(image: Any, tmp_path: Path) -> None:
    """Swapped intrinsics, a wrong unit or a wrong label would move or rename objects."""
    run = shapecat.process(FIXTURE, tmp_path, end_s=0.2, mcap=False, rrd=False)
    expected = [row for row in run.detections.arrow().to_pylist() if row["frame"] == 0]
    assert len(expected) == 8
    with_gaps = np.where(image.depth > 0, image.depth, np.nan)
    with_gaps[0, :3] = -1, np.inf, np.nan
    millimetres = (image.depth * 1000).round().astype(np.uint16)
    for depth in (image.depth, with_gaps, millimetres):
        result = shapecat.perceive(depth, intrinsics(image.camera))
        assert [o.track for o in result.objects] == list(range(1, len(expected) + 1))
        for item, row in zip(result.objects, expected, strict=True):
            assert item.category == row["category"]
            assert item.detections == (row["detection"],)
            assert (
                item.confidence == max(item.posterior) == pytest.approx(row["confidence"], abs=0.1)
            )
            np.testing.assert_allclose(item.box.center, row["center"], atol=0.003)
            np.testing.assert_allclose(item.box.size, row["size"], atol=0.006)
            assert item.full is not None
            np.testing.assert_allclose(item.full.size, row["size_full"], atol=0.01)
            assert item.height_m == pytest.approx(row["height_m"], abs=0.003)
            common = np.intersect1d(item.indices, row["indices"]).size
            assert common > 0.95 * max(item.indices.size, len(row["indices"]))
            assert np.array_equal(
                result.labels.ravel()[item.indices], [item.track] * item.indices.size
            )
        assert (result.labels > 0).sum() == sum(o.indices.size for o in result.objects)


def test_perceived_frame_has_all_that_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """A flag in place of another, or a missing plane, would change what a robot does."""
    perception, _ = frame_of(2, all_of(2))
    first, second, third = perception.detections
    cut = replace(second, candidate=replace(second.candidate, touches_border=True))
    hidden = replace(third, candidate=replace(third.candidate, occluded=True, plane=None))
    perception = replace(perception, detections=(first, cut, hidden))
    monkeypatch.setattr("shapecat.outputs.in_memory.perceive", lambda *_, **__: perception)

    labelled = shapecat.perceive(np.zeros((48, 64)), (61, 62, 33, 25)).labelled

    assert labelled.planes == perception.scene.planes
    assert labelled.up is perception.scene.up
    assert labelled.seconds == perception.seconds
    assert labelled.fixed_from_sensor is None
    for number, (item, found) in enumerate(
        zip(labelled.objects, perception.detections, strict=True)
    ):
        candidate, posterior = found.candidate, found.posterior
        assert vars(item) | {"height_m": None} == {
            "track": number + 1,
            "category": ("cup", "cup", "unknown")[number],
            "confidence": float(max(posterior)),
            "box": candidate.box,
            "indices": candidate.indices,
            "gas": found.gas,
            "posterior": posterior,
            "causal": posterior,
            "height_m": None,
            "touches_border": number == 1,
            "occluded": number == 2,
            "detections": (number,),
            "full": found.full,
        }
    heights = [item.height_m for item in labelled.objects]
    wanted = [float(labelled.up @ item.box.center) for item in labelled.objects[:2]]
    np.testing.assert_allclose(
        heights, [wanted[0] + 0.5, wanted[1] + 0.2 - 0.04, np.nan], atol=1e-5
    )


def test_frame_of_recording_is_perceived_as_it_is(image: Any) -> None:
    """Other intrinsics would give other objects; without a stamp, their time would be lost."""
    of_frame = shapecat.perceive(image)
    of_depth = shapecat.perceive(image.depth, image.camera)

    assert of_frame.reading is image
    assert of_frame.stamp_ns == of_frame.labelled.stamp_ns == image.stamp_ns > 0
    assert [o.category for o in of_frame.objects] == [o.category for o in of_depth.objects]
    for one, other in zip(of_frame.objects, of_depth.objects, strict=True):
        np.testing.assert_array_equal(one.indices, other.indices)


def test_masked_values_are_missing(image: Any) -> None:
    """What users have masked, say all beyond a table, would silently be perceived."""
    far = image.depth > np.median(image.depth)
    depth = shapecat.perceive(np.ma.array(image.depth, mask=far), intrinsics(image.camera))
    masked = np.zeros((3, 4, 3), bool)
    masked[1, 2, 0] = True
    points = shapecat.perceive(np.ma.array(np.ones((3, 4, 3)), mask=masked))

    np.testing.assert_array_equal(depth.reading.depth, np.where(far, 0, image.depth))
    np.testing.assert_array_equal(np.isnan(points.points).all(axis=1), np.arange(12) == 6)
    assert np.isfinite(np.delete(points.points, 6, axis=0)).all()


def test_largest_number_is_missing() -> None:
    """Some drivers write it where there is no depth; NumPy warned of an overflow, an error here."""
    largest = np.finfo(np.float64).max
    depth = shapecat.perceive(np.diag([0.7, largest, 0.9]), (5, 6, 1, 1))
    points = shapecat.perceive([[0.1, 0.2, 0.7], [0.3, largest, 0.9]])

    np.testing.assert_array_equal(depth.reading.depth, np.diag([0.7, 0, 0.9]).astype(np.float32))
    np.testing.assert_array_equal(np.isnan(points.points).all(axis=1), [False, True])


def test_points_of_the_caller_are_not_changed() -> None:
    """Incomplete rows become NaN in a copy, as the caller may use the points again."""
    points = np.ones((5, 3), np.float32)
    points[2, 1] = np.inf
    points.flags.writeable = False

    assert np.isnan(shapecat.perceive(points).points[2]).all()
    assert points[2].tolist() == [1, np.inf, 1]


def test_perceiving_points_finds_same_objects_as_depth_image(image: Any) -> None:
    """Invalid rows stay in place, so that masks fit the caller's points."""
    from_points = shapecat.perceive(image.xyz(), up=np.array([0, -6.2, -7.8]))
    from_depth = shapecat.perceive(image.depth, intrinsics(image.camera))

    assert from_points.labels.shape == (image.camera.width * image.camera.height,)
    assert [o.category for o in from_points.objects] == [o.category for o in from_depth.objects]
    for one, other in zip(from_points.objects, from_depth.objects, strict=True):
        np.testing.assert_allclose(one.box.center, other.box.center, atol=0.005)
        assert np.isfinite(from_points.points_of(one)).all()
    assert from_points.labelled.up @ [0, -0.622, -0.783] == pytest.approx(1, abs=0.001)


def test_perceive_uses_categories_of_model(image: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reordered names, or shapes unlike all categories, must not give a wrong category."""

    class Reversed(Guesser):
        categories = Guesser.categories[::-1]
        novel = False

        def predict(self, descriptors: Any) -> Any:
            found = super().predict(descriptors)
            return SimpleNamespace(posteriors=found.posteriors, novelty=found.novelty + self.novel)

    model = Reversed()
    monkeypatch.setattr(api, "load_model", lambda _path: model)
    result = shapecat.perceive(image.depth, intrinsics(image.camera))
    for item in result.objects:
        assert item.category == model.categories[int(item.posterior.argmax())]
    model.novel = True
    result = shapecat.perceive(image.depth, intrinsics(image.camera))
    assert {o.category for o in result.objects} == {"unknown"}


IMAGE = np.ones((4, 6), np.float32)


class OnGpu:
    """An array that NumPy cannot read, such as a tensor on a GPU."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        msg = "can't convert cuda:0 device type tensor to numpy; use Tensor.cpu()"
        raise TypeError(msg)


class WithGradient:
    """A tensor as a depth network returns it."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        msg = "Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy()"
        raise RuntimeError(msg)


@pytest.mark.parametrize(
    ("reading", "options", "problem"),
    [
        (IMAGE, {}, r"points \(n, 3\), or a depth image with intrinsics"),
        (IMAGE, {"intrinsics": (5, 5, 3)}, "fx, fy, cx, cy in pixels of an image of 6 x 4"),
        (IMAGE, {"intrinsics": (5, 5, 3, 20)}, "fx, fy, cx, cy in pixels of an image of 6 x 4"),
        (IMAGE, {"intrinsics": (0, 5, 3, 2)}, "fx, fy, cx, cy in pixels of an image of 6 x 4"),
        (IMAGE, {"intrinsics": (5, np.nan, 3, 2)}, "fx, fy, cx, cy in pixels of an image of 6 x 4"),
        # Divided by the size of the image, and the camera of another image:
        (
            np.ones((48, 64)),
            {"intrinsics": (0.8, 1.1, 0.5, 0.5)},
            "in pixels of an image of 64 x 48",
        ),
        (np.ones((48, 64)), {"intrinsics": (60, 1.1, 32, 24)}, "in pixels of an image of 64 x 48"),
        (IMAGE, {"intrinsics": Camera(4, 6, 5, 5, 2, 3)}, r"of an image of 6 x 4.* got Camera\("),
        *(
            (IMAGE, {"intrinsics": wrong}, r"image of 6 x 4, or its camera matrix \(3, 3\), got")
            for wrong in (
                np.eye(3)[:2],
                [[5, 0, 3], [0, 5], [0, 0, 1]],
                [[5, 1, 3], [0, 5, 2], [0, 0, 1]],
                [[5, 0, 3], [0, 5, 2], [0, 0, 5]],
                [[5, 0, 0], [0, 5, 0], [3, 2, 1]],
                "kinect",
                5,
            )
        ),
        (IMAGE * 900, {"intrinsics": (5, 5, 3, 2)}, "divide millimetres by 1000"),
        (np.full((9, 3), [-300, 90, np.nan]), {"up": (0, 0)}, "up: expected a direction"),
        ([[-300, 90, 0], [np.nan, 0, 1], [20, -900, 40]], {}, "points in metres"),
        (np.ones((4, 6, 3)), {"intrinsics": (5, 5, 3, 2)}, r"depth image \(h, w\)"),
        ([[1, 2], [3]], {"intrinsics": (5, 5, 3, 2)}, "not an array of numbers: .*inhomogeneous"),
        ([[1, 2, 3], [3]], {}, "not an array of numbers: .*inhomogeneous"),
        (
            Frame("/depth", 0, 0, 0, "camera", points=np.ones((9, 3), np.float32)),
            {"intrinsics": (5, 5, 3, 2)},
            "a frame has its own intrinsics",
        ),
        (OnGpu(), {}, r"not an array of numbers: .*cpu\(\)"),
        (WithGradient(), {}, r"not an array of numbers: .*detach\(\)"),
        (IMAGE, {"intrinsics": WithGradient()}, "fx, fy, cx, cy in pixels of an image of 6 x 4"),
        (np.array([["a"]]), {"intrinsics": (5, 5, 3, 2)}, "depth image"),
        # Of a data frame that may hold nulls: its shape alone would be as expected.
        (np.ones((9, 3), object), {}, r"got object \(9, 3\)"),
        (np.ones((9, 3)), {"up": (0, 0, 0)}, "up: expected a direction"),
        (np.ones((9, 3)), {"up": (0, 1)}, "up: expected a direction"),
        (np.ones((9, 3)), {"up": (0, np.inf, 1)}, "up: expected a direction"),
        (np.ones((9, 3)), {"up": "imu"}, "up: could not convert"),
        (np.ones((9, 3)), {"seeed": 1}, "did you mean seed"),
    ],
)
def test_perceive_rejects_invalid_input(
    reading: Any, options: dict[str, Any], problem: str
) -> None:
    """A wrong unit or another image's intrinsics would silently give garbage."""
    with pytest.raises(ConfigError, match=problem):
        shapecat.perceive(reading, **options)


def test_camera_matrix_and_camera_equal_four_numbers() -> None:
    matrix = np.array([[61.0, 0, 33], [0, 62, 25], [0, 0, 1]])
    same = Camera(64, 48, 61, 62, 33, 25)
    for given in (matrix, matrix.tolist(), matrix[[0, 1, 0, 1], [0, 1, 2, 2]], same):
        camera = shapecat.perceive(np.zeros((48, 64)), given).reading.camera

        assert camera == same


def test_crop_of_image_is_perceived() -> None:
    """The principal point of a cropped image may be outside of it."""
    camera = shapecat.perceive(np.zeros((48, 64)), (61, 62, -10.5, 50)).reading.camera
    assert camera == Camera(64, 48, 61, 62, -10.5, 50)

    with pytest.raises(ConfigError, match="expected fx, fy, cx, cy"):
        shapecat.perceive(np.zeros((48, 64)), (61, 62, 600, 24))


def test_moved_recording_may_be_in_home_folder(
    page_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In Python, no shell replaces the ``~`` of a path."""
    monkeypatch.setenv("HOME", str(page_folder))
    run = shapecat.open_run("~/results/demo")

    assert next(run.frames(recording="~/demo.mcap")).labelled.index == 0


def test_model_may_be_in_home_folder(
    page_folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("HOME", str(page_folder))

    with pytest.raises(ModelError, match=str(page_folder / "none.npz")):
        shapecat.process("~/demo.mcap", tmp_path, model="~/none.npz")


def test_merged_tracks_are_described_as_one(guessed_run: Path, tmp_path: Path) -> None:
    """Frames show merged tracks as one object, so the description of the run must not count two."""
    folder = tmp_path / "run"
    shutil.copytree(guessed_run, folder)
    count = len(shapecat.open_run(folder).labels)
    (tmp_path / "corrected.csv").write_text(
        "track,category,confidence,label\n2,cup,0,merge with 1\n"
    )
    adopt_labels(tmp_path / "corrected.csv", folder)

    run = shapecat.open_run(folder)

    assert run.labels[2] == run.labels[1]
    assert repr(run).endswith(f": 8 frames, {count - 1} tracks>")


def test_run_that_is_replaced_while_it_is_open_is_refused(
    guessed_run: Path, tmp_path: Path
) -> None:
    """Its labels would go to tracks of the new run that happen to have the same numbers."""
    folder = tmp_path / "run"
    shutil.copytree(guessed_run, folder)
    run = shapecat.open_run(folder)
    begun, later = run.labelled_frames(), run.labelled_frames()
    next(begun)
    text = (folder / "run.json").read_text("utf-8")
    (folder / "run.json").write_text(text.replace(run.info["work"], "w0123456789abcdef"), "utf-8")

    for frames in (later, run.frames()):
        with pytest.raises(OutputError, match="was processed again meanwhile"):
            next(frames)
    for table in (run.detections, run.tracks, run.frame_table, run.planes):
        with pytest.raises(OutputError, match="was processed again meanwhile"):
            table.arrow("frame")
    assert len([*begun]) == 7  # the files are still open


def test_frames_of_one_topic_are_read(page_folder: Path) -> None:
    """A single name is one topic, as for `process`, not a list of letters."""
    with shapecat.open_recording(page_folder / "demo.mcap") as recording:
        frame = next(iter(recording.frames("/camera/depth/image_raw")))

    assert frame.topic == "/camera/depth/image_raw"


@pytest.mark.parametrize("container", ["mcap", "ros1", "ros2"])
@pytest.mark.parametrize("read", [0, 1])
def test_frames_of_closed_recording_are_refused(tmp_path: Path, container: str, read: int) -> None:
    """A ROS 2 bag would seem to have no more frames; other formats would give a traceback."""
    path = record(tmp_path / "a", 5, container=container)
    with shapecat.open_recording(path) as recording:
        frames = recording.frames()
        for _ in range(read):
            next(frames)

    with pytest.raises(RecordingError, match=r"closed; read its frames before"):
        next(frames)
    with pytest.raises(RecordingError, match=r"closed; read its frames before"):
        recording.frames()


@pytest.mark.parametrize("container", ["mcap", "ros1"])
def test_threads_that_share_a_recording_read_all_of_its_frames(
    tmp_path: Path, container: str
) -> None:
    """A file has one position: messages between those of another thread seemed to be damaged."""
    path = record(tmp_path / "a", 9, container=container)
    with shapecat.open_recording(path) as recording, ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(lambda: [f.stamp_ns for f in recording.frames()]) for _ in range(40)]
        read = [job.result() for job in jobs]

    assert len(read[0]) == 9
    assert read == read[:1] * 40


def test_recording_that_was_opened_before_a_fork_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forked processes share the position in the file, and skipped frames like threads."""
    with shapecat.open_recording(record(tmp_path / "a", 3)) as recording:
        begun = recording.frames()
        next(begun)
        monkeypatch.setattr(os, "getpid", lambda: 1)
        for read in (lambda: next(begun), recording.frames):
            with pytest.raises(RecordingError, match="open it in each process"):
                read()


def test_topic_of_several_publishers_is_listed_once(tmp_path: Path) -> None:
    """Bags have a connection for each publisher of a topic such as /tf."""
    with mcap_writer(tmp_path / "a.mcap") as writer:
        for topic in ("/tf", "/scan", "/tf"):
            writer.add_message(writer.register_channel(topic, "json", 0), 5, b"{}", 5)

    with shapecat.open_recording(tmp_path / "a.mcap") as recording:
        assert recording.topics == ("/tf", "/scan")


def test_frames_are_those_of_the_selection(tmp_path: Path) -> None:
    """Steps count from the start of the range, whose end is left out."""
    items = [("/d/camera_info", EPOCH, messages.info(EPOCH))]
    for k in range(12):
        stamp = EPOCH + k * 100_000_000
        items += [("/d/image", stamp, messages.image(stamp, messages.wavy_depth()))]
    ranges: list[tuple[dict[str, Any], list[int]]] = [
        ({"start_s": 0.25, "end_s": 0.9, "every": 2}, [3, 5, 7]),
        ({"start_s": 0.95}, [10, 11]),
        ({"end_s": 0.2}, [0, 1]),
        ({"every": 5}, [0, 5, 10]),
    ]
    with shapecat.open_recording(messages.write(tmp_path / "a.mcap", items)) as recording:
        for options, expected in ranges:
            stamps = [frame.stamp_ns - EPOCH for frame in recording.frames("/d/image", **options)]
            assert stamps == [100_000_000 * k for k in expected]


def test_model_is_read_once_until_its_file_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading a model takes longer than perceiving an image."""
    read: list[Path] = []

    def counted(path: Path) -> Guesser:
        read.append(path)
        return Guesser()

    monkeypatch.setattr(api, "load_model", counted)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.npz").write_bytes(b"one")
    for model in ("mine.npz", tmp_path / "mine.npz"):
        shapecat.perceive(np.zeros((48, 64)), (60, 60, 32, 24), model=model)
    assert read == [tmp_path / "mine.npz"]

    (tmp_path / "mine.npz").write_bytes(b"two and more")
    shapecat.perceive(np.zeros((48, 64)), (60, 60, 32, 24), model="mine.npz")
    assert len(read) == 2
    with pytest.raises(ModelError, match=r"none\.npz: cannot read the model: No such file"):
        shapecat.perceive(np.zeros((48, 64)), (60, 60, 32, 24), model="none.npz")


def test_model_of_another_version_is_refused(tmp_path: Path) -> None:
    """Other descriptor components would give a traceback, reordered ones wrong categories."""
    model = load_model()
    reordered = (*model.descriptor_names[1:], model.descriptor_names[0])
    save_model(tmp_path / "old.npz", replace(model, descriptor_names=reordered))

    with pytest.raises(ModelError, match="was trained on a different descriptor"):
        shapecat.perceive(np.zeros((48, 64)), (60, 60, 32, 24), model=tmp_path / "old.npz")


@pytest.mark.parametrize("reading", [np.zeros((48, 64)), np.full((48, 64), np.nan)])
def test_empty_depth_image_has_no_objects(reading: Any) -> None:
    result = shapecat.perceive(reading, (60, 60, 32, 24))

    assert (result.objects, result.labelled.planes) == ((), ())
    assert (result.labels == -1).all()
    assert result.labelled.up.tolist() == [0, -1, 0]  # the default, says `perceive`


def test_table_columns_become_arrays(page_folder: Path) -> None:
    run = shapecat.open_run(str(page_folder / "results" / "demo"))
    n = run.info["counts"]["detections"]

    assert run.detections.numpy("center").shape == (n, 3)
    assert run.detections.numpy("category").shape == (n,)
    assert run.detections.numpy("posterior").shape == (n, 7)
    assert run.detections.numpy("indices").shape == (n,)  # of different lengths
    assert run.detections.numpy("indices")[0].dtype.kind in "ui"
    assert run.frame_table.numpy("up_given").shape == (4, 3)
    assert run.frame_table.numpy("fixed_rotation").shape == (4, 9)
    with pytest.raises(OutputError, match=r"no column centre; known: .*center"):
        run.detections.numpy("centre")
    with pytest.raises(OutputError, match=r"no track #999 among \d+ tracks"):
        run.posterior(999)


def test_name_of_one_column_is_not_a_list_of_letters(tmp_path: Path) -> None:
    """A name read as a list of letters gives a misleading error about a column `a`."""
    pq.write_table(pa.table({"area_m2": [0.5, 2.0], "plane": [0, 1]}), tmp_path / "t.parquet")
    table = Table(tmp_path / "t.parquet")

    assert table.arrow("area_m2").to_pydict() == {"area_m2": [0.5, 2.0]}
    with pytest.raises(OutputError, match=r"no column area; known: area_m2, plane"):
        table.arrow("area")


def test_names_may_come_from_a_generator(tmp_path: Path) -> None:
    """A generator can be read only once; read twice, it gives no columns and no frames."""
    pq.write_table(pa.table({"area_m2": [0.5], "plane": [0]}), tmp_path / "t.parquet")
    path = record(tmp_path / "a.mcap", 3)

    table = Table(tmp_path / "t.parquet").arrow(iter(["plane", "area_m2"]))
    with shapecat.open_recording(path) as recording:
        frames = list(recording.frames(iter(["/camera/depth/image_raw"])))

    assert table.to_pydict() == {"area_m2": [0.5], "plane": [0]}
    assert len(frames) == 3


def test_lists_of_text_become_an_array(tmp_path: Path) -> None:
    """The stages of frames.parquet are text; reading them ended in a traceback."""
    table = pa.table({"stages": [["detect", "masks"], ["detect", "track"]]})
    pq.write_table(table, tmp_path / "t.parquet")

    stages = Table(tmp_path / "t.parquet").numpy("stages")

    assert stages.tolist() == [["detect", "masks"], ["detect", "track"]]


def test_arrays_of_run_without_objects_join_those_of_others(
    page_folder: Path, tmp_path: Path
) -> None:
    """One recording without objects among many would make joining their descriptors fail."""
    flat = messages.image(EPOCH, np.full((48, 64), 2.0))
    items = [("/d/camera_info", EPOCH, messages.info(EPOCH)), ("/d/image", EPOCH, flat)]
    recording = messages.write(tmp_path / "a.mcap", items)
    empty = shapecat.process(recording, tmp_path, mcap=False, rrd=False)
    full = shapecat.open_run(page_folder / "results" / "demo")

    assert empty.info["counts"]["detections"] == 0
    for name in ("posterior", "descriptor", "outline_full", "center"):
        expected = full.detections.numpy(name)
        joined = np.concatenate([empty.detections.numpy(name), expected])
        assert (joined.dtype, joined.shape) == (expected.dtype, expected.shape)
    assert empty.tracks.numpy("posterior").shape == (0, len(empty.categories))
    assert empty.detections.numpy("indices").shape == (0,)


def test_lists_of_different_lengths_keep_their_type(tmp_path: Path) -> None:
    """If an empty list of edges became floats, it could not index the neurons."""
    edges = pa.array([[0, 1, 1, 2], [], [0, 3]], pa.list_(pa.uint16()))
    neurons = pa.array([[0.5, 1.5, 2.5], [], [3.5]], pa.list_(pa.float32()))
    pq.write_table(pa.table({"edges": edges, "neurons": neurons}), tmp_path / "t.parquet")

    for name, column, kind in (("edges", edges, np.uint16), ("neurons", neurons, np.float32)):
        rows = Table(tmp_path / "t.parquet").numpy(name)
        assert [row.dtype for row in rows] == [kind] * 3
        assert [row.tolist() for row in rows] == column.to_pylist()


def test_null_list_becomes_row_of_nan(tmp_path: Path) -> None:
    """Arrow may or may not store values behind a null; later rows must not shift."""
    kind = pa.list_(pa.float32(), 2)
    column = pa.array([[1, 2], None, [5, 6]], kind)
    pq.write_table(pa.table({"a": column}), tmp_path / "t.parquet")

    assert np.array_equal(
        Table(tmp_path / "t.parquet").numpy("a"),
        np.array([[1, 2], [np.nan, np.nan], [5, 6]], np.float32),
        equal_nan=True,
    )


def test_wrong_settings_and_folders_are_refused(page_folder: Path, tmp_path: Path) -> None:
    """A misspelt option, or one without effect, would go unnoticed."""
    with pytest.raises(ConfigError, match=r"did you mean detection\.max_range_m"):
        shapecat.process(page_folder / "demo.mcap", tmp_path, detection={"max_range": 1.0})
    with pytest.raises(OutputError, match="another input, model or settings"):
        shapecat.process(page_folder / "demo.mcap", page_folder / "results", rrd=False)
    with pytest.raises(OutputError, match=r"no run\.json there"):
        shapecat.open_run(tmp_path)
    with pytest.raises(
        ConfigError, match=r"unknown option or setting topic; did you mean topics\?"
    ):
        shapecat.process(page_folder / "demo.mcap", tmp_path, topic="/camera/depth/image_raw")
    with pytest.raises(ConfigError, match="discard_labels needs overwrite"):
        shapecat.process(page_folder / "demo.mcap", tmp_path, discard_labels=True)
    for cores in (0, 1.5):  # half of an odd number of processors
        with pytest.raises(
            ConfigError, match=f"cores must be an integer of at least 1, got {cores}"
        ):
            shapecat.process(page_folder / "demo.mcap", tmp_path, cores=cores)  # type: ignore[arg-type]
    with pytest.raises(AttributeError, match="nothing"):
        _ = shapecat.nothing


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"every": 0}, "every must be an integer of at least 1, got 0"),
        ({"every": 2.5}, r"every must be an integer of at least 1, got 2\.5"),
        ({"start_s": -1}, "start_s must be at least 0, got -1"),
        ({"start_s": float("nan")}, "start_s must be at least 0, got nan"),
        ({"end_s": float("inf")}, "end_s must be at least 0, got inf"),
        ({"start_s": 0.2, "end_s": 0.2}, r"end_s 0\.2 is not after start_s 0\.2"),
    ],
)
def test_frames_that_the_command_refuses_are_refused(
    tmp_path: Path, options: dict[str, Any], problem: str
) -> None:
    with pytest.raises(ConfigError, match=problem):
        shapecat.process(FIXTURE, tmp_path, **options)
    recording = shapecat.open_recording(FIXTURE)
    with recording, pytest.raises(ConfigError, match=problem):
        recording.frames(**options)
    assert list(tmp_path.iterdir()) == []


def test_times_may_be_numbers_of_numpy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy's numbers cannot be written to run.json; this failed after processing all frames."""
    jobs: list[Any] = []
    times: Any = {"start_s": np.float32(0.5), "end_s": np.int64(2)}
    monkeypatch.setattr("shapecat.pipeline.process", lambda job, *_, **__: jobs.append(job))

    with pytest.raises(OutputError, match=r"no run\.json"):
        shapecat.process(FIXTURE, tmp_path, **times)

    assert '"start_s": 0.5, "end_s": 2.0' in json.dumps(jobs[0].selection())


def test_options_of_process_reach_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Options are passed on one by one; one that is forgotten would silently have its default."""
    jobs: list[tuple[Any, int]] = []
    monkeypatch.setattr(
        "shapecat.pipeline.process", lambda job, *_, cores: jobs.append((job, cores))
    )
    monkeypatch.setattr(api, "runs_again", lambda: False)
    given: dict[str, Any] = {
        "up": "imu", "fixed_frame": "odom", "model": tmp_path / "mine.npz", "color": "/rgb",
        "mcap": False, "rrd": False, "overwrite": True, "discard_labels": True,
    }  # fmt: skip
    times: dict[str, Any] = {"start_s": 0.5, "end_s": 2.0, "every": 3}
    with pytest.raises(OutputError, match=r"no run\.json"):
        shapecat.process(FIXTURE, tmp_path, topics=["/b", "/a"], cores=2, seed=7, **given, **times)

    ((job, cores),) = jobs
    assert {name: getattr(job, name) for name in given} == given
    assert asdict(job.frame_range) == times
    assert times.items() <= job.selection().items()
    assert (job.topics, job.settings.seed, cores) == (("/b", "/a"), 7, 2)
    assert (job.source, job.folder) == (FIXTURE, tmp_path / "tabletop")


def test_run_of_the_current_folder_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a name, the results would be written into ``out`` itself, beside other runs."""
    jobs: list[Any] = []
    monkeypatch.setattr("shapecat.pipeline.process", lambda job, *_, **__: jobs.append(job))
    (tmp_path / "monday.1").mkdir()
    (tmp_path / "monday.1" / "part_0.db3").touch()
    monkeypatch.chdir(tmp_path / "monday.1")

    with pytest.raises(OutputError, match=r"no run\.json"):
        shapecat.process(".", tmp_path / "out")

    assert jobs[0].folder == tmp_path / "out" / "monday.1"


def test_process_accepts_single_topic_and_up_vector(page_folder: Path, tmp_path: Path) -> None:
    """A single topic was read as a list of letters, and an up vector ended in a traceback."""
    plain: Any = {"every": 8, "mcap": False, "rrd": False}
    topic, up = "/camera/depth/image_raw", np.array([0, -0.75, -0.5])

    run = shapecat.process(page_folder / "demo.mcap", tmp_path, topics=topic, up=up, **plain)

    assert (run.info["options"]["topics"], run.info["options"]["up"]) == ([topic], "0.0,-0.75,-0.5")
    given = np.array(run.frame_table.numpy("up_given")[0])
    np.testing.assert_allclose(given, up / np.linalg.norm(up), atol=1e-6)


def test_folder_of_recordings_is_refused(page_folder: Path, tmp_path: Path) -> None:
    """Only the command searches folders; the files would become one run with mixed frames."""
    for name in ("monday.mcap", "tuesday.mcap"):
        (tmp_path / name).write_bytes((page_folder / "demo.mcap").read_bytes())
    refused = r"a folder of 2 recordings; name one of them: monday\.mcap, tuesday\.mcap"

    with pytest.raises(RecordingError, match=refused):
        shapecat.process(tmp_path, tmp_path / "out")
    with pytest.raises(RecordingError, match=refused):
        shapecat.open_recording(tmp_path)
    assert not (tmp_path / "out").exists()


def test_url_is_refused(page_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The command takes URLs; as a path, ``s3://lab`` would become the local folder ``s3:/lab``."""
    monkeypatch.chdir(tmp_path)

    with pytest.raises(ConfigError, match="s3://lab is a URL"):
        shapecat.process(page_folder / "demo.mcap", "s3://lab")
    with pytest.raises(ConfigError, match=r"s3://lab/day\.mcap is a URL"):
        shapecat.open_recording("s3://lab/day.mcap")
    assert list(tmp_path.iterdir()) == []


def test_import_does_not_load_numpy() -> None:
    """Every command imports the package, so a heavy import would delay `--help`."""
    assert loaded_by("import shapecat", {"numpy"}) == set()


def test_names_that_load_on_first_use_are_listed() -> None:
    """Notebooks complete names from `dir`; `help` shows the functions only if they are in it."""
    assert {*shapecat.__all__, "__version__"} <= {*dir(shapecat)}
    for name in ("open_run", "perceive", "process"):
        assert f"{name}(" in pydoc.plain(pydoc.render_doc(shapecat))


def test_several_cores_require_main_guard_in_script(tmp_path: Path) -> None:
    """Otherwise each process would run the script again and print its own traceback."""
    script = tmp_path / "script.py"
    script.write_text("import shapecat\nshapecat.process('none.mcap', 'out', cores=3)\n")
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=False, cwd=tmp_path
    )

    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    last = done.stderr.splitlines()[-1]
    assert last.endswith('cores=3 starts processes: a script needs `if __name__ == "__main__":`')
    assert [path.name for path in tmp_path.iterdir()] == ["script.py"]


@pytest.mark.parametrize("content", [None, b"", b"PAR1" + bytes(20)])
def test_unreadable_table_is_named(tmp_path: Path, content: bytes | None) -> None:
    """Scripts over many runs must be able to skip one whose copy was cut short."""
    path = tmp_path / "tracks.parquet"
    if content is not None:
        path.write_bytes(content)

    for read in (lambda: Table(path).arrow("track"), lambda: Table(path).columns):
        with pytest.raises(OutputError) as error:
            read()
        assert str(error.value).startswith(f"{path}: not a readable table of a run (")
