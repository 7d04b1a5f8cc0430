"""Tests of simulated scenes, their truth and their recordings, and of scanned meshes."""

import hashlib
import json
import resource
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.spatial import ConvexHull

from shapecat.arrays import Bool
from shapecat.errors import OutputError
from shapecat.geometry import compose, inverse, rotation_from_quaternion, transform
from shapecat.models.meshes import load_mesh, uprighted
from shapecat.simulation import World, make_scene, render_frame, simulate, truth
from shapecat.simulation.camera.presets import IDEAL, KINECT
from shapecat.simulation.camera.render import geometry, render
from shapecat.simulation.camera.sensors import resized
from shapecat.simulation.containers import FormatName
from shapecat.simulation.recorder import EPOCH_NS, record, robot_links
from shapecat.simulation.scenes import layout
from shapecat.simulation.scenes.furniture import make_table
from shapecat.simulation.scenes.kinds import SCENES, SceneKind
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.simulation.shapes.stable_poses import stable_poses
from shapecat.simulation.truth import AMBIGUOUS_PIXELS, frame_truth
from shapecat.types import CATEGORIES, Camera, Pose

SETTLED = {"pile", "bin", "shelf_bin", "room"}  # with physics: objects touch and lie in each other
SHARE_IN_VIEW = {"walking": 0.3, "rows": 0.3}  # a counter longer than the view; hidden rows
KINDS: tuple[SceneKind, ...] = tuple(k for k in get_args(SceneKind) if k not in SETTLED)


def test_every_scene_is_a_kind() -> None:
    """The tests below run only for the kinds that `SceneKind` lists."""
    assert set(get_args(SceneKind)) == SCENES.keys()


WORLDS = [
    *((kind, 1) for kind in KINDS),
    *(pytest.param((kind, 2), marks=pytest.mark.many) for kind in KINDS),
]


