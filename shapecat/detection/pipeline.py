"""Detection on one page: from a frame to supporting planes and objects (thesis ch. 4).

1. The depth image is downsampled to samples of inverse depth; a point cloud is first turned into
   the image of a virtual camera (`depth_grid`, `virtual_camera`).
2. `planes`: the up direction; a plane at each peak of a height histogram, by least squares or, if
   few inliers are close to it, by RANSAC (Fischler and Bolles 1981); the planes that support
   objects; the height of each sample above its plane (thesis Alg. 1 and 2).
3. `foreground`: low-profile objects, walls, and objects that overhang the edge of their plane.
4. `segmentation`: surfaces are split at depth discontinuities and concave edges (local convexity,
   Stein et al. 2014) by a watershed (Meyer 1991), and where the width of a stack changes.
5. `merging`: segments of one object are merged if a learned classifier of pairs says so (Richtsfeld
   et al. 2012, 2014), or if an object in front separates them.
6. `cleanup`: structure rejection (of walls, furniture and noise), and hole filling.
7. `output`: boxes, support relations, labels at full resolution, the scene.

The thesis separates only objects that do not touch: steps 4 and 5 go beyond it.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8, I4, Bool, Records
from shapecat.config import DetectionSettings
from shapecat.detection.cleanup import structure
from shapecat.detection.cleanup.holes import fill_holes
from shapecat.detection.cleanup.object_features import measure_object_features
from shapecat.detection.cleanup.structure import find_background, number_objects
from shapecat.detection.depth_grid import DepthGrid, downsample
from shapecat.detection.foreground.low_profile import find_low_profile
from shapecat.detection.foreground.overhang import extend_overhang
from shapecat.detection.foreground.walls import remove_walls
from shapecat.detection.merging import learned
from shapecat.detection.merging.across_occlusion import merge_across_occluder
from shapecat.detection.merging.adjacency import measure_adjacency
from shapecat.detection.merging.pair_features import ViewGeometry
from shapecat.detection.merging.segments import measure_segments
from shapecat.detection.output.label_upsampling import label_pixels
from shapecat.detection.output.measurements import measure_objects
from shapecat.detection.output.point_labels import label_points
from shapecat.detection.output.scene import build_scene
from shapecat.detection.output.settings import OUTPUT
from shapecat.detection.planes import find_supporting_planes
from shapecat.detection.planes.assumed import assume_plane, find_unexplained
from shapecat.detection.planes.extent import SupportingPlane
from shapecat.detection.planes.height_map import HeightMap, measure_heights, pack_planes
from shapecat.detection.planes.ransac import draw_trials
from shapecat.detection.records import OverSegmentation, PlaneModel, Segmentation
from shapecat.detection.segmentation.connectivity import connect_surfaces
from shapecat.detection.segmentation.watershed import SeedSplitter, watershed
from shapecat.detection.segmentation.width_split import split_at_width_changes
from shapecat.detection.virtual_camera import VirtualImage, top_view, virtual_image
from shapecat.geometry import IDENTITY, inverse, unit_direction
from shapecat.types import Camera, Frame, Scene

__all__ = ["Task", "detect", "merge_segments", "model_planes", "oversegment"]

DEFAULT_UP = (0.0, -1.0, 0.0)
"""Up in the optical frame of an upright camera, used if nothing else is known."""


class Task(NamedTuple):
    """The inputs that all steps share: the settings, and the random generator for RANSAC."""

    settings: DetectionSettings
    rng: np.random.Generator


def detect(
    frame: Frame,
    *,
    up: ArrayLike | None = None,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Scene:
    """Find the supporting planes of a frame and the objects on them.

    Parameters
    ----------
    frame : a depth image or a point cloud.
    up : (3,) direction away from gravity, sensor frame, of any length but zero. If given, only
        planes with a normal within 15 degrees of it are considered. If None, it is estimated from
        the dominant plane.
    settings : see `DetectionSettings`.
    rng : source of the RANSAC samples; the same state gives the same scene.

    Returns
    -------
    The scene, with the planes lowest first and the objects in the order of their first point.
    Without a supporting plane, the scene has no planes and no objects.

    Raises
    ------
    ValueError : ``up`` is not of shape (3,), not finite, or zero.

    Notes
    -----
    Depth images are processed in image space. A point cloud is first turned into the image of a
    virtual camera at its origin, so that both give the same result for the same scene. If this
    image shows no plane, because the cloud was not taken from its origin, the virtual camera looks
    down on the dominant plane instead. In a cloud fused from several views, the points that are
    hidden from the virtual camera join the objects they touch.
    """
    hint, task = None if up is None else unit_direction(up), Task(settings, rng)
    if frame.depth is not None and frame.camera is not None:
        scene = _detect_in_image(frame.depth, frame.camera, hint, task)
    else:
        scene = _detect_in_cloud(frame.xyz(), hint, task)
    return scene or Scene(np.array(DEFAULT_UP) if hint is None else hint, (), ())


def _detect_in_image(depth: F4, camera: Camera, hint: F8 | None, task: Task) -> Scene | None:
    """Return the scene of a depth image (h, w), metres; None without a supporting plane.

    ``hint`` is as in `model_planes`.
    """
    range_m = task.settings.max_range_m
    grid = downsample(depth, camera, range_m=range_m)
    segmentation = None if grid is None else _segment(grid, hint, task)
    if grid is None or segmentation is None:
        return None
    indices = label_pixels(depth, grid, segmentation, range_m=range_m)
    return build_scene(grid, segmentation, indices, IDENTITY, settings=task.settings)


def _detect_in_cloud(points: F4, hint: F8 | None, task: Task) -> Scene | None:
    """Return the scene of a cloud (n, 3), metres; None without a supporting plane.

    ``hint`` (3,) is the ``up`` of `detect` as a unit vector.
    """
    view = virtual_image(points, range_m=task.settings.max_range_m)
    segmentation = None if view is None else _segment_view(view, hint, task)
    if segmentation is None:
        view = top_view(points, hint, range_m=task.settings.max_range_m, rng=task.rng)
        segmentation = None if view is None else _segment_view(view, hint, task)
    if view is None or segmentation is None:
        return None
    indices = label_points(
        view,
        segmentation,
        fused=view.crowded > OUTPUT.crowded,
        max_height_m=task.settings.max_height_m,
    )
    pose = inverse(view.view_from_sensor)
    return build_scene(
        view.grid, segmentation, indices, pose, settings=task.settings, points=view.points
    )


def _segment_view(view: VirtualImage, hint: F8 | None, task: Task) -> Segmentation | None:
    """Do the work of `_segment` for a virtual image; ``hint`` is in the frame of the cloud."""
    view_hint = None if hint is None else view.view_from_sensor.rotation @ hint
    return _segment(view.grid, view_hint, task, upright=False)


def _segment(
    grid: DepthGrid, hint: F8 | None, task: Task, *, upright: bool = True
) -> Segmentation | None:
    """Find planes and objects in a depth grid; return None if there is no supporting plane.

    The parameters are as in `model_planes`.
    """
    model = model_planes(grid, hint, task, upright=upright)
    if model is None:
        return None
    oversegmentation = oversegment(grid, model)
    merge_segments(grid, model, oversegmentation)
    return _clean_up(grid, model, oversegmentation, task.settings)


def model_planes(
    grid: DepthGrid, hint: F8 | None, task: Task, *, upright: bool = True
) -> PlaneModel | None:
    """Find the planes and the samples above them (steps 2 and 3).

    Return None if there is no supporting plane. ``hint`` is the up direction (3,), a unit vector in
    the frame of the grid, or None if unknown; ``upright`` is as in `find_supporting_planes`.
    """
    trials, settings = draw_trials(task.rng), task.settings
    result = _find_planes(grid, hint, trials, settings, upright=upright)
    if result is None:
        return None
    up, planes, heights = result
    low_profile: Bool = find_low_profile(grid, heights, planes, settings.max_size_m)
    walls = remove_walls(grid, heights.plane_id, up, settings.max_size_m, trials)
    extend_overhang(grid, heights, planes, walls, settings.max_height_m)
    return PlaneModel(up, planes, heights, low_profile, walls)


def _find_planes(
    grid: DepthGrid, hint: F8 | None, trials: F8, settings: DetectionSettings, *, upright: bool
) -> tuple[F8, Records, HeightMap] | None:
    """Return the up direction (3,), the supporting planes and the height map; None without a plane.

    The planes are from `pack_planes`; an assumed plane is added if many samples are above no other
    plane. If not ``upright``, the result is None without a visible plane. ``hint`` and ``upright``
    are as in `model_planes`, ``trials`` from `draw_trials`.
    """
    max_height_m = settings.max_height_m
    supports, up = find_supporting_planes(
        grid, hint, trials, max_height_m=max_height_m, upright=upright
    )
    if not supports and not upright:  # another view of the cloud may show a plane
        return None
    if not supports and hint is not None:
        up = hint
    elif not up.any():
        up = np.array(DEFAULT_UP)
    planes = pack_planes(supports)
    heights = measure_heights(grid, planes, max_height_m)
    assumed = _find_assumed_plane(grid, heights, up, trials, settings)
    if assumed is not None:
        supports = sorted([*supports, assumed], key=lambda support: support.offset)
        planes = pack_planes(supports)
        heights = measure_heights(grid, planes, max_height_m)
    return (up, planes, heights) if supports else None


def _find_assumed_plane(
    grid: DepthGrid, heights: HeightMap, up: F8, trials: F8, settings: DetectionSettings
) -> SupportingPlane | None:
    """Return a plane assumed below the samples that no plane and no wall explains.

    Return None if such samples are few, or if the plane would be above the camera. ``up`` and
    ``trials`` are as in `remove_walls`.
    """
    unexplained = find_unexplained(grid, heights.plane_id)
    if unexplained is not None:
        plane_id = heights.plane_id.copy()  # the low-profile search still needs the walls
        walls = remove_walls(grid, plane_id, up, settings.max_size_m, trials)
        unexplained = find_unexplained(grid, plane_id.view(np.uint8) | walls)
    if unexplained is None:
        return None
    return assume_plane(grid, unexplained, up, settings.max_height_m)


def oversegment(
    grid: DepthGrid, model: PlaneModel, *, split_seeds: SeedSplitter | None = None
) -> OverSegmentation:
    """Split the samples above the planes wherever two objects may meet.

    ``split_seeds`` is as in `watershed`.
    """
    heights, up = model.heights, model.up
    graph = connect_surfaces(grid, heights)
    labels, n = watershed(heights, graph, split_seeds=split_seeds)
    n = split_at_width_changes(grid, heights, graph, labels, up, n)
    segments = measure_segments(grid, heights, graph, labels, n, up)
    measure_adjacency(grid, heights, graph, labels, up, segments)
    return OverSegmentation(graph, labels, segments)


def merge_segments(grid: DepthGrid, model: PlaneModel, oversegmentation: OverSegmentation) -> None:
    """Merge the segments of each object; changes ``oversegmentation.segments`` in place."""
    graph, labels, segments = oversegmentation
    view_geometry = ViewGeometry(grid.intrinsics.fx, model.up)
    learned.merge_learned(segments, view_geometry, learned.load_trees())
    merge_across_occluder(segments, grid, graph.normal, labels)


def _clean_up(
    grid: DepthGrid,
    model: PlaneModel,
    oversegmentation: OverSegmentation,
    settings: DetectionSettings,
) -> Segmentation:
    """Reject structure, fill holes, measure the objects; changes ``oversegmentation`` in place."""
    graph, labels, segments = oversegmentation
    features = measure_object_features(grid, model, oversegmentation, settings.max_range_m)
    rejected = find_background(segments, features, grid, settings, structure.load_trees())
    representatives: I4 = number_objects(segments.parent, rejected, labels, graph.spans)
    # From here on, labels number the objects.
    filled = np.zeros(labels.shape, np.uint8)
    fill_holes(grid, labels, representatives.size - 1, filled)
    if model.low_profile.any():  # such objects may lie at the level of their plane
        filled |= model.low_profile & (labels > 0)
    plane_ids = segments.plane_id[representatives].astype(np.int64) - 1
    plane_ids[0] = 0
    offsets = model.planes["offset"][plane_ids[1:]]
    measured = measure_objects(grid, labels, segments, representatives, features, model.up, offsets)
    return Segmentation(model, labels, filled, plane_ids, measured)
