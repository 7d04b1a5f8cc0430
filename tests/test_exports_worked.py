"""Tests of exports of a rotated box, worked out by hand and read as specified."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial.transform import Rotation

from shapecat.cameras.colour import ColourImage, ColourView, LensCamera
from shapecat.colour.masks import Mask
from shapecat.errors import OutputError
from shapecat.evaluation.clouds import read_pcd
from shapecat.evaluation.comparison.references_kitti import KittiLabels
from shapecat.geometry import IDENTITY
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.exports.coco import write_coco, write_yolo
from shapecat.outputs.exports.crops import Origin, write_crops
from shapecat.outputs.exports.dataset_frames import DatasetImage, DatasetObject
from shapecat.outputs.exports.kitti import rectified_from_sensor, write_kitti
from shapecat.outputs.exports.labelcloud import _described, write_labelcloud
from shapecat.outputs.exports.points import write_point_labels
from shapecat.types import Box, Camera, Frame, LabelledFrame, LabelledObject, NeuralGas, Pose
from tests.kitti_files import (
    KittiLabel,
    projected_points,
    read_calibration,
    read_labels,
    read_points,
)

CAMERA = Camera(160, 120, 143.0, 139.0, 77.4, 61.9)
PITCH, ROLL = np.radians(34.0), np.radians(6.0)
LEVEL_FROM_SENSOR = Rotation.from_euler("x", -PITCH) * Rotation.from_euler("z", ROLL)
"""Rotation from the optical frame (x right, y down, z forward) to one with y along gravity."""
UP = LEVEL_FROM_SENSOR.inv().apply([0, -1, 0])
SIZE = np.array([0.31, 0.14, 0.23])
"""Length, width and height of the box, metres."""
CENTER = np.array([-0.37, 0.52, 1.64])
"""In the level camera: 0.37 m left, 0.52 m below, 1.64 m ahead."""
YAW = 0.7
"""Radians from the level camera's x axis, about its y axis, which points down."""
AXES = np.array(  # in the level camera: length, width, up
    [[np.cos(YAW), 0, -np.sin(YAW)], [np.sin(YAW), 0, np.cos(YAW)], [0, -1, 0]]
)
PIXELS = [(40, 70), (41, 70), (63, 92), (52, 81)]
"""Column and row of each pixel of the object."""


def labelled(*, truncated: bool, occluded: bool) -> LabelledFrame:
    rotation = LEVEL_FROM_SENSOR.inv()
    axes = rotation.apply(AXES).T
    box = Box(rotation.apply(CENTER), SIZE, Rotation.from_matrix(axes).as_quat())
    indices = np.array(sorted(v * CAMERA.width + u for u, v in PIXELS), np.uint32)
    item = LabelledObject(
        4, "bowl", 0.9, box, indices, NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int)),
        np.array([1.0]), np.array([1.0]), touches_border=truncated, occluded=occluded,
    )  # fmt: skip
    return LabelledFrame("/depth", 0, 5, 6, "optical", None, (), (item,), (), {}, UP)


def frame() -> Frame:
    """Return the depth image of a slanted wall."""
    v, u = np.mgrid[:120, :160]
    depth = (1.2 + 0.003 * u + 0.002 * v).astype(np.float32)
    return Frame("/depth", 0, 5, 6, "optical", depth, CAMERA)


def kitti(folder: Path, *, truncated: bool, occluded: bool) -> KittiLabel:
    views: Any = [(labelled(truncated=truncated, occluded=occluded), frame(), None)]
    finished: Any = SimpleNamespace(labels={})
    assert write_kitti(folder, views, finished) == 1
    (label,) = read_labels(folder)
    return label


def test_kitti_line_matches_hand_calculation(tmp_path: Path) -> None:
    """The position is the middle of the bottom face; alpha is the yaw minus the bearing."""
    label = kitti(tmp_path, truncated=True, occluded=False)

    assert (label.kind, label.truncated, label.occluded) == ("bowl", 1.0, 0)
    assert_allclose(label.size, [0.23, 0.14, 0.31], atol=1e-5)
    assert_allclose(label.place, [-0.37, 0.52 + 0.115, 1.64], atol=1e-5)
    assert label.yaw == pytest.approx(0.7, abs=1e-5)
    assert label.alpha == pytest.approx(0.7 + np.arctan(0.37 / 1.64), abs=1e-5)
    assert label.box == [40, 70, 63, 92]


