"""Tests of all columns of review.rrd for a turned sensor, worked out by hand."""

import io
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from shapecat.cameras.colour import ColourImage, ColourView
from shapecat.colour.masks import Mask
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.review.scenes import ReviewFrame
from shapecat.types import Box, Camera, Frame, LabelledFrame, LabelledObject, NeuralGas, Plane, Pose
from tests.colour_messages import png
from tests.test_review import TOPIC, as_rows, stamp, write_frames

CAMERA = Camera(8, 6, 9.0, 7.0, 3.2, 2.9)
CUP, CAN = (229, 72, 77), (70, 167, 88)
TURNS = Rotation.from_euler("zyx", [[0.3, 0.2, -0.7], [0.5, -0.4, 0.9]])
PLACES = np.array([[0.5, 0.1, 1.3], [0.7, -0.2, 1.4]])
BOXES = (
    Box(np.array([0.31, -0.22, 1.17]), np.array([0.06, 0.11, 0.19]),
        Rotation.from_euler("xyz", (0.4, -0.7, 1.1)).as_quat()),
    Box(np.array([-0.13, 0.24, 0.95]), np.array([0.08, 0.05, 0.14]),
        Rotation.from_euler("xyz", (-0.3, 0.6, 0.2)).as_quat()),
)  # fmt: skip
FULL = (
    Box(np.array([0.33, -0.25, 1.21]), np.array([0.07, 0.13, 0.22]),
        Rotation.from_euler("xyz", (0.5, -0.6, 0.9)).as_quat()),
    Box(np.array([-0.16, 0.28, 0.97]), np.array([0.1, 0.09, 0.15]),
        Rotation.from_euler("xyz", (-0.2, 0.7, 0.4)).as_quat()),
)  # fmt: skip
NEURONS = np.array([[0.3, -0.2, 1.1], [0.35, -0.21, 1.12], [0.32, -0.15, 1.13], [0.36, -0.16, 1.2]])
GASES = (
    NeuralGas(NEURONS, np.array([[0, 1], [0, 2], [1, 2], [1, 3]])),
    NeuralGas(NEURONS[:3] - 0.4, np.array([[0, 1], [0, 2], [1, 2]])),
)
PIXELS = ([9, 10, 17], [28, 29, 30, 37])
MASKS = (
    Mask(1, 2, np.array([[1, 1, 0], [1, 1, 1]], bool)), Mask(6, 1, np.ones((3, 1), bool))
)  # fmt: skip
TABLE = np.array([[-1, 0.4, 0.5], [1, 0.5, 0.6], [1.1, 0.6, 2], [-1.2, 0.7, 2.1]])
SHELF = np.array([[-0.3, 0.1, 0.7], [0.4, 0.2, 0.8], [0.5, 0.3, 1.7]])
PLANES = tuple(Plane(np.array([0, -1, 0]), -0.4, outline, 1.0, 0.0) for outline in (TABLE, SHELF))


def items() -> tuple[LabelledObject, ...]:
    posteriors = np.array([[0.9, 0.1], [0.3, 0.7]])
    return tuple(
        LabelledObject(
            k + 1, ("cup", "can")[k], (0.97, 0.61)[k], BOXES[k], np.array(PIXELS[k]), GASES[k],
            np.array([0.5, 0.5]), posteriors[k], full=FULL[k],
        )
        for k in range(2)
    )  # fmt: skip


def seen_at(k: int, objects: tuple[LabelledObject, ...], pixels: Any) -> ReviewFrame:
    """Return a frame with its colour image; the objects are nearer than all else."""
    depth = np.full((6, 8), 1.25, np.float32)
    depth.flat[[index for one in PIXELS for index in one]] = 0.875
    depth[5, 7] = 0
    frame = Frame(TOPIC, k, stamp(k), stamp(k), "optical", depth, CAMERA)
    image = ColourImage("/color", stamp(k), stamp(k), "optical", "png", 8, 6, 0, png(pixels))
    pose = Pose(TURNS[k].as_matrix(), PLACES[k])
    labelled = LabelledFrame(
        TOPIC, k, stamp(k), stamp(k) + 7, "optical", pose, PLANES, objects, (),
        {"detect": 0.02 + k}, np.array([0, -1, 0]),
    )  # fmt: skip
    return ReviewFrame(labelled, frame, Coloured(ColourView(image), MASKS[: len(objects)]))


