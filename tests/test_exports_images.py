"""Tests of image data sets, read back as training code reads them."""

import csv
import io
import json
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import Result
from PIL import Image, ImageDraw

from shapecat.colour.image_masks import mask_of
from shapecat.colour.masks import Mask
from shapecat.colour.outline import joined, outlines
from shapecat.errors import OutputError
from shapecat.outputs.exports.dataset_frames import ImageSelection
from shapecat.outputs.exports.formats import export_dataset, export_run
from shapecat.recordings import MessageError
from shapecat.recordings.decoding.colour_image import pixels_of
from shapecat.runs.finished import read_finished
from tests.kitti_files import read_calibration, read_labels
from tests.mcap_files import read_ros
from tests.test_colour_outputs import IMAGES
from tests.test_exports import relabel
from tests.track_tables import read_masks

pytestmark = pytest.mark.usefixtures("snapped_once")

Run = Callable[..., Result]
BAND_PX = 6
"""Outlines may move by three pixels of the depth image, and corners a little more."""


@pytest.fixture(scope="module")
def run(coloured_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a corrected run: track 1 is deleted, 2 is a `wine glass`, a new category."""
    folder = tmp_path_factory.mktemp("corrected") / "table"
    shutil.copytree(coloured_run, folder)
    relabel(folder, {1: "delete", 2: "wine glass"})
    return folder


def read_coco(out: Path, split: str = "train") -> dict[str, Any]:
    found: dict[str, Any] = json.loads((out / f"annotations/instances_{split}.json").read_text())
    return found


def decoded(segmentation: dict[str, Any]) -> np.ndarray:
    """Return the mask (height, width) of run lengths, decoded as COCO's rleFrString does."""
    counts: list[int] = []
    letters = iter(segmentation["counts"])
    for letter in letters:
        number, shift, value = 0, 0, ord(letter) - 48
        while True:
            number |= (value & 31) << shift
            shift += 5
            if not value & 32:
                break
            value = ord(next(letters)) - 48
        if value & 16:
            number -= 1 << shift
        counts.append(number + (counts[-2] if len(counts) > 2 else 0))
    height, width = segmentation["size"]
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    return flat.reshape(width, height).T


def test_coco_has_original_images_and_masks_of_tracks(run: Path, tmp_path: Path) -> None:
    count = export_dataset([read_finished(run)], "coco", tmp_path / "out", ImageSelection()).objects

    data = read_coco(tmp_path / "out")
    names = {c["id"]: c["name"] for c in data["categories"]}
    assert "wine glass" in names.values()
    assert min(names) == 1
    source = Path(read_finished(run).info["input"]["path"])
    files = [tmp_path / "out/images/train" / image["file_name"] for image in data["images"]]
    assert [f.read_bytes() for f in files] == [bytes(m.data) for _, m in read_ros(source, IMAGES)]
    assert all(
        np.asarray(Image.open(io.BytesIO(f.read_bytes()))).shape == (720, 960, 3) for f in files
    )
    tracks = {row["attributes"]["track"]: names[row["category_id"]] for row in data["annotations"]}
    assert 1 not in tracks
    assert tracks[2] == "wine glass"
    assert len(data["annotations"]) == count > 12
    # pycocotools takes a match with an annotation of id 0 for no match.
    assert sorted(row["id"] for row in data["annotations"]) == list(range(1, count + 1))
    wanted = {frame: masks for (_, frame), masks in read_masks(run)}
    frames = {image["id"]: image["frame"] for image in data["images"]}
    for row in data["annotations"]:
        mask = decoded(row["segmentation"])
        v, u = np.nonzero(mask)
        box = [u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1]
        assert row["bbox"] == box
        assert row["area"] == mask.sum()
        assert side_difference(box, wanted[frames[row["image_id"]]].boxes.values()) <= BAND_PX
        assert row["iscrowd"] == 0


def side_difference(box: list[int], others: Iterable[tuple[int, int, int, int]]) -> int:
    """Return the largest distance, px, of a side of a box (x, y, w, h) from the nearest other."""
    sides = np.add(box, [0, 0, *box[:2]])
    return min(int(np.abs(np.add(o, [0, 0, *o[:2]]) - sides).max()) for o in others)


def test_exported_masks_follow_colour_edges(coloured_run: Path, tmp_path: Path) -> None:
    """Models learn the outlines of masks; those from depth alone are off by a pixel or two."""
    export_dataset([read_finished(coloured_run)], "coco", tmp_path / "out", ImageSelection())
    true = np.load(coloured_run.parents[1] / "table.color_labels.npz")["labels"]
    data = read_coco(tmp_path / "out")
    frames = {image["id"]: image["frame"] for image in data["images"]}
    depth_masks = {frame: masks for (_, frame), masks in read_masks(coloured_run)}
    overlaps = []
    for row in data["annotations"]:
        frame, mask = frames[row["image_id"]], decoded(row["segmentation"])
        true_mask = np.bincount(true[frame][mask])[20:].argmax() + 20 == true[frame]
        depth = depth_masks[frame]
        pairs = [
            (side_difference(row["bbox"], [box]), mask_of(depth, [n]).full(*mask.shape))
            for n, box in depth.boxes.items()
        ]
        before = min(pairs, key=lambda pair: pair[0])[1]
        overlaps.append([(m & true_mask).sum() / (m | true_mask).sum() for m in (before, mask)])
    before, after = np.mean(overlaps, axis=0)
    assert after > max(0.92, before + 0.015)


def test_uncertain_labels_are_crowds_but_corrected_ones_are_not(run: Path, tmp_path: Path) -> None:
    """Training must neither learn a wrong label nor take the object for background."""
    export_dataset(
        [read_finished(run)], "coco", tmp_path / "out", ImageSelection(corrected_only=True)
    )
    data = read_coco(tmp_path / "out")
    certain = {row["attributes"]["track"] for row in data["annotations"] if not row["iscrowd"]}
    assert certain == {2}
    assert sum(row["iscrowd"] for row in data["annotations"]) > 5

    export_dataset(
        [read_finished(run)], "coco", tmp_path / "out", ImageSelection(min_confidence=1.0)
    )
    data = read_coco(tmp_path / "out")
    assert {r["attributes"]["track"] for r in data["annotations"] if not r["iscrowd"]} == {2}


@pytest.mark.parametrize("kind", ["coco", "yolo"])
def test_export_warns_about_missing_validation_and_labels(
    run: Path, tmp_path: Path, shapecat: Run, kind: str
) -> None:
    """A model without validation images, or one that learns to overlook objects, seems fine."""
    export_dataset(
        [read_finished(run)], "coco", tmp_path / "all", ImageSelection(corrected_only=True)
    )
    data = read_coco(tmp_path / "all")
    crowds = sum(row["iscrowd"] for row in data["annotations"])
    options = ("--format", kind, "--out", tmp_path / "out")
    done = shapecat("export", run, *options, "--corrected-only")

    why = "all frames of a recording go to the same split; export more recordings, or "
    line = f"{len(data['images'])} images in train, 0 in val: {why}raise --val if there are several"
    assert done.stdout.splitlines()[1:] == [line]
    warning = f"Warning: a model will learn {crowds} visible objects without a reliable label as"
    assert (warning in done.stderr) == (kind == "yolo")
    assert shapecat("export", run, *options).stderr == ""


def test_yolo_polygons_cover_masks(run: Path, tmp_path: Path) -> None:
    """Classes count from 0, and corners are fractions of the image: both are easy to get wrong."""
    export_dataset([read_finished(run)], "yolo", tmp_path / "yolo", ImageSelection())
    export_dataset([read_finished(run)], "coco", tmp_path / "coco", ImageSelection())
    data = read_coco(tmp_path / "coco")
    names = {c["id"]: c["name"] for c in data["categories"]}
    text = (tmp_path / "yolo/data.yaml").read_text()
    for number, name in names.items():
        assert f'  {number - 1}: "{name}"\n' in text
    assert "val: images/train\n" in text  # the key is required
    for image in data["images"]:
        label = (tmp_path / "yolo/labels/train" / image["file_name"]).with_suffix(".txt")
        rows = [r for r in data["annotations"] if r["image_id"] == image["id"]]
        for line, row in zip(label.read_text().splitlines(), rows, strict=True):
            number, *shares = line.split()
            assert int(number) == row["category_id"] - 1
            corners = np.array(list(map(float, shares))).reshape(-1, 2)
            assert corners.min() >= 0
            assert corners.max() <= 1
            mask, drawn = decoded(row["segmentation"]), filled(corners * (960, 720), 720, 960)
            assert (mask & drawn).sum() / (mask | drawn).sum() > 0.93


def filled(corners: Any, height: int, width: int) -> Any:
    """Return the pixels (height, width) that are more than half inside a polygon (n, 2)."""
    image = Image.new("L", (4 * width, 4 * height))
    ImageDraw.Draw(image).polygon([tuple(4 * corner) for corner in corners], fill=16)
    return np.asarray(image.reduce(4)) > 8  # the number of filled sixteenths of each pixel


def test_outlines_enclose_all_pixels() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        pixels = np.pad(rng.random((12, 17)) < 0.4, 2)
        pixels[0, :] = pixels[-1, :] = pixels[:, 0] = True
        coarse = np.kron(pixels, np.ones((2, 2), bool))  # every corner sticks out by 1.4 pixels
        image = np.zeros((70, 60), bool)
        for part in outlines(Mask(60, 100, coarse)):
            assert part.min(axis=0).tolist() >= [60, 100]
            image |= filled(part / 2, 70, 60)
        inside = image[50 : 50 + pixels.shape[0], 30 : 30 + pixels.shape[1]]
        assert (inside | ~pixels).all()  # holes are filled, no pixel is lost
        assert not np.delete(image, np.s_[50:66], axis=0).any()


def test_parts_of_object_are_joined_into_one_polygon() -> None:
    pixels = np.zeros((20, 40), bool)
    pixels[2:9, 3:14], pixels[10:18, 22:38] = True, True
    parts = outlines(Mask(0, 0, pixels))
    assert len(parts) == 2
    drawn = filled(joined(parts), 20, 40)
    assert (drawn & pixels).sum() / (drawn | pixels).sum() > 0.95


def test_outlines_are_sorted_by_area_and_links_add_none() -> None:
    """Links must add no area, since COCO tools compute areas from the polygons.

    A hole is not a part: linked to the outline, it would be subtracted from the object.
    """
    pixels = np.zeros((20, 40), bool)
    pixels[1:3, 30:34], pixels[4:19, 2:14], pixels[9:15, 20:27] = True, True, True
    pixels[6:16, 4:11] = pixels[16, 9:12] = pixels[11:13, 23] = False
    parts = outlines(Mask(100, 70, pixels))

    def area(ring: Any) -> float:
        (x, y), (next_x, next_y) = ring.T, np.roll(ring, -1, axis=0).T
        return float(abs((x * next_y - next_x * y).sum()) / 2)

    assert [area(part) for part in parts] == [15 * 12, 6 * 7, 2 * 4]
    whole = joined(parts)
    assert area(whole) == 15 * 12 + 6 * 7 + 2 * 4
    assert len(whole) == 3 * 4 + 2 * 2  # the ends of both links occur twice


def test_depth_images_are_millimetres_with_their_own_masks(run: Path, tmp_path: Path) -> None:
    """Recordings without colour give data sets too, and depth keeps its 16 bits."""
    export_dataset([read_finished(run)], "coco", tmp_path / "out", ImageSelection(depth=True))
    data = read_coco(tmp_path / "out")
    source = Path(read_finished(run).info["input"]["path"])
    (first, *_), messages = data["images"], read_ros(source, "/camera/depth/image_raw")
    pixels = np.asarray(Image.open(tmp_path / "out/images/train" / first["file_name"]))
    stored = np.frombuffer(bytes(messages[0][1].data), "<u2").reshape(480, 640)
    np.testing.assert_array_equal(pixels, stored)
    names = {c["id"]: c["name"] for c in data["categories"]}
    frames = {image["id"]: image["frame"] for image in data["images"]}
    left = {f.index: {o.track: o for o in f.objects} for f in read_finished(run).frames()}
    for row in data["annotations"]:
        item = left[frames[row["image_id"]]].pop(row["attributes"]["track"])
        mask, own = decoded(row["segmentation"]), np.zeros((480, 640), bool)
        own.flat[item.indices] = True
        assert (mask & own).sum() / (mask | own).sum() > 0.9  # holes are filled
        v, u = np.nonzero(mask)
        assert row["bbox"] == [u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1]
        assert row["area"] == mask.sum()
        assert names[row["category_id"]] == item.category
    assert {o.category for objects in left.values() for o in objects.values()} <= {"unknown"}


def test_runs_without_colour_are_named_and_skipped(
    run: Path, guessed_run: Path, tmp_path: Path, shapecat: Run
) -> None:
    """A data set of a folder of runs had no image at all if one of them had no colour."""
    for name, source in (("a", guessed_run), ("b", run), ("c", guessed_run)):
        shutil.copytree(source, tmp_path / "results" / name)
        place = tmp_path / "results" / name / "run.json"
        info = json.loads(place.read_text())
        info["input"]["digest"] = f"xxh3-128:{name}"
        place.write_text(json.dumps(info))
    out, results = tmp_path / "out", tmp_path / "results"
    result = shapecat("export", results, "--format", "coco", "--out", out)

    assert result.exit_code == 0
    hint = "no colour images (--depth exports depth images)"
    lines = [f"{results / name}: skipped: {hint}\n" for name in "ac"]
    assert result.stderr == "".join([*lines, "skipped 2 of 3 runs\n"])
    assert result.stdout.startswith("1 run: ")
    images = read_coco(out)["images"]
    assert {image["recording"] for image in images} == {"b"}
    assert len(images) > 1

    depth = shapecat("export", results, "--format", "coco", "--out", tmp_path / "d", "--depth")
    assert (depth.exit_code, depth.stderr) == (0, "")
    none = shapecat("export", results / "a", results / "c", "--format", "yolo", "--out", out / "n")
    assert (none.exit_code, none.stdout) == (1, "")
    assert none.stderr == "".join([*lines, "Error: no run is left to export\n"])
    alone = shapecat("export", results / "a", "--format", "yolo", "--out", out / "n")
    assert (alone.exit_code, alone.stderr) == (1, f"Error: {results / 'a'}: {hint}\n")
    assert not (out / "n").exists()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ((), "damaged image (4×)"),
        (("--depth", "--corrected-only"), "no object with a reliable label (4×)"),
        (("--depth", "--corrected-only", "--per-track", "1"), "no object with a reliable label"),
    ],
)
def test_export_without_images_says_why(
    coloured_run: Path,
    tmp_path: Path,
    shapecat: Run,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    reason: str,
) -> None:
    """An empty data set that counts as a success is noticed only when training fails."""

    def failing(_image: Any) -> Any:
        msg = "jpeg image is damaged"
        raise MessageError(msg)

    monkeypatch.setattr("shapecat.outputs.exports.dataset_frames.pixels_of", failing)
    words = ("export", coloured_run, "--format", "coco", "--out", tmp_path / "out", *options)
    result = shapecat(*words)

    assert (result.exit_code, result.stdout) == (1, "")
    assert f"Error: no image to export: {reason}\n" in result.stderr
    assert not (tmp_path / "out").exists()


