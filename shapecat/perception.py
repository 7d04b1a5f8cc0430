"""Perceive a frame, fused with earlier ones: detect, reconstruct, describe, categorize.

Consecutive frames are perceived in blocks: an object that looks the same as in an earlier frame
of its block keeps the description from that frame. Blocks are independent of each other.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F4, F8
from shapecat.cameras.colour import ColourView
from shapecat.colour.image_masks import find_masks
from shapecat.completion import ENOUGH_POINTS, complete
from shapecat.config import Settings
from shapecat.depth_fusion import Earlier, fuse, keep_same_surface
from shapecat.description import DESCRIPTOR_NAMES, describe
from shapecat.detection import detect
from shapecat.errors import ModelError
from shapecat.geometry import inverse, level_from_sensor, transform
from shapecat.learning import Categorizer, load_model
from shapecat.reuse import KeyView, find_repeats, reused, shows_the_same, view_object
from shapecat.surface import reconstruct, thin
from shapecat.types import Candidate, Detection, Frame, NeuralGas, Perception, Pose, Scene

__all__ = ["Perceiver", "PerceptionInput", "find_up", "level_points", "perceive"]

_ENOUGH_M2 = 0.1
"""Planes with a smaller total area give no up direction: they may be the face of an object."""
_UNDECIDED = 2.0
"""Novelty of an object with too few points for a surface: above the threshold, so unknown."""
_SAME_UP = float(np.cos(np.radians(1.0)))
"""Cosine of 1 degree: closer up directions are treated as equal."""


class PerceptionInput(NamedTuple):
    """A frame to perceive, with its context.

    Attributes
    ----------
    up : (3,) up direction in the sensor frame, a unit vector; None to estimate it from planes.
    earlier : frames to fuse with this one. Candidates keep only pixels at which ``frame`` itself
        shows the same surface.
    pose : ``fixed_from_sensor``, None if it is unknown.
    colour : the colour image nearest in time, for masks; its pixels are not used.
    """

    frame: Frame
    up: F4 | None
    earlier: tuple[Earlier, ...] = ()
    pose: Pose | None = None
    colour: ColourView | None = None


@dataclass(frozen=True)
class Perceiver:
    """Perceives blocks of frames; a pickled copy reads the model file again.

    Attributes
    ----------
    model : path of the model file, None for the default model.
    """

    categorizer: Categorizer
    settings: Settings
    model: Path | None

    def __call__(self, inputs: Sequence[PerceptionInput]) -> list[Perception]:
        """Perceive consecutive frames; later ones may reuse the results of earlier ones."""
        states: dict[str, _BlockState] = {}
        perceptions = []
        for given in inputs:
            topic = given.frame.topic
            perception, states[topic] = _perceive(given, states.get(topic, _NEW_BLOCK), self)
            perceptions.append(_add_masks(given, perception))
        return perceptions

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
    """The surface of a candidate, sensor frame, its descriptor, and the seconds spent on both.

    With too few points, the surface has no neurons, and the descriptor is 0.
    """

    gas: NeuralGas
    descriptor: F4
    seconds: float


def perceive(
    frame: Frame,
    *,
    up: F4 | None,
    categorizer: Categorizer,
    settings: Settings,
) -> Perception:
    """Find, reconstruct, describe and categorize the objects of one frame (thesis ch. 4 to 7).

    The result depends only on the arguments.

    Parameters
    ----------
    up : (3,) up direction in the sensor frame, a unit vector; None to estimate it from planes.
    """
    (perception,) = Perceiver(categorizer, settings, None)([PerceptionInput(frame, up)])
    return perception


class _BlockState(NamedTuple):
    """Results of the earlier frames of a topic in the same block.

    Attributes
    ----------
    reference : the last frame that repeated no earlier one, after fusion; None if there is none.
    perception : the result of that frame.
    keys : described objects, for comparison with later frames.
    """

    reference: PerceptionInput | None
    perception: Perception | None
    keys: tuple[KeyView, ...]


_NEW_BLOCK = _BlockState(None, None, ())


def _perceive(
    given: PerceptionInput, state: _BlockState, perceiver: Perceiver
) -> tuple[Perception, _BlockState]:
    """Perceive a frame; return the result and the state for the next frame."""
    clock, frame, range_m = _Clock(), given.frame, perceiver.settings.detection.max_range_m
    fused = given._replace(frame=fuse(frame, given.earlier, range_m=range_m), earlier=())
    then = state.reference
    if then is not None and state.perception and _repeats_frame(fused, then, range_m):
        repeated = _restrict_to(frame, then.frame, _copy_for(frame, state.perception))
        clock.lap("detect")
        return replace(repeated, seconds=clock.seconds), state
    scene, detections, keys = _perceive_objects(fused, state.keys, perceiver, clock)
    perception = Perception(
        topic=frame.topic,
        index=frame.index,
        stamp_ns=frame.stamp_ns,
        frame_id=frame.frame_id,
        scene=scene,
        detections=detections,
        seconds=clock.seconds,
    )
    after = _BlockState(fused, perception, keys)
    return _restrict_to(frame, fused.frame, perception), after


def _perceive_objects(
    given: PerceptionInput, keys: tuple[KeyView, ...], perceiver: Perceiver, clock: "_Clock"
) -> tuple[Scene, tuple[Detection, ...], tuple[KeyView, ...]]:
    """Return the scene and detections of a frame, and ``keys`` plus the newly described objects."""
    frame, settings = given.frame, perceiver.settings
    scene = detect(frame, up=given.up, settings=settings.detection, rng=_rng(settings, frame, 0))
    clock.lap("detect")
    views = [
        view_object(frame, given.pose, each, scene.up, scene.height_of(each))
        for each in scene.candidates
    ]
    repeats = find_repeats(views, keys)
    new = [k for k, repeat in enumerate(repeats) if repeat is None]
    shapes = [
        _describe(frame, scene, scene.candidates[k], settings, _rng(settings, frame, k + 1))
        for k in new
    ]
    clock.lap("describe")
    candidates = [scene.candidates[k] for k in new]
    categorized = _categorize(candidates, shapes, perceiver.categorizer)
    clock.lap("categorize")
    categories = perceiver.categorizer.categories
    completed = [_add_full_box(frame, scene, d, categories) for d in categorized]
    described = dict(zip(new, completed, strict=True))
    detections = tuple(
        described[k] if repeat is None else reused(repeat, views[k])
        for k, repeat in enumerate(repeats)
    )
    clock.lap("complete")
    return scene, detections, (*keys, *(KeyView(views[k], described[k]) for k in new))


def _add_masks(given: PerceptionInput, perception: Perception) -> Perception:
    """Add the masks of the objects on the colour image, if there is one."""
    if given.colour is None:
        return perception
    begun = time.perf_counter()
    objects = [detection.candidate.indices for detection in perception.detections]
    masks = find_masks(given.frame, given.colour, objects)
    seconds = {**perception.seconds, "masks": time.perf_counter() - begun}
    return replace(perception, seconds=seconds, masks=masks)


def _repeats_frame(now: PerceptionInput, then: PerceptionInput, range_m: float) -> bool:
    """Return whether `shows_the_same` is true, and the given up directions agree or are missing."""
    if (now.up is None) != (then.up is None):
        return False
    if now.up is not None and then.up is not None and now.up @ then.up < _SAME_UP:
        return False
    return shows_the_same(now.frame, now.pose, then.frame, then.pose, range_m=range_m)


def _copy_for(frame: Frame, first: Perception) -> Perception:
    """Return the result of an earlier frame as the result of this one."""
    detections = tuple(
        replace(d, seconds=0.0, reused_from=first.index if d.reused_from is None else d.reused_from)
        for d in first.detections
    )
    return replace(
        first,
        index=frame.index,
        stamp_ns=frame.stamp_ns,
        detections=detections,
        reused_from=first.index,
    )


def _restrict_to(frame: Frame, perceived: Frame, perception: Perception) -> Perception:
    """Restrict candidates found in ``perceived`` to what ``frame`` shows (`keep_same_surface`)."""
    if perceived is frame:
        return perception
    scene = keep_same_surface(perception.scene, frame, perceived)
    detections = tuple(
        replace(detection, candidate=candidate)
        for detection, candidate in zip(perception.detections, scene.candidates, strict=True)
    )
    return replace(perception, scene=scene, detections=detections)


class _Clock:
    """Measures the duration of successive steps."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Store the seconds since the previous lap as the duration of a step."""
        now = time.perf_counter()
        self.seconds[step], self._last = now - self._last, now


