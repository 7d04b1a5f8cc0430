"""Views of simulated objects, for training and evaluating a model."""

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import NamedTuple
from zlib import crc32

import numpy as np

from shapecat.arrays import F4
from shapecat.config import Settings
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.detection import detect
from shapecat.evaluation import View
from shapecat.evaluation.views import describe_view
from shapecat.geometry import (
    IDENTITY,
    inverse,
    level_from_sensor,
    transform,
)
from shapecat.models.arrangements import (
    BARE_TABLE,
    ArrangedObject,
    Arrangement,
    ArrangementOptions,
    arrange,
    placed,
)
from shapecat.models.fragments import cut_fragment, remove_base
from shapecat.models.rendered_views import RenderedView, render_view
from shapecat.perception import level_points
from shapecat.simulation.camera.render import geometry
from shapecat.simulation.shapes.mesh import Mesh, moved
from shapecat.simulation.shapes.stable_poses import StablePose
from shapecat.surface import voxelize
from shapecat.types import UNKNOWN, Candidate, Scene

__all__ = ["SimulatedView", "simulate_arrangement", "simulate_mesh", "simulate_views"]

_LEAST_VISIBLE = 0.3
"""Minimum visible fraction of an object that is described."""
_OVERLAP = 0.5
"""Minimum IoU of a detection and its object."""
_BACKGROUND = 0.1
"""Maximum fraction of object pixels in a detection of background."""
_THIN_M = 0.03
"""Maximum height of background that counts as *unknown*. Higher background may have the shape of a
category: a cupboard is a box."""
_HEIGHT = DESCRIPTOR_NAMES.index("metric.height")
_DETECTED_SHARE = 0.75
"""Fraction of the detected objects that are segmented by detection; others are by ground truth."""
_FRAGMENTS = 0.3
"""Fraction of the views from which a partial view is cut in addition."""
_SETTINGS = Settings()


class SimulatedView(NamedTuple):
    """One described view, and the conditions under which it was taken.

    Attributes
    ----------
    descriptor : (d,) descriptor.
    label : true category, or ``unknown``.
    instance : name of the object.
    points : number of voxels.
    distance : distance of the sensor from the mean of the points, metres.
    resting_pose : ``upright``, ``lying``, ``upside_down``, ``leaning`` or ``tilted``.
    source : how the view was segmented: ``truth``, ``detected`` or ``fragment``; or ``background``,
        for a thin detection that shows no object and has the label ``unknown``.
    visible : number of the object's depth pixels, divided by its number of pixels if nothing
        occluded it; 1 for background.
    overlap : IoU of the detection and the object's depth pixels, for a fragment before it was cut;
        1 for views that are not from a detection, and for background.
    sensor : name of the sensor.
    view : the voxels; None in the views of `simulate_views`.
    """

    descriptor: F4
    label: str
    instance: str
    points: int
    distance: float
    resting_pose: str
    source: str
    visible: float
    overlap: float
    sensor: str
    view: View | None


class _Conditions(NamedTuple):
    """Conditions of a view of an object or of background; fields as in `SimulatedView`."""

    resting_pose: str
    sensor: str
    visible: float
    overlap: float


def simulate_views(
    options: ArrangementOptions, numbers: Sequence[int], *, jobs: int = 1
) -> Iterator[SimulatedView]:
    """Simulate the arrangements with these numbers; yield their views in this order.

    The views are without points, which would fill the memory. The number of jobs does not affect
    the result.
    """
    one = partial(_simulate_without_points, options)
    if jobs <= 1:
        for number in numbers:
            yield from one(number)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for views in pool.map(one, numbers, chunksize=2):
            yield from views


def _simulate_without_points(options: ArrangementOptions, number: int) -> list[SimulatedView]:
    return [view._replace(view=None) for view in simulate_arrangement(options, number)]


def simulate_arrangement(options: ArrangementOptions, number: int) -> list[SimulatedView]:
    """Simulate one arrangement and describe its objects from several viewpoints."""
    rng = np.random.default_rng((options.seed, number))
    arrangement, name = arrange(options, rng), f"{options.seed}/{number}"
    return describe_arrangement(
        arrangement, name, cameras=options.cameras, rng=rng, background=options.background
    )


def simulate_mesh(
    mesh: Mesh,
    label: str,
    name: str,
    stable_pose: StablePose,
    *,
    cameras: int,
    rng: np.random.Generator,
) -> list[SimulatedView]:
    """Describe one object, alone on the table, from several viewpoints.

    Parameters
    ----------
    label : true category of the object.
    name : prefix of its instance name.
    stable_pose : pose in which the mesh rests on the table.
    cameras : number of viewpoints, each with its own sensor.
    """
    item = ArrangedObject(moved(mesh, stable_pose.pose), label, stable_pose.name, 0.0)
    alone = Arrangement([placed(item, (0.0, 0.0), 0.0, rng)], (BARE_TABLE,))
    return describe_arrangement(alone, name, cameras=cameras, rng=rng)


