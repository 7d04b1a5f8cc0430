"""Tests of scenes with physics: convex parts, settled objects and their supports."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from shapecat.geometry import rotation_from_quaternion, transform
from shapecat.simulation import KINECT, make_scene, record, render_frame
from shapecat.simulation.scenes import piles
from shapecat.simulation.scenes.furniture import make_table
from shapecat.simulation.scenes.kinds import SceneKind
from shapecat.simulation.scenes.physics import Drop, SettledPose, settle
from shapecat.simulation.scenes.worlds import World
from shapecat.simulation.shapes.balls import make_ball
from shapecat.simulation.shapes.categories import make_object
from shapecat.simulation.shapes.closed_shapes import make_box
from shapecat.simulation.shapes.convex_parts import convex_parts, hollowness
from shapecat.simulation.shapes.mesh import Mesh
from shapecat.simulation.shapes.primitives import lathe, rounded_box
from shapecat.types import Pose

MOSTLY_PILE = [
    "pile",
    *(pytest.param(kind, marks=pytest.mark.many) for kind in ("bin", "shelf_bin", "room")),
]
"""Scenes with physics. All settle in the same way; the quick tests make a pile."""
YAWED = rotation_from_quaternion([0, 0, np.sin(0.3), np.cos(0.3)])
"""A rotation about the vertical that is not a symmetry of a box."""


@cache
def settled(kind: SceneKind, seed: int) -> World:
    """Return a scene of two frames, which all tests share; remember the parts of its objects."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("shapecat.simulation.scenes.physics.convex_parts", known_parts)
        return make_scene(kind, np.random.default_rng(seed), frames=2)


KNOWN: dict[int, tuple[Mesh, list[np.ndarray]]] = {}


def known_parts(mesh: Mesh) -> list[np.ndarray]:
    """Return the convex parts of a mesh; they are computed once, since this takes long."""
    if id(mesh) not in KNOWN:
        KNOWN[id(mesh)] = mesh, convex_parts(mesh)
    return KNOWN[id(mesh)][1]


def table(height: float = 0.7) -> Mesh:
    """Return a slab whose top is at a height."""
    slab = rounded_box([1.2, 0.8, 0.03], fine=1)
    return Mesh(slab.vertices + np.array([0, 0, height - 0.03]), slab.triangles)


def test_falling_objects_are_not_supported_by_one_another() -> None:
    """Without a contact, the truth would name the first object, even for itself."""
    drops = [Drop(make_box(np.random.default_rng(k)), np.eye(3), np.array([k, 0])) for k in (0, 1)]

    assert [pose.supported_by for pose in settle([], drops)] == [None, None]