def contents(path: Path) -> dict[str, dict[str, Any]]:
    """Return the last value of each column of each entity, which the viewer shows at the end."""
    from rerun.chunk import RrdReader  # noqa: PLC0415  heavy

    found = [
        (row.get("frame", -1), str(chunk.entity_path).replace("\\", ""), row)
        for chunk in RrdReader(str(path)).stream().to_chunks()
        for row in as_rows(chunk.to_record_batch())
    ]
    shown: dict[str, dict[str, Any]] = {}
    for _, entity, row in sorted(found, key=lambda one: one[0]):
        values = {name: value for name, value in row.items() if ":" in name and value is not None}
        shown.setdefault(entity, {}).update(values)
    return {entity: values for entity, values in shown.items() if not entity.startswith("/__")}


def check(found: Any, expected: Any, name: str) -> None:
    """Compare nested lists of any shape; numbers must agree to 1e-5."""
    if isinstance(expected, list | tuple | np.ndarray):
        assert len(found) == len(expected), name
        for one, other in zip(found, expected, strict=True):
            check(one, other, name)
    elif isinstance(expected, str):
        assert found == expected, name
    else:
        assert found == pytest.approx(expected, rel=0, abs=1e-5), name


def check_entity(found: dict[str, Any], kind: str, **expected: Any) -> None:
    """Compare all columns of an archetype, ``kind``; there must be no others."""
    columns = {name.partition(":")[2] for name in found if name.startswith(f"{kind}:")}
    assert columns == expected.keys()
    for name, value in expected.items():
        check(found[f"{kind}:{name}"], value, name)


def packed(colour: Any, white: float = 0.0, alpha: int = 255) -> int:
    """Return 0xRRGGBBAA of a colour mixed with white."""
    red, green, blue = (round(part + white * (255 - part)) for part in map(int, colour))
    return red << 24 | green << 16 | blue << 8 | alpha


def edges_of(box: Box) -> list[tuple[Any, Any]]:
    """Return the ends of the twelve edges of a box."""
    half, turn = box.size / 2, Rotation.from_quat(box.orientation)
    return [
        tuple(
            turn.apply(half * np.insert([one, other], axis, side)) + box.center for side in (-1, 1)
        )
        for axis in range(3)
        for one, other in product((-1, 1), repeat=2)
    ]


@pytest.fixture(scope="module")
def pixels() -> Any:
    return np.random.default_rng(3).integers(0, 256, (6, 8, 3), np.uint8)


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory, pixels: Any) -> dict[str, dict[str, Any]]:
    """Return `contents` of two frames; the first object is in both, its full box in the second."""
    first, second = items()
    path = tmp_path_factory.mktemp("review") / "review.rrd"
    frames = [seen_at(0, (replace(first, full=None),), pixels), seen_at(1, (first, second), pixels)]
    run = {"fixed_frame": "map", "settings": {"outputs": {"cloud_points": 0}}}
    return contents(write_frames(path, frames, run=run))


SENSOR, SEEN, IMAGE = f"/world/{TOPIC}", f"/world/seen/{TOPIC}", f"/images/{TOPIC}"


def test_no_other_entities_are_written(shown: dict[str, Any]) -> None:
    """The next tests compare all columns of each of these archetypes."""
    kinds = {
        entity: " ".join(sorted({name.partition(":")[0] for name in columns}))
        for entity, columns in shown.items()
    }
    assert kinds == {
        "/log": "TextLog", "/run": "TextDocument", "/world": "ViewCoordinates",
        SENSOR: "Transform3D ViewCoordinates", SEEN: "Transform3D",
        f"{SENSOR}/camera": "Pinhole", f"/world/paths/{TOPIC}": "LineStrips3D",
        f"{SENSOR}/objects/boxes": "Boxes3D", f"{SENSOR}/objects/captions": "Points3D",
        f"{SEEN}/scene": "Points3D", f"{SEEN}/objects/points": "Points3D",
        f"{SEEN}/planes": "LineStrips3D", f"{SEEN}/planes/fill": "Mesh3D",
        f"{SEEN}/objects/full": "LineStrips3D", f"{SEEN}/objects/graphs": "LineStrips3D",
        f"{SEEN}/objects/surfaces": "Mesh3D",
        IMAGE: "EncodedImage", f"{IMAGE}/masks": "EncodedImage",
        f"{IMAGE}/boxes": "Boxes2D", f"{IMAGE}/captions": "Points2D",
        "/tracks/1/posterior": "Scalars SeriesLines",
        "/tracks/2/posterior": "Scalars SeriesLines SeriesPoints",
        "/plots/objects/cup": "Scalars SeriesLines", "/plots/objects/can": "Scalars SeriesLines",
        "/plots/seconds/detect": "Scalars SeriesLines",
    }  # fmt: skip


