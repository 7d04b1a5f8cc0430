"""Point labels: masks for depth images, SemanticKITTI labels for unorganized clouds.

A label is a class and an instance (the track number); 0 means no object. ``labels.json`` lists the
classes and the category of each instance. The binary format is that of SemanticKITTI (Behley 2019):
uint32 with the class in the lower and the instance in the upper 16 bits.
"""

import csv
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.arrays import F4, U2, U4
from shapecat.errors import OutputError
from shapecat.outputs.colouring import PairedFrame
from shapecat.outputs.colours import colour_of
from shapecat.outputs.png import png
from shapecat.runs.finished import FinishedRun
from shapecat.types import UNKNOWN, Frame, LabelledFrame

__all__ = ["write_point_labels"]

_LARGEST = 65535
_INDEX = ("number", "topic", "frame", "stamp_ns", "width", "height", "fx", "fy", "cx", "cy")


def write_point_labels(out: Path, frames: Iterable[PairedFrame], finished: FinishedRun) -> int:
    """Write the labels of all points; return the number of objects.

    Depth images give depth/ (millimetres), semantic/ and instance/ as 16-bit PNG. Clouds give
    velodyne/ (x, y, z and 0 for each point with depth, sensor frame), labels/ and
    semantic-kitti.yaml. Files are numbered; frames.csv lists the topic, frame and camera of each
    number.

    Raises
    ------
    OutputError : a track number does not fit in 16 bits.
    """
    if max(finished.labels, default=0) > _LARGEST:
        msg = f"{finished.folder}: has more than {_LARGEST} tracks; 16 bits cannot number them"
        raise OutputError(msg)
    classes = {name: k for k, name in enumerate((UNKNOWN, *finished.categories), start=1)}
    count, kinds = 0, set()
    with (out / "frames.csv").open("w", newline="", encoding="utf-8") as file:
        index = csv.writer(file, lineterminator="\n")
        index.writerow(_INDEX)
        for number, (labelled, frame, _) in enumerate(frames):
            index.writerow((f"{number:06d}", *_about(labelled, frame)))
            write = _write_masks if frame.organized else _write_cloud
            write(out, f"{number:06d}", frame, _labels(labelled, frame, classes))
            kinds.add(frame.organized)
            count += len(labelled.objects)
    instances = {label.track: label.category for label in finished.labels.values()}
    (out / "labels.json").write_text(_legend(classes, instances), "utf-8")
    if False in kinds:
        (out / "semantic-kitti.yaml").write_text(_yaml(classes), "utf-8")
    return count


def _about(labelled: LabelledFrame, frame: Frame) -> tuple[Any, ...]:
    camera = frame.camera
    lens = (
        ("",) * 6
        if camera is None
        else (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    )
    return (labelled.topic, labelled.index, labelled.stamp_ns, *lens)


def _labels(labelled: LabelledFrame, frame: Frame, classes: dict[str, int]) -> U4:
    """Return the labels (n,) of all pixels or points of a frame: class + 65536 * instance."""
    source = frame.depth if frame.depth is not None else frame.xyz()
    labels = np.zeros(source.size if frame.organized else len(source), np.uint32)
    for item in labelled.objects:
        labels[item.indices] = (item.track << 16) + classes[item.category]
    return labels


def _write_masks(out: Path, name: str, frame: Frame, labels: U4) -> None:
    depth = np.zeros((0, 0), np.float32) if frame.depth is None else frame.depth
    images = {
        "depth": depth_in_mm(depth),
        "semantic": (labels & 0xFFFF).reshape(depth.shape),
        "instance": (labels >> 16).reshape(depth.shape),
    }
    for folder, image in images.items():
        (out / folder).mkdir(exist_ok=True)
        (out / folder / f"{name}.png").write_bytes(png(image.astype(np.uint16), level=6))


def depth_in_mm(depth: F4) -> U2:
    """Convert a depth image (h, w) from metres to millimetres; beyond 65.535 m, depth is 0."""
    millimetres = np.round(depth.astype(np.float64) * 1000)
    return np.where(millimetres <= _LARGEST, millimetres, 0).astype(np.uint16)


def _write_cloud(out: Path, name: str, frame: Frame, labels: U4) -> None:
    points = frame.xyz()
    measured = np.isfinite(points).all(axis=1)
    rows = np.concatenate([points, np.zeros((len(points), 1))], axis=1)[measured]
    for folder in ("velodyne", "labels"):
        (out / folder).mkdir(exist_ok=True)
    rows.astype("<f4").tofile(out / "velodyne" / f"{name}.bin")
    labels[measured].astype("<u4").tofile(out / "labels" / f"{name}.label")


def _legend(classes: dict[str, int], instances: dict[int, str]) -> str:
    content = {
        "classes": {"0": "none", **{str(k): name for name, k in classes.items()}},
        "colours": {
            "0": [0, 0, 0],
            **{str(k): list(colour_of(name)) for name, k in classes.items()},
        },
        "instances": {str(track): name for track, name in sorted(instances.items())},
    }
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


def _yaml(classes: dict[str, int]) -> str:
    """Return the settings for the SemanticKITTI tools, with colours as blue, green, red."""
    names = {0: "none", **{k: name for name, k in classes.items()}}
    colours = {k: colour_of(name)[::-1] if k else (0, 0, 0) for k, name in names.items()}
    lines = ["name: shapecat", "labels:"]
    lines += [f"  {k}: {json.dumps(name, ensure_ascii=False)}" for k, name in names.items()]
    lines += ["color_map:", *(f"  {k}: {list(colour)}" for k, colour in colours.items())]
    lines += ["learning_map:", *(f"  {k}: {k}" for k in names)]
    lines += ["learning_map_inv:", *(f"  {k}: {k}" for k in names)]
    lines += ["learning_ignore:", *(f"  {k}: {json.dumps(k == 0)}" for k in names)]
    return "\n".join(lines) + "\n"