def test_category_is_ambiguous_if_little_of_object_is_visible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Either few visible pixels or a small visible fraction makes the category ambiguous."""
    world = make_scene("tabletop", np.random.default_rng(11), frames=1)
    _, labels = render_frame(world, 0, rng=np.random.default_rng(0), sensor=KINECT)
    clear = [
        t for t in frame_truth(world, 0, labels, KINECT.camera)["objects"] if not t["ambiguous"]
    ]
    largest = max(clear, key=lambda one: one["pixels"])

    def judged(shown: float) -> dict[str, Any]:
        cut, own = labels.copy(), np.flatnonzero(labels == largest["label"])
        cut.reshape(-1)[own[round(shown * len(own)) :]] = world.supports[0].label
        found = frame_truth(world, 0, cut, KINECT.camera)["objects"]
        return next(one for one in found if one["label"] == largest["label"])

    less = judged(0.3)
    assert less["pixels"] > 2 * AMBIGUOUS_PIXELS
    assert less["visible"] == pytest.approx(0.3 * largest["visible"], abs=0.01)
    assert [judged(shown)["ambiguous"] for shown in (1.0, 0.5, 0.3)] == [False, False, True]
    monkeypatch.setattr(truth, "AMBIGUOUS_PIXELS", judged(0.8)["pixels"])
    assert [judged(shown)["ambiguous"] for shown in (0.8, 0.79)] == [False, True]


def test_truth_states_how_objects_stand() -> None:
    """Results are judged by these fields, separately for lying or tilted objects."""
    names = (
        "label",
        "category",
        "kind",
        "lying",
        "upside_down",
        "tilted",
        "on_support",
        "on_track",
    )
    stand: list[tuple[Any, ...]] = [
        (20, "cup", "mug", True, False, False, "table", None),
        (21, "unknown", "arm", False, True, False, "shelf", None),
        (22, "box", "book", False, False, True, None, 1),
    ]
    world = make_scene("tabletop", np.random.default_rng(11), frames=1)
    items = [
        replace(item, **dict(zip(names[1:], row[1:], strict=True)))
        for item, row in zip(world.objects, stand, strict=False)
    ]
    nothing = np.zeros((480, 640), np.uint8)
    found = frame_truth(replace(world, objects=tuple(items)), 0, nothing, KINECT.camera)

    assert [tuple(entry[name] for name in names) for entry in found["hidden"]] == stand
    assert [entry["parts"] for entry in found["hidden"]] == [[20], [21], [22]]
    assert found["objects"] == []


@pytest.fixture(scope="module", params=WORLDS, ids=str)
def world(request: pytest.FixtureRequest) -> World:
    kind, seed = request.param
    return make_scene(kind, np.random.default_rng(seed), frames=40)


def top_view(mesh: Mesh, pose: Pose) -> Bool:
    """Return whether an object, seen from far above, covers each cell (500, 500) of 3 mm."""
    far = 500.0
    camera = Camera(500, 500, far / 0.003, far / 0.003, 249.5, 249.5)
    above = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, far]))
    return np.asarray(render(geometry([(mesh, pose)]), camera, above).mesh_ids >= 0)


def test_objects_do_not_interpenetrate(world: World) -> None:
    """Where two objects overlap in height, no vertical line may meet both."""
    here = Pose(np.eye(3), np.zeros(3))
    solids = [(item.mesh, item.pose) for item in world.objects]
    solids += [(s.mesh, here) for s in world.supports if s.name != "floor"]
    heights = [transform(pose, mesh.vertices)[:, 2] for mesh, pose in solids]
    covers = [top_view(*solid) for solid in solids]
    for i in range(len(world.objects)):
        for j in range(i + 1, len(solids)):
            apart = min(heights[i].max(), heights[j].max()) - max(
                heights[i].min(), heights[j].min()
            )
            if apart > 1e-4:
                assert not np.any(covers[i] & covers[j]), (world.kind, i, j)


def test_objects_stand_on_their_true_supports(world: World) -> None:
    boards = {support.name: support for support in world.supports}
    for item in world.objects:
        points = transform(item.pose, item.mesh.vertices)
        bottom = float(points[:, 2].min())
        if item.on_support is not None:
            assert item.on_track is None
            assert bottom == pytest.approx(boards[item.on_support].height, abs=3e-5)
        else:
            assert item.on_track is not None
            below = world.objects[item.on_track]
            top = float(transform(below.pose, below.mesh.vertices)[:, 2].max())
            assert bottom == pytest.approx(top, abs=3e-5)


def test_most_objects_are_visible(world: World) -> None:
    rng = np.random.default_rng(0)
    for index in (0, 20, 39):
        _, labels = render_frame(world, index, rng=rng, sensor=KINECT)
        visible = {item.track for item in world.objects if (labels == item.label).sum() > 60}
        share = SHARE_IN_VIEW.get(world.kind, 0.6)
        assert len(visible) >= share * len(world.objects)


def test_camera_moves_smoothly(world: World) -> None:
    places = np.array([pose.translation for pose in world.path])
    step = np.linalg.norm(np.diff(places, axis=0), axis=1)

    assert step.max() < 0.04  # 1.2 m/s
    traces = [(a.rotation.T @ b.rotation).trace() for a, b in pairwise(world.path)]
    assert min(traces) > 1 + 2 * np.cos(np.radians(3))


def test_tabletop_contains_all_categories() -> None:
    for seed in range(5):
        world = make_scene("tabletop", np.random.default_rng(seed), frames=2)
        assert {item.category for item in world.objects} == set(CATEGORIES)
        assert 6 <= len(world.objects) <= 10


def test_tabletop_of_more_categories_than_objects_draws_some_of_them() -> None:
    """Training on categories of one's own may need more than ten; an empty range was an error."""
    names = [f"{name}s" for name in CATEGORIES]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(layout, "make_object", lambda _name, rng: make_object("can", rng))
        rng = np.random.default_rng(0)
        world = make_scene("tabletop", rng, frames=1, categories=(*CATEGORIES, *names))

    assert len({item.category for item in world.objects}) == len(world.objects) == 10