def test_several_runs_make_one_data_set_split_by_recording(
    run: Path, coloured_run: Path, tmp_path: Path
) -> None:
    """Frames of one recording in both splits would make any model look good."""
    other = tmp_path / "other"
    shutil.copytree(coloured_run, other)
    info = json.loads((other / "run.json").read_text())
    info["input"]["digest"] = "xxh3-128:another"
    (other / "run.json").write_text(json.dumps(info))
    found = export_dataset(
        [read_finished(run), read_finished(other)],
        "coco",
        tmp_path / "out",
        ImageSelection(val=0.5),
    )

    both = [read_coco(tmp_path / "out", split) for split in ("train", "val")]
    recordings = [{image["recording"] for image in part["images"]} for part in both]
    assert sorted(name for part in recordings for name in part) == ["other", "table"]
    assert sum(len(part["annotations"]) for part in both) == found.objects
    sizes = [len(part["images"]) for part in both]
    assert [found.images["train"], found.images["val"]] == sizes
    tracks = [{row["track_id"] for row in part["annotations"]} for part in both]
    assert not tracks[0] & tracks[1]
    assert both[0]["categories"] == both[1]["categories"]


@pytest.mark.parametrize("format_", ["coco", "point-labels"])
def test_progress_counts_frames_that_are_left_out(run: Path, tmp_path: Path, format_: str) -> None:
    """Otherwise progress ends far below its total, and the time left is several times too long."""
    events: list[tuple[str, int, int | None]] = []

    def observe(*event: Any) -> None:
        events.append(event)

    if format_ == "coco":
        chosen = ImageSelection(depth=True, every=3)
        export_dataset([read_finished(run)], format_, tmp_path / "out", chosen, observe=observe)
    else:
        export_run(read_finished(run), format_, tmp_path / "out", every=3, observe=observe)

    total = read_finished(run).info["counts"]["frames"]
    assert events == [("export", k, total) for k in range(1, total + 1)]