def test_kitti_distinguishes_truncated_from_occluded(tmp_path: Path) -> None:
    """A truncated object is cut by the image border; an occluded one is hidden by another."""
    assert kitti(tmp_path, truncated=False, occluded=True)[1:3] == (0.0, 1)


def test_kitti_calibration_projects_points_to_pixels(tmp_path: Path) -> None:
    kitti(tmp_path, truncated=False, occluded=False)
    matrices, points = read_calibration(tmp_path), read_points(tmp_path)
    for name in ("P0", "P1", "P3"):
        assert np.array_equal(matrices[name], matrices["P2"])
    assert np.array_equal(matrices["Tr_imu_to_velo"], np.eye(3, 4))
    to_sensor = LEVEL_FROM_SENSOR.inv().as_matrix()
    assert_allclose(matrices["Tr_rect_to_sensor"], np.c_[to_sensor, np.zeros(3)], atol=1e-6)
    v, u = np.mgrid[:120, :160]
    assert_allclose(projected_points(tmp_path), np.c_[u.ravel(), v.ravel()], atol=2e-3)
    level = LEVEL_FROM_SENSOR.apply(frame().xyz())  # x right, y down, z forward
    assert_allclose(points[:, :3], level[:, [2, 0, 1]] * [1, -1, -1], atol=1e-5)
    assert (points[:, 3] == 0).all()


@pytest.mark.parametrize(("pitch", "roll"), [(62, 6), (-55, 10), (12, 95), (8, -100), (5, 176)])
def test_kitti_frame_of_depth_image_looks_along_its_camera(
    tmp_path: Path, pitch: float, roll: float
) -> None:
    """Steep and portrait cameras were taken for laser scanners, which look along x."""
    level_from_sensor = Rotation.from_euler("x", -pitch, degrees=True) * Rotation.from_euler(
        "z", roll, degrees=True
    )
    up = level_from_sensor.inv().apply([0, -1, 0])
    seen = replace(labelled(truncated=False, occluded=False), up=up)
    views: Any = [(seen, frame(), None)]
    finished: Any = SimpleNamespace(labels={})
    write_kitti(tmp_path, views, finished)

    level = level_from_sensor.apply(frame().xyz())  # x right, y down, z forward
    assert_allclose(read_points(tmp_path)[:, :3], level[:, [2, 0, 1]] * [1, -1, -1], atol=1e-5)
    place = np.add(level_from_sensor.apply(seen.objects[0].box.center), [0, SIZE[2] / 2, 0])
    assert_allclose(read_labels(tmp_path)[0].place, place, atol=1e-5)


def test_kitti_calibration_projects_points_into_colour_camera(tmp_path: Path) -> None:
    """P2 contains the pose of the colour camera, and the 2D box is in pixels of its image."""
    camera = Camera(200, 150, 171.0, 166.0, 103.2, 71.5)
    pose = Pose(
        Rotation.from_euler("xyz", [0.05, -0.08, 0.03]).as_matrix(), np.array([0.06, -0.02, 0.01])
    )
    data = np.zeros((150, 200, 3), np.uint8).tobytes()
    image = ColourImage("/color", 5, 6, "color", "rgb8", 200, 150, 600, data)
    view = ColourView(image, LensCamera(camera), pose)
    views: Any = [(labelled(truncated=False, occluded=False), frame(), Coloured(view, ()))]
    finished: Any = SimpleNamespace(labels={})
    assert write_kitti(tmp_path, views, finished) == 1

    x, y, z = (frame().xyz() @ pose.rotation.T + pose.translation).T
    u, v = 171.0 * x / z + 103.2, 166.0 * y / z + 71.5
    assert_allclose(projected_points(tmp_path), np.c_[u, v], atol=2e-3)
    of_object = [row * CAMERA.width + column for column, row in PIXELS]
    low, high = ([f(at[of_object]) for at in (u, v)] for f in (np.min, np.max))
    assert read_labels(tmp_path)[0].box == np.rint([*low, *high]).tolist()
    assert (tmp_path / "image_2" / "000000.png").exists()

    # The rotation between the cameras must not rotate the boxes that are read back.
    (tmp_path / "frames.csv").write_text("number,topic,frame,stamp_ns\n000000,/depth,0,5\n")
    found = KittiLabels(tmp_path, ["bowl"]).at(("/depth", 0), 5)
    assert found is not None
    back, item = found.items[0].box, labelled(truncated=False, occluded=False).objects[0]
    assert back is not None
    assert_allclose(back.center, item.box.center, atol=2e-5)
    error = Rotation.from_quat(back.orientation).inv() * Rotation.from_quat(item.box.orientation)
    assert error.magnitude() < 1e-4


