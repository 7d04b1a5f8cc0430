"""One frame, and those to fuse with it: detect, reconstruct, describe, categorize."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4
from shapecat.completion import ENOUGH_POINTS, complete
from shapecat.config import Settings
from shapecat.depth_fusion import Earlier, fuse, with_own_readings
from shapecat.description import DESCRIPTOR_NAMES, describe
from shapecat.detection import detect
from shapecat.errors import ModelError
from shapecat.geometry import inverse, level_from_sensor, transform
from shapecat.learning import Categorizer, load_model
from shapecat.surface import reconstruct, thin
from shapecat.types import Candidate, Detection, Frame, FullBox, NeuralGas, Perception, Scene

__all__ = ["Perceiver", "View", "find_up", "perceive"]


class View(NamedTuple):
    """A frame, its up direction (None to estimate it), and the frames to fuse with it."""

    frame: Frame
    up: F4 | None
    earlier: tuple[Earlier, ...]


@dataclass(frozen=True)
class Perceiver:
    """Perceives frames, in this or another process; each process reads the model file itself.

    Attributes
    ----------
    model : the file of the categorizer, None for the default one.
    """

    categorizer: Categorizer
    settings: Settings
    model: Path | None

    def __call__(self, view: View) -> Perception:
        """Perceive a frame."""
        return perceive(
            view.frame,
            up=view.up,
            categorizer=self.categorizer,
            settings=self.settings,
            earlier=view.earlier,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _read_perceiver, (self.model, self.categorizer.model_id, self.settings)


@lru_cache(maxsize=1)
def _read_perceiver(model: Path | None, model_id: str, settings: Settings) -> Perceiver:
    categorizer = load_model(model)
    if categorizer.model_id != model_id:
        msg = f"{model}: has changed since the run began"
        raise ModelError(msg)
    return Perceiver(categorizer, settings, model)


class _Shape(NamedTuple):
    gas: NeuralGas
    descriptor: F4
    seconds: float


def perceive(
    frame: Frame,
    *,
    up: F4 | None,
    categorizer: Categorizer,
    settings: Settings,
    earlier: Sequence[Earlier] = (),
) -> Perception:
    """Find, reconstruct, describe and categorize the objects of one frame (thesis ch. 4 to 7).

    Pure: the result depends on the arguments alone, whichever worker computes it.

    Parameters
    ----------
    up : (3,) unit vector in the sensor frame, or None to estimate it from the planes.
    earlier : frames to fuse with this one; indices are those of the frame's own readings.
    """
    begun = time.perf_counter()
    fused = fuse(frame, earlier, range_m=settings.detection.max_range_m)
    scene = detect(fused, up=up, settings=settings.detection, rng=_rng(settings, frame, 0))
    detected = time.perf_counter()
    shapes = [
        _describe_candidate(fused, scene, candidate, settings, _rng(settings, frame, k))
        for k, candidate in enumerate(scene.candidates, start=1)
    ]
    described = time.perf_counter()
    if fused is not frame:
        scene = with_own_readings(scene, frame)
    detections = _categorize(scene, shapes, categorizer)
    categorized = time.perf_counter()
    detections = tuple(
        replace(d, full=_full_box(frame, scene, d, categorizer.categories)) for d in detections
    )
    return Perception(
        topic=frame.topic,
        index=frame.index,
        stamp_ns=frame.stamp_ns,
        frame_id=frame.frame_id,
        scene=scene,
        detections=detections,
        seconds={
            "detect": detected - begun,
            "describe": described - detected,
            "categorize": categorized - described,
            "complete": time.perf_counter() - categorized,
        },
    )


def find_up(frame: Frame, settings: Settings) -> F4 | None:
    """Return the normal (3,) of the supporting planes, or None if they are too small."""
    scene = detect(frame, settings=settings.detection, rng=_rng(settings, frame, 0))
    return scene.up if sum(plane.area_m2 for plane in scene.planes) >= _TELLS_M2 else None


def _rng(settings: Settings, frame: Frame, item: int) -> np.random.Generator:
    """Seed by (seed, stamp, object): the same whatever the order and the number of workers."""
    return np.random.default_rng((settings.seed, abs(frame.stamp_ns), item))


def _describe_candidate(
    frame: Frame, scene: Scene, candidate: Candidate, settings: Settings, rng: np.random.Generator
) -> _Shape:
    """Move the candidate upright onto z = 0, learn its surface, and describe it."""
    begun = time.perf_counter()
    points = frame.xyz(candidate.indices)
    level = level_from_sensor(scene.up, scene.support_offset(candidate), points)
    cloud = thin(transform(level, points).astype(np.float32), settings=settings.surface)
    gas = reconstruct(cloud, settings=settings.surface, rng=rng)
    if gas is None:
        nothing = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2)))
        empty = np.zeros(len(DESCRIPTOR_NAMES), np.float32)
        return _Shape(nothing, empty, time.perf_counter() - begun)
    descriptor = describe(cloud, gas, eye=level.translation)
    in_sensor = NeuralGas(transform(inverse(level), gas.neurons), gas.edges)
    return _Shape(in_sensor, descriptor, time.perf_counter() - begun)


def _full_box(
    frame: Frame, scene: Scene, detection: Detection, categories: Sequence[str]
) -> FullBox | None:
    """Estimate the full box of an object; None if no reading of the frame is left after fusion."""
    candidate = detection.candidate
    some = candidate.indices[:: max(1, -(-len(candidate.indices) // ENOUGH_POINTS))]
    if not len(some):
        return None
    offset = scene.support_offset(candidate)
    return complete(frame.xyz(some), scene.up, offset, detection.posterior, categories)


def _categorize(
    scene: Scene, shapes: list[_Shape], categorizer: Categorizer
) -> tuple[Detection, ...]:
    """Categorize all candidates of a frame in one call; one without a surface is undecided."""
    if not shapes:
        return ()
    begun = time.perf_counter()
    prediction = categorizer.predict(np.stack([shape.descriptor for shape in shapes]))
    each = (time.perf_counter() - begun) / len(shapes)
    known = [len(shape.gas.neurons) > 0 for shape in shapes]
    uniform = np.full(len(categorizer.categories), 1 / len(categorizer.categories))
    return tuple(
        Detection(
            candidate=candidate,
            gas=shape.gas,
            descriptor=shape.descriptor,
            posterior=prediction.posteriors[k] if known[k] else uniform,
            novelty=float(prediction.novelty[k]) if known[k] else _UNDECIDED,
            seconds=shape.seconds + each,
        )
        for k, (candidate, shape) in enumerate(zip(scene.candidates, shapes, strict=True))
    )


_TELLS_M2 = 0.1
"""Area of planes that tells where up is; a smaller one may be the face of something."""
_UNDECIDED = 2.0
"""Novelty of an object with too few points for a surface: beyond the threshold, so unknown."""