def test_runs_with_equal_names_keep_their_images(coloured_run: Path, tmp_path: Path) -> None:
    """The images of one run would replace those of the other."""
    for day in ("monday", "tuesday"):
        shutil.copytree(coloured_run, tmp_path / day / "lab 1")
    runs = [tmp_path / day / "lab 1" for day in ("monday", "tuesday")]
    export_dataset(
        [read_finished(one) for one in runs], "coco", tmp_path / "out", ImageSelection(val=0.0)
    )

    images = read_coco(tmp_path / "out")["images"]
    names = [image["file_name"] for image in images]
    assert len(set(names)) == len(names) == 2 * len([n for n in names if "lab 1_" in n])
    assert all(list((tmp_path / "out").rglob(Path(name).name)) for name in names)
    info = json.loads((tmp_path / "out" / "export.json").read_text())
    assert list(info["runs"]) == ["lab 1", "lab 1-2"]


def test_frames_are_selected_by_interval_and_by_track(run: Path, tmp_path: Path) -> None:
    export_dataset([read_finished(run)], "coco", tmp_path / "every", ImageSelection(every=2))
    assert [i["frame"] for i in read_coco(tmp_path / "every")["images"]] == [0, 2]
    export_dataset(
        [read_finished(run)],
        "coco",
        tmp_path / "track",
        ImageSelection(per_track=1, corrected_only=True),
    )
    (image,) = read_coco(tmp_path / "track")["images"]
    pixels = {
        frame.index: item.indices.size
        for frame in read_finished(run).frames()
        for item in frame.objects
        if item.track == 2  # the only corrected one
    }
    assert image["frame"] == max(pixels, key=lambda frame: pixels[frame])