def test_kitti_image_is_that_of_its_pinhole_camera(tmp_path: Path) -> None:
    """P2 has no lens distortion, so image_2 must show objects where P2 projects them."""
    camera = Camera(200, 150, 171.0, 166.0, 103.2, 71.5)
    k1, k2, p1, p2, k3 = lens = (-0.31, 0.12, 0.004, -0.003, 0.02)
    pose = Pose(
        Rotation.from_euler("xyz", [0.05, -0.08, 0.03]).as_matrix(), np.array([0.06, -0.02, 0.01])
    )
    column, row = 17, 21
    x, y, z = pose.rotation @ frame().xyz()[row * CAMERA.width + column] + pose.translation
    x, y = x / z, y / z
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))  # the model plumb_bob
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    u, v = round(171.0 * bent_x + 103.2), round(166.0 * bent_y + 71.5)
    pixels = np.zeros((150, 200, 3), np.uint8)
    pixels[v - 1 : v + 2, u - 1 : u + 2] = 255
    image = ColourImage("/color", 5, 6, "color", "rgb8", 200, 150, 600, pixels.tobytes())
    view = ColourView(image, LensCamera(camera, "plumb_bob", lens), pose)
    views: Any = [(labelled(truncated=False, occluded=False), frame(), Coloured(view, ()))]
    finished: Any = SimpleNamespace(labels={})
    write_kitti(tmp_path, views, finished)

    expected = projected_points(tmp_path)[row * CAMERA.width + column]
    drawn = np.asarray(Image.open(tmp_path / "image_2" / "000000.png").convert("L"), float)
    found = [float(np.average(axis, weights=drawn)) for axis in np.mgrid[:150, :200][::-1]]
    assert_allclose(found, expected, atol=1.0)
    assert np.hypot(*(expected - (u, v))) > 4  # the lens moves this point by more than that


def test_kitti_image_on_depth_pixels_has_the_depth_camera(tmp_path: Path) -> None:
    """For images registered to depth, some drivers publish the calibration of the colour camera."""
    pixels = np.random.default_rng(1).integers(0, 256, (120, 160, 3), np.uint8)
    image = ColourImage("/color", 5, 6, "optical", "rgb8", 160, 120, 480, pixels.tobytes())
    lens = LensCamera(Camera(160, 120, 144.1, 140.3, 76.2, 62.8), "plumb_bob", (0.02, 0, 0, 0, 0))
    coloured = Coloured(ColourView(image, lens), ())
    views: Any = [(labelled(truncated=False, occluded=False), frame(), coloured)]
    finished: Any = SimpleNamespace(labels={})
    write_kitti(tmp_path, views, finished)

    v, u = np.mgrid[:120, :160]
    assert_allclose(projected_points(tmp_path), np.c_[u.ravel(), v.ravel()], atol=2e-3)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "image_2" / "000000.png")), pixels)


@pytest.mark.parametrize(
    ("left", "top", "width", "height", "box"),
    [
        (45, 60, 30, 50, [7, 21, 18, 32]),
        (30, 75, 60, 20, [22, 6, 33, 17]),
        (35, 60, 20, 60, [5, 10, 17, 21]),
        (30, 65, 60, 20, [10, 5, 22, 16]),
    ],
    ids=["left", "top", "right", "bottom"],
)
def test_kitti_2d_box_is_clipped_to_colour_image(
    tmp_path: Path, left: int, top: int, width: int, height: int, box: list[int]
) -> None:
    """The colour camera sees a window of the depth image that cuts the object."""
    camera = replace(CAMERA, width=width, height=height, cx=CAMERA.cx - left, cy=CAMERA.cy - top)
    image = ColourImage(
        "/color", 5, 6, "color", "rgb8", width, height, 3 * width, bytes(3 * width * height)
    )
    coloured = Coloured(ColourView(image, LensCamera(camera), IDENTITY), ())
    views: Any = [(labelled(truncated=False, occluded=False), frame(), coloured)]
    finished: Any = SimpleNamespace(labels={})
    write_kitti(tmp_path, views, finished)

    assert read_labels(tmp_path)[0].box == box


def labelcloud(folder: Path) -> None:
    finished: Any = SimpleNamespace(
        categories=("cup", "bowl"), info={"versions": {"shapecat": "0"}}, labels={}
    )
    assert (
        write_labelcloud(
            folder, [(labelled(truncated=False, occluded=False), frame(), None)], finished
        )
        == 1
    )


