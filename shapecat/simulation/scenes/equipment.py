"""Background objects of rooms: robot arms, people, screens, chairs, curtains, plants, cables."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from shapecat.arrays import F8
from shapecat.simulation.shapes.mesh import Mesh, join, standing
from shapecat.simulation.shapes.parts import ellipsoid, placed, rod
from shapecat.simulation.shapes.primitives import lathe, rounded_box, smooth_path, tube
from shapecat.types import Camera, Pose

__all__ = [
    "make_arm",
    "make_cable",
    "make_chair",
    "make_curtain",
    "make_forearm",
    "make_keyboard",
    "make_laptop",
    "make_monitor",
    "make_own_arms",
    "make_plant",
    "make_resting_arms",
]


def make_arm(rng: Generator, base: F8, tip: F8) -> list[Mesh]:
    """Return the links of a robot arm from its base to its gripper.

    Parameters
    ----------
    base : (3,) position of the base, metres, world frame.
    tip : (3,) position of the gripper's fingertips.
    """
    thick = rng.uniform(0.035, 0.06)
    wrist = _above(tip, rng.uniform(0.16, 0.24))
    shoulder = _above(base, rng.uniform(0.2, 0.4))
    elbow = _above((shoulder + wrist) / 2, rng.uniform(0.1, 0.35))
    foot = placed(rod(0.04, 2 * thick), base)
    links = [foot, *_links([base, shoulder, elbow, wrist], [thick, 0.9 * thick, 0.75 * thick])]
    return [*links, *_gripper(rng, wrist, tip)]


def make_own_arms(rng: Generator, camera: Pose, height: float) -> list[Mesh]:
    """Return the parts of one or two arms of the robot that carries the camera.

    The arms enter the image from its border.

    Parameters
    ----------
    camera : ``world_from_camera`` with optical axes.
    height : height of the support that they reach for, metres, world frame.
    """
    ahead = camera.rotation[:, 2]
    distance = (camera.translation[2] - height) / max(-float(ahead[2]), 0.3)
    below = 1 if rng.random() < 0.75 else -1  # otherwise the camera looks back at the robot
    links: list[Mesh] = []
    for side in rng.permutation([-1, 1])[: int(rng.integers(1, 3))]:
        thick = rng.uniform(0.035, 0.09)
        base = [side * rng.uniform(0.1, 0.55), below * rng.uniform(0.2, 0.6), rng.uniform(0, 0.4)]
        depth = distance * rng.uniform(0.55, 0.95)
        aside = side * depth * rng.uniform(-0.05, 0.45)
        tip_in_camera = [aside, below * depth * rng.uniform(-0.1, 0.4), depth]
        start, tip = (camera.rotation @ p + camera.translation for p in (base, tip_in_camera))
        tip[2] = max(tip[2], height + rng.uniform(0.03, 0.12))
        wrist = _above(tip, rng.uniform(0.1, 0.24))
        elbow = _above((start + wrist) / 2, rng.uniform(-0.05, 0.25))
        joints = [start, elbow, wrist] if rng.random() < 0.7 else [start, wrist]
        links += _links(joints, [thick, 0.85 * thick][: len(joints) - 1])
        links += _gripper(rng, wrist, tip)
    return links


def make_resting_arms(
    rng: Generator, camera: Pose, intrinsics: Camera, height: float
) -> list[Mesh]:
    """Return the parts of arms that enter the image from its border, on or just above a support.

    Parameters
    ----------
    camera : ``world_from_camera`` with optical axes.
    intrinsics : intrinsics of this camera.
    height : height of the support, metres, world frame.
    """
    parts: list[Mesh] = []
    side = rng.choice(4, p=[0.6, 0.15, 0.15, 0.1])  # bottom, left, right, top
    for along in rng.uniform(0.05, 0.95, int(rng.integers(1, 3))):
        deep = rng.uniform(0.05, 0.35)
        ends = []
        for inside, shift in ((-0.3, rng.uniform(-0.2, 0.2)), (deep, 0.0)):
            u = along + shift
            places = [(u, 1 - inside), (inside, u), (1 - inside, u), (u, inside)]
            ends.append(_on_support(places[side], camera, intrinsics, height))
        parts += _resting_arm(rng, *ends)
    return parts


def _on_support(uv: ArrayLike, camera: Pose, intrinsics: Camera, height: float) -> F8:
    """Return the point (3,) where the ray of a pixel meets a support, in the world frame, metres.

    The result is at most at a depth of 2 m, even if the ray is then still above the support. ``uv``
    is the column and the row of the pixel, as fractions of the image size. ``camera`` and
    ``height`` are as for `make_resting_arms`.
    """
    u, v = np.asarray(uv, float) * [intrinsics.width, intrinsics.height]
    ray = [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, 1.0]
    ray = camera.rotation @ ray
    depth = (camera.translation[2] - height) / max(-float(ray[2]), 1e-3)
    place = camera.translation + min(depth, 2.0) * ray
    place[2] = max(place[2], height)
    return np.asarray(place)


def _resting_arm(rng: Generator, start: F8, end: F8) -> list[Mesh]:
    """Return the parts of a forearm just above a support, with a hand or gripper.

    It extends from above ``start`` (3,) to above ``end`` (3,), points of the support.
    """
    thick, rise, gap = rng.uniform(0.03, 0.08), rng.uniform(0, 0.25), rng.uniform(-0.005, 0.05)
    kind = rng.random()
    if kind < 0.25:
        return make_forearm(rng, _above(end, 0.03 + gap), _above(start, 0.05 + rise))
    wrist, elbow = _above(end, thick + gap), _above(start, thick + gap + rise)
    if kind < 0.6:
        links = _links([elbow, wrist], [thick])
        return [*links, *_gripper(rng, _above(wrist, thick), _above(end, gap))]
    ahead = (end - start) / max(float(np.linalg.norm(end - start)), 1e-6)
    heading = float(np.degrees(np.arctan2(ahead[1], ahead[0]))) + rng.uniform(-20, 20)
    size = [rng.uniform(0.12, 0.25), rng.uniform(0.07, 0.16), rng.uniform(0.06, 0.16)]
    hand = rounded_box(size, radius=rng.uniform(0.005, 0.03))
    housing = _put(hand, _above(end, gap), heading)
    finger = placed(rounded_box([0.07, 0.02, 0.02]), [size[0] / 2 + 0.02, 0, 0.3 * size[2]])
    finger = _put(finger, _above(end, gap), heading)
    return [housing, finger, *_links([elbow, _above(end, gap + size[2] / 2)], [thick])]


def _links(joints: Sequence[F8], radii: Sequence[float]) -> list[Mesh]:
    """Return a tube between consecutive joints, and a motor at each joint except the first.

    ``joints`` are positions (3,), ``radii`` the radii of the tubes, metres.
    """
    parts = []
    for (start, end), radius in zip(pairwise(joints), radii, strict=True):
        ends = smooth_path(np.stack([start, end]), 6)
        parts.append(tube(ends, radius * np.array([1, 0.8, 0.75, 0.75, 0.8, 1]), segments=14))
        motor = placed(rod(3 * radius, 1.2 * radius), [0, 0, -1.5 * radius])
        parts.append(placed(placed(motor, about="x", degrees=90), end))
    return parts


def _gripper(rng: Generator, hand: F8, tip: F8) -> list[Mesh]:
    """Return a palm below ``hand`` (3,), and two fingers down to the height of ``tip`` (3,)."""
    turn, wide = rng.uniform(0, 180), rng.uniform(0.03, 0.09)
    tall = float(hand[2] - tip[2])
    palm = placed(rounded_box([wide + 0.05, 0.05, 0.5 * tall]), [0, 0, 0.45 * tall])
    finger = rounded_box([0.012, 0.022, 0.5 * tall], fine=2)
    fingers = [placed(finger, [side * wide / 2, 0, 0]) for side in (-1, 1)]
    return [_put(part, [*hand[:2], tip[2]], turn) for part in (palm, *fingers)]


def make_forearm(rng: Generator, tip: F8, start: F8) -> list[Mesh]:
    """Return a person's arm from ``start`` (3,) to the hand at ``tip`` (3,); metres."""
    over = _above((start + tip) / 2, rng.uniform(0.02, 0.12))
    path = smooth_path(np.stack([start, over, tip]), 10)
    arm = tube(path, np.linspace(rng.uniform(0.045, 0.06), 0.03, 10), segments=12)
    palm = placed(ellipsoid([0.05, 0.045, 0.022]), tip)
    ahead = (tip - start) / np.linalg.norm(tip - start)
    side = np.array([-ahead[1], ahead[0], 0.0])
    fingers = [
        tube(
            smooth_path(
                tip
                + np.outer([0.02, rng.uniform(0.06, 0.1)], ahead)
                + np.outer([1.0, 1.2], spread * side)
                - np.array([[0, 0, 0], [0, 0, 0.03]]),
                5,
            ),
            0.009,
            segments=8,
        )
        for spread in (-0.035, -0.012, 0.012, 0.035)
    ]
    return [arm, join([palm, *fingers])]