def test_boxes_turned_over_are_upside_down_in_layouts_as_in_piles() -> None:
    """The truth of a pile called such a box upside down, that of a layout did not."""
    box = make_object("box", np.random.default_rng(0))
    turned = next(stable for stable in stable_poses(box) if stable.name == "upside_down")
    piece = layout.Piece("box", "box", box, turned)
    table = make_table(np.random.default_rng(0))
    placed = layout.place_piece(piece, 0, piece.stable_pose.pose, table, None)

    assert placed.pose.rotation[2, 2] < -0.9
    assert (placed.upside_down, placed.lying) == (True, False)


def test_stacks_occur_in_clutter_and_on_shelves() -> None:
    stacked = [
        sum(t.on_track is not None for t in make_scene(kind, np.random.default_rng(s)).objects)
        for kind in ("clutter", "shelf")
        for s in range(2)
    ]

    assert sum(stacked) >= 3


def test_turntable_moves_objects_and_not_the_camera() -> None:
    world = make_scene("turntable", np.random.default_rng(0), frames=30)
    item = world.objects[0]
    first, last = world.pose_of(item, 0), world.pose_of(item, 29)

    assert np.linalg.norm(first.translation - last.translation) > 0.005
    assert first.translation[2] == last.translation[2]
    assert np.array_equal(world.path[0].translation, world.path[29].translation)
    assert world.turns is not None
    back = replace(world, turns=world.turns[::-1])  # ends where the other begins
    np.testing.assert_array_equal(back.geometry(29).vertices, world.geometry(0).vertices)


def test_scene_is_independent_of_number_of_frames() -> None:
    """A longer demo of the same seed must show the same table."""
    short = make_scene("tabletop", np.random.default_rng(5), frames=3)
    long = make_scene("tabletop", np.random.default_rng(5), frames=50)

    assert len(short.objects) == len(long.objects)
    for a, b in zip(short.path, long.path, strict=False):
        assert np.array_equal(a.translation, b.translation)


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.many)])
def test_moving_objects_stay_on_table_and_do_not_collide(seed: int) -> None:
    """Objects that pass through each other or through the table would make truth wrong."""
    kinds: tuple[SceneKind, ...] = ("crossing", "rearranged")
    for kind in kinds:
        moving = make_scene(kind, np.random.default_rng(seed), frames=24, rate_hz=4)
        assert moving.motions
        table = next(s for s in moving.supports if s.name == "table")
        known: dict[tuple[int, bytes], Bool] = {}  # the views of objects at rest
        for k in range(24):
            current = [item for item in moving.objects if moving.present(item, k)]
            solids = [(item.mesh, moving.pose_of(item, k)) for item in current]
            z = [transform(pose, mesh.vertices)[:, 2] for mesh, pose in solids]
            covers = []
            for item, (mesh, pose) in zip(current, solids, strict=True):
                key = item.track, pose.rotation.tobytes() + pose.translation.tobytes()
                if key not in known:
                    known[key] = top_view(mesh, pose)
                covers.append(known[key])
            assert min(low.min() for low in z) > table.height - 1e-4
            for i in range(len(solids)):
                for j in range(i):
                    apart = min(z[i].max(), z[j].max()) - max(z[i].min(), z[j].min())
                    # Carried objects may pass over others, 15 cm high, or close to them.
                    lifted = max(z[i].min(), z[j].min()) > table.height + 0.001
                    assert apart < 1e-4 or lifted or not np.any(covers[i] & covers[j])


def test_truth_lists_only_present_objects(tmp_path: Path) -> None:
    path = simulate(tmp_path / "a.mcap", scene="rearranged", frames=6, rate_hz=1, seed=5)
    truth = json.loads(path.with_name("a.truth.json").read_text())
    labels = np.load(path.with_name("a.labels.npz"))["labels"]
    world = make_scene("rearranged", np.random.default_rng(5), frames=6, rate_hz=1)
    counts = []
    for k, frame in enumerate(truth):
        listed = {o["track"]: o["pixels"] for o in frame["objects"] + frame["hidden"]}
        assert set(listed) == {t.track for t in world.objects if world.present(t, k)}
        absent = {t.label for t in world.objects} - {20 + track for track in listed}
        assert not np.isin(labels[k], list(absent)).any()
        counts.append(len(listed))
    assert min(counts) < max(counts) <= len(world.objects)


