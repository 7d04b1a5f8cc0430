"""Write the tables of perceived frames: frames, detections, planes and masks, in segments."""

import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import pyarrow as pa

from shapecat.arrays import F4
from shapecat.geometry import transform
from shapecat.runs.tables.masks import mask_columns
from shapecat.runs.tables.schemas import PERCEIVED, SCHEMA_VERSION
from shapecat.runs.tables.segments import (
    GROUP_FRAMES,
    REVISIONS,
    SEGMENTS,
    group_frames,
    list_segments,
    read_segment,
    row_groups,
    write_segment,
)
from shapecat.runs.tables.writing import arrow_table, lists, open_writer
from shapecat.system.files import complete_folder, replacing
from shapecat.types import Perception, Pose

__all__ = ["FrameRow", "PerceptionTables"]

_SEGMENT_S = 2.0
"""A segment is written if this time has passed since the last one, so that a kill loses little."""
_SEGMENT_FRAMES = 2 * GROUP_FRAMES
"""A segment is written if at least this many frames are waiting."""


@dataclass(frozen=True)
class FrameRow:
    """Values of the frames table that a `Perception` lacks.

    Attributes
    ----------
    up_given : (3,) up direction in the sensor frame, a unit vector; None if estimated from planes.
    frame_from_sensor : as in `Frame`.
    """

    log_time_ns: int
    fixed_from_sensor: Pose | None
    up_given: F4 | None = None
    frame_from_sensor: Pose | None = None