def corners_of(center: Sequence[float], size: Any, yaw: float) -> Any:
    rotation = Rotation.from_euler("z", yaw)
    unit = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / 2
    return rotation.apply(unit * size) + center


def corner_distance(a: Any, b: Any) -> float:
    """Return the largest distance from a corner in ``a`` to the nearest in ``b``."""
    return float(np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1).max())


def test_labelcloud_boxes_and_clouds_share_a_frame(tmp_path: Path) -> None:
    labelcloud(tmp_path)
    (item,) = json.loads((tmp_path / "labels" / "000000.json").read_text())["objects"]
    center, size = item["centroid"], item["dimensions"]
    box = corners_of(
        [center[a] for a in "xyz"],
        [size[n] for n in ("length", "width", "height")],
        item["rotations"]["z"],
    )
    (vertices,) = json.loads((tmp_path / "labels_vertices" / "000000.json").read_text())["objects"]
    path = tmp_path / "pointclouds" / "000000.pcd"
    header = path.read_bytes().split(b"DATA binary\n")[0].decode().splitlines()
    words = {line.split()[0]: line.split()[1:] for line in header}
    points = np.frombuffer(path.read_bytes().split(b"DATA binary\n", 1)[1], "<f4").reshape(-1, 3)

    assert item["name"] == "bowl"
    # The sensor is the origin of both frames, so box and points must agree.
    w, x, y, z = map(float, words["VIEWPOINT"][3:])
    level_from_sensor = Rotation.from_quat([x, y, z, w])
    assert_allclose(level_from_sensor.apply(frame().xyz()), points, atol=1e-5)
    assert_allclose(level_from_sensor.apply(UP), [0, 0, 1], atol=1e-5)
    source = labelled(truncated=False, occluded=False).objects[0].box
    rotation = Rotation.from_quat(source.orientation)
    unit = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) / 2
    wanted = level_from_sensor.apply(rotation.apply(unit * source.size) + source.center)
    assert corner_distance(wanted, box) < 1e-4
    assert corner_distance(wanted, np.array(vertices["vertices"])) < 1e-4
    assert len(read_pcd(path).points) == len(points)


def test_example_pose_is_not_identity() -> None:
    """An identity rotation would hide mistakes."""
    assert np.abs(LEVEL_FROM_SENSOR.as_matrix() - IDENTITY.rotation).max() > 0.3


def test_kitti_2d_box_of_cloud_is_minus_one(tmp_path: Path) -> None:
    """An unorganised cloud has no image; the specification asks for -1."""
    points = frame().xyz()
    cloud = Frame("/scan", 0, 5, 6, "laser", points=points)
    views: Any = [(labelled(truncated=False, occluded=False), cloud, None)]
    finished: Any = SimpleNamespace(labels={})
    write_kitti(tmp_path, views, finished)

    assert read_labels(tmp_path)[0].box == [-1, -1, -1, -1]
    assert len(read_points(tmp_path)) == len(points)


def test_kitti_keeps_cloud_of_level_lidar(tmp_path: Path) -> None:
    """Taken for a camera that looks up, a level lidar would have its cloud turned on its side."""
    points = np.array([[4.0, 1.0, -0.5], [2.0, -3.0, 0.25]], np.float32)
    level = replace(
        labelled(truncated=False, occluded=False), up=np.array([0.0, 0.0, 1.0]), objects=()
    )
    views: Any = [(level, Frame("/scan", 0, 5, 6, "laser", points=points), None)]
    finished: Any = SimpleNamespace(labels={})
    write_kitti(tmp_path, views, finished)

    assert_allclose(read_points(tmp_path)[:, :3], points, atol=1e-6)


def test_kitti_turns_loose_points_of_camera_like_its_image(tmp_path: Path) -> None:
    """Taken for a laser scan with x forward, the cloud would lie beside the camera."""
    cloud = Frame("/points", 0, 5, 6, "optical", points=frame().xyz())
    finished: Any = SimpleNamespace(labels={})
    found = []
    for name, seen in (("image", frame()), ("cloud", cloud)):
        (tmp_path / name).mkdir()
        views: Any = [(labelled(truncated=False, occluded=False), seen, None)]
        write_kitti(tmp_path / name, views, finished)
        found.append(read_points(tmp_path / name))

    assert_allclose(found[1], found[0])
    assert found[0][:, 0].min() > 0.7  # x is forward


