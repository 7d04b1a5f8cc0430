"""Tests of colour images that a moving camera took before or after their depth images."""

import csv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import shapecat.pipeline
from shapecat.arrays import F8
from shapecat.cameras.colour import ColourImage, ColourView, LensCamera
from shapecat.colour.image_masks import mask_of
from shapecat.geometry import compose
from shapecat.outputs.exports.formats import export_run
from shapecat.pipeline import process
from shapecat.recordings import TransformBuffer
from shapecat.recordings.colour_motion import view_at_its_time
from shapecat.recordings.transforms.window import TransformWindow
from shapecat.runs.finished import read_finished
from shapecat.runs.jobs import Job
from shapecat.simulation import recorder, simulate
from shapecat.types import Camera, Frame, Pose
from tests.conftest import Guesser
from tests.kitti_files import read_labels
from tests.messages import EPOCH, SECOND
from tests.track_tables import read_masks

RATE_HZ = 10.0
EVERY = 5
"""The walking camera takes a colour image with every fifth depth image, twice per second."""
LATER = EPOCH + SECOND // 5
CAMERA = Camera(64, 48, 50.0, 51.0, 31.0, 23.0)
LENS = LensCamera(Camera(80, 60, 70.0, 71.0, 39.0, 29.0))


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Process a recording of a walking camera with rare colour images; return its run folder."""
    folder = tmp_path_factory.mktemp("walk")
    write_colour = recorder._write_colour

    def rarely(writer: Any, world: Any, frame: Frame) -> Any:
        if frame.index % EVERY:
            writer = SimpleNamespace(messages=writer.messages, write=lambda *_: None)
        return write_colour(writer, world, frame)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder, "_write_colour", rarely)
        patch.setattr(shapecat.pipeline, "load_model", lambda _path: Guesser())
        source = simulate(
            folder / "walk.mcap",
            scene="walking",
            frames=6,
            seed=3,
            rate_hz=RATE_HZ,
            sensor="realsense",
            color=True,
        )
        process(Job(source=source, folder=folder / "out" / "walk", rrd=False, mcap=False))
    return folder / "out" / "walk"


def true_labels(run: Path) -> dict[int, Any]:
    """Return, for each frame, the true labels of the pixels of its colour image."""
    labels = np.load(run.parents[1] / "walk.color_labels.npz")["labels"]
    period = SECOND / RATE_HZ
    found = list(read_masks(run))
    begin = min(masks.stamp_ns for _, masks in found)
    return {frame: labels[round((m.stamp_ns - begin) / period)] for (_, frame), m in found}


def test_masks_are_where_objects_are_when_colour_image_is_taken(walk: Path) -> None:
    """A walking camera moves by the width of an object in a fifth of a second."""
    truth = true_labels(walk)
    best: dict[int, list[float]] = {}
    for (_, frame), masks in read_masks(walk):
        labels = truth[frame]
        own = [mask_of(masks, [number]).full(*labels.shape) for number in masks.counts]
        for label in np.unique(labels[labels >= 20]):
            visible = labels == label
            if visible.sum() > 2000 and not (visible[:, [0, -1]].any() or visible[[0, -1]].any()):
                best.setdefault(frame, []).append(
                    max(float((visible & mask).sum() / (visible | mask).sum()) for mask in own)
                )

    assert sorted(best) == list(range(6))
    assert min(map(len, best.values())) > 2
    assert all(np.median(scores) > 0.8 for scores in best.values()), best


def test_kitti_boxes_are_on_objects_of_colour_image(walk: Path, tmp_path: Path) -> None:
    """The image in image_2 is of another time than the points; the 2D boxes must fit it."""
    export_run(read_finished(walk), "kitti", tmp_path)
    truth = true_labels(walk)
    with (tmp_path / "walk" / "frames.csv").open() as file:
        numbers = {int(row["frame"]): row["number"] for row in csv.DictReader(file)}
    for frame, labels in truth.items():
        true_boxes = []
        for label in np.unique(labels[labels >= 20]):
            rows, columns = np.nonzero(labels == label)
            true_boxes.append((columns.min(), rows.min(), columns.max(), rows.max()))
        inside = [
            label.box
            for label in read_labels(tmp_path / "walk", numbers[frame])
            if min(label.box[:2]) > 8 and label.box[2] < labels.shape[1] - 8
        ]
        assert len(inside) > 2
        best = [max(overlap(box, true) for true in true_boxes) for box in inside]
        assert np.median(best) > 0.75, (frame, best)


def overlap(a: Any, b: Any) -> float:
    """Return the IoU of two boxes: left, top, right, bottom."""
    width = max(0, min(a[2], b[2]) - max(a[0], b[0]))
    height = max(0, min(a[3], b[3]) - max(a[1], b[1]))
    areas = sum((box[2] - box[0]) * (box[3] - box[1]) for box in (a, b))
    return float(width * height / (areas - width * height))


def pose(x: float, y: float, z: float, *degrees: float) -> Pose:
    return Pose(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), np.array([x, y, z]))


START, END = pose(0.3, -1.2, 1.1, -100, 10, 25), pose(0.7, -1.0, 1.3, -95, -7, 50)
"""Poses of the robot in the map, at the stamps of the depth and of the colour image."""
LINK = pose(0.1, 0.04, 0.2, 3, -8, 5)
DEPTH_FROM_COLOUR = pose(-0.05, 0.02, 0.01, 2, 1, -3)


def matrix(a_from_b: Pose) -> F8:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = a_from_b.rotation, a_from_b.translation
    return result


def buffer(*, start: Pose = START, end: Pose = END) -> TransformBuffer:
    """Return transforms of a moving robot with a depth camera, which carries a colour camera."""
    found = TransformBuffer()
    links = [("base", "depth", LINK, LINK), ("map", "base", start, end)]
    for parent, child, *poses in links:
        for stamp, one in zip((EPOCH, LATER), poses, strict=True):
            turn = Rotation.from_matrix(one.rotation).as_quat()
            found.add(parent, child, stamp, (one.translation, turn), static=False)
    turn = Rotation.from_matrix(DEPTH_FROM_COLOUR.rotation).as_quat()
    where = DEPTH_FROM_COLOUR.translation
    found.add("depth", "colour", 0, (where, turn), static=True)
    return found


def corrected(
    transforms: TransformBuffer,
    view: ColourView,
    fixed_from_sensor: Pose | None = None,
    fixed_frame: str | None = "map",
    **frame: Any,
) -> Any:
    taken = {"frame_id": "depth", "frame_from_sensor": None} | frame
    depth = np.ones((48, 64), np.float32)
    of_frame = Frame("/depth", 0, EPOCH, EPOCH, camera=CAMERA, depth=depth, **taken)
    placed = compose(START, LINK) if fixed_from_sensor is None else fixed_from_sensor
    return view_at_its_time(
        view, of_frame, placed, fixed_frame, lambda: TransformWindow(transforms)
    )


def image(frame_id: str = "colour", stamp: int = LATER) -> ColourImage:
    return ColourImage("/colour", stamp, stamp, frame_id, "rgb8", 80, 60, 240, b"")


COLOUR_FROM_DEPTH = np.linalg.inv(matrix(DEPTH_FROM_COLOUR))


def still_view(frame_id: str = "colour", stamp: int = LATER) -> ColourView:
    """Return the view of a camera that does not move after the depth image is taken."""
    rotation, translation = COLOUR_FROM_DEPTH[:3, :3], COLOUR_FROM_DEPTH[:3, 3]
    return ColourView(image(frame_id, stamp), LENS, Pose(rotation, translation))


WANTED = (
    COLOUR_FROM_DEPTH @ np.linalg.inv(matrix(END) @ matrix(LINK)) @ matrix(START) @ matrix(LINK)
)
"""Pose of the depth sensor, at its time, in the colour camera at the time of the colour image."""


@pytest.mark.parametrize("frame_id", ["colour", "/colour", "not in the transforms"])
def test_colour_camera_is_where_it_is_at_the_time_of_its_image(frame_id: str) -> None:
    """A frame that is not in the transforms is taken to move with the depth camera."""
    found = corrected(buffer(), still_view(frame_id))

    assert_allclose(matrix(found.colour_from_depth), WANTED, atol=1e-9)
    assert found.lens == LENS


def test_registered_image_becomes_that_of_the_depth_camera_elsewhere() -> None:
    found = corrected(buffer(), ColourView(image("depth"), LENS))

    assert not found.registered
    assert found.lens == LensCamera(CAMERA)  # not that of the colour camera before registration
    wanted = matrix(DEPTH_FROM_COLOUR) @ WANTED
    assert_allclose(matrix(found.colour_from_depth), wanted, atol=1e-9)


def test_data_with_other_axes_than_their_frame_move_as_their_frame() -> None:
    """Simulators name a frame with x forward for optical data; the pose in the run is corrected."""
    axes = Pose(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    named = compose(compose(START, LINK), axes)
    found = corrected(buffer(), ColourView(image("depth"), LENS), named)

    motion = matrix(DEPTH_FROM_COLOUR) @ WANTED
    wanted = np.linalg.inv(matrix(axes)) @ motion @ matrix(axes)
    assert_allclose(matrix(found.colour_from_depth), wanted, atol=1e-9)


def test_cloud_in_the_map_is_seen_from_where_the_colour_camera_is() -> None:
    """The frame of a cloud in the map is at rest, unlike the camera."""
    sensor = compose(START, LINK)
    found = corrected(buffer(), still_view(), sensor, frame_id="map", frame_from_sensor=sensor)

    assert_allclose(matrix(found.colour_from_depth), WANTED, atol=1e-9)


def test_nothing_changes_without_a_known_motion() -> None:
    """Tables of recordings with equal stamps, or a camera at rest, must stay the same."""
    measured = Pose(START.rotation, START.translation + 1e-5)
    late = buffer().lookup("map", "base", LATER)
    ends = TransformBuffer()
    turn = Rotation.from_matrix(late.rotation).as_quat()
    ends.add("map", "depth", EPOCH - SECOND // 20, (late.translation, turn), static=False)
    for view in (still_view(), ColourView(image("depth"), LENS)):
        assert corrected(buffer(end=measured), view) is view
        assert corrected(buffer(), view, fixed_frame=None) is view
        assert corrected(buffer(), view, fixed_frame="odom") is view
        assert corrected(ends, view) is view
    for same in (still_view(stamp=EPOCH), ColourView(image("depth", EPOCH), LENS)):
        assert corrected(buffer(), same) is same