def test_carried_object_stands_on_nothing(tmp_path: Path) -> None:
    """Otherwise correct support relations would be judged wrong."""
    path = simulate(tmp_path / "a.mcap", scene="rearranged", frames=12, rate_hz=4, seed=5)
    truth = json.loads(path.with_name("a.truth.json").read_text())
    start = {
        item.track: item
        for item in make_scene("rearranged", np.random.default_rng(5), frames=12, rate_hz=4).objects
    }
    heights = []
    for entry in (o for frame in truth for o in frame["objects"] + frame["hidden"]):
        item = start[entry["track"]]
        bottom = float(transform(item.pose, item.mesh.vertices)[:, 2].min())
        lifted = entry["center"][2] - entry["box"]["size"][2] / 2 - bottom > 0.002
        heights.append(lifted)
        assert (entry["on_support"] is None) == lifted
    assert 0 < sum(heights) < len(heights) / 2


def test_unknown_scene_raises() -> None:
    with pytest.raises(ValueError, match="kitchen"):
        make_scene("kitchen", np.random.default_rng(0))  # type: ignore[arg-type]  # the mistake


def test_labels_exist_exactly_where_depth_does(world: World) -> None:
    frame, labels = render_frame(world, 0, rng=np.random.default_rng(0))
    assert frame.depth is not None

    assert np.array_equal(labels == 0, frame.depth == 0)


def test_labelled_points_lie_within_their_object(world: World) -> None:
    """Labels must not be shifted against depth."""
    frame, labels = render_frame(world, 7, rng=np.random.default_rng(0), sensor=IDEAL)
    points = transform(world.path[7], frame.xyz())
    for item in world.objects:
        own = points[labels.reshape(-1) == item.label]
        if len(own) == 0:
            continue
        local = transform(inverse(world.pose_of(item, 7)), own)
        low, high = item.mesh.vertices.min(axis=0), item.mesh.vertices.max(axis=0)
        assert np.all(local > low - 1e-4)
        assert np.all(local < high + 1e-4)


def test_robot_links_compose_to_the_camera_pose(world: World) -> None:
    optical = Pose(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.zeros(3))
    for pose in world.path[::13]:
        (_, _, base), (_, _, mast) = robot_links(pose)
        whole = compose(compose(base, mast), optical)
        np.testing.assert_allclose(whole.rotation, pose.rotation, atol=1e-9)
        np.testing.assert_allclose(whole.translation, pose.translation, atol=1e-9)
        assert base.translation[2] == 0


# --- recordings ----------------------------------------------------------------------------------


CONTAINERS = [
    "mcap",
    # `test_pipeline` processes such recordings.
    *(pytest.param(name, marks=pytest.mark.many) for name in ("ros1", "ros2")),
]