@pytest.mark.parametrize(("up", "forward"), [((0, 0, 1), (1, 0, 0)), ((0.3, 0, 0.95), (1, 0, 0))])
def test_lidar_looks_along_its_x_axis(up: Any, forward: Any) -> None:
    """REP 103: x forward, y left, z up; a camera looks along z."""
    rotation = rectified_from_sensor(np.array(up), optical=False)

    assert rotation[2] @ np.array(forward) > 0.9  # the rectified z axis, in the sensor frame
    assert rotation[0] @ np.array([0, -1, 0]) > 0.9  # x is right


def crops_run(*topics: str, name: str = "lab", **options: float | None) -> Any:
    made = {"topics": list(topics), "start_s": None, "end_s": None, **options}
    run = {"input": {"digest": "xxh3-128:0123456789"}, "options": made}
    return SimpleNamespace(name=name, info=run)


def crops_frames(*topics: str) -> list[Any]:
    one = labelled(truncated=False, occluded=False)
    return [(replace(one, topic=topic), replace(frame(), topic=topic), None) for topic in topics]


@pytest.mark.parametrize("topics", [("/left/depth", "/right/depth"), ("/a/depth", "/a_depth")])
def test_crops_of_two_cameras_do_not_replace_each_other(tmp_path: Path, topics: Any) -> None:
    """Frames of each topic are numbered from 0, so files of two cameras may have equal names."""
    for _ in range(2):  # the second export replaces the first
        assert write_crops(tmp_path, crops_frames(*topics), crops_run(*topics)) == 2
        (instance,) = tmp_path.glob("*/*")
        assert re.fullmatch(r"lab\.[0-9a-f]{12}\.track-4", instance.name)
        assert instance.parent.name == "bowl"
        assert len(list(instance.iterdir())) == 2


def test_crops_are_replaced_whatever_the_order_of_topics(tmp_path: Path) -> None:
    """If the topics are given in another order next time, each view would be exported twice."""
    topics = ("/left/depth", "/right/depth")
    for order in (topics, topics[::-1]):
        assert write_crops(tmp_path, crops_frames(*topics), crops_run(*order)) == 2
    assert len(list(tmp_path.glob("*/*/*.pcd"))) == 2


def test_crops_of_runs_of_two_cameras_do_not_replace_each_other(tmp_path: Path) -> None:
    """Two runs of one recording, one for each camera, may have the same name."""
    for topic in ("/left/depth", "/right/depth"):
        assert write_crops(tmp_path, crops_frames(topic), crops_run(topic)) == 1

    assert [path.name for path in tmp_path.glob("*/*/*")] == ["000000.pcd"] * 2


def test_crops_of_a_renamed_run_replace_the_earlier_ones(tmp_path: Path) -> None:
    """A training set would hold each object twice, with two labels if they were corrected."""
    for name in ("lab", "lab 2.a"):
        write_crops(tmp_path, crops_frames("/depth"), crops_run("/depth", name=name))

    assert [path.name[:7] for path in tmp_path.glob("*/*")] == ["lab 2.a"]


@pytest.mark.parametrize(
    ("ranges", "kept"),
    [
        ([(None, 10.0), (10.0, 20.5), (20.5, None)], 3),
        ([(3.0, 10.0), (12.0, 20.5), (None, 11.0)], 2),
        ([(3.0, 10.0), (None, None)], 1),
        ([(0.12345, 10.12345), (0.12345, 10.12345)], 1),
    ],
)
def test_crops_of_other_time_ranges_stay(tmp_path: Path, ranges: Any, kept: int) -> None:
    """Only crops of a range within the new one are replaced: they show the same frames."""
    for start, end in ranges:
        made = crops_run("/depth", start_s=start, end_s=end)
        assert write_crops(tmp_path, crops_frames("/depth"), made) == 1

    assert len(list(tmp_path.glob("*/*/*.pcd"))) == kept


@pytest.mark.parametrize(
    ("first", "second"), [((None, None), (3.0, 10.0)), ((None, 10.0), (5.0, None))]
)
def test_crops_do_not_replace_those_of_more_frames(tmp_path: Path, first: Any, second: Any) -> None:
    """The views of the frames that the new run lacks would be lost, with their labels."""
    made, part = (crops_run("/depth", start_s=start, end_s=end) for start, end in (first, second))
    write_crops(tmp_path, crops_frames("/depth"), made)

    with pytest.raises(OutputError, match="has views of another time range of this recording"):
        write_crops(tmp_path, crops_frames("/depth"), part)

    assert [Origin.read(path.name) for path in tmp_path.glob("*/*")] == [Origin.of(made)]