def test_sensor_and_scene_are_at_the_pose_of_the_frame(shown: dict[str, Any]) -> None:
    """Axes are numbered up 1, down 2, right 3, forward 5; matrices are stored by column."""
    pose = {"translation": [PLACES[1]], "quaternion": [TURNS[1].as_quat()]}
    check_entity(shown[SENSOR], "Transform3D", **pose)
    check_entity(shown[SENSOR], "ViewCoordinates", xyz=[[3, 2, 5]])
    check_entity(shown[SEEN], "Transform3D", **pose)
    check_entity(shown["/world"], "ViewCoordinates", xyz=[[3, 5, 1]])
    check_entity(
        shown[f"{SENSOR}/camera"], "Pinhole", camera_xyz=[[3, 2, 5]], resolution=[[8, 6]],
        image_from_camera=[[9, 0, 0, 0, 7, 0, 3.2, 2.9, 1]],
        color=[packed((120, 130, 145))], image_plane_distance=[0.06],
    )  # fmt: skip


def test_every_row_has_the_stamp_of_its_frame(tmp_path: Path, pixels: Any) -> None:
    """At its log time, a box would be drawn before or after the image in which it was found."""
    from rerun.chunk import RrdReader  # noqa: PLC0415  heavy

    run = {"fixed_frame": "map", "settings": {"outputs": {"cloud_points": 0}}}
    frames = [seen_at(k, items(), pixels) for k in range(2)]
    chunks = RrdReader(str(write_frames(tmp_path / "review.rrd", frames, run=run))).stream()
    found = {
        (str(chunk.entity_path), row["sensor_time"] - stamp(row["frame"]))
        for chunk in chunks.to_chunks()
        for row in as_rows(chunk.to_record_batch())
        if row.get("frame") is not None
    }

    assert len(found) > 15  # entities
    assert {late_ns for _, late_ns in found} == {0}


def test_path_is_in_the_fixed_frame(shown: dict[str, Any]) -> None:
    path = [TURNS[k].apply(box.center) + PLACES[k] for k, box in enumerate((BOXES[0], FULL[0]))]
    check_entity(
        shown[f"/world/paths/{TOPIC}"], "LineStrips3D", strips=[path], colors=[packed(CUP, 0.2)]
    )


def test_boxes_and_captions_are_those_of_their_objects(shown: dict[str, Any]) -> None:
    check_entity(
        shown[f"{SENSOR}/objects/boxes"], "Boxes3D",
        centers=[box.center for box in BOXES],
        half_sizes=[box.size / 2 for box in BOXES],
        quaternions=[box.orientation for box in BOXES],
        colors=[packed(CUP, 0.25), packed(CAN, 0.25)],
        labels=["#1 cup 0.97", "#2 can 0.61"],
        radii=[0.001], show_labels=[False],
    )  # fmt: skip
    above = [
        box.center + Rotation.from_quat(box.orientation).apply([0, 0, box.size[2] / 2 + 0.02])
        for box in BOXES
    ]
    check_entity(
        shown[f"{SENSOR}/objects/captions"], "Points3D", positions=above,
        colors=[packed(CUP, 0.6), packed(CAN, 0.6)], labels=["#1 cup", "#2 can 0.61"],
        radii=[0.0005], show_labels=[True],
    )  # fmt: skip


