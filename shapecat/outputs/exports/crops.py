"""Crops: each view of each object as a point cloud, in the folder layout of data sets.

``DATASET/<category>/<instance>/<view>.pcd``: metres, z up, the support at z = 0; VIEWPOINT is the
pose of the sensor.
"""

import glob
import shutil
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import xxhash

from shapecat.errors import OutputError, explained
from shapecat.outputs.colouring import ExportedFrame
from shapecat.outputs.level_clouds import upright_cloud, write_pcd
from shapecat.outputs.wording import different_names, safe_name
from shapecat.runs.finished import FinishedRun

__all__ = ["crops_prefix", "write_crops"]


def write_crops(out: Path, frames: Iterable[ExportedFrame], finished: FinishedRun) -> int:
    """Add the views of a run to a data set; return their number.

    Earlier views of the same topics of the recording are replaced, so that none keeps an outdated
    label. Deleted tracks are left out; ``unknown`` is a category like any other.

    Raises
    ------
    OutputError : ``out`` is not writable.
    """
    prefix = crops_prefix(finished)
    hidden = out / f".{prefix}.partial"
    topics = finished.run["options"]["topics"]
    names = dict(zip(topics, different_names(topics), strict=True))
    count, new = 0, not out.exists()
    try:
        with explained(f"{out}: cannot be written", OutputError):
            shutil.rmtree(hidden, ignore_errors=True)
            for labelled, frame, _ in frames:
                for item in labelled.objects:
                    cloud = upright_cloud(labelled, frame, item)
                    if cloud is None:
                        continue
                    instance = hidden / safe_name(item.category) / f"{prefix}.track-{item.track}"
                    instance.mkdir(parents=True, exist_ok=True)
                    stem = f"{names[labelled.topic]}." if len(names) > 1 else ""
                    view = instance / f"{stem}{labelled.index:06d}.pcd"
                    write_pcd(view, cloud[0], viewpoint=cloud[1])
                    count += 1
            _replace(out, prefix, hidden)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
        if new:
            with suppress(OSError):  # not empty, unless writing has failed
                out.rmdir()
    return count


def crops_prefix(finished: FinishedRun) -> str:
    """Return how the names of the views of a run begin.

    A digest distinguishes runs of the same name: of other recordings, or of other topics.
    """
    run = finished.run
    source = "\0".join([run["input"]["digest"], *sorted(run["options"]["topics"])])
    return f"{safe_name(finished.name)}.{xxhash.xxh3_64_hexdigest(source.encode())[:8]}"


def _replace(out: Path, prefix: str, hidden: Path) -> None:
    for old in out.glob(f"*/{glob.escape(prefix)}.track-*"):
        shutil.rmtree(old)
        if not any(old.parent.iterdir()):
            old.parent.rmdir()
    for instance in sorted(hidden.glob("*/*")):
        place = out / instance.parent.name / instance.name
        place.parent.mkdir(parents=True, exist_ok=True)
        instance.rename(place)