def make_monitor(rng: Generator, place: ArrayLike, *, degrees: float) -> list[Mesh]:
    """Return a screen on a stand at ``place`` (3,), metres, turned by ``degrees`` about z."""
    wide, tall, low = rng.uniform(0.4, 0.7), rng.uniform(0.26, 0.4), rng.uniform(0.08, 0.16)
    parts = [
        rounded_box([rng.uniform(0.18, 0.28), 0.18, 0.012]),
        placed(rounded_box([0.05, 0.03, low + 0.1]), [0, 0.02, 0]),
        placed(rounded_box([wide, 0.03, tall]), [0, 0, low]),
    ]
    return [_put(part, place, degrees) for part in parts]


def make_chair(rng: Generator, place: ArrayLike, *, degrees: float) -> list[Mesh]:
    """Return a chair at ``place`` (3,), metres, turned by ``degrees`` about z."""
    high, wide = rng.uniform(0.42, 0.5), rng.uniform(0.38, 0.5)
    back = rng.uniform(0.35, 0.55)
    parts = [
        placed(rounded_box([wide, wide, rng.uniform(0.03, 0.09)], radius=0.01), [0, 0, high]),
        placed(rounded_box([wide, 0.04, back]), [0, wide / 2, high + rng.uniform(0.02, 0.2)]),
    ]
    if rng.random() < 0.4:
        parts += [rod(high, 0.03), rod(0.06, wide / 2)]
    else:
        spots = [(x, y) for x in (-0.45, 0.45) for y in (-0.45, 0.45)]
        parts += [placed(rod(high, 0.016), [x * wide, y * wide, 0]) for x, y in spots]
    return [_put(part, place, degrees) for part in parts]