def test_full_boxes_are_dashed(shown: dict[str, Any]) -> None:
    """Each edge has five dashes, from end to end, with gaps of the same length."""
    found = shown[f"{SEEN}/objects/full"]
    strips = np.array(found["LineStrips3D:strips"])
    colors = [packed(CUP, 0.45)] * 60 + [packed(CAN, 0.45)] * 60
    check_entity(found, "LineStrips3D", colors=colors, radii=[0.0008], strips=strips)
    for box, dashes in zip(FULL, np.split(strips, 2), strict=True):
        expected = np.array([
            [(a + (b - a) * (k + end) / 4.5) for end in (0, 0.5)]
            for a, b in edges_of(box)
            for k in range(5)
        ])  # fmt: skip
        either = np.stack([expected, expected[:, ::-1]])
        apart = np.abs(dashes[:, None, None] - either).max(axis=(3, 4)).min(axis=1)
        assert sorted(apart.argmin(axis=1)) == list(range(60))
        assert apart.min(axis=1).max() < 1e-5


def test_graphs_and_surfaces_are_those_of_their_objects(shown: dict[str, Any]) -> None:
    first, second = GASES
    check_entity(
        shown[f"{SEEN}/objects/graphs"], "LineStrips3D",
        strips=[*first.neurons[first.edges], *second.neurons[second.edges]],
        colors=[packed(CUP, 0.65)] * 4 + [packed(CAN, 0.65)] * 3, radii=[0.0008],
    )  # fmt: skip
    check_entity(
        shown[f"{SEEN}/objects/surfaces"], "Mesh3D",
        vertex_positions=[*first.neurons, *second.neurons],
        vertex_colors=[packed(CUP, alpha=70)] * 4 + [packed(CAN, alpha=70)] * 3,
        triangle_indices=[[0, 1, 2], [4, 5, 6]],
    )  # fmt: skip


def test_planes_have_their_outline_and_fill(shown: dict[str, Any]) -> None:
    grey = (190, 205, 220)
    strips = [[*TABLE, TABLE[0]], [*SHELF, SHELF[0]]]
    check_entity(
        shown[f"{SEEN}/planes"], "LineStrips3D", strips=strips, colors=[packed(grey)], radii=[0.001]
    )
    check_entity(
        shown[f"{SEEN}/planes/fill"], "Mesh3D", vertex_positions=[*TABLE, *SHELF],
        triangle_indices=[[0, 1, 2], [0, 2, 3], [4, 5, 6]], albedo_factor=[packed(grey, alpha=28)],
    )  # fmt: skip


def test_points_have_their_place_and_colour(shown: dict[str, Any], pixels: Any) -> None:
    """Points of objects are tinted by 35 %; channels have 32 levels."""
    owner = {index: k for k, one in enumerate(PIXELS) for index in one}
    rest = [index for index in range(47) if index not in owner]
    for name, chosen, z in (("scene", rest, 1.25), ("objects/points", sorted(owner), 0.875)):
        colours = []
        for index in chosen:
            colour = pixels.reshape(-1, 3)[index].astype(float)
            if index in owner:
                colour += 0.35 * ((CUP, CAN)[owner[index]] - colour)
            colours.append(packed(np.floor(colour / 8) * 8 + 4))
        v, u = np.divmod(chosen, 8)
        check_entity(
            shown[f"{SEEN}/{name}"], "Points3D", colors=colours, point_shading=[2],
            positions=np.stack([(u - 3.2) / 9 * z, (v - 2.9) / 7 * z, 0 * u + z], axis=1),
            radii=[0.55 * z / 9],
        )  # fmt: skip


