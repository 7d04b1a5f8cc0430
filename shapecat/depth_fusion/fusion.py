"""Consecutive depth images become one with less noise and fewer holes (thesis 4.2).

Each pixel of the current image is projected into the earlier ones. The result therefore keeps the
pixels of the current camera and never averages two surfaces. Depths of anything that has moved
since disagree, and are not used.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from shapecat.arrays import F4, I4
from shapecat.depth_fusion.recent import Earlier
from shapecat.geometry import AGREE, DISCONTINUITY, IDENTITY, NEAREST_M
from shapecat.jit import kernel
from shapecat.types import Camera, Frame, Pose, Scene

__all__ = ["fuse", "keep_same_surface"]

LEAST_SHARE = 0.9
"""Minimum fraction of the compared depths that differ by less than a `DISCONTINUITY`; below it,
the pose of the earlier image is considered wrong."""
STRIDE = 8
"""Distance between the pixels that are compared for `LEAST_SHARE`, pixels."""
REACH = 2
"""Largest distance, in pixels, from a hole to a depth whose surface may continue into the
hole."""


def fuse(frame: Frame, earlier: Sequence[Earlier], *, range_m: float) -> Frame:
    """Average the depths of a depth image with those of earlier ones, and fill its holes.

    1. An earlier image of the same camera counts if most of its depths agree with the current ones.
    2. A depth becomes the mean of itself and the earlier depths that agree with it (`AGREE`; a
       larger limit would smear low objects that move). Where they disagree, something has moved or
       was hidden, and the current depth stays.
    3. A hole gets the mean of the earlier depths that continue a surface beside it in the current
       image. Depths of an object that has since moved away are not used.

    differs: the thesis merges the clouds and subsamples them.

    Parameters
    ----------
    frame : the current frame; a point cloud is returned unchanged.
    earlier : from `RecentFrames`, the newest first.
    range_m : metres; depths farther away are not changed.

    Returns
    -------
    The frame with the fused depth image; the frame itself if no earlier image counts. Time and
    memory do not depend on the content of the images.
    """
    depth, camera = frame.depth, frame.camera
    if depth is None or camera is None or not earlier:
        return frame
    expected = _expected_depth(depth, np.float32(range_m))
    total, count = depth.copy(), (depth > 0).astype(np.float32)
    fused = 0
    for other, pose in earlier:
        earlier_depth = other.depth
        if earlier_depth is None or other.camera != camera:
            continue
        homography, shift = _homography(camera, IDENTITY if pose is None else pose)
        if _agreeing_share(expected, earlier_depth, homography, shift) < LEAST_SHARE:
            continue
        fused += 1
        if np.allclose(homography, np.eye(3), atol=1e-5) and np.abs(shift).max() < 0.01:
            _add_unmoved(expected, earlier_depth, total, count)
        else:
            _add_moved(expected, earlier_depth, homography, shift, total, count)
    if not fused:
        return frame
    return replace(frame, depth=total / np.maximum(count, 1))


def keep_same_surface(scene: Scene, frame: Frame, perceived: Frame) -> Scene:
    """Remove from the candidates of a scene the pixels that show something else in a frame.

    Parameters
    ----------
    scene : the result of detection on ``perceived``; returned unchanged for point clouds. A
        candidate may lose all its pixels.
    frame : pixels without depth in this frame, or with the depth of another surface, are removed.
    perceived : the frame in which ``scene`` was detected instead of ``frame``: fused, or earlier.
    """
    if frame.depth is None or perceived.depth is None:
        return scene
    depth, expected = frame.depth.reshape(-1), perceived.depth.reshape(-1)

    def shared(pixels: I4) -> I4:
        z, other = depth[pixels], expected[pixels]
        return pixels[(z > 0) & (np.abs(z - other) <= np.float32(DISCONTINUITY) * z * other)]

    return replace(
        scene,
        candidates=tuple(replace(item, indices=shared(item.indices)) for item in scene.candidates),
    )


def _homography(camera: Camera, earlier_from_sensor: Pose) -> tuple[F4, F4]:
    """Return H (3, 3) and h (3,), which map current pixels to pixels of an earlier image.

    The point at depth z in pixel (u, v) has the depth z' and the pixel (u', v') in the earlier
    image, where ``(z' u', z' v', z') = z * H @ (u, v, 1) + h``.
    """
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    homography = k @ earlier_from_sensor.rotation @ np.linalg.inv(k)
    return homography.astype(np.float32), (k @ earlier_from_sensor.translation).astype(np.float32)


@kernel
def _expected_depth(depth: F4, range_m: float) -> F4:
    """Return the depths (h, w), metres, to compare with earlier images; negative for holes.

    A hole gets the negative depth of the nearest pixel with depth in its row or column, at most
    `REACH` away, or 0 if there is none. Depths beyond the range are 0, too.
    """
    rows, columns = depth.shape
    expected = np.zeros((rows, columns), np.float32)
    for v in range(rows):
        for u in range(columns):
            expected[v, u] = depth[v, u] if depth[v, u] <= range_m else np.float32(0)
            if depth[v, u] > 0:
                continue
            for step in range(1, REACH + 1):
                z = np.float32(0)
                if u >= step:
                    z = depth[v, u - step]
                if (z == 0) & (u + step < columns):
                    z = depth[v, min(u + step, columns - 1)]
                if (z == 0) & (v >= step):
                    z = depth[v - step, u]
                if (z == 0) & (v + step < rows):
                    z = depth[min(v + step, rows - 1), u]
                if (z > 0) & (z <= range_m):
                    expected[v, u] = -z
                    break
    return expected


@kernel
def _agreeing_share(expected: F4, earlier: F4, homography: F4, shift: F4) -> float:
    """Return the fraction of the compared pixels, with depth in both images, whose depths agree.

    The result is 0 if there is no such pixel. ``expected`` (h, w) is from `_expected_depth`,
    ``homography`` and ``shift`` from `_homography`; ``earlier`` (h, w) are the depths of the
    earlier image, metres.
    """
    columns = expected.shape[1]
    places = np.zeros((3, columns), np.float32)
    x, y, z = places[0], places[1], places[2]
    compared = agreed = 0
    for v in range(STRIDE // 2, expected.shape[0], STRIDE):
        _project_row(expected[v], v, homography, shift, x, y, z)
        for u in range(STRIDE // 2, columns, STRIDE):
            read = _interpolate(earlier, x[u], y[u])
            if (expected[v, u] > 0) & (read > 0):
                compared += 1
                agreed += abs(read - z[u]) <= DISCONTINUITY * read * z[u]
    return agreed / max(compared, 1)


@kernel
def _add_unmoved(expected: F4, earlier: F4, total: F4, count: F4) -> None:
    """Do the same as `_add_moved`, for a camera that has not moved."""
    agree, jump = np.float32(AGREE), np.float32(DISCONTINUITY)
    zero, one = np.float32(0), np.float32(1)
    for v in range(expected.shape[0]):
        expected_row, earlier_row, sums, counts = expected[v], earlier[v], total[v], count[v]
        for u in range(expected_row.size):
            g, read = expected_row[u], earlier_row[u]
            z = abs(g)
            limit = (agree if g > 0 else jump) * z * read
            agrees = (read > 0) & (z > 0) & (abs(read - z) <= limit)
            sums[u] += read if agrees else zero
            counts[u] += one if agrees else zero
            expected_row[u] = read if agrees & (g < 0) else g


@kernel
def _add_moved(expected: F4, earlier: F4, homography: F4, shift: F4, total: F4, count: F4) -> None:
    """Add to ``total`` (h, w) the earlier depths that agree, and to ``count`` (h, w) their number.

    They are converted to depths in the current camera. The depth of a hole is also written to
    ``expected``. The other parameters are as in `_agreeing_share`.
    """
    agree, jump = np.float32(AGREE), np.float32(DISCONTINUITY)
    coordinates = np.zeros((3, expected.shape[1]), np.float32)
    x, y, z = coordinates[0], coordinates[1], coordinates[2]
    for v in range(expected.shape[0]):
        row = expected[v]
        _project_row(row, v, homography, shift, x, y, z)
        for u in range(row.size):
            g = row[u]
            if g == 0:
                continue
            read = _interpolate(earlier, x[u], y[u])
            # A surface may slope between a hole and its neighbour.
            limit = (agree if g > 0 else jump) * z[u] * read
            if (read > 0) & (abs(read - z[u]) <= limit):
                estimate = abs(g) * (read / z[u])
                total[v, u] += estimate
                count[v, u] += np.float32(1)
                if g < 0:
                    row[u] = estimate


@kernel(inner=True)
def _project_row(depths: F4, v: int, homography: F4, shift: F4, x: F4, y: F4, z: F4) -> None:
    """Write column x, row y and depth z (w,), in the earlier image, of the pixels in row ``v``.

    ``depths`` (w,) are a row of `_expected_depth`, whose sign is ignored; ``homography`` and
    ``shift`` are from `_homography`. Depths ``z`` below `NEAREST_M` are raised to it.
    """
    min_depth = np.float32(NEAREST_M)
    row = np.float32(v)
    a, b = homography[0, 1] * row + homography[0, 2], homography[1, 1] * row + homography[1, 2]
    c = homography[2, 1] * row + homography[2, 2]
    for u in range(depths.size):
        depth, column = abs(depths[u]), np.float32(u)
        z[u] = max(depth * (homography[2, 0] * column + c) + shift[2], min_depth)
        inverse = np.float32(1) / z[u]
        x[u] = (depth * (homography[0, 0] * column + a) + shift[0]) * inverse
        y[u] = (depth * (homography[1, 0] * column + b) + shift[1]) * inverse


@kernel(inner=True)
def _interpolate(earlier: F4, x: float, y: float) -> Any:
    """Interpolate depths (h, w) bilinearly at column x and row y; return 0 outside the image.

    The result is also 0 if more than half of the weight belongs to missing depths.
    """
    rows, columns = earlier.shape
    zero, one = np.float32(0), np.float32(1)
    if not ((x >= 0) & (y >= 0) & (x < columns - 1) & (y < rows - 1)):
        return zero
    j, i = np.uint32(x), np.uint32(y)
    right, down = x - np.float32(j), y - np.float32(i)
    top, bottom = earlier[i], earlier[i + 1]
    a, b, c, d = top[j], top[j + 1], bottom[j], bottom[j + 1]
    wa = (one - right) * (one - down) if a > 0 else zero
    wb = right * (one - down) if b > 0 else zero
    wc = (one - right) * down if c > 0 else zero
    wd = right * down if d > 0 else zero
    weight = wa + wb + wc + wd
    total = wa * a + wb * b + wc * c + wd * d
    return total / weight if weight >= np.float32(0.5) else zero
