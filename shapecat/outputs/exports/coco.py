"""Data sets of images with instance masks: COCO, and YOLO segmentation labels.

Source: the data format of the COCO challenge (Lin et al. 2014); the label files of Ultralytics
YOLO, with a line per object: class, then x and y of each corner, relative to the image size.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from shapecat.colour.outline import joined, outlines
from shapecat.colour.rle import rle_counts, rle_text
from shapecat.outputs.exports.dataset_frames import DatasetImage
from shapecat.runs.finished import FinishedRun
from shapecat.types import LabelledObject

__all__ = ["DATASETS", "write_coco", "write_yolo"]

Images = Iterable[tuple[str, FinishedRun, DatasetImage]]
"""Images, each with its split (``train`` or ``val``) and its run."""


def write_coco(out: Path, images: Images, categories: Sequence[str]) -> int:
    """Write images/SPLIT/ and annotations/instances_SPLIT.json; return the number of objects.

    Masks are compressed run lengths. Objects without a reliable label have ``iscrowd`` set, so
    that evaluation ignores them, and are not counted. ``track_id`` is unique in the data set.
    ``attributes`` holds the run, the track number in that run, ``occluded`` (another object hides a
    part) and ``truncated`` (the border of the depth image cuts the object, and thus its mask).
    """
    tracks: dict[tuple[str, int], int] = {}
    splits: dict[str, dict[str, list[dict[str, Any]]]] = {}
    count = 0
    for split, finished, image in images:
        part = splits.setdefault(split, {"images": [], "annotations": []})
        folder = out / "images" / split
        folder.mkdir(parents=True, exist_ok=True)
        (folder / image.name).write_bytes(image.contents)
        number = len(part["images"]) + 1
        part["images"].append(_coco_image(number, finished, image))
        for item, mask, sure in image.objects:
            track = tracks.setdefault((str(finished.folder), item.track), len(tracks) + 1)
            size = [image.height, image.width]
            annotation = {
                "id": len(part["annotations"]) + 1,
                "image_id": number,
                "category_id": categories.index(item.category) + 1,
                "bbox": list(map(float, mask.box)),
                "area": float(mask.area),
                "segmentation": {"size": size, "counts": rle_text(rle_counts(mask, *size))},
                "iscrowd": int(not sure),
                "track_id": track,
                "score": round(item.confidence, 4),
                "attributes": _attributes(finished, item),
            }
            part["annotations"].append(annotation)
            count += sure
    _write_splits(out / "annotations", splits, categories)
    return count


def _coco_image(number: int, finished: FinishedRun, image: DatasetImage) -> dict[str, Any]:
    labelled = image.labelled
    return {
        "id": number,
        "file_name": image.name,
        "width": image.width,
        "height": image.height,
        "recording": finished.name,
        "digest": finished.info["input"]["digest"],
        "topic": labelled.topic,
        "frame": labelled.index,
        "stamp_ns": labelled.stamp_ns,
    }


def _attributes(finished: FinishedRun, item: LabelledObject) -> dict[str, Any]:
    return {
        "run": finished.name,
        "track": item.track,
        "occluded": item.occluded,
        "truncated": item.touches_border,
    }


def _write_splits(
    folder: Path, splits: Mapping[str, Mapping[str, Any]], categories: Sequence[str]
) -> None:
    """Write instances_SPLIT.json with the images and annotations of each split."""
    named = [{"id": k, "name": name, "supercategory": ""} for k, name in enumerate(categories, 1)]
    folder.mkdir(exist_ok=True)
    for split, part in splits.items():
        content = {"info": {"description": "shapecat"}, "licenses": [], "categories": named, **part}
        (folder / f"instances_{split}.json").write_text(json.dumps(content), "utf-8")


def write_yolo(out: Path, images: Images, categories: Sequence[str]) -> int:
    """Write images/SPLIT/, labels/SPLIT/ and data.yaml; return the number of objects.

    The format allows one polygon per object: the parts of an object are linked, and holes are
    filled. Objects without a reliable label are left out.
    """
    count, splits = 0, set()
    for split, _, image in images:
        splits.add(split)
        for folder in (out / "images" / split, out / "labels" / split):
            folder.mkdir(parents=True, exist_ok=True)
        (out / "images" / split / image.name).write_bytes(image.contents)
        lines = []
        for item, mask, sure in image.objects:
            if sure:
                polygon = joined(outlines(mask)) / (image.width, image.height)
                numbers = " ".join(f"{value:.6f}" for value in polygon.ravel())
                lines.append(f"{categories.index(item.category)} {numbers}\n")
        label = (out / "labels" / split / image.name).with_suffix(".txt")
        label.write_text("".join(lines), "utf-8")
        count += len(lines)
    names = [f"  {k}: {json.dumps(name, ensure_ascii=False)}" for k, name in enumerate(categories)]
    val = "val" if "val" in splits else "train"
    # Without "path", the paths are relative to data.yaml, wherever training is started.
    about = ["train: images/train", f"val: images/{val}", "names:", *names]
    (out / "data.yaml").write_text("\n".join(about) + "\n", "utf-8")
    return count


DATASETS = {"coco": write_coco, "yolo": write_yolo}
"""The writer of each format that merges several runs into one data set."""
