"""Crops: each view of each object as a point cloud, in the folder layout of data sets.

The files are ``DATASET/<category>/<instance>/<view>.pcd``, in metres, with z up and the support at
z = 0. VIEWPOINT is the pose of the sensor.
"""

import math
import re
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import xxhash

from shapecat.errors import OutputError, explained
from shapecat.outputs.colouring import PairedFrame
from shapecat.outputs.level_clouds import upright_cloud, write_pcd
from shapecat.outputs.wording import different_names, safe_name
from shapecat.runs.finished import FinishedRun
from shapecat.system.files import holding

__all__ = ["Origin", "write_crops"]

_INSTANCE = re.compile(r".*\.([0-9a-f]{12})(?:\.([\d.]+)-([\d.]+|inf))?\.track-\d+", re.DOTALL)
"""Name of an instance that is from a run: the run, its `Origin`, and the track."""
_LONGEST_NAME = 255
"""Maximum length of a folder name, bytes: enough for a category of 60 characters in any script."""


class Origin(NamedTuple):
    """Source and time range of the views of a run, independent of the name of the run.

    Comparing origins shows which views in a data set may be from the same frames. ``source`` is a
    digest of the recording and the topics. ``start_s`` and ``end_s`` (exclusive, or infinite) are
    in seconds after the start of the recording.
    """

    source: str
    start_s: float
    end_s: float

    @classmethod
    def of(cls, finished: FinishedRun) -> "Origin":
        """Return the origin of the views of a run."""
        options = finished.info["options"]
        source = "\0".join([finished.info["input"]["digest"], *sorted(options["topics"])])
        start, end = options.get("start_s"), options.get("end_s")
        digest = xxhash.xxh3_64_hexdigest(source.encode())[:12]
        # Rounded as in the name of an instance, so that a run includes its own earlier views.
        return cls(digest, round(start or 0.0, 3), math.inf if end is None else round(end, 3))

    @classmethod
    def read(cls, instance: str) -> "Origin | None":
        """Return the origin in the folder name of an instance; None if it is not from a run."""
        if match := _INSTANCE.fullmatch(instance):
            return cls(match[1], float(match[2] or 0), float(match[3] or "inf"))
        return None

    def shares_frames(self, other: "Origin") -> bool:
        """Return whether views of both origins may be from the same frames."""
        begin, end = max(self.start_s, other.start_s), min(self.end_s, other.end_s)
        return self.source == other.source and begin < end

    def includes(self, other: "Origin") -> bool:
        """Return whether the time range includes that of another origin."""
        return self.start_s <= other.start_s and other.end_s <= self.end_s

    def __str__(self) -> str:
        is_whole = (self.start_s, self.end_s) == (0, math.inf)
        return self.source if is_whole else f"{self.source}.{self.start_s:.3f}-{self.end_s:.3f}"


def write_crops(out: Path, frames: Iterable[PairedFrame], finished: FinishedRun) -> int:
    """Add the views of a run to a data set; return their number.

    Earlier views of the same topics of the recording are replaced if the run covers their time
    range, even if their run had another name. No view then has an outdated label or occurs twice.
    Deleted tracks are left out; ``unknown`` is a category like any other.

    Raises
    ------
    OutputError : ``out`` is not writable, or holds views of a time range covered only in part.
    """
    with explained(f"{out}: cannot be written", OutputError):
        out.mkdir(parents=True, exist_ok=True)
    with holding(out):  # exports at the same time would not see each other's views
        return _write_views(out, frames, finished)


def _write_views(out: Path, frames: Iterable[PairedFrame], finished: FinishedRun) -> int:
    """Do the work of `write_crops`, while no other export writes to ``out``."""
    origin = Origin.of(finished)
    earlier = _earlier_views(out, origin)
    prefix = f"{safe_name(finished.name)}.{origin}"
    hidden = out / f".{prefix}.partial"
    topics = finished.info["options"]["topics"]
    names = dict(zip(topics, different_names(topics), strict=True))
    count = 0
    try:
        with explained(f"{out}: cannot be written", OutputError):
            shutil.rmtree(hidden, ignore_errors=True)
            for labelled, frame, _ in frames:
                for item in labelled.objects:
                    cloud = upright_cloud(labelled, frame, item)
                    if cloud is None:
                        continue
                    category = safe_name(item.category, _LONGEST_NAME)
                    instance = hidden / category / f"{prefix}.track-{item.track}"
                    instance.mkdir(parents=True, exist_ok=True)
                    stem = f"{names[labelled.topic]}." if len(names) > 1 else ""
                    view = instance / f"{stem}{labelled.index:06d}.pcd"
                    write_pcd(view, cloud[0], viewpoint=cloud[1])
                    count += 1
            _replace(out, earlier, hidden)
    finally:
        shutil.rmtree(hidden, ignore_errors=True)
    return count


def _earlier_views(out: Path, origin: Origin) -> list[Path]:
    """Return the folders of the instances that a new export of the same frames replaces.

    Raises
    ------
    OutputError : an instance also has views of frames that the new export lacks.
    """
    found = [(old, Origin.read(old.name)) for old in out.glob("[!.]*/*.track-*")]
    shared = [(old, earlier) for old, earlier in found if earlier and earlier.shares_frames(origin)]
    for old, earlier in shared:
        if not origin.includes(earlier):
            msg = (
                f"{old}: has views of another time range of this recording; choose another --out, "
                "or move them away"
            )
            raise OutputError(msg)
    return [old for old, _ in shared]


def _replace(out: Path, earlier: Sequence[Path], hidden: Path) -> None:
    for old in earlier:
        shutil.rmtree(old)
        if not any(old.parent.iterdir()):
            old.parent.rmdir()
    for instance in sorted(hidden.glob("*/*")):
        place = out / instance.parent.name / instance.name
        place.parent.mkdir(parents=True, exist_ok=True)
        instance.rename(place)
