"""Errors of a depth camera at depth edges: raggedness, round corners, margins, flying pixels."""

import numpy as np
from numpy.random import Generator

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.jit import kernel
from shapecat.simulation.camera.noise import noise
from shapecat.simulation.camera.render import Image
from shapecat.simulation.camera.sensors import Sensor

__all__ = [
    "DISCONTINUITY",
    "MARGIN_DISCONTINUITY",
    "blended_edges",
    "displace_edges",
    "drop_margins",
]

DISCONTINUITY = 0.03
"""Minimum discontinuity of the inverse depth between two surfaces, 1/m."""
MARGIN_DISCONTINUITY = 0.07
"""Minimum discontinuity of the inverse depth beside which stereo matching fails, 1/m."""


def displace_edges(image: Image, sensor: Sensor, rng: Generator) -> tuple[F8, I4, F4]:
    """Displace the depth edges of a rendered image at random, as a depth camera does.

    A stereo matching window also rounds the corners of outlines. Returns the inverse depth (1/m),
    mesh ids and cosines, all (h, w); the image does not change.

    Source: Barron and Malik 2013.
    """
    given = image.inverse, image.mesh_ids, image.cosine
    inverse = np.array(image.inverse)
    mesh_ids, cosine = np.array(image.mesh_ids), np.array(image.cosine)
    if sensor.edge_jitter_px > 0 or sensor.matching_window_px:
        shape, window, size = inverse.shape, sensor.edge_jitter_window, sensor.edge_jitter_px
        across = noise(shape, window, size, rng, smoothings=sensor.smoothings)
        if sensor.matching_window_px:
            _match_windows(
                *given, sensor.matching_window_px // 2, across, inverse, mesh_ids, cosine
            )
        else:
            down = noise(shape, window, size, rng, smoothings=sensor.smoothings)
            _sample_beside(*given, across, down, inverse, mesh_ids, cosine)
    return inverse, mesh_ids, cosine


def blended_edges(inverse: F8, width: int) -> F8:
    """Mix near and far inverse depth at edges, as stereo windows and smoothing filters do.

    The inverse depth and the result are (h, w), 1/m; the window is ``width`` pixels wide.
    """
    result = np.zeros_like(inverse)
    _blend(inverse, width // 2, result)
    return result


@kernel
def _sample_beside(
    inverse: F8, mesh_ids: I4, cosine: F4, across: F4, down: F4, out: F8, ids_out: I4, cos_out: F4
) -> None:
    """Displace the edges of an image; write the result to ``out``, ``ids_out`` and ``cos_out``.

    Each pixel of the result shows the pixel of the image that is ``across`` columns and ``down``
    rows (h, w) away, or its own if both show the same surface. ``inverse``, ``mesh_ids`` and
    ``cosine`` (h, w) are the image.
    """
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            x, y = int(np.floor(u + across[v, u] + 0.5)), int(np.floor(v + down[v, u] + 0.5))
            x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
            neighbour, center = inverse[y, x], inverse[v, u]
            # Only edges move; on a surface, the pixel keeps its own true depth.
            if abs(neighbour - center) < DISCONTINUITY and mesh_ids[y, x] == mesh_ids[v, u]:
                x, y = u, v
            out[v, u] = inverse[y, x]
            ids_out[v, u] = mesh_ids[y, x]
            cos_out[v, u] = cosine[y, x]


@kernel
def _match_windows(
    inverse: F8, mesh_ids: I4, cosine: F4, radius: int, shift: F4, out: F8, ids_out: I4, cos_out: F4
) -> None:
    """Give each pixel the surface that covers most of its window, as stereo matching does.

    ``inverse``, ``mesh_ids`` and ``cosine`` (h, w) are the image; ``out``, ``ids_out`` and
    ``cos_out``, at first copies of it, get the result. The window extends ``radius`` pixels to each
    side. ``shift`` (h, w) displaces edges, pixels: where it is positive, nearer surfaces grow.
    """
    height, width = inverse.shape
    step = max(radius // 3, 1)
    reach = radius // step * step
    samples = np.zeros((2 * (reach // step) + 1) ** 2)
    near_edge = np.zeros((height, width), np.bool_)
    for v in range(height):
        for u in range(width):
            for y, x in ((v, min(u + 1, width - 1)), (min(v + 1, height - 1), u)):
                if abs(inverse[y, x] - inverse[v, u]) >= DISCONTINUITY:
                    rows = slice(max(v - reach, 0), v + reach + 1)
                    near_edge[rows, max(u - reach, 0) : u + reach + 1] = True
    for v in range(height):
        for u in range(width):
            if not near_edge[v, u]:
                continue
            n = nearer = farther = 0
            for y in range(v - reach, v + reach + 1, step):
                for x in range(u - reach, u + reach + 1, step):
                    sample = inverse[min(max(y, 0), height - 1), min(max(x, 0), width - 1)]
                    nearer += sample > inverse[v, u] + MARGIN_DISCONTINUITY
                    farther += sample < inverse[v, u] - MARGIN_DISCONTINUITY
                    samples[n] = sample
                    n += 1
            rank = int((0.5 + shift[v, u] / (2 * reach + 1)) * n)
            rank = min(max(rank, 0), n - 1)
            if farther <= rank < n - nearer:
                continue  # its own surface
            chosen = np.sort(samples)[rank]
            least = 1 << 30  # squared distance of the nearest pixel of the chosen surface
            for y in range(max(v - reach, 0), min(v + reach + 1, height)):
                for x in range(max(u - reach, 0), min(u + reach + 1, width)):
                    distance = (y - v) ** 2 + (x - u) ** 2
                    if distance < least and abs(inverse[y, x] - chosen) < DISCONTINUITY:
                        least = distance
                        out[v, u], ids_out[v, u] = inverse[y, x], mesh_ids[y, x]
                        cos_out[v, u] = cosine[y, x]


@kernel
def drop_margins(inverse: F8, width: int, lost: Bool) -> None:
    """Set ``lost`` (h, w) to True beside nearer surfaces, where stereo matching fails.

    These margins are ``width`` pixels wide; ``inverse`` (h, w) is the inverse depth, 1/m.
    """
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
                if nearest[y, u] > inverse[v, u] + MARGIN_DISCONTINUITY:
                    lost[v, u] = True
                    break


@kernel
def _blend(inverse: F8, radius: int, out: F8) -> None:
    """Write inverse depth (h, w) to ``out``, averaged over windows at depth edges, else unchanged.

    A window extends ``radius`` pixels to each side. A pixel gets the average if there is an edge in
    the middle row of its window, and the whole window is in the image. Pixels without depth do not
    count.
    """
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            center = inverse[v, u]
            out[v, u] = center
            if not (radius <= u < width - radius and radius <= v < height - radius) or center <= 0:
                continue
            edge = False
            for k in range(1, radius + 1):
                edge = edge or abs(inverse[v, u - k] - center) > DISCONTINUITY
                edge = edge or abs(inverse[v, u + k] - center) > DISCONTINUITY
            if not edge:
                continue
            total, count = 0.0, 0
            for y in range(v - radius, v + radius + 1):
                for x in range(u - radius, u + radius + 1):
                    if inverse[y, x] > 0:
                        total += inverse[y, x]
                        count += 1
            out[v, u] = total / count
