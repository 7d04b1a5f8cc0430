"""Detection on one page: from a frame to supporting planes and objects (thesis ch. 4).

1. The depth image is downsampled to samples of inverse depth; a cloud is looked at through a
   virtual camera first (`depth_grid`, `virtual_camera`).
2. `planes`: the up direction; multi-plane RANSAC (Fischler and Bolles 1981); which of the planes
   bear objects; how high every sample is above one (thesis Alg. 1 and 2).
3. `foreground`: low-profile objects, walls, and what reaches over the edge of its plane.
4. `segmentation`: surfaces are parted at depth discontinuities and concave edges (local convexity,
   Stein et al. 2014) by a watershed (Meyer 1991), and where a stack changes its width.
5. `merging`: relations between surface patches, learned (Richtsfeld et al. 2012, 2014), tell which
   segments are of one object; others go on behind what is in front of them.
6. `cleanup`: background structure and noise are rejected, holes are filled.
7. `output`: boxes, what stands on what, labels at full resolution, the scene.

The thesis stops at objects that do not touch: steps 4 and 5 go beyond it.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, F8, I4, Bool
from shapecat.config import DetectionSettings
from shapecat.detection.cleanup.holes import fill_enclosed, grow_feet
from shapecat.detection.cleanup.structure import Field, Limits, is_no_object
from shapecat.detection.depth_grid import Cells, cells_of
from shapecat.detection.foreground.low_profile import raise_low
from shapecat.detection.foreground.overhang import reach_over
from shapecat.detection.foreground.walls import clear_walls
from shapecat.detection.merging.across_occlusion import join_around, join_behind
from shapecat.detection.merging.adjacency import meet
from shapecat.detection.merging.learned import Sight, join_parts, trees
from shapecat.detection.merging.segments import pieces_after_cuts, pieces_of
from shapecat.detection.merging.small import join_raised, join_small
from shapecat.detection.output.label_upsampling import pixels_of, points_of
from shapecat.detection.output.measurements import things_of
from shapecat.detection.output.scene import scene_of
from shapecat.detection.planes import NO_HINT, find_supporting_planes
from shapecat.detection.planes.height_map import heights_of
from shapecat.detection.planes.ransac import draws_of
from shapecat.detection.records import LabelledGrid, OverSegmentation, PlaneModel
from shapecat.detection.segmentation.axis_split import cut_at_axes
from shapecat.detection.segmentation.connectivity import surfaces_of
from shapecat.detection.segmentation.top_face_split import cut_at_ledges
from shapecat.detection.segmentation.watershed import regions_of, rename
from shapecat.detection.segmentation.width_split import cut_at_steps
from shapecat.detection.virtual_camera import View, overview_of, view_of
from shapecat.errors import ConfigError
from shapecat.geometry import IDENTITY, inverse
from shapecat.types import Camera, Frame, Scene

__all__ = ["RULES", "detect", "label", "oversegment"]


class Rules(NamedTuple):
    """Which of the rules beyond the thesis apply, in their order.

    Without any of them what remains is the plane, the height above it, and depth jumps.
    """

    low: bool
    concave: bool
    ledge: bool
    axis: bool
    step: bool
    small: bool
    parts: bool
    occluder: bool
    feet: bool
    fill: bool


RULES = Rules._fields


DEFAULT_UP = (0.0, -1.0, 0.0)
"""Up in an upright optical frame, where nothing else is known."""
CROWDED = 0.08
"""Share of points behind others from which a cloud is taken for fused from several views."""


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
    frame : a depth image or a cloud. The sensor is at the origin of its frame.
    up : (3,) direction away from gravity, sensor frame, of any length but zero. With it only
        planes within 15 degrees of level count; without, it is estimated from the dominant plane.
    settings : see `DetectionSettings`.
    rng : source of what RANSAC tries; the same state gives the same scene.

    Returns
    -------
    The planes, lowest first, and the objects in the order of their first point; both empty if no
    supporting plane is seen.

    Raises
    ------
    ValueError : ``up`` is not a direction.
    ConfigError : ``settings.rules`` names an unknown rule.

    Notes
    -----
    Depth images are worked on in image space. A cloud is looked at through a virtual camera at
    its origin and goes the same way, so both give the same answer on the same scene. A cloud that
    was not taken from its origin is looked at from above its dominant plane; the points of a
    fused cloud that are hidden in the view join what they touch.
    """
    hint = None if up is None else _unit(up)
    if frame.depth is not None and frame.camera is not None:
        scene = _in_image(frame.depth, frame.camera, hint, settings, rng)
    else:
        scene = _in_cloud(frame.xyz(), hint, settings, rng)
    return scene or Scene(np.array(DEFAULT_UP) if hint is None else hint, (), ())


