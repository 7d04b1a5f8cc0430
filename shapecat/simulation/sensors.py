"""From true depth to what a depth camera reports.

The figures are fitted to real images: a Kinect v1 registered to its colour camera looking at a
table with objects, and an Intel D435.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F4, F8
from shapecat.jit import kernel
from shapecat.simulation.render import Image
from shapecat.types import Camera

__all__ = ["IDEAL", "KINECT", "REALSENSE", "SENSORS", "Sensor", "measure"]


@dataclass(frozen=True)
class Sensor:
    """A depth camera and its faults. Disparities are in inverse depth, 1/m; lengths in pixels.

    Attributes
    ----------
    camera : its intrinsics.
    nearest_m, farthest_m : range in which it reports.
    step : quantum of the inverse depth; 0 is none.
    noise : standard deviation of the inverse depth.
    grain : (across, down) width of the window over which the noise is alike.
    wave : standard deviation of a slow error over `wave_px` pixels.
    ragged_px : how far the outlines of things are displaced, standard deviation.
    shadow_m : places, along x, of the light source and the other cameras: what one of them does
        not see has no reading.
    filled_px : shadows are this much narrower than geometry says, on average.
    grazing : cosine of the angle of incidence at which half of the readings fail.
    holes : share of pixels in holes anywhere.
    blend_px : width over which near and far are mixed at outlines (flying pixels); 0 is none.
    border_px : (left, right, top, bottom) without readings.
    """

    camera: Camera
    nearest_m: float = 0.4
    farthest_m: float = 4.0
    step: float = 0.0
    noise: float = 0.0
    grain: tuple[int, int] = (1, 1)
    wave: float = 0.0
    wave_px: int = 40
    ragged_px: float = 0.0
    shadow_m: tuple[float, ...] = ()
    filled_px: float = 0.0
    grazing: float = 0.0
    holes: float = 0.0
    blend_px: int = 0
    border_px: tuple[int, int, int, int] = (0, 0, 0, 0)


IDEAL = Sensor(Camera(640, 480, 525.0, 525.0, 319.5, 239.5), nearest_m=0.05, farthest_m=10.0)
"""A camera without faults."""

KINECT = Sensor(
    Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
    nearest_m=0.45,
    step=0.0029,  # 1/8 px of a 580 px infrared camera, 7.5 cm from its projector
    noise=0.0019,
    grain=(5, 3),
    wave=0.0012,
    ragged_px=1.1,
    shadow_m=(0.05, -0.025),  # projector and infrared camera, seen from the colour camera
    filled_px=2.0,
    grazing=0.1,
    holes=0.0004,
    border_px=(4, 40, 4, 6),
)
"""Kinect v1 (structured light), depth registered to the colour camera."""

REALSENSE = Sensor(
    Camera(640, 480, 610.0, 610.0, 319.5, 239.5),
    nearest_m=0.2,
    step=0.0006,
    noise=0.0035,
    grain=(9, 9),
    wave=0.003,
    wave_px=48,
    ragged_px=1.8,
    shadow_m=(0.05,),
    filled_px=1.5,
    grazing=0.12,
    holes=0.002,
    blend_px=3,
    border_px=(8, 0, 0, 0),
)
"""Intel D435 (active stereo, the left infrared camera)."""

SENSORS: dict[Literal["ideal", "kinect", "realsense"], Sensor] = {
    "ideal": IDEAL,
    "kinect": KINECT,
    "realsense": REALSENSE,
}
"""The sensors by name."""


def measure(image: Image, sensor: Sensor, rng: Generator) -> tuple[F4, F4]:
    """Report a rendered image as a depth camera does.

    Parameters
    ----------
    image : what the sensor's camera, or a part of it, truly sees.

    Returns
    -------
    depth : (h, w) float32 metres, 0 where there is no reading.
    owners : (h, w) int16, the thing each reading belongs to, -1 where there is none.
    """
    inverse, owners, cosine = _displaced(image, sensor, rng)
    shadow = np.zeros(inverse.shape, np.bool_)
    for place in sensor.shadow_m:
        _cast_shadow(inverse, place * sensor.camera.fx, shadow)
    if sensor.filled_px > 0:
        eaten = rng.integers(0, round(2 * sensor.filled_px) + 1, (inverse.shape[0] // 3 + 1, 16))
        _fill_shadow(inverse, owners, shadow, eaten)
    if sensor.blend_px:
        inverse = _blended(inverse, owners, sensor.blend_px)
    inverse += _noise(inverse.shape, sensor, rng)
    lost = shadow | (inverse <= 0) | _dropouts(cosine, sensor, rng)
    if sensor.step > 0:
        inverse = np.round(inverse / sensor.step) * sensor.step
    with np.errstate(divide="ignore"):
        depth = 1.0 / inverse
    lost |= ~((depth >= sensor.nearest_m) & (depth <= sensor.farthest_m)) | (owners < 0)
    left, right, top, bottom = sensor.border_px
    height, width = lost.shape
    lost[:top] = lost[height - bottom :] = True
    lost[:, :left] = lost[:, width - right :] = True
    return np.where(lost, 0.0, depth).astype(np.float32), np.where(lost, -1, owners).astype(np.int16)


def _displaced(image: Image, sensor: Sensor, rng: Generator) -> tuple[F8, F4, F4]:
    """Look up the true image at places a little beside: ragged outlines (Barron and Malik 2013)."""
    with np.errstate(divide="ignore"):
        inverse = np.where(image.depth > 0, 1.0 / image.depth, 0.0)
    if sensor.ragged_px <= 0:
        return inverse, np.array(image.owners), np.array(image.cosine)
    shape = inverse.shape
    across = _smooth_normal(shape, (3, 3), rng) * sensor.ragged_px
    down = _smooth_normal(shape, (3, 3), rng) * sensor.ragged_px
    owners = np.zeros(shape, np.int16)
    cosine = np.zeros(shape, np.float32)
    result = np.zeros(shape)
    _look_beside(inverse, image.owners, image.cosine, across, down, result, owners, cosine)
    return result, owners, cosine


def _smooth_normal(shape: tuple[int, int], window: tuple[int, int], rng: Generator) -> F4:
    """Return normal noise of variance 1 averaged over a window (across, down)."""
    wide, tall = window
    raw = rng.standard_normal((shape[0] + tall - 1, shape[1] + wide - 1), np.float32)
    result = np.zeros(shape, np.float32)
    _box_sum(raw, wide, tall, result)
    result *= np.float32(1.0 / np.sqrt(wide * tall))
    return result


def _noise(shape: tuple[int, int], sensor: Sensor, rng: Generator) -> F8:
    """Return the error of the inverse depth: half of it alike in windows, half in their cores."""
    result = np.zeros(shape)
    if sensor.noise > 0:
        wide, tall = sensor.grain
        share = sensor.noise * np.sqrt(0.5)
        result += _smooth_normal(shape, sensor.grain, rng) * share
        core = (max(1, wide // 2), max(1, tall // 2))
        result += _smooth_normal(shape, core, rng) * share
    if sensor.wave > 0:
        _add_wave(rng.normal(0, sensor.wave, _knots(shape, sensor.wave_px)), sensor.wave_px, result)
    return result


def _knots(shape: tuple[int, int], spacing: int) -> tuple[int, int]:
    return shape[0] // spacing + 2, shape[1] // spacing + 2


def _dropouts(cosine: F4, sensor: Sensor, rng: Generator) -> F4:
    """Tell where readings fail: at grazing angles, and in small holes anywhere."""
    lost = np.zeros(cosine.shape, np.bool_)
    if sensor.grazing > 0:
        luck = _smooth_normal(cosine.shape, (3, 3), rng)
        lost |= cosine < sensor.grazing * (1 + 0.5 * luck)
    if sensor.holes > 0:
        count = rng.poisson(sensor.holes * cosine.size / 12)
        rows, columns = rng.integers(0, cosine.shape[0], count), rng.integers(0, cosine.shape[1], count)
        sizes = rng.integers(1, 4, (count, 2))
        for v, u, (a, b) in zip(rows, columns, sizes, strict=True):
            lost[v : v + 2 * a, u : u + 2 * b] = True
    return lost


def _blended(inverse: F8, owners: F4, width: int) -> F8:
    """Mix near and far across outlines, as stereo windows and smoothing filters do."""
    result = np.zeros_like(inverse)
    _blend(inverse, owners, width // 2, result)
    return result


@kernel
def _look_beside(
    inverse: F8, owners: F4, cosine: F4, across: F4, down: F4, out: F8, who: F4, angle: F4
) -> None:
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            x, y = int(np.floor(u + across[v, u] + 0.5)), int(np.floor(v + down[v, u] + 0.5))
            x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
            there, here = inverse[y, x], inverse[v, u]
            # Only outlines move: on a surface the true depth of the pixel itself is reported.
            if abs(there - here) < 0.03 and owners[y, x] == owners[v, u]:
                x, y = u, v
            out[v, u] = inverse[y, x]
            who[v, u] = owners[y, x]
            angle[v, u] = cosine[y, x]


@kernel
def _box_sum(raw: F4, wide: int, tall: int, out: F4) -> None:
    height, width = out.shape
    column = np.zeros(raw.shape[1], np.float32)
    for v in range(height):
        for u in range(column.size):
            column[u] = raw[v, u]
        for k in range(1, tall):
            for u in range(column.size):
                column[u] += raw[v + k, u]
        for u in range(width):
            out[v, u] = column[u]
        for k in range(1, wide):
            for u in range(width):
                out[v, u] += column[u + k]


@kernel
def _add_wave(knots: F8, spacing: int, out: F8) -> None:
    height, width = out.shape
    for v in range(height):
        i = v // spacing
        t = (v - i * spacing) / spacing
        for u in range(width):
            j = u // spacing
            s = (u - j * spacing) / spacing
            low = knots[i, j] + s * (knots[i, j + 1] - knots[i, j])
            high = knots[i + 1, j] + s * (knots[i + 1, j + 1] - knots[i + 1, j])
            out[v, u] += low + t * (high - low)


@kernel
def _cast_shadow(inverse: F8, shift: float, shadow: F4) -> None:
    """Mark what is hidden from a place beside the camera, at ``shift`` / focal length metres."""
    height, width = inverse.shape
    margin = int(abs(shift) * 5) + 2
    nearest = np.zeros(width + 2 * margin)
    for v in range(height):
        nearest[:] = 0.0
        for u in range(width):
            w = inverse[v, u]
            x = u - shift * w
            start = int(np.floor(x + 0.5))
            end = start
            if u + 1 < width and abs(inverse[v, u + 1] - w) < 0.03:  # the surface goes on
                end = max(start, int(np.floor(u + 1 - shift * inverse[v, u + 1] + 0.5)) - 1)
            for cell in range(start, end + 1):
                at = cell + margin
                if 0 <= at < nearest.size and w > nearest[at]:
                    nearest[at] = w
        for u in range(width):
            w = inverse[v, u]
            at = int(np.floor(u - shift * w + 0.5)) + margin
            if 0 <= at < nearest.size and nearest[at] > w + 0.03:
                shadow[v, u] = True


@kernel
def _fill_shadow(inverse: F8, owners: F4, shadow: F4, eaten: F4) -> None:
    """Let the nearer side of each shadow grow into it: windows see the outline too early."""
    height, width = inverse.shape
    for v in range(height):
        u = 0
        while u < width:
            if not shadow[v, u]:
                u += 1
                continue
            end = u
            while end < width and shadow[v, end]:
                end += 1
            grow = eaten[v // 3, (u // 8) % eaten.shape[1]]
            before = inverse[v, u - 1] if u > 0 else 0.0
            after = inverse[v, end] if end < width else 0.0
            if before > after:
                for k in range(u, min(u + grow, end)):
                    inverse[v, k], owners[v, k] = before, owners[v, u - 1]
                    shadow[v, k] = False
            elif after > 0:
                for k in range(max(end - grow, u), end):
                    inverse[v, k], owners[v, k] = after, owners[v, end]
                    shadow[v, k] = False
            u = end


@kernel
def _blend(inverse: F8, owners: F4, reach: int, out: F8) -> None:
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            here = inverse[v, u]
            out[v, u] = here
            if not (reach <= u < width - reach and reach <= v < height - reach) or here <= 0:
                continue
            edge = False
            for k in range(1, reach + 1):
                edge = edge or abs(inverse[v, u - k] - here) > 0.03
                edge = edge or abs(inverse[v, u + k] - here) > 0.03
            if not edge:
                continue
            total, count = 0.0, 0
            for y in range(v - reach, v + reach + 1):
                for x in range(u - reach, u + reach + 1):
                    if inverse[y, x] > 0:
                        total += inverse[y, x]
                        count += 1
            out[v, u] = total / count