def find_up(frame: Frame, settings: Settings) -> F4 | None:
    """Return the up direction (3,) of the planes, sensor frame; None if they are too small."""
    scene = detect(frame, settings=settings.detection, rng=_rng(settings, frame, 0))
    return scene.up if sum(plane.area_m2 for plane in scene.planes) >= _ENOUGH_M2 else None


def level_points(frame: Frame, scene: Scene, candidate: Candidate) -> tuple[F8, Pose]:
    """Return the points (n, 3) of a candidate, metres, level frame, and `level_from_sensor`."""
    points = frame.xyz(candidate.indices)
    level = level_from_sensor(scene.up, scene.support_offset(candidate), points)
    return transform(level, points), level


def _rng(settings: Settings, frame: Frame, item: int) -> np.random.Generator:
    """Return a generator seeded by seed, stamp and ``item``: an object's number from 1, else 0."""
    return np.random.default_rng((settings.seed, abs(frame.stamp_ns), item))


def _describe(
    frame: Frame, scene: Scene, candidate: Candidate, settings: Settings, rng: np.random.Generator
) -> _Shape:
    """Learn and describe the surface of a candidate in the level frame, its support at z = 0."""
    begun = time.perf_counter()
    points, level = level_points(frame, scene, candidate)
    cloud = thin(points.astype(np.float32), settings=settings.surface)
    gas = reconstruct(cloud, settings=settings.surface, rng=rng)
    if gas is None:
        gas = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))
        descriptor = np.zeros(len(DESCRIPTOR_NAMES), np.float32)
    else:
        descriptor = describe(cloud, gas, eye=level.translation)
        gas = NeuralGas(transform(inverse(level), gas.neurons), gas.edges)  # sensor frame
    return _Shape(gas, descriptor, time.perf_counter() - begun)