def dataset_image() -> DatasetImage:
    """Return an image of 40 x 20 pixels with two objects; the second label is uncertain."""
    first, second = (
        labelled(truncated=False, occluded=True).objects[0],
        labelled(truncated=True, occluded=False),
    )
    corner = np.zeros((6, 8), bool)
    corner[:2], corner[:, :3] = True, True  # 16 pixels above, and 12 of the foot below
    masks = (Mask(20, 5, corner), Mask(1, 2, np.ones((3, 4), bool)))
    uncertain = replace(second.objects[0], track=9, category="cup", confidence=0.4)
    view = labelled(truncated=False, occluded=False)
    objects = tuple(map(DatasetObject, (first, uncertain), masks, (True, False)))
    return DatasetImage("a.jpg", b"jpeg", 40, 20, view, objects)


def finished(path: str = "runs/lab", digest: str = "l") -> Any:
    run = {"input": {"digest": digest}}
    return SimpleNamespace(folder=Path(path), name=Path(path).name, info=run)


def test_coco_entries_have_right_values(tmp_path: Path) -> None:
    categories = ("cup", "can", "bowl")
    assert write_coco(tmp_path, [("train", finished(), dataset_image())], categories) == 1
    data = json.loads((tmp_path / "annotations" / "instances_train.json").read_text())
    (image,), (first, second) = data["images"], data["annotations"]
    names = {entry["id"]: entry["name"] for entry in data["categories"]}

    assert (image["width"], image["height"], image["file_name"]) == (40, 20, "a.jpg")
    assert [names[a["category_id"]] for a in (first, second)] == ["bowl", "cup"]
    assert [a["iscrowd"] for a in (first, second)] == [0, 1]
    assert [a["bbox"] for a in (first, second)] == [[20, 5, 8, 6], [1, 2, 4, 3]]
    assert [a["area"] for a in (first, second)] == [28, 12]
    assert first["segmentation"]["size"] == [20, 40]
    assert [a["score"] for a in (first, second)] == [0.9, 0.4]
    attributes = {"run": "lab", "track": 4, "occluded": True, "truncated": False}
    assert first["attributes"] == attributes
    assert second["attributes"]["truncated"]  # depth cuts its mask, even if the image is wider
    assert len({a["id"] for a in (first, second)}) == len({a["track_id"] for a in (first, second)})


def test_tracks_of_runs_with_equal_names_have_different_ids(tmp_path: Path) -> None:
    """Two batches may each have a run ``lab``; their tracks 4 must not be one object."""
    runs = [finished("monday/lab"), finished("tuesday/lab")]
    images: Any = [("train", run, dataset_image()) for run in runs]
    write_coco(tmp_path, images, ("cup", "can", "bowl"))
    data = json.loads((tmp_path / "annotations" / "instances_train.json").read_text())

    assert [a["attributes"]["track"] for a in data["annotations"]] == [4, 9, 4, 9]
    assert [a["track_id"] for a in data["annotations"]] == [1, 2, 3, 4]


@pytest.mark.parametrize("side", [1, -1])
def test_top_of_image_is_forward_for_camera_that_looks_straight_down_or_up(side: int) -> None:
    """Otherwise all boxes of a camera above a bin would be turned by half a turn."""
    rotation = rectified_from_sensor(np.array([0.01, -0.02, -side]), optical=True)

    assert_allclose(rotation, [[side, 0, 0], [0, 0, side], [0, -1, 0]], atol=0.03)


def test_yolo_omits_uncertain_labels(tmp_path: Path) -> None:
    """The format has no flag for uncertain labels, so they would be trained on."""
    categories = ("cup", "can", "bowl")
    assert write_yolo(tmp_path, [("val", finished(), dataset_image())], categories) == 1
    (line,) = (tmp_path / "labels" / "val" / "a.txt").read_text().splitlines()
    kind, *numbers = line.split()
    corners = np.reshape(list(map(float, numbers)), (-1, 2)) * [40, 20]

    assert kind == "2"
    expected = [(20, 5), (20, 11), (23, 7), (23, 11), (28, 5), (28, 7)]
    assert_allclose(sorted(corners.tolist()), expected, atol=1e-4)