def make_curtain(rng: Generator, width: float, place: ArrayLike) -> Mesh:
    """Return a pleated curtain along x, 2.2 m high.

    Its lower edge is centred at ``place`` (3,); lengths are in metres.
    """
    x, z = np.linspace(-width / 2, width / 2, 160), np.linspace(0, 2.2, 4)
    depth = rng.uniform(0.02, 0.06) * np.sin(x / rng.uniform(0.02, 0.05))
    depth = depth * (1 + 0.5 * np.sin(3 * x + rng.uniform(0, 6)))
    u, v = np.meshgrid(x, z)
    points = np.stack([u, np.tile(depth, (4, 1)), v], -1).reshape(-1, 3)
    row = np.arange(3)[:, None] * 160 + np.arange(159)[None]
    cells = np.stack([row, row + 160, row + 1, row + 160, row + 161, row + 1], -1)
    return placed(Mesh(points, cells.reshape(-1, 3)), place)


def make_plant(rng: Generator) -> Mesh:
    """Return a plant in a pot."""
    r = rng.uniform(0.05, 0.09)
    tall = r * rng.uniform(1.3, 2.0)
    parts = [lathe([[0, 0], [0.75 * r, 0], [r, tall], [0.9 * r, tall], [0, 0.9 * tall]])]
    for _ in range(int(rng.integers(7, 16))):
        angle, out, up = rng.uniform(0, 6.3), rng.uniform(0.8, 3) * r, rng.uniform(1, 5) * r
        c, s = np.cos(angle), np.sin(angle)
        path = [
            [0.2 * r * c, 0.2 * r * s, 0.9 * tall],
            [0.5 * out * c, 0.5 * out * s, tall + up],
            [out * c, out * s, tall + up * rng.uniform(0.5, 1.1)],
        ]
        width = r * rng.uniform(0.15, 0.5) * np.sin(np.linspace(0.3, 3.0, 9))
        parts.append(tube(smooth_path(path, 9), width, segments=6, flatness=0.15))
    return join(parts)


def make_cable(rng: Generator, ends: F8) -> Mesh:
    """Return a winding cable between two points ``ends`` (2, 3), metres."""
    steps = np.linspace(ends[0], ends[1], 6)
    steps[1:-1, :2] += rng.normal(0, 0.06, (4, 2))
    return tube(smooth_path(steps, 50), rng.uniform(0.002, 0.006), segments=6)


def make_laptop(rng: Generator) -> Mesh:
    """Return an open laptop."""
    wide, deep = rng.uniform(0.28, 0.38), rng.uniform(0.2, 0.26)
    base = rounded_box([wide, deep, rng.uniform(0.012, 0.022)])
    lid = rounded_box([wide, 0.008, deep])
    tilt = -rng.uniform(0, 30)
    return standing(join([base, placed(lid, [0, deep / 2, 0.012], about="x", degrees=tilt)]))


def make_keyboard(rng: Generator) -> Mesh:
    """Return a keyboard with rows of keys."""
    wide, deep = rng.uniform(0.28, 0.45), rng.uniform(0.1, 0.15)
    parts = [rounded_box([wide, deep, 0.014])]
    key = rounded_box([0.9 * wide, deep / 7, 0.006])
    parts += [placed(key, [0, y * deep, 0.014]) for y in (-0.33, -0.11, 0.11, 0.33)]
    return join(parts)


def _above(place: F8, height: float) -> F8:
    """Return the position (3,) ``height`` metres above ``place`` (3,)."""
    return np.asarray(place + np.array([0.0, 0.0, height]))


def _put(mesh: Mesh, place: ArrayLike, degrees: float) -> Mesh:
    """Turn a mesh about z and move it by ``place`` (3,), metres."""
    # A single step would round coordinates only once, and thus change recordings.
    return placed(placed(mesh, about="z", degrees=degrees), place)