def _add_full_box(
    frame: Frame, scene: Scene, detection: Detection, categories: Sequence[str]
) -> Detection:
    """Add the estimated box of the whole object to a detection."""
    candidate = detection.candidate
    sampled = candidate.indices[:: max(1, -(-len(candidate.indices) // ENOUGH_POINTS))]
    offset = scene.support_offset(candidate)
    full = complete(frame.xyz(sampled), scene.up, offset, detection.posterior, categories)
    return replace(detection, full=full)


def _categorize(
    candidates: Sequence[Candidate], shapes: Sequence[_Shape], categorizer: Categorizer
) -> list[Detection]:
    """Categorize candidates; those without a surface are unknown, with a uniform posterior."""
    if not shapes:
        return []
    begun = time.perf_counter()
    prediction = categorizer.predict(np.stack([shape.descriptor for shape in shapes]))
    seconds = (time.perf_counter() - begun) / len(shapes)
    has_surface = [len(shape.gas.neurons) > 0 for shape in shapes]
    uniform = np.full(len(categorizer.categories), 1 / len(categorizer.categories))
    return [
        Detection(
            candidate=candidate,
            gas=shape.gas,
            descriptor=shape.descriptor,
            posterior=prediction.posteriors[k] if has_surface[k] else uniform,
            novelty=float(prediction.novelty[k]) if has_surface[k] else _UNDECIDED,
            seconds=shape.seconds + seconds,
        )
        for k, (candidate, shape) in enumerate(zip(candidates, shapes, strict=True))
    ]
