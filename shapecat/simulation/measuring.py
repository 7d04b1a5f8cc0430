"""Error model of a depth camera: from rendered depth to measured depth."""

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.jit import kernel
from shapecat.simulation.noise import fixed_error, noise
from shapecat.simulation.render import Image
from shapecat.simulation.sensors import Sensor

__all__ = ["measure"]

_STEP = 0.03
"""Step in inverse depth that separates two surfaces, 1/m."""
_MARGIN = 0.07
"""Step in inverse depth beside which stereo matching fails, 1/m."""


def measure(image: Image, sensor: Sensor, rng: Generator) -> tuple[F4, I4]:
    """Measure a rendered image with the errors of a depth camera.

    Parameters
    ----------
    image : rendered with the sensor's camera, or with a crop of it.
    rng : generator of the noise and the lost readings.

    Returns
    -------
    depth : (h, w) float32 metres, 0 where there is no reading.
    owners : (h, w) int16 owner of each reading, -1 where there is none.
    """
    inverse, owners, cosine = _displaced(image, sensor, rng)
    lost = np.zeros(image.inverse.shape, np.bool_)
    if sensor.edge_px:
        _lose_margins(inverse, sensor.edge_px, lost)
    for place in sensor.shadow_m:
        _cast_shadow(inverse, place * sensor.camera.fx, lost)
    if sensor.filled_px > 0:
        middle = round(sensor.filled_px)
        eaten = rng.integers(middle - 1, middle + 2, (inverse.shape[0] // 3 + 1, 16), np.int8)
        _fill_shadow(inverse, owners, lost, eaten)
    _lose_grazing(_returned(cosine, owners, sensor), sensor, rng, lost)
    _punch_holes(sensor, rng, lost)
    _lose_border(sensor, lost)
    if sensor.rounded_px:
        inverse = _rounded(inverse, sensor.rounded_px)
    if sensor.blend_px:
        inverse = _blended(inverse, sensor.blend_px)
    depth = np.zeros(inverse.shape, np.float32)
    error = _error(inverse, sensor, rng)
    limits = np.array([sensor.step, sensor.nearest_m, sensor.farthest_m])
    _read_out(inverse, error, lost, limits, depth, owners)
    return depth, owners


def _displaced(image: Image, sensor: Sensor, rng: Generator) -> tuple[F8, I4, F4]:
    """Sample the true image at slightly displaced pixels, which makes outlines ragged.

    Returns the inverse depth (1/m), owners and cosines, all (h, w).

    Source: Barron and Malik 2013.
    """
    inverse = np.array(image.inverse)
    owners, cosine = np.array(image.owners), np.array(image.cosine)
    if sensor.ragged_px > 0:
        shape, window, size = inverse.shape, sensor.ragged_window, sensor.ragged_px
        across = noise(shape, window, size, rng, smoothings=sensor.smoothings)
        down = noise(shape, window, size, rng, smoothings=sensor.smoothings)
        _look_beside(
            image.inverse, image.owners, image.cosine, across, down, inverse, owners, cosine
        )
    return inverse, owners, cosine


def _error(inverse: F8, sensor: Sensor, rng: Generator) -> F4:
    """Return the error (h, w) of the inverse depth before quantization, 1/m."""
    error = np.zeros(inverse.shape, np.float32)
    if sensor.noise > 0:
        error += noise(inverse.shape, sensor.grain, sensor.noise, rng, smoothings=sensor.smoothings)
    if sensor.noise_m > 0:
        relative = noise(inverse.shape, sensor.grain, sensor.noise_m, rng)
        error += relative * inverse.astype(np.float32)
    if sensor.wave > 0:
        error += fixed_error(inverse.shape, sensor.wave, sensor.wave_px, sensor.device)
    return error


def _returned(cosine: F4, owners: I4, sensor: Sensor) -> F4:
    """Return the cosines (h, w) of incidence, scaled by the reflectance of each owner."""
    if sensor.dark <= 0 or owners.max(initial=-1) < 0:
        return cosine
    draws = np.random.default_rng((sensor.device, 2)).normal(0, sensor.dark, owners.max() + 1)
    light = np.append(np.exp(draws), 1.0).astype(np.float32)
    return cosine * light[owners]


def _lose_grazing(cosine: F4, sensor: Sensor, rng: Generator, lost: Bool) -> None:
    """Mark lost readings where the ray grazes the surface."""
    if sensor.grazing > 0:
        window = (sensor.hole_px, sensor.hole_px)
        luck = noise(cosine.shape, window, 0.5 * sensor.grazing, rng)
        lost |= cosine < luck + np.float32(sensor.grazing)


def _lose_border(sensor: Sensor, lost: Bool) -> None:
    left, right, top, bottom = sensor.border_px
    lost[:top] = True
    lost[len(lost) - bottom :] = True
    lost[:, :left] = True
    lost[:, lost.shape[1] - right :] = True


def _punch_holes(sensor: Sensor, rng: Generator, lost: Bool) -> None:
    """Mark lost readings in random holes."""
    area = 0.32 * (sensor.hole_px + 2) ** 2  # about the mean of width times height
    count = rng.poisson(sensor.holes * lost.size / area) if sensor.holes > 0 else 0
    rows = rng.integers(0, lost.shape[0], count)
    columns = rng.integers(0, lost.shape[1], count)
    sizes = rng.integers(1, sensor.hole_px + 2, (count, 2))
    for v, u, (tall, wide) in zip(rows, columns, sizes, strict=True):
        lost[v : v + tall, u : u + wide] = True


def _rounded(inverse: F8, width: int) -> F8:
    """Average the inverse depth over a window within each surface, which rounds its edges."""
    for _ in range(2):  # along the rows, then along the columns
        along = np.zeros_like(inverse)
        _smooth(inverse, width // 2, along)
        inverse = np.ascontiguousarray(along.T)
    return inverse


def _blended(inverse: F8, width: int) -> F8:
    """Mix near and far inverse depth across outlines, like stereo windows and smoothing filters."""
    result = np.zeros_like(inverse)
    _blend(inverse, width // 2, result)
    return result


@kernel
def _read_out(inverse: F8, error: F4, lost: Bool, limits: F8, depth: F4, owners: I4) -> None:
    """Write the depth of the readings, with their errors and in steps, within the limits."""
    step, nearest, farthest = limits
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            if not lost[v, u] and inverse[v, u] > 0:
                w = inverse[v, u] + error[v, u]
                if step > 0:
                    w = np.floor(w / step + 0.5) * step
                if w > 0:
                    z = 1.0 / w
                    if nearest <= z <= farthest:
                        depth[v, u] = z
            if depth[v, u] == 0:
                owners[v, u] = -1


@kernel
def _look_beside(
    inverse: F8, owners: I4, cosine: F4, across: F4, down: F4, out: F8, who: I4, angle: F4
) -> None:
    """Write what pixels displaced by ``across`` and ``down`` see: ``out``, ``who``, ``angle``."""
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            x, y = int(np.floor(u + across[v, u] + 0.5)), int(np.floor(v + down[v, u] + 0.5))
            x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
            there, here = inverse[y, x], inverse[v, u]
            # Only outlines move; on a surface, the pixel keeps its own true depth.
            if abs(there - here) < _STEP and owners[y, x] == owners[v, u]:
                x, y = u, v
            out[v, u] = inverse[y, x]
            who[v, u] = owners[y, x]
            angle[v, u] = cosine[y, x]


@kernel
def _lose_margins(inverse: F8, width: int, lost: Bool) -> None:
    """Mark the pixels up to ``width`` rows and columns beside a nearer surface."""
    height, columns = inverse.shape
    nearest = np.zeros(inverse.shape)
    for v in range(height):
        for u in range(columns):
            best = inverse[v, u]
            for x in range(max(u - width, 0), min(u + width + 1, columns)):
                best = max(best, inverse[v, x])
            nearest[v, u] = best
    for v in range(height):
        first, last = max(v - width, 0), min(v + width + 1, height)
        for u in range(columns):
            for y in range(first, last):
                if nearest[y, u] > inverse[v, u] + _MARGIN:
                    lost[v, u] = True
                    break


@kernel
def _cast_shadow(inverse: F8, shift: float, shadow: Bool) -> None:
    """Mark pixels that are occluded from a second viewpoint beside the camera.

    ``shift`` is the viewpoint's x position in metres times the focal length in pixels.
    """
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
            if u + 1 < width and abs(inverse[v, u + 1] - w) < _STEP:  # the same surface continues
                end = max(start, int(np.floor(u + 1 - shift * inverse[v, u + 1] + 0.5)) - 1)
            for cell in range(start, end + 1):
                at = cell + margin
                if 0 <= at < nearest.size and w > nearest[at]:
                    nearest[at] = w
        for u in range(width):
            w = inverse[v, u]
            at = int(np.floor(u - shift * w + 0.5)) + margin
            if 0 <= at < nearest.size and nearest[at] > w + _STEP:
                shadow[v, u] = True


@kernel
def _fill_shadow(inverse: F8, owners: I4, shadow: Bool, eaten: I4) -> None:
    """Grow the nearer side of each shadow into it, as the windows of stereo matching do.

    ``eaten`` (h // 3 + 1, 16) holds the widths of this growth in pixels, which vary over the image.
    """
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
def _blend(inverse: F8, reach: int, out: F8) -> None:
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            here = inverse[v, u]
            out[v, u] = here
            if not (reach <= u < width - reach and reach <= v < height - reach) or here <= 0:
                continue
            edge = False
            for k in range(1, reach + 1):
                edge = edge or abs(inverse[v, u - k] - here) > _STEP
                edge = edge or abs(inverse[v, u + k] - here) > _STEP
            if not edge:
                continue
            total, count = 0.0, 0
            for y in range(v - reach, v + reach + 1):
                for x in range(u - reach, u + reach + 1):
                    if inverse[y, x] > 0:
                        total += inverse[y, x]
                        count += 1
            out[v, u] = total / count


@kernel
def _smooth(inverse: F8, reach: int, out: F8) -> None:
    """Average along rows, up to ``reach`` pixels to each side, without crossing a depth step."""
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            total, count = inverse[v, u], 1
            for way in (-1, 1):
                last = inverse[v, u]
                for k in range(1, reach + 1):
                    x = u + way * k
                    if not 0 <= x < width or abs(inverse[v, x] - last) >= _STEP:
                        break
                    last = inverse[v, x]
                    total += last
                    count += 1
            out[v, u] = total / count