def describe_arrangement(
    arrangement: Arrangement,
    name: str,
    *,
    cameras: int,
    rng: np.random.Generator,
    background: bool = False,
) -> list[SimulatedView]:
    """Describe the objects of an arrangement from several viewpoints.

    Views of objects that are less than 30 % visible are left out.

    Parameters
    ----------
    name : prefix of the instance names.
    cameras : number of viewpoints, each with its own sensor.
    background : whether to add thin detections that show no object, as unknown.
    """
    objects = arrangement.objects
    if not objects:
        return []
    meshes = (*(item.mesh for item in objects), *arrangement.furniture)
    scene_geometry = geometry([(mesh, IDENTITY) for mesh in meshes])
    views: list[SimulatedView] = []
    for _ in range(cameras):
        image = render_view(scene_geometry, arrangement, rng)
        scene = detect(image.frame, up=None, settings=_SETTINGS.detection, rng=rng)
        for k, item in enumerate(objects):
            if image.visible[k] >= _LEAST_VISIBLE:
                views += _views_of(image, scene, k, item, f"{name}/{k}", rng)
        if background:
            views += _background(image, scene, len(objects), f"{name}/background")
    return views


def _views_of(
    image: RenderedView,
    scene: Scene,
    k: int,
    item: ArrangedObject,
    instance: str,
    rng: np.random.Generator,
) -> list[SimulatedView]:
    """Return a view of object ``k``, segmented by truth or detection, and sometimes a fragment.

    Views with too few points for a surface are left out.
    """
    detected = _segment_by_detection(image, scene, k)
    if detected is not None and rng.random() < _DETECTED_SHARE:
        (view, overlap), source = detected, "detected"
    else:
        view, overlap = remove_base(_segment_by_truth(image, k, item, rng), rng), 1.0
        source = "truth"
    view = View(view.points, view.eye, item.label, instance)
    conditions = _Conditions(item.resting_pose, image.sensor, float(image.visible[k]), overlap)
    described = [_described(view, source, conditions)]
    if rng.random() < _FRAGMENTS:
        piece = cut_fragment(view, rng)
        if piece is not None:
            described.append(_described(piece, "fragment", conditions))
    return [each for each in described if each is not None]


def _background(image: RenderedView, scene: Scene, objects: int, name: str) -> list[SimulatedView]:
    """Return views of the thin detections that show no object.

    ``objects`` is the number of objects, whose mesh ids come first.
    """
    mesh_ids = image.mesh_ids.reshape(-1)
    views = []
    for candidate in scene.candidates:
        ids = mesh_ids[candidate.indices]
        if np.mean((ids >= 0) & (ids < objects)) <= _BACKGROUND:
            view = replace(_view_of(image, scene, candidate), category=UNKNOWN, instance=name)
            conditions = _Conditions("upright", image.sensor, visible=1.0, overlap=1.0)
            views.append(_described(view, "background", conditions))
    return [view for view in views if view is not None and view.descriptor[_HEIGHT] < _THIN_M]


def _segment_by_detection(image: RenderedView, scene: Scene, k: int) -> tuple[View, float] | None:
    """Return the detection of object ``k`` as a view, and its IoU; None if detection missed it."""
    mesh_ids = image.mesh_ids.reshape(-1)
    valid = np.asarray(image.frame.depth).reshape(-1) > 0
    total = int(np.count_nonzero((mesh_ids == k) & valid))
    for candidate in scene.candidates:
        hits = int(np.count_nonzero(mesh_ids[candidate.indices] == k))
        overlap = hits / (total + candidate.indices.size - hits)
        if overlap >= _OVERLAP:
            return _view_of(image, scene, candidate), overlap
    return None


def _view_of(image: RenderedView, scene: Scene, candidate: Candidate) -> View:
    """Return the points of a detection in its level frame, without label and instance."""
    points, level = level_points(image.frame, scene, candidate)
    return View(points, level.translation, "", "")


def _segment_by_truth(
    image: RenderedView, k: int, item: ArrangedObject, rng: np.random.Generator
) -> View:
    """Return the true points of object ``k`` in its level frame, without label and instance.

    The level frame has random errors of about half a degree and 2 mm, like one from detection.
    """
    indices = np.flatnonzero((image.mesh_ids == k) & (np.asarray(image.frame.depth) > 0))
    points = image.frame.xyz(indices)
    camera_from_table = inverse(image.table_from_camera)
    up = camera_from_table.rotation[:, 2] + rng.normal(0, 0.008, 3)
    up /= np.linalg.norm(up)
    outline = item.mesh.vertices[:, :2]
    foot = np.array([*(outline.min(axis=0) + outline.max(axis=0)) / 2, item.support_m])
    offset = float(up @ transform(camera_from_table, foot)) + rng.normal(0, 0.002)
    level = level_from_sensor(up, offset, points)
    return View(transform(level, points), level.translation, "", "")


def _described(view: View, source: str, conditions: _Conditions) -> SimulatedView | None:
    """Describe the voxels of a view; return None if there are too few for a surface."""
    distance = float(np.linalg.norm(view.points.mean(axis=0) - view.eye))
    view = replace(view, points=voxelize(view.points, voxel_m=_SETTINGS.surface.voxel_m))
    rng = np.random.default_rng(crc32(view.points.tobytes()))  # equal views, equal descriptors
    described = describe_view(view, settings=_SETTINGS, rng=rng)
    if described is None:
        return None
    return SimulatedView(
        descriptor=described.descriptor,
        label=view.category,
        instance=view.instance,
        points=described.points,
        distance=distance,
        source=source,
        view=view,
        **conditions._asdict(),
    )