def test_only_open_shapes_are_divided_into_convex_parts() -> None:
    """The convex hull of a cup is solid, and nothing could lie in it."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        for category in ("cup", "bowl", "plate"):
            assert hollowness(make_object(category, rng)) > 0.25
            assert len(convex_parts(make_object(category, rng))) > 10
        for closed in ("box", "can", "bottle", "ball"):
            assert len(convex_parts(make_object(closed, rng))) == 1


def test_convex_parts_cover_surface_and_leave_inside_open() -> None:
    """Objects would fall through a hole in a wall, or rest on a filled corner."""
    cup = lathe([[0, 0], [0.05, 0], [0.05, 0.12], [0.046, 0.12], [0.046, 0.005], [0, 0.005]])
    hulls = [ConvexHull(part).equations for part in convex_parts(cup)]

    def depth(points: np.ndarray) -> np.ndarray:
        """Return the depth of points (n, 3) inside the parts, metres; negative outside."""
        return np.asarray(
            np.max([-(points @ h[:, :3].T + h[:, 3]).max(axis=1) for h in hulls], axis=0)
        )

    assert depth(np.asarray(cup.vertices, np.float64)).min() > -0.002
    inside = np.array([[0, 0, 0.04], [0.02, 0.01, 0.06], [-0.015, 0.02, 0.09]])
    assert depth(inside).max() < -0.005


def test_ball_dropped_into_cup_lies_in_it() -> None:
    """The truth must name the cup as its support, not the table."""
    cup = lathe([[0, 0], [0.05, 0], [0.05, 0.1], [0.046, 0.1], [0.046, 0.005], [0, 0.005]])
    ball = make_ball(np.random.default_rng(1))
    ball = Mesh(ball.vertices * (0.05 / ball.extents.max()), ball.triangles)
    place = np.array([0.11, -0.07])
    first, second = settle([table()], [Drop(cup, YAWED, place), Drop(ball, np.eye(3), place)])
    middle = transform(second.pose, ball.vertices).mean(axis=0)
    assert (first.supported_by, second.supported_by) == (None, 0)
    assert np.hypot(*(middle[:2] - place)) < 0.03
    assert 0.7 < transform(second.pose, ball.vertices)[:, 2].min() < 0.72


def test_box_dropped_on_box_is_supported_by_it() -> None:
    """Benchmarks of support relations rely on this."""
    low, high = rounded_box([0.12, 0.09, 0.07]), rounded_box([0.05, 0.06, 0.04])
    place = np.array([-0.2, 0.13])
    first, second = settle([table()], [Drop(low, YAWED, place), Drop(high, YAWED, place)])
    assert (first.supported_by, second.supported_by) == (None, 0)
    np.testing.assert_allclose(first.pose.translation, [-0.2, 0.13, 0.7], atol=2e-3)
    np.testing.assert_allclose(second.pose.translation, [-0.2, 0.13, 0.77], atol=3e-3)
    np.testing.assert_allclose(second.pose.rotation, YAWED, atol=0.02)


def test_falling_object_comes_to_rest() -> None:
    """A tall box that stands on an edge takes longer to fall over than the time between drops."""
    tall = rounded_box([0.05, 0.04, 0.24])
    tipped = rotation_from_quaternion([0, np.sin(0.15), 0, np.cos(0.15)])
    (settled_pose,) = settle([table()], [Drop(tall, YAWED @ tipped, np.array([-0.1, 0.08]))])
    points = transform(settled_pose.pose, tall.vertices)
    assert points[:, 2].min() == pytest.approx(0.7, abs=2e-3)
    assert points[:, 2].max() == pytest.approx(0.75, abs=2e-3)


def test_object_beside_table_falls() -> None:
    box = make_box(np.random.default_rng(2))
    (settled_pose,) = settle([table()], [Drop(box, np.eye(3), np.array([0.9, 0.0]))])
    assert transform(settled_pose.pose, box.vertices)[:, 2].max() < 0.5


def test_objects_on_one_that_is_left_out_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """They would float in the air, and the truth would say that they stand on the table."""
    below = make_table(np.random.default_rng(0))
    fallen, shelf = Pose(np.eye(3), np.zeros(3)), Pose(np.eye(3), np.array([0, 0, below.height]))
    landed = [(shelf, 1), (shelf, 2), (fallen, None), (shelf, None), (shelf, 3)]
    monkeypatch.setattr(piles, "settle", lambda *_: [SettledPose(*pose) for pose in landed])
    mesh = make_box(np.random.default_rng(2))
    objects = piles.settled([piles.Item("box", "box", mesh)] * 5, [], [below], below)
    assert [(item.on_support, item.on_track) for item in objects] == [(below.name, None), (None, 0)]


@pytest.mark.parametrize("kind", MOSTLY_PILE)
def test_settled_scenes_are_reproducible(kind: SceneKind) -> None:
    """Training and evaluation identify scenes by their seeds."""
    one, other = settled(kind, 1), make_scene(kind, np.random.default_rng(1), frames=2)
    assert len(one.objects) == len(other.objects) > 2
    for a, b in zip(one.objects, other.objects, strict=True):
        assert np.array_equal(a.pose.translation, b.pose.translation)
        assert np.array_equal(a.pose.rotation, b.pose.rotation)


@pytest.mark.parametrize("kind", MOSTLY_PILE)
@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.many) for seed in (2, 3))]
)
def test_settled_objects_lie_on_support_without_interpenetration(
    kind: SceneKind, seed: int
) -> None:
    world = settled(kind, seed)
    solids = [
        (transform(item.pose, item.mesh.vertices), [moved_part(p, item.pose) for p in parts])
        for item in world.objects
        for parts in [known_parts(item.mesh)]
    ]
    support = next(s for s in world.supports if s.name == world_support(world.kind))
    for points, _ in solids:
        assert points[:, 2].min() > support.height - 0.02  # it may hang over an edge
    for j, (_, parts) in enumerate(solids):
        for part in parts:
            hull = ConvexHull(part).equations
            low, high = part.min(axis=0), part.max(axis=0)
            for i, (points, _) in enumerate(solids):
                near = points[((points > low) & (points < high)).all(axis=1)]
                if i != j and len(near):  # no other point can be inside
                    inside = -(near @ hull[:, :3].T + hull[:, 3]).max(axis=1)
                    assert inside.max() < 0.006, (i, j)


def moved_part(part: np.ndarray, pose: Pose) -> np.ndarray:
    return np.asarray(transform(pose, part), np.float64)


def world_support(kind: str) -> str:
    return {"pile": "table", "bin": "bin", "shelf_bin": "board_1", "room": "table"}[kind]


def test_tilted_objects_are_marked() -> None:
    """Their category accuracy is reported separately."""
    tilted = straight = 0
    for item in settled("pile", 1).objects:
        upright = np.degrees(np.arccos(np.clip(np.abs(item.pose.rotation[2]).max(), 0, 1)))
        assert item.tilted == (upright > 15)
        tilted += item.tilted
        straight += not item.tilted
    assert tilted > 1
    assert straight > 5


def test_truth_of_pile_has_support_relations(tmp_path: Path) -> None:
    """Support relations must refer to tracks that the truth lists."""
    path = record(settled("pile", 1), tmp_path / "pile.mcap", seed=1, sensor=KINECT)
    first, _ = json.loads(path.with_suffix(".truth.json").read_text("utf-8"))
    objects = {o["track"]: o for o in [*first["objects"], *first["hidden"]]}
    assert len(objects) > 3
    for entry in objects.values():
        assert (entry["on_support"] is None) != (entry["on_track"] is None)
        assert entry["on_track"] is None or entry["on_track"] in objects
        assert isinstance(entry["tilted"], bool)


@pytest.mark.parametrize("kind", MOSTLY_PILE)
def test_most_dropped_objects_are_visible(kind: SceneKind) -> None:
    world = settled(kind, 1)
    _, labels = render_frame(world, 1, rng=np.random.default_rng(0))
    visible = set(np.unique(labels).tolist())
    assert sum(item.label in visible for item in world.objects) > 0.5 * len(world.objects)