def test_labels_of_images_with_dots_in_their_names_stay_apart(tmp_path: Path) -> None:
    """Recordings are often named after dates or versions; trainers pair files by their stems."""
    names = ("2024.05.01_depth_0.jpg", "2024.05.01_depth_1.jpg")
    images: Any = [("train", finished(), replace(dataset_image(), name=name)) for name in names]
    write_yolo(tmp_path, images, ("cup", "can", "bowl"))

    labels = sorted((tmp_path / "labels" / "train").iterdir())
    assert [path.name for path in labels] == [f"{Path(name).stem}.txt" for name in names]


def test_yaml_files_hold_names_as_they_are_written(tmp_path: Path) -> None:
    """JSON escapes a rare character as two surrogates, which YAML would read as two characters."""
    run: Any = SimpleNamespace(folder=tmp_path, labels={}, categories=("can", "𠮷 cup"))
    write_yolo(tmp_path, [], run.categories)
    cloud = Frame("/depth", 0, 5, 6, "optical", points=np.ones((2, 3), np.float32))
    empty = replace(labelled(truncated=False, occluded=False), objects=())
    write_point_labels(tmp_path, [(empty, cloud, None)], run)

    assert '  1: "𠮷 cup"\n' in (tmp_path / "data.yaml").read_text("utf-8")
    assert '  3: "𠮷 cup"\n' in (tmp_path / "semantic-kitti.yaml").read_text("utf-8")


def test_tiny_negative_yaw_is_not_written_as_360_degrees() -> None:
    """Modulo 360, a negative rounding error gives 360 itself, which labelCloud cannot show."""
    item = labelled(truncated=False, occluded=False).objects[0]
    for yaw in (-1e-12, 0.0, 1e-12):
        half = np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
        rotated = replace(item, box=Box(np.zeros(3), SIZE, half))
        assert _described(rotated, np.eye(3), "centroid_abs")["rotations"]["z"] == 0


def test_data_set_files_have_frames_runs_and_categories(tmp_path: Path) -> None:
    """Tracks 4 of two runs are different objects; ids of images count from 1 in each split.

    Ultralytics would resolve a relative "path" in data.yaml against the current directory.
    """
    view = replace(
        labelled(truncated=False, occluded=False), topic="/left", index=17, stamp_ns=12_345
    )
    second = replace(dataset_image(), name="b.jpg", labelled=view)
    other = finished("runs/hall", "h")
    images: Any = [
        ("train", finished(), dataset_image()), ("train", other, second), ("val", other, second)
    ]  # fmt: skip
    categories = ("cup", "can", "bowl")
    assert write_coco(tmp_path, images, categories) == 3
    assert write_yolo(tmp_path, images, categories) == 3
    train, val = (
        json.loads((tmp_path / "annotations" / f"instances_{split}.json").read_text())
        for split in ("train", "val")
    )

    # The sections of the format; importers look for all of them.
    assert train.keys() == {"info", "licenses", "categories", "images", "annotations"}
    size = {"width": 40, "height": 20}
    b = {"file_name": "b.jpg", **size, "recording": "hall", "digest": "h", "topic": "/left",
         "frame": 17, "stamp_ns": 12_345}  # fmt: skip
    assert train["images"] == [
        {"id": 1, "file_name": "a.jpg", **size, "recording": "lab", "digest": "l",
         "topic": "/depth", "frame": 0, "stamp_ns": 5},
        {"id": 2, **b},
    ]  # fmt: skip
    assert val["images"] == [{"id": 1, **b}]
    assert [[c["id"], c["name"]] for c in train["categories"]] == [
        [1, "cup"],
        [2, "can"],
        [3, "bowl"],
    ]
    names = ("id", "image_id", "category_id", "track_id")
    assert [[a[name] for name in names] for a in train["annotations"]] == [
        [1, 1, 3, 1], [2, 1, 1, 2], [3, 2, 3, 3], [4, 2, 1, 4]
    ]  # fmt: skip
    assert [[a[name] for name in names] for a in val["annotations"]] == [[1, 1, 3, 3], [2, 1, 1, 4]]
    runs = [(a["attributes"]["run"], a["attributes"]["track"]) for a in train["annotations"]]
    assert runs == [("lab", 4), ("lab", 9), ("hall", 4), ("hall", 9)]
    assert (tmp_path / "data.yaml").read_text().splitlines() == [
        "train: images/train", "val: images/val", "names:",
        '  0: "cup"', '  1: "can"', '  2: "bowl"',
    ]  # fmt: skip
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.glob("*/*/*")) == [
        "images/train/a.jpg", "images/train/b.jpg", "images/val/b.jpg",
        "labels/train/a.txt", "labels/train/b.txt", "labels/val/b.txt",
    ]  # fmt: skip