@pytest.fixture(scope="module", params=CONTAINERS)
def recording(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    container: FormatName = request.param
    out = tmp_path_factory.mktemp("sim") / "demo"
    return simulate(out, format=container, frames=3, seed=11)


def read(path: Path) -> dict[str, list[Any]]:
    found: dict[str, list[Any]] = {}
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append(message)
    return found


def test_recordings_contain_the_rendered_frames(recording: Path) -> None:
    found = read(recording)
    world = make_scene("tabletop", np.random.default_rng(11), frames=3)

    assert len(found["/tf_static"]) == 1
    for index, image in enumerate(found["/camera/depth/image_raw"]):
        frame, _ = render_frame(world, index, rng=np.random.default_rng((11, index)))
        assert frame.depth is not None
        depth = np.frombuffer(image.data, "<u2").reshape(480, 640)
        np.testing.assert_allclose(depth / 1000, frame.depth, atol=0.00051)
        assert image.header.frame_id == "camera_depth_optical_frame"
    for info in found["/camera/depth/camera_info"]:
        k = info.k if hasattr(info, "k") else info.K
        assert k[0] == 525.0


def test_stamps_begin_at_the_epoch(recording: Path) -> None:
    images = read(recording)["/camera/depth/image_raw"]
    stamps = [m.header.stamp.sec * 1_000_000_000 + m.header.stamp.nanosec for m in images]

    assert stamps == [EPOCH_NS, EPOCH_NS + 33_333_333, EPOCH_NS + 66_666_667]


def test_transforms_connect_map_and_camera(recording: Path) -> None:
    found = read(recording)
    world = make_scene("tabletop", np.random.default_rng(11), frames=3)
    links = [found["/tf"][2].transforms[0], found["/tf"][2].transforms[1]]
    links.append(found["/tf_static"][0].transforms[0])
    pose = Pose(np.eye(3), np.zeros(3))
    for link in links:
        q, t = link.transform.rotation, link.transform.translation
        step = Pose(rotation_from_quaternion([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z]))
        pose = compose(pose, step)

    names = [links[0].header.frame_id, *(link.child_frame_id for link in links)]
    assert names == ["map", "base_link", "camera_link", "camera_depth_optical_frame"]
    np.testing.assert_allclose(pose.translation, world.path[2].translation, atol=1e-7)
    np.testing.assert_allclose(pose.rotation, world.path[2].rotation, atol=1e-7)


def test_truth_has_pixel_counts_of_labels(recording: Path) -> None:
    truth = json.loads(recording.with_name("demo.truth.json").read_text("utf-8"))
    labels = np.load(recording.with_name("demo.labels.npz"))["labels"]

    assert labels.shape == (3, 480, 640)
    assert [t["scene"] for t in truth] == ["sim11"] * 3
    for frame, image in zip(truth, labels, strict=True):
        counts = np.bincount(image.ravel(), minlength=256)
        assert all(o["pixels"] == counts[o["label"]] for o in frame["objects"])
        assert all(counts[p["label"]] == p["pixels"] for p in frame["planes"])
        assert {o["category"] for o in frame["objects"]} <= set(CATEGORIES)
        assert all(0 < o["visible"] <= 1 for o in frame["objects"])


def test_true_boxes_contain_points_of_their_object(recording: Path) -> None:
    truth = json.loads(recording.with_name("demo.truth.json").read_text("utf-8"))[1]
    world = make_scene("tabletop", np.random.default_rng(11), frames=3)
    frame, labels = render_frame(world, 1, rng=np.random.default_rng(0), sensor=IDEAL)
    for entry in truth["objects"]:
        box = entry["box"]
        own = frame.xyz()[labels.reshape(-1) == entry["label"]] - box["center"]
        local = own @ rotation_from_quaternion(box["orientation"])
        assert np.all(np.abs(local) < np.array(box["size"]) / 2 + 1e-3)
        center = transform(world.path[1], np.array(box["center"]))
        np.testing.assert_allclose(center, entry["center"], atol=1e-4)


def test_true_planes_contain_their_points(recording: Path) -> None:
    truth = json.loads(recording.with_name("demo.truth.json").read_text("utf-8"))[1]
    world = make_scene("tabletop", np.random.default_rng(11), frames=3)
    frame, labels = render_frame(world, 1, rng=np.random.default_rng(0), sensor=IDEAL)

    assert truth["planes"]
    for plane in truth["planes"]:
        own = frame.xyz()[labels.reshape(-1) == plane["label"]]
        offsets = own @ plane["normal"] - plane["offset"]
        assert np.mean(np.abs(offsets) < 2e-3) > 0.9  # other points are on sides of the table
        place = transform(world.path[1], np.array(plane["normal"]) * plane["offset"])
        assert place[2] == pytest.approx(plane["height"], abs=1e-4)


def digest(path: Path) -> str:
    total = hashlib.sha256()
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            total.update(channel.topic.encode() + message.data)
            total.update(message.log_time.to_bytes(8, "little"))
    return total.hexdigest()


def test_recordings_are_reproducible(tmp_path: Path) -> None:
    """Every machine generates the fixtures itself: they must be equal."""
    paths = [
        simulate(tmp_path / name, scene="clutter", frames=1, seed=seed)
        for name, seed in (("a", 3), ("b", 3), ("c", 4))
    ]
    first, second, other = (digest(path) for path in paths)

    assert first == second
    assert first != other
    labels = [path.with_name(f"{path.stem}.labels.npz").read_bytes() for path in paths]
    assert labels[0] == labels[1]


def test_clouds_match_the_depth_image(tmp_path: Path) -> None:
    image = simulate(tmp_path / "d", frames=1, seed=1)
    cloud = simulate(tmp_path / "c", frames=1, seed=1, clouds=True)
    depth = np.frombuffer(read(image)["/camera/depth/image_raw"][0].data, "<u2") / 1000
    message = read(cloud)["/camera/depth/points"][0]
    points = np.frombuffer(message.data, "<f4").reshape(-1, 4)

    assert (message.height, message.width) == (480, 640)
    assert np.array_equal(np.isnan(points[:, 2]), depth == 0)
    np.testing.assert_allclose(np.nan_to_num(points[:, 2]), depth, atol=0.00051)


def test_older_recording_is_replaced(tmp_path: Path) -> None:
    for seed in (1, 2):
        simulate(tmp_path / "bag", format="ros2", scene="empty", frames=1, seed=seed)

    truth = json.loads((tmp_path / "bag.truth.json").read_text("utf-8"))
    assert truth[0]["scene"] == "sim2"
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_foreign_folder_is_refused_before_the_first_frame(tmp_path: Path) -> None:
    """A long simulation must not end with an error that was certain from the beginning."""
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "thesis.txt").write_text("mine")
    seen: list[int] = []

    with pytest.raises(OutputError, match="not a recording"):
        simulate(
            tmp_path / "bag", format="ros2", scene="empty", frames=1,
            observe=lambda _, done, __: seen.append(done),
        )  # fmt: skip
    assert seen == []


