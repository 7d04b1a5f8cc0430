"""Camera paths: poses ``world_from_camera`` with optical axes (x right, y down, z forward)."""

from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F8
from shapecat.geometry import quaternion_from_rotation, rotation_from_quaternion
from shapecat.types import Pose

__all__ = ["Filming", "arc_orbit", "lateral_pass", "looking_at", "static_view"]


class Filming(NamedTuple):
    """Number of frames and frame rate of a camera path."""

    frames: int
    rate_hz: float

    def times(self) -> F8:
        """Return the times (frames,) since the first frame, seconds."""
        return np.arange(self.frames) / self.rate_hz


Range = float | tuple[float, float]
"""A value, or the range from which to draw it."""


def looking_at(eye: F8, target: F8, *, roll: float = 0.0) -> Pose:
    """Return the pose of a camera at ``eye`` (3,) that looks at ``target`` (3,).

    The line of sight must not be vertical; ``roll`` is in radians. The pose is rounded, so that it
    is the same on every machine.
    """
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    right = np.array([forward[1], -forward[0], 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.stack([c * right + s * down, c * down - s * right, forward], axis=1)
    quaternion = np.round(quaternion_from_rotation(rotation), 9)
    return Pose(rotation_from_quaternion(quaternion), np.round(eye, 7))


def arc_orbit(
    rng: Generator,
    target: F8,
    filming: Filming,
    *,
    distance: Range,
    elevation: Range,
    sweep: Range,
) -> tuple[Pose, ...]:
    """Move a camera back and forth on an arc in front of a target, as if a person carried it.

    Parameters
    ----------
    target : (3,) metres, world frame; the camera is on the side of negative y.
    distance : mean distance to the target, metres.
    elevation : mean angle of the line of sight below the horizontal, degrees.
    sweep : half the angle of the arc, degrees.
    """
    distance, elevation, sweep = (
        rng.uniform(*value) if isinstance(value, tuple) else value
        for value in (distance, elevation, sweep)
    )
    t = filming.times()
    speed = rng.uniform(0.25, 0.6) / distance  # walking speed, radians per second
    width = np.radians(sweep)
    phase = rng.uniform(-np.pi, np.pi)
    azimuth = -np.pi / 2 + width * np.sin(speed / width * t + phase)
    slow = rng.uniform(0.1, 0.35, 3) * 2 * np.pi
    shift = rng.uniform(0, 2 * np.pi, 6)
    radius = distance * (1 + 0.1 * np.sin(slow[0] * t + shift[0]))
    up = np.radians(elevation + 4 * np.sin(slow[1] * t + shift[1]))
    flat = radius * np.cos(up)
    step = 2 * np.pi * 1.8  # 1.8 steps per second
    bob = 0.006 * np.sin(step * t + shift[2])
    eye = np.stack(
        [
            target[0] + flat * np.cos(azimuth),
            target[1] + flat * np.sin(azimuth),
            target[2] + radius * np.sin(up) + bob,
        ],
        -1,
    )
    aim = target + 0.03 * np.stack(
        [np.sin(slow[2] * t + shift[3]), np.cos(slow[0] * t + shift[4]), np.sin(slow[1] * t)], -1
    )
    roll = np.radians(rng.normal(0, 1.0) + 0.6 * np.sin(0.5 * step * t + shift[5]))
    return tuple(looking_at(e, g, roll=float(r)) for e, g, r in zip(eye, aim, roll, strict=True))


def lateral_pass(rng: Generator, target: F8, filming: Filming) -> tuple[Pose, ...]:
    """Move a camera back and forth along a counter that it faces, as if a person carried it.

    ``target`` (3,) is the middle of the counter, metres; the camera is on the side of negative y.
    """
    distance, elevation = rng.uniform(0.95, 1.2), rng.uniform(30, 48)
    amplitude = rng.uniform(0.6, 0.75)  # from the middle to the turning points
    t = filming.times()
    speed = rng.uniform(0.4, 0.55)
    side = amplitude * np.sin(speed / amplitude * t + rng.uniform(-np.pi, np.pi))
    up, shift = np.radians(elevation), rng.uniform(0, 2 * np.pi, 4)
    bob = 0.006 * np.sin(2 * np.pi * 1.8 * t + shift[0])
    jitter = 0.02 * np.sin(2 * np.pi * 0.4 * t + shift[1])
    aim = target + np.column_stack([side + 0.03 * np.sin(t + shift[2]), jitter, 0 * t])
    eye = target + distance * np.array([0, -np.cos(up), np.sin(up)])
    eye = eye + np.column_stack([side, jitter, bob])
    roll = np.radians(0.6 * np.sin(np.pi * 1.8 * t + shift[3]))
    return tuple(looking_at(e, g, roll=float(r)) for e, g, r in zip(eye, aim, roll, strict=True))


def static_view(rng: Generator, target: F8, frames: int) -> tuple[Pose, ...]:
    """Return the pose of a static camera that faces a target, once for each of the frames.

    ``target`` (3,) is in metres, world frame; the camera is on the side of negative y.
    """
    distance, up = rng.uniform(0.9, 1.2), np.radians(rng.uniform(28, 48))
    eye = target + distance * np.array([0, -np.cos(up), np.sin(up)])
    return (looking_at(eye, target, roll=float(np.radians(rng.normal(0, 1.0)))),) * frames
