"""One depth image or point cloud in memory, perceived without a recording or a run."""

import math
from collections.abc import Sequence
from contextlib import suppress
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, Bool
from shapecat.config import Settings
from shapecat.errors import ConfigError
from shapecat.geometry import unit_direction
from shapecat.learning import Categorizer
from shapecat.outputs.opened_run import RunFrame
from shapecat.perception import perceive
from shapecat.types import Camera, Detection, Frame, LabelledFrame, LabelledObject, Scene

__all__ = ["frame_of", "perceive_alone"]

_FARTHEST_M = 100.0
"""The unit is not metres if the median depth, or largest coordinate of a point, is above this."""
_FIXED = ([0, 1, 2, 2, 2], [1, 0, 0, 1, 2])
"""Rows and columns of the elements that are 0 or 1 in every camera matrix without skew."""
_SHORTEST = 0.05
"""A focal length of at most this fraction of the image's width or height is not in pixels."""


def frame_of(reading: ArrayLike | Frame, intrinsics: ArrayLike | Camera | None = None) -> Frame:
    """Return a depth image or points as a frame, with stamp 0; a frame is returned as it is.

    Parameters
    ----------
    reading, intrinsics : as for `shapecat.perceive`.

    Raises
    ------
    ConfigError : the shape, type or unit is wrong, or the intrinsics are implausible or come with a
        frame.
    """
    if isinstance(reading, Frame):
        if intrinsics is not None:
            msg = "a frame has its own intrinsics; pass its depth to use others"
            raise ConfigError(msg)
        return reading
    try:
        values = np.asarray(reading)
    except (TypeError, ValueError, RuntimeError) as error:
        # rows of different lengths, or a tensor on a GPU or with a gradient
        msg = f"not an array of numbers: {error}"
        raise ConfigError(msg) from error
    masked = np.ma.getmaskarray(reading if isinstance(reading, np.ma.MaskedArray) else values)
    frame = partial(Frame, topic="", index=0, stamp_ns=0, log_time_ns=0, frame_id="")
    if intrinsics is None:
        return frame(points=_points(values, masked))
    depth = _depth(values, masked)
    return frame(depth=depth, camera=_camera(intrinsics, *depth.shape))


def _points(values: np.ndarray, masked: Bool) -> F4:
    """Return points (n, 3) as float32; all NaN if a coordinate is masked or not finite.

    ``values`` and ``masked`` are (n, 3) or (h, w, 3).

    Raises
    ------
    ConfigError : the shape or the type is wrong, or the unit is not metres.
    """
    if values.dtype.kind not in "fiu" or values.ndim not in {2, 3} or values.shape[-1] != 3:
        found = f"{values.dtype} {values.shape}"
        msg = f"expected points (n, 3), or a depth image with intrinsics, got {found}"
        raise ConfigError(msg)
    with np.errstate(over="ignore"):  # the largest float64 may mean "missing"
        points = values.reshape(-1, 3).astype(np.float32, order="C")
    finite = np.isfinite(points).all(axis=1) & ~masked.reshape(-1, 3).any(axis=1)
    points[~finite] = np.nan
    sample = points[finite][:: 1 + len(points) // 10_000]  # enough for their median
    if sample.size and np.median(np.abs(sample).max(axis=1)) > _FARTHEST_M:
        msg = "expected points in metres, near the sensor; divide millimetres by 1000"
        raise ConfigError(msg)
    return points


def _depth(values: np.ndarray, masked: Bool) -> F4:
    """Return a depth image (h, w) in metres, 0 where it is masked or not measured.

    ``values`` are metres, or millimetres if they are integers.

    Raises
    ------
    ConfigError : the shape or the type is wrong, or the unit is not metres.
    """
    if values.dtype.kind not in "fiu" or values.ndim != 2:
        msg = f"expected a depth image (h, w) of numbers, got {values.dtype} {values.shape}"
        raise ConfigError(msg)
    with np.errstate(over="ignore"):  # the largest float64 may mean "missing"
        depth = values.astype(np.float32, order="C") * (1.0 if values.dtype.kind == "f" else 0.001)
    depth[masked | ~(np.isfinite(depth) & (depth > 0))] = 0
    if depth.any() and np.median(depth[depth > 0]) > _FARTHEST_M:
        msg = "expected depth in metres; divide millimetres by 1000, or pass integers"
        raise ConfigError(msg)
    return depth


def _camera(intrinsics: ArrayLike | Camera, height: int, width: int) -> Camera:
    """Return the camera of an image; raise `ConfigError` if the intrinsics are implausible."""
    if isinstance(intrinsics, Camera) and (intrinsics.width, intrinsics.height) == (width, height):
        return intrinsics
    with suppress(TypeError, ValueError, RuntimeError):  # not numbers, or rows of different lengths
        values = np.asarray(intrinsics, np.float64)
        if values.shape == (3, 3) and (values[_FIXED] == np.eye(3)[_FIXED]).all():
            values = values[[0, 1, 0, 1], [0, 1, 2, 2]]
        if values.shape == (4,) and np.isfinite(values).all():
            fx, fy, cx, cy = values.tolist()
            in_pixels = fx > _SHORTEST * width and fy > _SHORTEST * height
            if in_pixels and abs(cx) <= 3 * width and abs(cy) <= 3 * height:
                return Camera(width, height, fx, fy, cx, cy)
    msg = (
        f"expected fx, fy, cx, cy in pixels of an image of {width} x {height}, or its camera "
        f"matrix (3, 3), got {' '.join(repr(intrinsics).split())}"
    )
    raise ConfigError(msg)


def perceive_alone(
    frame: Frame, *, up: ArrayLike | None, categorizer: Categorizer, settings: Settings
) -> RunFrame:
    """Perceive one frame, and return its objects with labels from this view alone.

    Parameters
    ----------
    up : (3,) up direction in the sensor frame; None to estimate it from planes.

    Raises
    ------
    ConfigError : ``up`` is not a direction.
    """
    try:
        hint = None if up is None else unit_direction(up).astype(np.float32)
    except (TypeError, ValueError) as error:
        msg = f"up: {error}"
        raise ConfigError(msg) from None
    perceived = perceive(frame, up=hint, categorizer=categorizer, settings=settings)
    objects = tuple(
        _labelled(number, detection, perceived.scene, categorizer.categories)
        for number, detection in enumerate(perceived.detections, start=1)
    )
    labelled = LabelledFrame(
        topic=frame.topic,
        index=frame.index,
        stamp_ns=frame.stamp_ns,
        log_time_ns=frame.log_time_ns,
        frame_id=frame.frame_id,
        fixed_from_sensor=None,
        planes=perceived.scene.planes,
        objects=objects,
        ended=(),
        seconds=perceived.seconds,
        up=perceived.scene.up,
    )
    return RunFrame(labelled, frame)


def _labelled(
    number: int, detection: Detection, scene: Scene, categories: Sequence[str]
) -> LabelledObject:
    """Return a detection as an object of track ``number``, with the label of this one view."""
    candidate = detection.candidate
    return LabelledObject(
        track=number,
        category=detection.category(categories),
        confidence=float(detection.posterior.max()),
        box=candidate.box,
        indices=candidate.indices,
        gas=detection.gas,
        posterior=detection.posterior,
        causal=detection.posterior,
        height_m=math.nan if candidate.plane is None else scene.height_of(candidate),
        touches_border=candidate.touches_border,
        occluded=candidate.occluded,
        detections=(number - 1,),
        full=detection.full,
    )
