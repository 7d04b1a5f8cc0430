"""Tests of image data sets read back by other libraries, and of the export options."""

import json
import shutil
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from shapecat.outputs.exports.dataset_frames import ImageSelection
from shapecat.outputs.exports.formats import export_dataset
from shapecat.runs.finished import read_finished
from tests.test_exports import relabel
from tests.test_exports_images import decoded, read_coco

pytestmark = pytest.mark.usefixtures("snapped_once")

Run = Callable[..., Result]
RUNS = 5


@pytest.fixture(scope="module")
def runs(coloured_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of runs of five recordings; in each run, one track is corrected."""
    folder = tmp_path_factory.mktemp("runs")
    for k in range(RUNS):
        shutil.copytree(coloured_run, folder / f"lab{k}")
        relabel(folder / f"lab{k}", {2: "wine glass"})
        info = json.loads((folder / f"lab{k}/run.json").read_text())
        info["input"]["digest"] = f"xxh3-128:{k}"
        (folder / f"lab{k}/run.json").write_text(json.dumps(info))
    return folder


@pytest.fixture(scope="module")
def coco(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a data set with certain and uncertain labels."""
    out = tmp_path_factory.mktemp("readback") / "coco"
    export_dataset([read_finished(runs / "lab0")], "coco", out, ImageSelection(corrected_only=True))
    return out


@pytest.fixture
def supervision() -> Iterator[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns on import
        yield import_module("supervision")


def export(shapecat: Run, runs: Path, out: Path, *options: str) -> None:
    result = shapecat("export", runs, "--out", out, *options)
    assert result.exit_code == 0, result.output


def rows(out: Path) -> list[dict[str, Any]]:
    """Return the annotations of both splits."""
    return [row for split in ("train", "val") for row in read_coco(out, split)["annotations"]]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of its compiled part
def test_coco_api_reads_masks_boxes_ids_and_crowds(coco: Path) -> None:
    read = import_module("pycocotools.coco").COCO(str(coco / "annotations/instances_train.json"))
    rle = import_module("pycocotools.mask")
    data = read_coco(coco)

    assert sorted(read.getImgIds()) == sorted(image["id"] for image in data["images"])
    assert len(read.getAnnIds()) == len(data["annotations"])
    crowds = set(read.getAnnIds(iscrowd=True))
    assert crowds == {row["id"] for row in data["annotations"] if row["iscrowd"]}
    assert 0 < len(crowds) < len(data["annotations"])
    (glass,) = read.getCatIds(catNms=["wine glass"])
    assert set(read.getAnnIds(catIds=[glass])) == set(read.getAnnIds(iscrowd=False))
    for row in read.loadAnns(read.getAnnIds()):
        np.testing.assert_array_equal(read.annToMask(row) > 0, decoded(row["segmentation"]))
        assert rle.area(read.annToRLE(row)) == row["area"]
        assert rle.toBbox(read.annToRLE(row)).tolist() == row["bbox"]


def test_supervision_reads_coco(coco: Path, supervision: Any) -> None:
    data = read_coco(coco)
    read = supervision.DetectionDataset.from_coco(
        str(coco / "images/train"), str(coco / "annotations/instances_train.json"), force_masks=True
    )

    names = {row["id"]: row["name"] for row in data["categories"]}
    by_image = {image["file_name"]: image["id"] for image in data["images"]}
    assert len(read) == len(by_image)
    for path, pixels, found in read:
        wanted = [r for r in data["annotations"] if r["image_id"] == by_image[Path(path).name]]
        assert pixels.shape == (720, 960, 3)
        assert [read.classes[k] for k in found.class_id] == [
            names[row["category_id"]] for row in wanted
        ]
        for row, box, mask in zip(wanted, found.xyxy, found.mask, strict=True):
            left, top, width, height = row["bbox"]
            np.testing.assert_allclose(box, [left, top, left + width, top + height])
            np.testing.assert_array_equal(mask, decoded(row["segmentation"]))


def test_supervision_reads_yolo(runs: Path, tmp_path: Path, supervision: Any) -> None:
    """YOLO polygons cover the COCO masks of the same objects."""
    export_dataset([read_finished(runs / "lab0")], "yolo", tmp_path / "yolo", ImageSelection())
    export_dataset([read_finished(runs / "lab0")], "coco", tmp_path / "coco", ImageSelection())
    data = read_coco(tmp_path / "coco")
    names = {row["id"]: row["name"] for row in data["categories"]}
    read = supervision.DetectionDataset.from_yolo(
        str(tmp_path / "yolo/images/train"),
        str(tmp_path / "yolo/labels/train"),
        str(tmp_path / "yolo/data.yaml"),
        force_masks=True,
    )

    by_image = {image["file_name"]: image["id"] for image in data["images"]}
    assert len(read) == len(by_image) > 0
    for path, _, found in read:
        wanted = [r for r in data["annotations"] if r["image_id"] == by_image[Path(path).name]]
        classes = [read.classes[k] for k in found.class_id]
        assert classes == [names[row["category_id"]] for row in wanted]
        for row, mask in zip(wanted, found.mask, strict=True):
            true = decoded(row["segmentation"])
            assert (mask & true).sum() / (mask | true).sum() > 0.9


def test_folder_of_runs_becomes_data_set_split_by_recording(
    runs: Path, tmp_path: Path, shapecat: Run
) -> None:
    export(shapecat, runs, tmp_path / "out", "--format", "coco", "--val", "0.4")
    recordings = [
        {image["recording"] for image in read_coco(tmp_path / "out", split)["images"]}
        for split in ("train", "val")
    ]

    assert [len(found) for found in recordings] == [3, 2]
    assert set.union(*recordings) == {f"lab{k}" for k in range(RUNS)}
    for split, found in zip(("train", "val"), recordings, strict=True):
        files = [file.name for file in (tmp_path / "out/images" / split).iterdir()]
        assert {name.partition("_")[0] for name in files} == found
        assert len(files) == len(read_coco(tmp_path / "out", split)["images"])


def test_command_options_select_frames_and_labels(
    runs: Path, tmp_path: Path, shapecat: Run
) -> None:
    for name in ("lab0", "lab1"):
        shutil.copytree(runs / name, tmp_path / "two" / name)
    found = {}
    options = {
        "all": (),
        "every": ("--every", "2"),
        "track": ("--per-track", "1"),
        "sure": ("--min-confidence", "0.99"),
        "corrected": ("--corrected-only",),
    }
    for name, chosen in options.items():
        export(
            shapecat, tmp_path / "two", tmp_path / name, "--format", "coco", "--val", "0.5", *chosen
        )
        found[name] = rows(tmp_path / name)
    images = {
        name: sum(len(read_coco(tmp_path / name, split)["images"]) for split in ("train", "val"))
        for name in options
    }

    assert images["every"] == images["all"] / 2
    assert 2 <= images["track"] < images["all"]
    assert {r["attributes"]["track"] for r in found["track"]} == {
        r["attributes"]["track"] for r in found["all"]
    }
    assert not any(row["iscrowd"] for row in found["all"])
    for row in found["sure"]:
        assert row["iscrowd"] == (row["score"] < 0.99 and row["attributes"]["track"] != 2)
    for row in found["corrected"]:
        assert row["iscrowd"] == (row["attributes"]["track"] != 2)
