"""Error model of a depth camera: from rendered depth to measured depth."""

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.jit import kernel
from shapecat.simulation.camera.edges import (
    DISCONTINUITY,
    MARGIN_DISCONTINUITY,
    blended_edges,
    displace_edges,
    drop_margins,
)
from shapecat.simulation.camera.noise import fixed_error, noise
from shapecat.simulation.camera.render import Image
from shapecat.simulation.camera.sensors import Sensor

__all__ = ["measure"]


def measure(image: Image, sensor: Sensor, rng: Generator) -> tuple[F4, I4]:
    """Measure a rendered image with the errors of a depth camera.

    Parameters
    ----------
    image : rendered with the sensor's camera, or with a crop of it.
    rng : generator of the noise and of missing depth.

    Returns
    -------
    depth : (h, w) float32 metres, 0 where it is missing.
    mesh_ids : (h, w) int16 index of the measured mesh, -1 where there is no depth.
    """
    inverse, mesh_ids, cosine = displace_edges(image, sensor, rng)
    lost = np.zeros(image.inverse.shape, np.bool_)
    if sensor.stereo_margin_px:
        drop_margins(inverse, sensor.stereo_margin_px, lost)
    for place in sensor.shadow_m:
        _cast_shadow(inverse, place * sensor.camera.fx, lost)
    if sensor.shadow_fill_px > 0:
        middle = round(sensor.shadow_fill_px)
        growth_px = rng.integers(middle - 1, middle + 2, (inverse.shape[0] // 3 + 1, 16), np.int8)
        _fill_shadow(inverse, mesh_ids, lost, growth_px)
    _drop_grazing(_scaled_by_reflectance(cosine, mesh_ids, sensor), sensor, rng, lost)
    _drop_random_holes(sensor, rng, lost)
    _drop_border(sensor, lost)
    if sensor.smoothing_px:
        inverse = _smoothed(inverse, sensor.smoothing_px, DISCONTINUITY)
    if sensor.matching_window_px:
        inverse = _smoothed(inverse, sensor.matching_window_px, MARGIN_DISCONTINUITY)
    if sensor.blend_px:
        inverse = blended_edges(inverse, sensor.blend_px)
    depth = np.zeros(inverse.shape, np.float32)
    error = _inverse_depth_error(inverse, sensor, rng)
    limits = np.array([sensor.step, sensor.nearest_m, sensor.farthest_m])
    _write_depth(inverse, error, lost, limits, depth, mesh_ids)
    return depth, mesh_ids


def _inverse_depth_error(inverse: F8, sensor: Sensor, rng: Generator) -> F4:
    """Draw the error (h, w) of ``inverse`` (h, w), inverse depth before quantization; 1/m."""
    error = np.zeros(inverse.shape, np.float32)
    if sensor.noise > 0:
        error += noise(
            inverse.shape, sensor.noise_window, sensor.noise, rng, smoothings=sensor.smoothings
        )
    if sensor.relative_noise > 0:
        relative = noise(inverse.shape, sensor.noise_window, sensor.relative_noise, rng)
        error += relative * inverse.astype(np.float32)
    if sensor.fixed_error > 0:
        error += fixed_error(
            inverse.shape, sensor.fixed_error, sensor.fixed_error_px, sensor.device
        )
    return error


def _scaled_by_reflectance(cosine: F4, mesh_ids: I4, sensor: Sensor) -> F4:
    """Return the cosines (h, w) of the incidence angles, times the reflectance of each mesh.

    ``cosine`` (h, w) and ``mesh_ids`` (h, w) are as in `Image`.
    """
    if sensor.log_reflectance_std <= 0 or mesh_ids.max(initial=-1) < 0:
        return cosine
    draws = np.random.default_rng((sensor.device, 2)).normal(
        0, sensor.log_reflectance_std, mesh_ids.max() + 1
    )
    reflectance = np.append(np.exp(draws), 1.0).astype(np.float32)
    return cosine * reflectance[mesh_ids]


def _drop_grazing(cosine: F4, sensor: Sensor, rng: Generator, lost: Bool) -> None:
    """Set ``lost`` (h, w) to True on oblique and dark surfaces, with random borders.

    ``cosine`` (h, w) is from `_scaled_by_reflectance`.
    """
    if sensor.grazing_cosine > 0:
        window = (sensor.hole_px, sensor.hole_px)
        threshold_noise = noise(cosine.shape, window, 0.5 * sensor.grazing_cosine, rng)
        lost |= cosine < threshold_noise + np.float32(sensor.grazing_cosine)


def _drop_border(sensor: Sensor, lost: Bool) -> None:
    """Set ``lost`` (h, w) to True in the sensor's margins without depth."""
    left, right, top, bottom = sensor.border_px
    lost[:top] = True
    lost[len(lost) - bottom :] = True
    lost[:, :left] = True
    lost[:, lost.shape[1] - right :] = True


def _drop_random_holes(sensor: Sensor, rng: Generator, lost: Bool) -> None:
    """Set ``lost`` (h, w) to True in random holes."""
    area = 0.32 * (sensor.hole_px + 2) ** 2  # about the mean of width times height
    count = rng.poisson(sensor.holes * lost.size / area) if sensor.holes > 0 else 0
    rows = rng.integers(0, lost.shape[0], count)
    columns = rng.integers(0, lost.shape[1], count)
    sizes = rng.integers(1, sensor.hole_px + 2, (count, 2))
    for v, u, (tall, wide) in zip(rows, columns, sizes, strict=True):
        lost[v : v + tall, u : u + wide] = True


def _smoothed(inverse: F8, width: int, limit: float) -> F8:
    """Average inverse depth (h, w) over windows ``width`` pixels wide and high.

    The windows end at discontinuities of at least ``limit``, 1/m. So edges and corners within a
    surface become round, but depth edges stay.
    """
    for _ in range(2):  # along the rows, then along the columns
        along = np.zeros_like(inverse)
        _smooth(inverse, width // 2, limit, along)
        inverse = np.ascontiguousarray(along.T)
    return inverse


@kernel
def _write_depth(inverse: F8, error: F4, lost: Bool, limits: F8, depth: F4, mesh_ids: I4) -> None:
    """Write the measured depth, metres, to ``depth``; set the mesh ids without depth to -1.

    All arrays but ``limits`` are (h, w). ``inverse`` and its ``error`` are in 1/m; ``lost`` pixels
    get no depth. ``limits`` (3,): quantization step of the inverse depth (0: none), least and
    greatest depth. ``depth`` must be 0 at first.
    """
    step, nearest, farthest = limits
    for v in range(inverse.shape[0]):
        for u in range(inverse.shape[1]):
            if not lost[v, u] and inverse[v, u] > 0:
                inverse_depth = inverse[v, u] + error[v, u]
                if step > 0:
                    inverse_depth = np.floor(inverse_depth / step + 0.5) * step
                if inverse_depth > 0:
                    z = 1.0 / inverse_depth
                    if nearest <= z <= farthest:
                        depth[v, u] = z
            if depth[v, u] == 0:
                mesh_ids[v, u] = -1


@kernel
def _cast_shadow(inverse: F8, shift: float, shadow: Bool) -> None:
    """Set ``shadow`` to True where points are occluded from a second viewpoint beside the camera.

    ``inverse`` is the inverse depth, 1/m; both are (h, w). ``shift`` is the viewpoint's x position
    in metres times the focal length in pixels.
    """
    height, width = inverse.shape
    margin = int(abs(shift) * 5) + 2
    nearest = np.zeros(width + 2 * margin)
    for v in range(height):
        nearest[:] = 0.0
        for u in range(width):
            inverse_depth = inverse[v, u]
            x = u - shift * inverse_depth
            start = int(np.floor(x + 0.5))
            end = start
            # The same surface continues.
            if u + 1 < width and abs(inverse[v, u + 1] - inverse_depth) < DISCONTINUITY:
                end = max(start, int(np.floor(u + 1 - shift * inverse[v, u + 1] + 0.5)) - 1)
            for cell in range(start, end + 1):
                at = cell + margin
                if 0 <= at < nearest.size and inverse_depth > nearest[at]:
                    nearest[at] = inverse_depth
        for u in range(width):
            inverse_depth = inverse[v, u]
            at = int(np.floor(u - shift * inverse_depth + 0.5)) + margin
            if 0 <= at < nearest.size and nearest[at] > inverse_depth + DISCONTINUITY:
                shadow[v, u] = True


@kernel
def _fill_shadow(inverse: F8, mesh_ids: I4, shadow: Bool, growth_px: I4) -> None:
    """Extend the surface on the nearer side of a shadow into the shadow, as stereo matching does.

    ``inverse``, ``mesh_ids`` and ``shadow`` (h, w) are changed in place. ``growth_px`` (h // 3 + 1,
    16) holds the widths of the extension: one for each 3 rows and 8 columns, repeated across.
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
            grow = growth_px[v // 3, (u // 8) % growth_px.shape[1]]
            before = inverse[v, u - 1] if u > 0 else 0.0
            after = inverse[v, end] if end < width else 0.0
            if before > after:
                for k in range(u, min(u + grow, end)):
                    inverse[v, k], mesh_ids[v, k] = before, mesh_ids[v, u - 1]
                    shadow[v, k] = False
            elif after > 0:
                for k in range(max(end - grow, u), end):
                    inverse[v, k], mesh_ids[v, k] = after, mesh_ids[v, end]
                    shadow[v, k] = False
            u = end


@kernel
def _smooth(inverse: F8, radius: int, limit: float, out: F8) -> None:
    """Write to ``out`` the inverse depth (h, w), averaged along rows.

    The average extends ``radius`` pixels to each side, but ends at discontinuities of at least
    ``limit``, 1/m.
    """
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            total, count = inverse[v, u], 1
            for way in (-1, 1):
                last = inverse[v, u]
                for k in range(1, radius + 1):
                    x = u + way * k
                    if not 0 <= x < width or abs(inverse[v, x] - last) >= limit:
                        break
                    last = inverse[v, x]
                    total += last
                    count += 1
            out[v, u] = total / count