def test_labelcloud_formats_hold_same_box_in_their_units(tmp_path: Path) -> None:
    """Absolute angles are in degrees, from 0 to 360; relative ones in radians."""
    labelcloud(tmp_path)
    relative, absolute = (
        json.loads((tmp_path / folder / "000000.json").read_text())
        for folder in ("labels", "labels_centroid_abs")
    )
    (a,), (b,) = relative.pop("objects"), absolute.pop("objects")
    angles = a["rotations"].pop("z"), b["rotations"].pop("z")

    assert a == b
    assert a["dimensions"] == pytest.approx({"length": 0.31, "width": 0.14, "height": 0.23})
    assert (a["rotations"], a["name"]) == ({"x": 0, "y": 0}, "bowl")
    # The level frame differs from the level camera only by a rotation about the vertical.
    assert a["centroid"]["z"] == pytest.approx(-0.52)
    assert np.hypot(a["centroid"]["x"], a["centroid"]["y"]) == pytest.approx(np.hypot(0.37, 1.64))
    assert angles[1] == pytest.approx(np.degrees(angles[0]) % 360)
    assert 0.1 < abs(angles[0]) < np.pi
    assert relative == absolute == {
        "folder": "pointclouds", "filename": "000000.pcd", "path": "pointclouds/000000.pcd"
    }  # fmt: skip
    for folder, form in (
        ("labels", "centroid_rel"), ("labels_centroid_abs", "centroid_abs"),
        ("labels_vertices", "vertices"),
    ):  # fmt: skip
        classes = json.loads((tmp_path / folder / "_classes.json").read_text())
        assert classes["format"] == form
        assert [[c["id"], c["name"], c["color"]] for c in classes["classes"]] == [
            [0, "unknown", "#e2e2dc"], [1, "cup", "#e5484d"], [2, "bowl", "#f0b928"]
        ]  # fmt: skip


def test_kitti_lists_frame_of_each_number(tmp_path: Path) -> None:
    """Only this list leads from a label back to its frame."""
    view = labelled(truncated=False, occluded=False)
    other = replace(view, topic="/left", index=17, stamp_ns=12_345, objects=())
    views: Any = [(view, frame(), None), (other, frame(), None)]
    finished: Any = SimpleNamespace(labels={})

    assert write_kitti(tmp_path, views, finished) == 1
    assert (tmp_path / "frames.csv").read_text() == (
        "number,topic,frame,stamp_ns\n000000,/depth,0,5\n000001,/left,17,12345\n"
    )
    assert (tmp_path / "label_2" / "000001.txt").read_text() == ""


@pytest.mark.parametrize("without", ["lens", "data", "view"])
def test_kitti_2d_box_is_that_of_the_image_that_is_written(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, without: str
) -> None:
    """Without a usable image, boxes and P2 are those of the depth camera."""
    image = ColourImage("/color", 5, 6, "color", "rgb8", 40, 30, 120, bytes(3600))
    lens = LensCamera(replace(CAMERA, width=40, height=30, cx=20.0, cy=15.0))
    pose = Pose(np.eye(3), np.array([0.0, 9.0, 0.0] if without == "view" else [0.0, 0.0, 0.0]))
    if without == "data":
        image = replace(image, data=bytes(99))
    view = ColourView(image, None if without == "lens" else lens, pose)
    folders = tmp_path / "with", tmp_path / "alone"
    for folder, coloured in zip(folders, (Coloured(view, ()), None), strict=True):
        views: Any = [(labelled(truncated=False, occluded=False), frame(), coloured)]
        finished: Any = SimpleNamespace(labels={})
        folder.mkdir()
        write_kitti(folder, views, finished)
    (label,), (alone,) = map(read_labels, folders)

    if without == "view":  # the colour camera does not see it
        assert label.box == [-1, -1, -1, -1]
        assert alone.box[2] > 0
        return
    assert label == alone
    assert np.array_equal(*(read_calibration(one)["P2"] for one in folders))
    assert not (folders[0] / "image_2").exists()
    assert ("image_2/000000.png is missing" in caplog.text) is (without == "data")


def test_instances_of_other_tools_are_not_those_of_a_run() -> None:
    """Crops that someone added by hand must not be replaced by a later export."""
    assert Origin.read("mug_3") is None
    assert Origin.read("lab.0123456789ab.track-3") is not None
