"""Tests of the warning about colour images that are far in time from their depth images."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import shapecat.pipeline
from shapecat.geometry import LINK_FROM_OPTICAL
from shapecat.pipeline import process
from shapecat.runs.jobs import Job
from shapecat.runs.perceive.colour_offsets import explain_colour_offsets
from shapecat.runs.tables.schemas import DETECTIONS, FRAMES, MASKS
from shapecat.simulation.containers import CONTAINERS
from tests.colour_messages import gradient, png
from tests.conftest import Guesser
from tests.messages import EPOCH, SECOND
from tests.scenes import OPTICAL, views

MS = SECOND // 1000


def write_tables(
    folder: Path, speed_m_s: float, offset_s: float, poses: str, object_speed_m_s: float = 0
) -> None:
    """Write the tables of a camera that drives past objects, with late colour images.

    Parameters
    ----------
    poses : poses in the tables: ``right``, ``none``, or ``still``, in a frame that moves along.
    object_speed_m_s : speed of the objects.
    """
    objects = np.array([[0.1, 0.3, 1.9], [0.8, -0.4, 1.2], [1.4, 0.1, 1.5]])
    rows = range(20)
    stamps = [EPOCH + k * SECOND // 10 for k in rows]
    late = [stamp + round(offset_s * SECOND) for stamp in stamps]
    fixed = [p + np.array([0.1 * k * object_speed_m_s, 0, 0]) for k in rows for p in objects]
    own = [np.array([0.1 * k * speed_m_s, 0, 0]) for k in rows for _ in objects]
    centers = [(p - q).tolist() for p, q in zip(fixed, own, strict=True)]
    placed: dict[str, list[Any]] = {
        "right": [p.tolist() for p in fixed],
        "none": [None] * len(fixed),
        "still": centers,
    }
    detected: dict[str, list[Any]] = {
        "frame": [k for k in rows for _ in objects],
        "center": centers,
        "center_fixed": placed[poses],
    }
    tables: tuple[tuple[str, Any, dict[str, list[Any]]], ...] = (
        ("frames", FRAMES, {"frame": [*rows], "stamp_ns": stamps}),
        ("detections", DETECTIONS, detected),
        ("masks", MASKS, {"frame": [*rows], "color_stamp_ns": late}),
    )
    for name, schema, columns in tables:
        count = len(columns["frame"])
        columns["topic"] = ["/depth"] * count
        filled = {field.name: columns.get(field.name, [None] * count) for field in schema}
        pq.write_table(pa.table(filled, schema), folder / f"{name}.parquet")


DISPLACED = (
    "/depth: in 20 of 20 frames, the colour image is up to {} s older or newer than the depth "
    "image; objects move by about {} m meanwhile, so that their masks are displaced; if it is the "
    "camera that moves, record transforms that give its motion"
)
FAR = (
    "/depth: in 20 of 20 frames, the colour image is up to {} s older or newer than the depth "
    "image; masks of objects that moved meanwhile are displaced"
)


@pytest.mark.parametrize(
    ("speed_m_s", "object_speed_m_s", "offset_s", "poses", "wanted"),
    [
        (0.3, 0, 0.2, "none", DISPLACED.format("0.20", "0.06")),
        (0.3, 0, -0.2, "none", DISPLACED.format("0.20", "0.06")),
        (0.3, 0, 0.2, "still", DISPLACED.format("0.20", "0.06")),
        (0, 0.4, 0.2, "right", DISPLACED.format("0.20", "0.08")),  # objects on a belt
        (0.3, 0, 0.02, "none", None),  # 6 mm
        (0, 0, 0.2, "none", None),
        (0.3, 0, 0.2, "right", None),  # masks are corrected
        (0.3, 0, 0.3, "right", FAR.format("0.30")),
        (0, 0, 0.3, "none", FAR.format("0.30")),
    ],
)
def test_displaced_masks_are_reported(
    tmp_path: Path,
    speed_m_s: float,
    object_speed_m_s: float,
    offset_s: float,
    poses: str,
    wanted: str | None,
) -> None:
    """Nothing else tells why a data set has masks beside its objects."""
    write_tables(tmp_path, speed_m_s, offset_s, poses, object_speed_m_s)

    assert list(explain_colour_offsets(tmp_path)) == ([] if wanted is None else [wanted])


def test_recording_without_transforms_says_that_its_masks_are_displaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The static transforms of a driver give poses, but these do not show that the camera moves."""
    link = [("camera_link", OPTICAL, LINK_FROM_OPTICAL)]
    monkeypatch.setattr(shapecat.pipeline, "load_model", lambda _path: Guesser())
    warnings = {}
    for name, offset in (("late", 150 * MS), ("same", 0)):
        source = tmp_path / f"{name}.mcap"
        with CONTAINERS["mcap"].open(source) as writer:
            for k, view in enumerate(views(17)[::4]):
                stamp = EPOCH + k * 300 * MS
                if k == 0:
                    still = writer.messages.transforms(link, stamp)
                    writer.write("/tf_static", still, stamp)
                depth = writer.messages.image(view.depth, stamp, OPTICAL)
                colours = png(gradient(120, 160))
                later = stamp + offset
                of_camera = writer.messages.camera_info(view.camera, stamp, OPTICAL)
                writer.write("/camera/depth/camera_info", of_camera, stamp)
                writer.write("/camera/depth/image_raw", depth, stamp)
                picture = writer.messages.compressed(colours, later, OPTICAL)
                writer.write("/camera/color/image_raw/compressed", picture, later)
        process(Job(source=source, folder=tmp_path / name, rrd=False, mcap=False))
        run = json.loads((tmp_path / name / "run.json").read_text())
        assert (run["counts"]["color"], run["fixed_frame"]) == (5, "camera_link")
        warnings[name] = [text for text in run["warnings"] if "colour image" in text]

    assert warnings["same"] == []
    (warning,) = warnings["late"]
    assert warning.startswith("/camera/depth/image_raw: in 5 of 5 frames, the colour image is up")
    assert "0.15 s older or newer" in warning