def test_unwritable_path_raises_output_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    with pytest.raises(OutputError, match=r"cannot write the recording: .*file is not a folder"):
        simulate(tmp_path / "file" / "demo.mcap", frames=1)


def test_full_disk_raises_output_error(tmp_path: Path) -> None:
    """SQLite, which writes ROS 2 recordings, has errors of its own."""
    world, sensor = make_scene("empty", np.random.default_rng(0), frames=4), resized(KINECT, 0.25)
    render_frame(world, 0, rng=np.random.default_rng(0), sensor=sensor)  # compiles, which writes
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(OutputError, match="cannot write the recording"):
            record(world, tmp_path / "a", format="ros2", seed=0, sensor=sensor)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("odd", [{"frames": 0}, {"rate_hz": 0.0}, {"rate_hz": float("nan")}])
def test_recordings_without_frames_or_rate_are_refused(tmp_path: Path, odd: dict[str, Any]) -> None:
    """Without frames, an empty recording would replace another one."""
    with pytest.raises(ValueError, match="expected at least 1 frame and a positive rate"):
        simulate(tmp_path / "a.mcap", scene="empty", **{"frames": 1} | odd)

    assert list(tmp_path.iterdir()) == []


# --- scanned meshes ------------------------------------------------------------------------------


@pytest.mark.many  # `test_simulation_shapes` checks that simulated objects stand
def test_scanned_meshes_are_placed_upright(real_data: Path) -> None:
    """Wrong poses would look like a weakness of the model."""
    pytest.importorskip("open3d")
    folder = real_data / "meshes"
    for entry in json.loads((folder / "catalogue.json").read_text("utf-8")):
        category = entry["category"]
        mesh = uprighted(load_mesh(folder / entry["file"]), category)
        x, y, z = (float(e) for e in mesh.extents)
        fill = ConvexHull(mesh.vertices).volume / (x * y * z)
        where = entry["file"]
        assert "upright" in [stable.name for stable in stable_poses(mesh)], where
        if category == "plate":
            assert z < 0.25 * min(x, y), where
        if category == "bowl":
            assert z < 0.65 * min(x, y), where
        if category == "bottle":
            assert z > 1.3 * max(x, y), where
            assert fill < 0.75, where
        if category == "can":
            assert 0.7 < fill < 0.8, where
        if category == "box":
            assert fill > 0.8, where