class PerceptionTables:
    """Writes the tables of frames, detections, planes and masks.

    Use it as a context manager. Frames are first written as *segments*, folders that appear when
    they are complete, so that an interrupted run resumes after its last segment. Leaving the block
    joins the segments into tables, which do not depend on where a run was interrupted. Frames that
    are perceived a second time (`shapecat.runs.perceive.second_look`) have segments of their own,
    and replace the earlier results when the tables are joined.

    Attributes
    ----------
    done : number of frames in the segments of an interrupted run.
    """

    def __init__(
        self,
        folder: Path,
        *,
        categories: Sequence[str],
        model_id: str,
        colour: bool = False,
        again: bool = False,
    ) -> None:
        """Find the segments in ``folder``.

        Parameters
        ----------
        categories, model_id : of the model, stored in the tables.
        colour : whether to write a table of masks.
        again : whether the frames are perceived for the second time.
        """
        metadata = {
            "schema_version": SCHEMA_VERSION,
            "categories": ",".join(categories),
            "model": model_id,
        }
        self._folder = folder
        names = [name for name in PERCEIVED if name != "masks" or colour]
        self._schemas = {name: PERCEIVED[name].with_metadata(metadata) for name in names}
        self._categories = tuple(categories)
        self._pending: list[tuple[Perception, FrameRow]] = []
        self._again = again
        self._place = folder / (REVISIONS if again else SEGMENTS)
        self._segments = list_segments(self._place)
        self._flushed = time.monotonic()
        self.done = sum(read_segment(s, "frames").num_rows for s in self._segments)

    def __enter__(self) -> Self:
        """Return this writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        """Write pending rows and join the segments; after an error, only write."""
        if kind is not None:
            with suppress(OSError):
                self._flush()
            return
        self._flush()
        self._join()

    def write(self, perceptions: Sequence[Perception], rows: Sequence[FrameRow]) -> None:
        """Append a block of frames; a segment holds whole blocks.

        ``rows[k]`` belongs to ``perceptions[k]``.
        """
        self._pending.extend(zip(perceptions, rows, strict=True))
        late = time.monotonic() - self._flushed > _SEGMENT_S
        if late or len(self._pending) >= _SEGMENT_FRAMES:
            self._flush()

    def _flush(self) -> None:
        if not self._pending:
            return
        perceptions = [perception for perception, _ in self._pending]
        rows = {
            "frames": _frame_columns(self._pending, again=self._again),
            "detections": _detection_columns(self._pending, self._categories),
            "planes": _plane_columns(perceptions),
            "masks": mask_columns(perceptions),
        }
        segment = self._place / f"{len(self._segments):06d}"
        with complete_folder(segment) as hidden:
            for name, schema in self._schemas.items():
                write_segment(hidden, name, arrow_table(rows[name], schema))
        self._segments.append(segment)
        self._pending.clear()
        self._flushed = time.monotonic()

    def _join(self) -> None:
        """Join the segments into tables, whose row groups cover the same frames."""
        place = self._folder / SEGMENTS
        frames = sum(read_segment(s, "frames").num_rows for s in list_segments(place))
        with ExitStack() as stack:
            writers = {}
            for name, schema in self._schemas.items():
                path = stack.enter_context(replacing(self._folder / f"{name}.parquet"))
                writers[name] = stack.enter_context(open_writer(path, schema))
            for group in row_groups(self._folder, group_frames(frames)):
                for name, writer in writers.items():
                    writer.write_table(group[name])


def _frame_columns(rows: Sequence[tuple[Perception, FrameRow]], *, again: bool) -> dict[str, Any]:
    """Return the columns of the frames table, by name; ``again`` is as in `PerceptionTables`."""
    return {
        "topic": [p.topic for p, _ in rows],
        "frame": [p.index for p, _ in rows],
        "stamp_ns": [p.stamp_ns for p, _ in rows],
        "log_time_ns": [row.log_time_ns for _, row in rows],
        "frame_id": [p.frame_id for p, _ in rows],
        "up": [p.scene.up for p, _ in rows],
        "up_given": [row.up_given for _, row in rows],
        "revised": [again and bool(p.scene.planes or p.detections) for p, _ in rows],
        "reused_from": [p.reused_from for p, _ in rows],
        **_pose_columns("fixed", [row.fixed_from_sensor for _, row in rows]),
        **_pose_columns("frame", [row.frame_from_sensor for _, row in rows]),
        "stages": [list(p.seconds) for p, _ in rows],
        "seconds": [list(p.seconds.values()) for p, _ in rows],
    }


def _pose_columns(name: str, poses: Sequence[Pose | None]) -> dict[str, Any]:
    """Return the columns of translations (3,) and rotations (9,), None where the pose is unknown.

    Their names begin with ``name``. Rotation matrices are flattened row by row.
    """
    return {
        f"{name}_translation": [pose and pose.translation for pose in poses],
        f"{name}_rotation": [pose and pose.rotation.ravel() for pose in poses],
    }


def _detection_columns(
    rows: Sequence[tuple[Perception, FrameRow]], categories: Sequence[str]
) -> dict[str, Any]:
    """Return the columns of the detections table, by name."""
    objects = [(p, row, k, d) for p, row in rows for k, d in enumerate(p.detections)]
    detections = [d for _, _, _, d in objects]
    candidates = [d.candidate for d in detections]
    return {
        "topic": [p.topic for p, *_ in objects],
        "frame": [p.index for p, *_ in objects],
        "stamp_ns": [p.stamp_ns for p, *_ in objects],
        "frame_id": [p.frame_id for p, *_ in objects],
        "detection": [k for _, _, k, _ in objects],
        "plane": [c.plane for c in candidates],
        "on_detection": [c.on_candidate for c in candidates],
        "touches_border": [c.touches_border for c in candidates],
        "occluded": [c.occluded for c in candidates],
        "center": [c.box.center for c in candidates],
        "size": [c.box.size for c in candidates],
        "orientation": [c.box.orientation for c in candidates],
        "center_full": [d.full and d.full.center for d in detections],
        "size_full": [d.full and d.full.size for d in detections],
        "orientation_full": [d.full and d.full.orientation for d in detections],
        "size_full_std": [d.full and d.full.size_std for d in detections],
        "outline_full": lists([d.full.outline if d.full else () for d in detections], pa.float32()),
        "center_fixed": [
            row.fixed_from_sensor and transform(row.fixed_from_sensor, d.candidate.box.center)
            for _, row, _, d in objects
        ],
        "height_m": [
            _height(p, c.plane, c.support_m, c.box.center)
            for (p, *_), c in zip(objects, candidates, strict=True)
        ],
        "points": [c.indices.size for c in candidates],
        "indices": lists([c.indices for c in candidates], pa.uint32()),
        "posterior": lists([d.posterior for d in detections], pa.float32()),
        "category": [d.category(categories) for d in detections],
        "confidence": [float(d.posterior.max()) for d in detections],
        "novelty": [d.novelty for d in detections],
        "reused_from": [d.reused_from for d in detections],
        "descriptor": lists([d.descriptor for d in detections], pa.float32()),
        "neurons": lists([d.gas.neurons for d in detections], pa.float32()),
        "edges": lists([d.gas.edges for d in detections], pa.uint16()),
        "seconds": [d.seconds for d in detections],
    }


def _height(perception: Perception, plane: int | None, support_m: float, center: Any) -> float:
    """Return the height of a centre above the object's support, metres; NaN without a plane.

    ``plane`` is the index of the plane; the support is ``support_m`` above it; ``center`` is (3,).
    """
    if plane is None:
        return float("nan")
    support = perception.scene.planes[plane]
    return float(support.normal @ center) - support.offset - support_m


def _plane_columns(perceptions: Iterable[Perception]) -> dict[str, Any]:
    """Return the columns of the planes table, by name."""
    planes = [(p, k, plane) for p in perceptions for k, plane in enumerate(p.scene.planes)]
    return {
        "topic": [p.topic for p, *_ in planes],
        "frame": [p.index for p, *_ in planes],
        "stamp_ns": [p.stamp_ns for p, *_ in planes],
        "plane": [k for _, k, _ in planes],
        "normal": [plane.normal for *_, plane in planes],
        "offset": [plane.offset for *_, plane in planes],
        "height_m": [plane.height_m for *_, plane in planes],
        "area_m2": [plane.area_m2 for *_, plane in planes],
        "outline": lists([plane.outline for *_, plane in planes], pa.float32()),
    }
