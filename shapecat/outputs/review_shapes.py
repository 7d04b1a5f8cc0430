"""What the review draws: records of the house as archetypes of Rerun."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import pyarrow as pa
import rerun as rr

from shapecat.arrays import F4, F8
from shapecat.geometry import quaternion_from_rotation, rotation_from_quaternion
from shapecat.outputs.colours import colour_of
from shapecat.outputs.review_cloud import PaintedCloud
from shapecat.types import Box, Camera, LabelledObject, Plane, Pose

__all__ = [
    "boxes",
    "captions",
    "fills",
    "graphs",
    "label",
    "markdown",
    "outlines",
    "paths",
    "pinhole",
    "points",
    "surfaces",
    "transform3d",
]

_PLANE = (190, 205, 220)
_CAPTION_M = 0.02  # from the top of a box to its label


def label(item: LabelledObject) -> str:
    """Return ``#track category confidence``."""
    return f"#{item.track} {item.category} {item.confidence:.2f}"


def points(cloud: PaintedCloud) -> rr.Points3D:
    """Return the points of a cloud."""
    return rr.Points3D(
        cloud.points,
        colors=cloud.colours,
        radii=cloud.radius_m,
        point_shading=rr.components.PointShading.Flat,  # their colours are shaded already
    )


def boxes(objects: Sequence[LabelledObject]) -> rr.Boxes3D:
    """Return the labelled boxes of a frame."""
    return rr.Boxes3D(
        centers=np.reshape([o.box.center for o in objects], (-1, 3)),
        half_sizes=np.reshape([o.box.size for o in objects], (-1, 3)) / 2,
        quaternions=np.reshape([o.box.orientation for o in objects], (-1, 4)),
        colors=[_tint(o.category, 0.25) for o in objects],
        labels=[label(o) for o in objects],
        radii=0.001,
        show_labels=False,  # they would cover the objects
    )


def captions(objects: Sequence[LabelledObject]) -> rr.Points3D:
    """Return the labels of a frame, each a little above its box."""
    return rr.Points3D(
        np.reshape([_above(o.box) for o in objects], (-1, 3)),
        colors=[_tint(o.category, 0.6) for o in objects],
        labels=[label(o) for o in objects],
        radii=0.0005,
        show_labels=True,
    )


def graphs(objects: Sequence[LabelledObject]) -> rr.LineStrips3D:
    """Return the edges of the graphs of a frame."""
    strips = [o.gas.neurons[o.gas.edges] for o in objects]
    counts = [len(o.gas.edges) for o in objects]
    colours = np.repeat(
        np.array([_packed(o.category, 255, 0.65) for o in objects], np.uint32), counts
    )
    pairs = np.concatenate(strips) if strips else np.zeros((0, 2, 3), np.float32)
    return rr.LineStrips3D(_segments(pairs), colors=colours, radii=0.0008)


def _segments(pairs: F4) -> pa.Array:
    """Return lines (n, 2, 3) as Rerun stores them: its own conversion goes one by one."""
    kind = rr.components.LineStrip3DBatch._ARROW_DATATYPE  # noqa: SLF001  not told otherwise
    flat = pa.array(np.ascontiguousarray(pairs, np.float32).ravel())
    corners = pa.FixedSizeListArray.from_arrays(flat, type=kind.value_type)
    offsets = pa.array(np.arange(0, 2 * len(pairs) + 1, 2, dtype=np.int32))
    return pa.ListArray.from_arrays(offsets, corners, type=kind)


def surfaces(objects: Sequence[LabelledObject]) -> rr.Mesh3D:
    """Return the triangles of the graphs of a frame, as one translucent mesh."""
    shown = [o for o in objects if len(o.gas.triangles)]
    starts = np.cumsum([0, *(len(o.gas.neurons) for o in shown)])
    faces = [o.gas.triangles.astype(np.uint32) + n for o, n in zip(shown, starts, strict=False)]
    colours = [np.full(len(o.gas.neurons), _packed(o.category, 70), np.uint32) for o in shown]
    return rr.Mesh3D(
        vertex_positions=_stacked([o.gas.neurons for o in shown]),
        triangle_indices=np.concatenate(faces) if faces else np.zeros((0, 3), np.uint32),
        vertex_colors=np.concatenate(colours) if colours else np.zeros(0, np.uint32),
    )


def outlines(planes: Sequence[Plane]) -> rr.LineStrips3D:
    """Return the closed outlines of the planes."""
    strips = [np.concatenate([p.outline, p.outline[:1]]) for p in planes if len(p.outline)]
    return rr.LineStrips3D(strips, colors=_PLANE, radii=0.001)


def fills(planes: Sequence[Plane]) -> rr.Mesh3D:
    """Return the planes as translucent polygons: fans, as outlines are convex."""
    shown = [plane.outline for plane in planes if len(plane.outline) >= 3]
    starts = np.cumsum([0, *(len(outline) for outline in shown)])
    faces = [
        (start, start + k, start + k + 1)
        for outline, start in zip(shown, starts.tolist(), strict=False)
        for k in range(1, len(outline) - 1)
    ]
    return rr.Mesh3D(
        vertex_positions=_stacked(shown),
        triangle_indices=np.reshape(faces, (-1, 3)).astype(np.uint32),
        albedo_factor=(*_PLANE, 28),
    )


def paths(ways: Iterable[tuple[str, Sequence[F8]]]) -> rr.LineStrips3D:
    """Return lines (category, places) in metres."""
    kept = list(ways)
    return rr.LineStrips3D(
        [np.array(places) for _, places in kept],
        colors=[_tint(category, 0.2) for category, _ in kept],
        radii=0.0015,
    )


def transform3d(pose: Pose) -> rr.Transform3D:
    """Return the pose ``parent_from_child``."""
    return rr.Transform3D(
        translation=pose.translation, quaternion=quaternion_from_rotation(pose.rotation)
    )


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
    """Return nested values as headings and lists."""
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


def _stacked(rows: Sequence[F8]) -> F8:
    return np.concatenate(rows) if len(rows) else np.zeros((0, 3), np.float32)


def _tint(category: str, white: float) -> tuple[int, int, int]:
    """Return the colour of a category mixed with white."""
    red, green, blue = (round(c + white * (255 - c)) for c in colour_of(category))
    return red, green, blue


def _packed(category: str, alpha: int, white: float = 0.0) -> int:
    red, green, blue = _tint(category, white)
    return int((red << 24) | (green << 16) | (blue << 8) | alpha)
