"""Convert records to Rerun archetypes for the review.

Several frames are converted to columns at a time: a call for each frame costs ten times as much.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import rerun as rr

from shapecat.arrays import F4, F8, U4
from shapecat.geometry import (
    BOX_EDGES,
    box_corners,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from shapecat.outputs.colours import colour_of
from shapecat.outputs.review.clouds import PaintedCloud
from shapecat.outputs.review.columns import Drawing
from shapecat.outputs.wording import caption
from shapecat.surface.triangles import triangles_of
from shapecat.types import Box, Camera, LabelledFrame, LabelledObject, Pose

__all__ = [
    "PATHS",
    "POSES",
    "SCENE",
    "SKETCH",
    "DrawnScene",
    "label",
    "markdown",
    "pinhole",
    "short_label",
    "sketch",
]

_PLANE = (190, 205, 220)
_CAPTION_M = 0.02  # from the top of a box to its caption
_SURE = 0.9
"""A caption omits a confidence of at least this."""

_DASHES = (np.arange(5)[:, None] + [0.0, 0.5])[..., None] / 4.5
"""Start and end (5, 2, 1) of the dashes of an edge, as fractions of its length, from 0 to 1."""

_Columns = Iterable[rr.ComponentColumn]
_TrackPath = tuple[str, F8]
"""The category of a track and its path (n, 3), metres."""


class DrawnScene(NamedTuple):
    """A frame to draw; ``points`` holds the points on objects, ``rest`` all others."""

    labelled: LabelledFrame
    rest: PaintedCloud
    points: PaintedCloud

    @property
    def size(self) -> int:
        """The size for `Columns.add`: the number of points plus the number of pixels of objects."""
        pixels = sum(o.indices.size for o in self.labelled.objects)
        return len(self.rest.points) + len(self.points.points) + pixels


class Sketch(NamedTuple):
    """The box and texts of an object, which are drawn in every frame.

    ``label`` is the text of the box, ``caption`` the shorter text above it.
    """

    box: Box
    category: str
    label: str
    caption: str


def label(item: LabelledObject) -> str:
    """Return ``#track category confidence``; for an unknown object, without the confidence."""
    return caption(item.track, item.category, item.confidence)


def short_label(item: LabelledObject) -> str:
    """Return ``#track category``, with the confidence only if it is low: long captions overlap."""
    return label(item) if item.confidence < _SURE else f"#{item.track} {item.category}"


def sketch(labelled: LabelledFrame) -> list[Sketch]:
    """Return the boxes and texts of the objects in a frame."""
    return [Sketch(o.box, o.category, label(o), short_label(o)) for o in labelled.objects]


def _boxes(rows: Sequence[Sequence[Sketch]]) -> _Columns:
    """Return the labelled boxes; a row holds those of one frame."""
    every = list(chain.from_iterable(rows))
    yield from rr.Boxes3D.columns(
        centers=_stacked([o.box.center for o in every], 3),
        half_sizes=_stacked([o.box.size for o in every], 3) / 2,
        quaternions=_stacked([o.box.orientation for o in every], 4),
        colors=_packed(every, white=0.25),
        labels=[o.label for o in every],
    ).partition([len(row) for row in rows])


def _captions(rows: Sequence[Sequence[Sketch]]) -> _Columns:
    """Return the captions, each just above its box."""
    every = list(chain.from_iterable(rows))
    yield from rr.Points3D.columns(
        positions=_stacked([_above(o.box) for o in every], 3),
        colors=_packed(every, white=0.6),
        labels=[o.caption for o in every],
    ).partition([len(row) for row in rows])


def _points(clouds: Sequence[PaintedCloud]) -> _Columns:
    columns = rr.Points3D.columns(
        positions=np.concatenate([cloud.points for cloud in clouds]),
        colors=np.concatenate([cloud.colours for cloud in clouds]),
    )
    yield from columns.partition([len(cloud.points) for cloud in clouds])
    yield from rr.Points3D.columns(radii=[cloud.radius_m for cloud in clouds])


def _dashes(scenes: Sequence[DrawnScene]) -> _Columns:
    """Return the edges of the full boxes, dashed."""
    with_full = [[o for o in m.labelled.objects if o.full is not None] for m in scenes]
    objects = list(chain.from_iterable(with_full))
    corners = np.reshape([box_corners(o.full) for o in objects if o.full is not None], (-1, 8, 3))
    starts, ends = corners[:, BOX_EDGES[:, 0]], corners[:, BOX_EDGES[:, 1]]
    pairs = starts[:, :, None, None] + _DASHES * (ends - starts)[:, :, None, None]
    dashes = len(BOX_EDGES) * len(_DASHES)
    yield from rr.LineStrips3D.columns(
        strips=_segments(pairs.reshape(-1, 2, 3)),
        colors=np.repeat(_packed(objects, white=0.45), dashes),
    ).partition([dashes * len(each) for each in with_full])


