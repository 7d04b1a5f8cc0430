"""The columns of the Parquet tables of a run folder.

A run folder holds ``frames``, ``detections``, ``planes`` and, with colour images, ``masks``
(written by perceive), and ``tracks`` (written by track). Within a schema version, columns may be
added, but the meaning of a column must not change.
"""

import pyarrow as pa

__all__ = [
    "BOX_WIDTH",
    "DETECTIONS",
    "FIXED_LISTS",
    "FRAMES",
    "FRAME_COLUMNS",
    "FULL_BOX",
    "FULL_WIDTHS",
    "MASKS",
    "MAY_BE_NULL",
    "PERCEIVED",
    "PLANES",
    "SCHEMA_VERSION",
    "TABLES",
    "TRACKS",
]

SCHEMA_VERSION = "1"

_VEC3 = pa.list_(pa.float32(), 3)
_POSITION = pa.list_(pa.float64(), 3)
"""A position in the fixed frame, whose origin may be thousands of kilometres away."""
_ROTATION = pa.list_(pa.float64(), 9)
_QUATERNION = pa.list_(pa.float32(), 4)
_FLOATS = pa.list_(pa.float32())
_FULL = (
    ("center_full", _VEC3),
    ("size_full", _VEC3),
    ("orientation_full", _QUATERNION),
    ("size_full_std", _VEC3),
)

FULL_WIDTHS = {name: kind.list_size for name, kind in _FULL}
"""The columns of full boxes, and the number of values in each."""
FULL_BOX = ("center_full", "size_full", "orientation_full")
"""Columns of the box itself: centre and size in metres, and a quaternion, in the sensor frame."""
MAY_BE_NULL = (
    "up_given",
    *(f"{frame}_{part}" for frame in ("fixed", "frame") for part in ("translation", "rotation")),
    "center_fixed",
    *FULL_WIDTHS,
)
"""Columns with lists of fixed size that may be null."""
BOX_WIDTH = sum(FULL_WIDTHS[name] for name in FULL_BOX)
"""Number of values in `FULL_BOX`."""
FRAME_COLUMNS = (("topic", pa.string()), ("frame", pa.int32()), ("stamp_ns", pa.int64()))
"""Columns that identify a frame: topic, number on that topic, and stamp."""

FRAMES = pa.schema(
    [
        *FRAME_COLUMNS,
        ("log_time_ns", pa.int64()),
        ("frame_id", pa.string()),
        ("up", _VEC3),
        ("up_given", _VEC3),
        ("revised", pa.bool_()),
        ("reused_from", pa.int32()),
        ("fixed_translation", _POSITION),
        ("fixed_rotation", _ROTATION),
        ("frame_translation", _POSITION),
        ("frame_rotation", _ROTATION),
        ("stages", pa.list_(pa.string())),
        ("seconds", _FLOATS),
    ]
)
"""One row per frame read, even without detections. ``up`` is the up direction that detection used;
``up_given`` is from transforms, an IMU or an option, null without these. ``revised`` is true if
the phase *revise* replaced the result. ``reused_from`` is the number of the earlier frame whose
scene this one repeats, null if none. ``fixed_*`` is ``fixed_from_sensor`` (rotation row by row),
null if unknown; ``frame_*`` is ``frame_from_sensor``, null if ``frame_id`` is the frame of the
sensor. ``seconds`` has one entry per entry of ``stages``."""

DETECTIONS = pa.schema(
    [
        *FRAME_COLUMNS,
        ("frame_id", pa.string()),
        ("detection", pa.int32()),
        ("plane", pa.int16()),
        ("on_detection", pa.int32()),
        ("touches_border", pa.bool_()),
        ("occluded", pa.bool_()),
        ("center", _VEC3),
        ("size", _VEC3),
        ("orientation", _QUATERNION),
        ("center_fixed", _POSITION),
        *_FULL,
        ("outline_full", _FLOATS),
        ("height_m", pa.float32()),
        ("points", pa.int32()),
        ("indices", pa.list_(pa.uint32())),
        ("posterior", _FLOATS),
        ("category", pa.string()),
        ("confidence", pa.float32()),
        ("novelty", pa.float32()),
        ("reused_from", pa.int32()),
        ("descriptor", _FLOATS),
        ("neurons", _FLOATS),
        ("edges", pa.list_(pa.uint16())),
        ("seconds", pa.float32()),
    ]
)
"""One row per object per frame; lengths in metres, ``center`` and ``neurons`` in the sensor frame.
``*_full`` is the box of the whole object, null if only the visible part is known. The columns
``posterior`` to ``edges`` are copied from the frame ``reused_from``, unless that is null."""

PLANES = pa.schema(
    [
        *FRAME_COLUMNS,
        ("plane", pa.int16()),
        ("normal", _VEC3),
        ("offset", pa.float32()),
        ("height_m", pa.float32()),
        ("area_m2", pa.float32()),
        ("outline", _FLOATS),
    ]
)
"""One row per supporting plane per frame, with the values of a `Plane`; ``outline`` is x, y, z of
each corner in turn."""

TRACKS = pa.schema(
    [
        ("track", pa.int32()),
        *FRAME_COLUMNS,
        ("detection", pa.int32()),
        ("center_fixed", _POSITION),
        *_FULL,
        ("posterior", _FLOATS),
    ]
)
"""One row per track per frame; ``detection`` is null while the track coasts; ``posterior`` is
causal. ``center_fixed`` is in the fixed frame, or the sensor frame if there is none.
``center_full`` and ``orientation_full`` are in the sensor frame, null while the track coasts."""

MASKS = pa.schema(
    [
        ("topic", pa.string()),
        ("frame", pa.int32()),
        ("color_topic", pa.string()),
        ("color_stamp_ns", pa.int64()),
        ("color_log_time_ns", pa.int64()),
        ("color_frame_id", pa.string()),
        ("width", pa.int32()),
        ("height", pa.int32()),
        ("detection", pa.list_(pa.int32())),
        ("box", pa.list_(pa.int32())),
        ("counts", pa.list_(pa.list_(pa.uint32()))),
    ]
)
"""One row per frame that has a colour image: the size of the image, and for each detection visible
in it the box (left, top, width, height; pixels) and the run lengths of the mask."""

PERCEIVED = {"frames": FRAMES, "detections": DETECTIONS, "planes": PLANES, "masks": MASKS}
"""The tables of perceive; recordings without colour have no masks."""
TABLES = {**PERCEIVED, "tracks": TRACKS}
"""The tables of a run, by name."""
FIXED_LISTS = {
    field.name: field.type
    for schema in TABLES.values()
    for field in schema
    if pa.types.is_fixed_size_list(field.type)
}
"""The types of all columns with lists of fixed size."""