def _unit(up: ArrayLike) -> F8:
    vector = np.asarray(up, np.float64)
    norm = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not (np.isfinite(norm) and norm > 1e-9):
        msg = f"up must be a direction (3,), got {vector.tolist()}"
        raise ValueError(msg)
    return vector / norm


def _in_image(
    depth: F4,
    camera: Camera,
    hint: F8 | None,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> Scene | None:
    cells = cells_of(depth, camera, range_m=settings.max_range_m)
    found = None if cells is None else label(cells, hint, settings=settings, rng=rng)
    if cells is None or found is None:
        return None
    indices = pixels_of(depth, cells, found, range_m=settings.max_range_m)
    return scene_of(cells, found, indices, IDENTITY, settings=settings)


def _in_cloud(
    points: F4, hint: F8 | None, settings: DetectionSettings, rng: np.random.Generator
) -> Scene | None:
    view = view_of(points, range_m=settings.max_range_m)
    found = None if view is None else _seen(view, hint, settings, rng)
    if found is None:
        view = overview_of(points, hint, range_m=settings.max_range_m, rng=rng)
        found = None if view is None else _seen(view, hint, settings, rng)
    if view is None or found is None:
        return None
    indices = points_of(view, found, fused=view.crowded > CROWDED)
    return scene_of(
        view.cells, found, indices, inverse(view.view_from_sensor), settings=settings,
        points=view.points,
    )  # fmt: skip


def _seen(
    view: View, hint: F8 | None, settings: DetectionSettings, rng: np.random.Generator
) -> LabelledGrid | None:
    turned = None if hint is None else view.view_from_sensor.rotation @ hint
    return label(view.cells, turned, settings=settings, rng=rng)


def label(
    cells: Cells,
    hint: F8 | None,
    *,
    settings: DetectionSettings,
    rng: np.random.Generator,
) -> LabelledGrid | None:
    """Find planes and objects among the samples; None if there is no supporting plane."""
    model = _find_planes(cells, hint, settings, rng)
    if model is None:
        return None
    segments = _oversegment(cells, model, settings)
    known = _merge(cells, model, segments, settings)
    leaders = _clean_up(cells, model, segments, known, settings)
    return _fill(cells, model, segments, leaders, settings)


def oversegment(
    cells: Cells, *, settings: DetectionSettings, rng: np.random.Generator
) -> tuple[PlaneModel, OverSegmentation] | None:
    """Find planes and the segments of objects; None if no plane bears anything."""
    model = _find_planes(cells, None, settings, rng)
    return None if model is None else (model, _oversegment(cells, model, settings))


def _find_planes(
    cells: Cells, hint: F8 | None, settings: DetectionSettings, rng: np.random.Generator
) -> PlaneModel | None:
    """Find what objects stand on and before; None if no plane bears anything."""
    draws = draws_of(rng)
    hint = NO_HINT if hint is None else hint
    supports, up, planes = find_supporting_planes(cells, hint, draws)
    if not supports:
        return None
    heights = heights_of(cells, planes, settings.max_height_m)
    raised = np.zeros(cells.w.shape, np.int16)
    if _rules_of(settings.rules).low:
        raise_low(cells, heights, planes, raised, settings.max_size_m)
    walls = clear_walls(cells, heights.owner, up, settings.max_size_m, draws)
    reach_over(cells, heights, planes, walls, settings.max_height_m)
    return PlaneModel(up, supports, planes, heights, raised, walls)


def _oversegment(cells: Cells, model: PlaneModel, settings: DetectionSettings) -> OverSegmentation:
    """Part what stands on the planes where two objects may meet."""
    heights, up, rules = model.heights, model.up, _rules_of(settings.rules)
    surfaces = surfaces_of(cells, heights)
    regions, n = regions_of(heights, surfaces, rules.concave)
    pieces = pieces_of(cells, heights, surfaces, regions, n, up)
    more = n
    if rules.ledge:
        more = cut_at_ledges(cells, heights, surfaces, pieces, regions, up)
    if rules.axis:
        more = cut_at_axes(cells, heights, surfaces, pieces, regions, up, more)
    if rules.step:
        more = cut_at_steps(cells, heights, surfaces, pieces, regions, up, more)
    if more > n:
        pieces = pieces_after_cuts(cells, heights, surfaces, regions, more, up, pieces)
    meet(cells.w, heights, surfaces, regions, up, pieces)
    return OverSegmentation(surfaces, regions, pieces)


def _merge(
    cells: Cells, model: PlaneModel, segments: OverSegmentation, settings: DetectionSettings
) -> Bool:
    """Merge the segments of each object; return which are known to be low-profile objects."""
    surfaces, regions, pieces = segments
    rules = _rules_of(settings.rules)
    known: Bool = join_raised(pieces, model.raised, regions, surfaces.spans)
    if rules.small:
        join_small(pieces, cells)
    if rules.parts:
        join_parts(pieces, Sight(cells.lens.fx, model.up[2]), trees())
    if rules.occluder:
        join_behind(pieces, cells.w, cells.lens, surfaces.normal, regions)
        join_around(pieces)
    return known


def _clean_up(
    cells: Cells,
    model: PlaneModel,
    segments: OverSegmentation,
    known: Bool,
    settings: DetectionSettings,
) -> I4:
    """Reject what is no object, and number the others; return their leading segments."""
    surfaces, regions, pieces = segments
    field = Field(
        cells.w, cells.lens, model.planes, model.heights.owner, model.walls, regions, surfaces.spans
    )
    limits = Limits(settings.max_height_m, settings.max_size_m, settings.max_range_m)
    refused = is_no_object(field, pieces, model.up, known, limits)
    leaders, numbers = _number(pieces.group, refused)
    rename(regions, surfaces.spans, numbers)
    return leaders


def _number(group: I4, refused: Bool) -> tuple[I4, I4]:
    """Return the leading segment of each object, and the label of each segment; group 0 is none."""
    leading = (group == np.arange(group.size)) & ~refused
    leading[0] = False
    leaders = np.concatenate([[0], np.flatnonzero(leading)])
    numbers = np.zeros(group.size, np.int16)
    numbers[leaders] = np.arange(leaders.size)
    numbers = numbers[group]
    group[refused[group]] = 0
    return leaders, numbers


def _fill(
    cells: Cells,
    model: PlaneModel,
    segments: OverSegmentation,
    leaders: I4,
    settings: DetectionSettings,
) -> LabelledGrid:
    """Complete the labels near the planes, and measure the objects."""
    labels, pieces = segments.regions, segments.pieces  # of objects from `_clean_up` on
    rules = _rules_of(settings.rules)
    if rules.feet:
        grow_feet(cells.w, model.heights, labels)
    filled = np.zeros(labels.shape, np.uint8)
    if rules.fill:
        fill_enclosed(cells.w, model.heights.height, labels, leaders.size - 1, filled)
    filled |= (model.raised > 0) & (labels > 0)  # it may lie at the level of its plane
    owners = pieces.owner[leaders].astype(np.int64) - 1
    owners[0] = 0
    things = things_of(cells, labels, pieces, leaders, model.up, settings.max_range_m)
    return LabelledGrid(model.up, model.supports, model.planes, labels, filled, owners, things)


@cache
def _rules_of(text: str) -> Rules:
    rules = text.split()
    unknown = [rule for rule in rules if rule not in RULES]
    if unknown:
        msg = f"detection.rules: unknown {', '.join(unknown)}; known: {' '.join(RULES)}"
        raise ConfigError(msg)
    return Rules(*(rule in rules for rule in RULES))