def _graphs(scenes: Sequence[DrawnScene]) -> _Columns:
    """Return the edges of the objects' neural gases."""
    objects = [o for m in scenes for o in m.labelled.objects]
    lines = [o.gas.neurons[o.gas.edges] for o in objects]
    pairs = np.concatenate(lines) if lines else np.zeros((0, 2, 3), np.float32)
    colours = np.repeat(_packed(objects, white=0.65), [len(each) for each in lines])
    counts = [sum(len(o.gas.edges) for o in m.labelled.objects) for m in scenes]
    yield from rr.LineStrips3D.columns(strips=_segments(pairs), colors=colours).partition(counts)


def _segments(pairs: F4) -> pa.Array:
    """Return lines (n, 2, 3) in the form that Rerun stores; Rerun's own conversion is slow."""
    kind = rr.components.LineStrip3DBatch._ARROW_DATATYPE  # noqa: SLF001  no public name
    flat = pa.array(np.ascontiguousarray(pairs, np.float32).ravel())
    corners = pa.FixedSizeListArray.from_arrays(flat, type=kind.value_type)
    offsets = pa.array(np.arange(0, 2 * len(pairs) + 1, 2, dtype=np.int32))
    return pa.ListArray.from_arrays(offsets, corners, type=kind)


def _surfaces(scenes: Sequence[DrawnScene]) -> _Columns:
    """Return the triangles of the objects' neural gases, one translucent mesh per frame."""
    meshes = [
        [(o, faces) for o in m.labelled.objects if len(faces := _triangles(o))] for m in scenes
    ]
    objects = [o for each in meshes for o, _ in each]
    sizes = [len(o.gas.neurons) for o in objects]
    colours = np.repeat(_packed(objects, alpha=70), sizes)
    yield from rr.Mesh3D.columns(
        vertex_positions=_stacked([o.gas.neurons for o in objects], 3), vertex_colors=colours
    ).partition([sum(len(o.gas.neurons) for o, _ in each) for each in meshes])
    yield _faces([_mesh([(len(o.gas.neurons), faces) for o, faces in each]) for each in meshes])


def _triangles(item: LabelledObject) -> U4:
    return np.asarray(triangles_of(item.gas.edges, len(item.gas.neurons)))


def _outlines(scenes: Sequence[DrawnScene]) -> _Columns:
    """Return the closed outlines of the planes."""
    outlines = [[p.outline for p in m.labelled.planes if len(p.outline)] for m in scenes]
    strips = [np.concatenate([o, o[:1]]) for o in chain.from_iterable(outlines)]
    yield from rr.LineStrips3D.columns(strips=strips).partition([len(each) for each in outlines])


def _fills(scenes: Sequence[DrawnScene]) -> _Columns:
    """Return the planes as triangle fans, since outlines are convex."""
    scene_outlines = [[p.outline for p in m.labelled.planes if len(p.outline) >= 3] for m in scenes]
    corners = _stacked(list(chain.from_iterable(scene_outlines)), 3)
    counts = [sum(map(len, outlines)) for outlines in scene_outlines]
    yield from rr.Mesh3D.columns(vertex_positions=corners).partition(counts)
    yield _faces([_mesh([(len(o), _fan(len(o))) for o in outlines]) for outlines in scene_outlines])


def _fan(corners: int) -> U4:
    inner = np.arange(1, corners - 1)
    return np.stack([np.zeros_like(inner), inner, inner + 1], axis=1).astype(np.uint32)


def _mesh(parts: Sequence[tuple[int, U4]]) -> U4:
    """Return the triangles of a mesh that joins parts, each a vertex count and triangles (n, 3)."""
    starts = np.cumsum([0, *(vertices for vertices, _ in parts)])
    faces = [triangles + start for (_, triangles), start in zip(parts, starts, strict=False)]
    return np.concatenate(faces).astype(np.uint32) if faces else np.zeros((0, 3), np.uint32)