def test_image_has_masks_boxes_and_captions_of_its_objects(
    shown: dict[str, Any], pixels: Any
) -> None:
    files = {}
    for name, style in (("", {}), ("/masks", {"draw_order": [1.0]})):
        (blob,) = blobs = shown[IMAGE + name]["EncodedImage:blob"]
        files[name] = Image.open(io.BytesIO(bytes(bytearray(blob))))
        check_entity(
            shown[IMAGE + name], "EncodedImage", media_type=["image/png"], blob=blobs, **style
        )
    np.testing.assert_array_equal(np.asarray(files[""]), pixels)
    layer = np.zeros((6, 8, 4), np.uint8)
    for mask, colour in zip(MASKS, (CUP, CAN), strict=True):
        layer[mask.full(6, 8)] = (*colour, 110)
    np.testing.assert_array_equal(np.asarray(files["/masks"].convert("RGBA")), layer)
    check_entity(
        shown[f"{IMAGE}/boxes"], "Boxes2D", centers=[[2.5, 3], [6.5, 2.5]],
        half_sizes=[[1.5, 1], [0.5, 1.5]], colors=[packed(CUP), packed(CAN)], draw_order=[2.0],
    )  # fmt: skip
    pale = [packed([127 + part // 2 for part in colour]) for colour in (CUP, CAN)]
    check_entity(
        shown[f"{IMAGE}/captions"], "Points2D", positions=[[2.5, 2], [6.5, 1]], colors=pale,
        labels=["#1 cup", "#2 can 0.61"], radii=[0.5], show_labels=[True], draw_order=[3.0],
    )  # fmt: skip


def test_curves_have_their_values_names_and_colours(shown: dict[str, Any]) -> None:
    names, colors = ["cup", "can"], [packed(CUP), packed(CAN)]
    for number, posterior in ((1, [0.9, 0.1]), (2, [0.3, 0.7])):
        found = shown[f"/tracks/{number}/posterior"]
        check_entity(found, "Scalars", scalars=posterior)
        check_entity(found, "SeriesLines", names=names, colors=colors, widths=[1.5, 1.5])
    check_entity(found, "SeriesPoints", names=names, colors=colors, marker_sizes=[4, 4])
    for name, color in zip(names, colors, strict=True):
        found = shown[f"/plots/objects/{name}"]
        check_entity(found, "Scalars", scalars=[1])
        check_entity(
            found, "SeriesLines", names=[name], colors=[color], widths=[2], interpolation_mode=[2]
        )
    check_entity(shown["/plots/seconds/detect"], "Scalars", scalars=[1.02])
    check_entity(shown["/plots/seconds/detect"], "SeriesLines", names=["detect"], widths=[2])


def test_texts_are_those_of_run_and_last_event(shown: dict[str, Any]) -> None:
    assert "- **fixed_frame**: map" in shown["/run"]["TextDocument:text"][0]
    assert shown["/run"]["TextDocument:media_type"] == ["text/markdown"]
    check_entity(shown["/log"], "TextLog", text=["#2 can 0.61 appears"], level=["INFO"])


@pytest.mark.parametrize(
    ("up", "axes"),
    [
        ((0.0, 0.0, 1.0), [3, 5, 1]),
        ((0.4, -0.3, 0.87), [3, 5, 1]),
        ((0.2, -0.95, -0.25), [3, 2, 5]),
    ],
)
def test_cloud_without_fixed_frame(tmp_path: Path, up: Any, axes: list[int]) -> None:
    """The z axis of a laser scanner is up, and y of a camera is down, also in unorganized clouds.

    The scene is in the sensor frame; the pose of the sensor in another frame is not shown.
    """
    first, _ = items()
    first = replace(first, indices=np.array([1, 2]))
    points = np.array([[4.1, 1.2, -0.5], [2.3, -3.4, 0.25], [2.6, -3.7, 0.3]], np.float32)
    frame = Frame("/lidar", 0, stamp(0), stamp(0), "lidar", points=points)
    pose = Pose(TURNS[0].as_matrix(), PLACES[0])
    floor = Plane(np.array(up), -0.5, np.eye(3), 0.7, 0.0)  # it confirms the up direction
    labelled = LabelledFrame(
        "/lidar", 0, stamp(0), stamp(0), "lidar", pose, (floor,), (first,), (), {},
        np.array(up),
    )  # fmt: skip
    shown = contents(write_frames(tmp_path / "review.rrd", [ReviewFrame(labelled, frame)]))

    check_entity(shown["/world//lidar"], "ViewCoordinates", xyz=[axes])
    check(shown["/world//lidar/scene"]["Points3D:positions"], points[:1], "scene")
    check(shown["/world//lidar/objects/points"]["Points3D:positions"], points[1:], "points")
    assert not shown.keys() & {"/world", "/world//lidar/camera", "/world/seen//lidar"}