def test_images_with_equal_stamps_are_all_exported(coloured_run: Path, tmp_path: Path) -> None:
    """After a reset of a simulator, images repeat the stamps of earlier ones: half were lost."""
    folder = tmp_path / "table"
    shutil.copytree(coloured_run, folder)
    masks = pq.read_table(folder / "masks.parquet")
    at, half = masks.schema.get_field_index("color_stamp_ns"), masks.num_rows // 2
    stamps = masks["color_stamp_ns"].to_pylist()[:half] * 2
    masks = masks.set_column(at, masks.schema.field(at), pa.array(stamps, pa.int64()))
    pq.write_table(masks, folder / "masks.parquet")

    export_dataset([read_finished(folder)], "coco", tmp_path / "out", ImageSelection())

    assert [i["frame"] for i in read_coco(tmp_path / "out")["images"]] == list(range(2 * half))


def test_no_frames_are_kept_for_views_that_are_not_labelled(
    coloured_run: Path, tmp_path: Path
) -> None:
    """The best view of an object that a person labelled unknown would add an unlabelled image."""
    folder = tmp_path / "table"
    shutil.copytree(coloured_run, folder)
    frames = list(read_finished(folder).frames())
    best: dict[int, tuple[int, int]] = {}
    for frame in frames:
        for item in frame.objects:
            best[item.track] = max(best.get(item.track, (0, 0)), (item.indices.size, frame.index))
    named = min(best)
    other = next(track for track in best if best[track][1] != best[named][1])
    relabel(folder, {named: "vase", other: "unknown"})

    export_dataset(
        [read_finished(folder)],
        "coco",
        tmp_path / "out",
        ImageSelection(per_track=1, corrected_only=True),
    )

    assert [i["frame"] for i in read_coco(tmp_path / "out")["images"]] == [best[named][1]]