def _faces(meshes: Sequence[U4]) -> rr.ComponentColumn:
    (column,) = rr.Mesh3D.columns(triangle_indices=np.concatenate(meshes))
    return column.partition([len(mesh) for mesh in meshes])


# The colours of points are shaded already.
_FLAT = rr.Points3D.from_fields(point_shading=rr.components.PointShading.Flat)
SCENE: Mapping[str, Drawing] = {
    "scene": Drawing(lambda scenes: _points([moment.rest for moment in scenes]), _FLAT),
    "objects/points": Drawing(lambda scenes: _points([moment.points for moment in scenes]), _FLAT),
    "planes": Drawing(_outlines, rr.LineStrips3D.from_fields(colors=_PLANE, radii=0.001)),
    "planes/fill": Drawing(_fills, rr.Mesh3D.from_fields(albedo_factor=(*_PLANE, 28))),
    "objects/full": Drawing(_dashes, rr.LineStrips3D.from_fields(radii=0.0008)),
    "objects/graphs": Drawing(_graphs, rr.LineStrips3D.from_fields(radii=0.0008)),
    "objects/surfaces": Drawing(_surfaces),
}
"""The `Drawing` of each entity of a scene; each draws a `DrawnScene`, a few times per second."""
SKETCH: Mapping[str, Drawing] = {
    # Labels of boxes would cover the objects.
    "objects/boxes": Drawing(_boxes, rr.Boxes3D.from_fields(radii=0.001, show_labels=False)),
    "objects/captions": Drawing(_captions, rr.Points3D.from_fields(radii=0.0005, show_labels=True)),
}
"""The `Drawing` of each entity that is drawn in every frame, from a `Sketch` of each object."""


def _paths(snapshots: Sequence[Sequence[_TrackPath]]) -> _Columns:
    strips = [way for snapshot in snapshots for way in snapshot]
    yield from rr.LineStrips3D.columns(
        strips=[places for _, places in strips],
        colors=[_tint(category, 0.2) for category, _ in strips],
    ).partition([len(snapshot) for snapshot in snapshots])


def _poses(poses: Sequence[Pose]) -> _Columns:
    yield from rr.Transform3D.columns(
        translation=[pose.translation for pose in poses],
        quaternion=[quaternion_from_rotation(pose.rotation) for pose in poses],
    )


PATHS, POSES = Drawing(_paths), Drawing(_poses)
"""The `Drawing` of the paths of tracks, and of poses ``parent_from_child``."""


def pinhole(camera: Camera) -> rr.Pinhole:
    """Return the frustum of a camera."""
    return rr.Pinhole(
        image_from_camera=[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]],
        resolution=[camera.width, camera.height],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.06,
        color=(120, 130, 145),
    )


def markdown(values: Mapping[str, object], level: int = 1) -> str:
    """Return values as a Markdown list; nested values have headings and lists of their own.

    Headings start at ``level + 1``; the deepest level is 6.
    """
    lines = [
        f"- **{key}**: {_inline(v)}" for key, v in values.items() if not isinstance(v, Mapping)
    ]
    parts = ["\n".join(lines)] if lines else []
    for key, value in values.items():
        if isinstance(value, Mapping):
            parts.append(f"{'#' * min(level + 1, 6)} {key}\n\n{markdown(value, level + 1)}")
    return "\n\n".join(parts)


def _inline(value: object) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return ", ".join(map(str, value)) or "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _above(box: Box) -> F8:
    up = rotation_from_quaternion(box.orientation)[:, 2]
    return np.asarray(box.center + (0.5 * box.size[2] + _CAPTION_M) * up)


def _stacked(rows: Sequence[F8], width: int) -> F8:
    return np.concatenate([np.reshape(row, (-1, width)) for row in rows] or [np.zeros((0, width))])


def _tint(category: str, white: float) -> tuple[int, int, int]:
    """Return the colour of a category, mixed with the fraction ``white`` of white."""
    red, green, blue = (round(c + white * (255 - c)) for c in colour_of(category))
    return red, green, blue


def _packed(
    objects: Sequence[LabelledObject | Sketch], *, alpha: int = 255, white: float = 0.0
) -> U4:
    """Return the colours (n,) of objects, 0xRRGGBBAA, by category; ``white`` is as in `_tint`."""
    tints = {category: _tint(category, white) for category in {o.category for o in objects}}
    numbers = {
        category: (red << 24) | (green << 16) | (blue << 8) | alpha
        for category, (red, green, blue) in tints.items()
    }
    return np.array([numbers[o.category] for o in objects], np.uint32)