@pytest.mark.parametrize("out", [".", "/"])
def test_current_folder_is_not_replaced(shapecat: Run, run: Path, tmp_path: Path, out: str) -> None:
    """`--out .` ended in a traceback."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)
        results = [
            shapecat("export", run, "--format", "yolo", "--out", out),
            shapecat("train", tmp_path, "--out", out),
        ]
    for result in results:
        assert result.exit_code == 1
        assert f"Error: {out}: name a file or folder in it" in result.output


def test_only_earlier_export_is_replaced(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    export_dataset([read_finished(run)], "coco", out, ImageSelection())
    export_dataset([read_finished(run)], "coco", out, ImageSelection(every=2))
    assert len(read_coco(out)["images"]) == 2
    with pytest.raises(OutputError, match="holds coco, not an earlier yolo export"):
        export_dataset([read_finished(run)], "yolo", out, ImageSelection())
    with pytest.raises(OutputError, match="is a run; choose another --out"):
        export_dataset([read_finished(run)], "coco", run, ImageSelection())
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "a.txt").touch()
    with pytest.raises(OutputError, match="holds something else"):
        export_dataset([read_finished(run)], "coco", tmp_path / "notes", ImageSelection())


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("--per-track", "3"),
        ("--min-confidence", "0.5"),
        ("--corrected-only", ""),
        ("--depth", ""),
        ("--val", "0.2"),
    ],
)
def test_data_set_options_are_refused_by_other_formats(
    run: Path, tmp_path: Path, shapecat: Run, option: str, value: str
) -> None:
    """An ignored option would silently give another export than requested."""
    out = tmp_path / "out"
    result = shapecat("export", run, "--format", "kitti", "--out", out, option, *value.split())
    assert result.exit_code == 2
    assert f"{option} is for --format coco and yolo, not kitti" in result.stderr
    assert not out.exists()


@pytest.mark.parametrize("kind", ["coco", "yolo", "crops", "point-labels"])
def test_boxes_option_is_refused_by_formats_without_boxes(
    run: Path, tmp_path: Path, shapecat: Run, kind: str
) -> None:
    out = tmp_path / "out"
    result = shapecat("export", run, "--format", kind, "--out", out, "--boxes", "visible")
    assert result.exit_code == 2
    assert f"--boxes is for --format kitti and labelcloud, not {kind}" in result.stderr
    assert not out.exists()


def test_kitti_boxes_project_onto_colour_image(run: Path, tmp_path: Path) -> None:
    """P2, the 3D boxes and the image are in three files, which must be for the same camera."""
    export_run(read_finished(run), "kitti", tmp_path)
    folder = tmp_path / "table"
    with (folder / "frames.csv").open() as file:
        numbers = [row["number"] for row in csv.DictReader(file)]
    source = Path(read_finished(run).info["input"]["path"])
    labels = np.load(source.with_suffix(".color_labels.npz"))["labels"]
    checked = 0
    for k, number in enumerate(numbers):
        picture = np.asarray(Image.open(folder / "image_2" / f"{number}.png"))
        assert picture.shape == (720, 960, 3)
        projection = read_calibration(folder, number)["P2"]
        for label in read_labels(folder, number):
            left, top, right, bottom = label.box
            projected = np.column_stack([label.corners, np.ones(8)]) @ projection.T
            u, v = (projected[:, :2] / projected[:, 2:]).T
            if right < 955 and bottom < 715 and left > 5 and top > 5:
                assert u.min() - 6 <= left <= right <= u.max() + 6
                assert v.min() - 6 <= top <= bottom <= v.max() + 6
                # The lens distorts by a few pixels: the middle of a box is still on an object.
                middle = labels[k, int((top + bottom) / 2), int((left + right) / 2)]
                checked += middle >= 20
    assert checked > 10


def test_damaged_image_is_skipped(run: Path, tmp_path: Path, monkeypatch: Any) -> None:
    """One bad frame among thousands must not end the export."""
    from shapecat.outputs.exports import dataset_frames  # noqa: PLC0415  to be changed

    calls = iter(range(99))
    read = pixels_of

    def failing(image: Any) -> Any:
        if next(calls) == 1:
            msg = "jpeg image is damaged"
            raise MessageError(msg)
        return read(image)

    monkeypatch.setattr(dataset_frames, "pixels_of", failing)
    export_dataset([read_finished(run)], "coco", tmp_path / "out", ImageSelection())
    assert [i["frame"] for i in read_coco(tmp_path / "out")["images"]] == [0, 2, 3]
