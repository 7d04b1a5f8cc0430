"""Tests of `shapecat compare`: metrics, table, page, references and error messages."""

import base64
import io
import json
import re
import runpy
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import Result
from PIL import Image
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection
from scipy.spatial.transform import Rotation

from shapecat.colour.rle import parse_rle_text, rle_mask
from shapecat.errors import OutputError, RecordingError
from shapecat.evaluation.comparison import comparing
from shapecat.evaluation.comparison.comparing import (
    Comparison,
    _ComparedFrames,
    compare,
)
from shapecat.evaluation.comparison.figures import Tally, figures_of
from shapecat.evaluation.comparison.labellings import (
    LabelledItem,
    Labelling,
    Reference,
)
from shapecat.evaluation.comparison.matching import (
    Difference,
    frame_identities,
    labelled_part,
    match_objects,
)
from shapecat.evaluation.comparison.overlap import Matched, Overlap, box_iou
from shapecat.evaluation.comparison.page import (
    figure_rows,
    format_page,
    place_captions,
    prepare_new,
    write_comparison,
)
from shapecat.evaluation.comparison.pictures import (
    COLOURS,
    Caption,
    DifferenceImage,
    _captions,
    _shades,
    draw_frame,
)
from shapecat.evaluation.comparison.references import (
    _LabelImages,
    open_reference,
    read_complete,
    run_labellings,
)
from shapecat.evaluation.comparison.references_coco import CocoLabels, _Annotation, filled_polygon
from shapecat.evaluation.comparison.references_kitti import KittiLabels
from shapecat.runs.tables.reading import read_stamps
from shapecat.runs.tables.schemas import DETECTIONS, FRAMES, TRACKS
from shapecat.types import Box, Camera, Frame
from tests.run_info import run_info

Run = Callable[..., Result]
SCORER = Path(__file__).parents[2] / "shared" / "tools" / "score_scenes.py"
START, STEP = 1_700_000_000_000_000_000, 100_000_000
SIDE = 10
NAMES = ["cup", "can", "box"]


def block(x: int, y: int, w: int, h: int) -> list[int]:
    """Return the flat indices of a rectangle of pixels in an image of 10 by 10."""
    return [v * SIDE + u for v in range(y, y + h) for u in range(x, x + w)]


CUP, CAN, BOX = block(0, 0, 4, 5), block(5, 0, 4, 4), block(1, 6, 5, 3)
LESS = block(5, 0, 4, 3)
CORNERS = [0, 0, 4, 0, 4, 5, 0, 5]
"""The outline of CUP, x and y of each corner."""
FOUND: list[list[tuple[int | None, list[int], str]]] = [
    [(1, CUP, "cup"), (2, LESS, "can")],
    [(1, CUP, "cup"), (2, LESS, "can"), (3, BOX, "box")],
    [(4, CUP, "can"), (2, LESS, "can"), (3, BOX, "box"), (None, block(8, 8, 2, 2), "cup")],
]
"""For each frame, the track, the pixels and the single-view category of each detection."""
FINAL = {1: "cup", 2: "can", 3: "box", 4: "cup"}


def write_run(
    folder: Path,
    *,
    digest: str = "one",
    shift_ns: int = 0,
    step: int = STEP,
    part: slice = slice(0, 3),
) -> Path:
    """Write the tables of a run of three frames, or ``part`` of them; there is no recording.

    Frames are ``step`` ns apart, and the first one is ``shift_ns`` after `START`.
    """
    folder.mkdir(parents=True)
    stamps = [START + shift_ns + step * k for k in range(3)[part]]
    none: dict[str, Any] = dict.fromkeys(FRAMES.names)
    frames = [
        none | {"topic": "/d", "frame": k, "stamp_ns": stamp, "up": [0, -1, 0]}
        for k, stamp in enumerate(stamps)
    ]
    rows, tracks = [], []
    for k, found in enumerate(FOUND[part]):
        for n, (track, pixels, category) in enumerate(found):
            head = {"topic": "/d", "frame": k, "stamp_ns": stamps[k], "detection": n}
            scores = [0.8 if name == category else 0.1 for name in NAMES]
            box = {"center": [0.1 * n, 0, 1], "size": [0.1, 0.2, 0.3], "orientation": [0, 0, 0, 1]}
            own = {"indices": pixels, "posterior": scores, "category": category, "confidence": 0.8}
            rows.append(dict.fromkeys(DETECTIONS.names) | head | box | own)
            if track is not None:
                tracks.append(dict.fromkeys(TRACKS.names) | head | {"track": track})
    for name, content, schema in (
        ("frames", frames, FRAMES), ("detections", rows, DETECTIONS), ("tracks", tracks, TRACKS)
    ):  # fmt: skip
        pq.write_table(pa.Table.from_pylist(content, schema), folder / f"{name}.parquet")
    lines = [f"{track},{category},0.9," for track, category in FINAL.items()]
    for name in ("tracks.original.csv", "tracks.csv"):
        (folder / name).write_text("\n".join(["track,category,confidence,label", *lines]))
    about = run_info(
        input={"path": str(folder / "gone.mcap"), "digest": digest},
        model={"categories": NAMES},
        counts={"frames": len(stamps)},
        options={"topics": ["/d"]},
    )
    (folder / "run.json").write_text(json.dumps(about))
    return folder


def true_objects() -> list[dict[str, Any]]:
    return [
        {"label": 7, "parts": [7], "category": "cup", "ambiguous": False, "track": 11},
        {"label": 8, "parts": [8, 9], "category": "box", "ambiguous": False, "track": 12},
        {"label": 5, "parts": [5], "category": "box", "ambiguous": True, "track": 13},
    ]


def write_truth(folder: Path) -> Path:
    """Write truth as the simulator does: a cup, a box in two parts, and an ambiguous box."""
    image = np.full(SIDE * SIDE, 3, np.uint8)
    for label, pixels in ((7, CUP), (8, CAN[:8]), (9, CAN[8:]), (5, BOX)):
        image[pixels] = label
    image[block(9, 8, 1, 2)] = 0  # half of the detection without a track is not labelled
    np.savez_compressed(folder / "lab.labels.npz", labels=np.stack([image.reshape(10, 10)] * 3))
    truth = [
        {"frame": k, "scene": "learn1", "stamp_ns": START + STEP * k, "objects": true_objects()}
        for k in range(3)
    ]
    (folder / "lab.truth.json").write_text(json.dumps(truth))
    return folder / "lab.truth.json"


def coco_text(**changes: dict[str, str]) -> str:
    """Return COCO labels with one image and two annotations.

    ``image`` and ``annotation`` replace entries of the image and of the second annotation by JSON.
    """
    plain = {"id": "1", "image_id": "1", "category_id": "1", "segmentation": "[[0, 0, 5, 0, 5, 5]]"}
    image = {"id": "1", "stamp_ns": "0", "height": "10", "width": "10"} | changes.get("image", {})
    last = plain | changes.get("annotation", {})
    image_text, plain_text, last_text = (
        "{" + ", ".join(f'"{name}": {value}' for name, value in item.items()) + "}"
        for item in (image, plain, last)
    )
    return (
        f'{{"categories": [{{"id": 1, "name": "cup"}}], "images": [{image_text}], '
        f'"annotations": [{plain_text}, {last_text}]}}'
    )


def test_coco_crowd_has_undecidable_category() -> None:
    """Other tools mark ambiguous objects as crowds; these count as found, without a category."""
    square = [[1, 0, 3, 0, 3, 2, 1, 2]]
    annotations = [
        {"id": k, "image_id": 7, "category_id": 4, "segmentation": square, "iscrowd": k}
        for k in (0, 1)
    ]
    images = [{"id": 7, "file_name": "a_000012.png", "width": 4, "height": 3}]
    content = {"categories": [{"id": 4, "name": "cup"}], "annotations": annotations}
    labels = CocoLabels(Path("labels.json"), {**content, "images": images}).at(("/depth", 12), 0)

    assert labels is not None
    assert [(item.category, item.decidable) for item in labels.items] == [
        ("cup", True), ("cup", False)
    ]  # fmt: skip
    pixels = labels.items[0].pixels
    assert pixels is not None
    assert pixels.tolist() == [1, 2, 5, 6]


@pytest.mark.parametrize("track", [0, 7])
@pytest.mark.parametrize("attribute", [False, True])
def test_coco_tracks_are_read_from_field_or_attribute(track: int, attribute: bool) -> None:
    """CVAT writes track numbers, from 0, as an attribute. If one is missing, none are compared."""
    own: dict[str, Any] = {"track_id": track}
    own = {"attributes": {**own, "x": 3}} if attribute else own
    item = {"id": 1, "image_id": 2, "category_id": 4, "segmentation": [[1, 0, 3, 0, 3, 2, 1, 2]]}
    images = [{"id": 2, "frame": 5, "width": 4, "height": 3}]
    content = {"categories": [{"id": 4, "name": "cup"}], "images": images}
    labels = CocoLabels(Path("x.json"), {**content, "annotations": [{**item, **own}]})
    mixed = CocoLabels(Path("x.json"), {**content, "annotations": [{**item, **own}, item]})
    found = labels.at(("/d", 5), 0)

    assert found is not None
    assert [known.track for known in found.items] == [track]
    assert (labels.tracked, mixed.tracked) == (True, False)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_run(tmp_path / "lab")


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    return write_truth(tmp_path)


def test_metrics_match_hand_calculation(run: Path, truth: Path) -> None:
    """In pixels: cup 20; can 16, of which 12 are found; box 15, missed once; labelled surplus 2."""
    figures = compare(run, truth).figures
    shared, found, true = 3 * 20 + 3 * 12 + 2 * 15, 3 * 20 + 3 * 12 + 2 * 15 + 2, 3 * (20 + 16 + 15)

    assert figures["overlap"]["f"] == pytest.approx(2 * shared / (found + true), abs=1e-4)
    assert figures["overlap"]["precision"] == pytest.approx(shared / found, abs=1e-4)
    assert figures["objects"] == {"true": 9, "detections": 9, "found": 8, "share_found": 0.8889}
    category = figures["category"]
    assert category["n"] == 6  # the ambiguous box does not count
    assert category["accuracy"] == 0.5  # cups right, the box always a can
    assert category["view_accuracy"] == pytest.approx(2 / 6, abs=1e-4)
    assert (category["balanced"], category["view_balanced"]) == (0.5, 0.3333)
    assert category["taken_for"] == [{"true": "box", "label": "can", "n": 3}]
    assert category["ece"] == pytest.approx(0.8 - 2 / 6, abs=1e-4)
    tracking = figures["tracking"]
    assert (tracking["switches"], tracking["misses"], tracking["false_positives"]) == (1, 1, 0)
    assert tracking["mota"] == pytest.approx(1 - 2 / 9, abs=1e-4)
    assert tracking["idf1"] == pytest.approx(2 * 7 / (9 + 8), abs=1e-4)


def test_detection_of_hidden_object_is_not_false(run: Path, truth: Path) -> None:
    """The simulator lists objects with few visible pixels as hidden; detection may find them."""
    before = compare(run, truth).figures["objects"]
    content = json.loads(truth.read_text())
    for entry in content:
        entry["hidden"] = [entry["objects"].pop(2)]
    truth.write_text(json.dumps(content))
    after = compare(run, truth).figures["objects"]

    boxes = sum(track == 3 for found in FOUND for track, *_ in found)
    assert before["detections"] - after["detections"] == boxes
    assert before["true"] - after["true"] == 3


def test_pixels_on_hidden_object_are_not_wrong(run: Path, truth: Path) -> None:
    """Of a detection that covers a corner of a hidden object, the other pixels count."""
    content = json.loads(truth.read_text())
    for entry in content:
        entry["hidden"] = [{"label": 6, "parts": [6]}]
    truth.write_text(json.dumps(content))
    with np.load(truth.with_name("lab.labels.npz")) as file:
        labels = file["labels"]
    labels[:, 0, :2] = 6  # two of the 20 pixels of the cup, which is found in each frame
    np.savez_compressed(truth.with_name("lab.labels.npz"), labels=labels)
    overlap = compare(run, truth).figures["overlap"]

    shared, found, true = 3 * 18 + 3 * 12 + 2 * 15, 3 * 18 + 3 * 12 + 2 * 15 + 2, 3 * (18 + 16 + 15)
    assert overlap["precision"] == pytest.approx(shared / found, abs=1e-4)
    assert overlap["recall"] == pytest.approx(shared / true, abs=1e-4)


@pytest.mark.parametrize(("beside", "kept"), [(2, [10, 11, 12]), (3, None)])
def test_detection_is_left_out_if_mostly_ignored(beside: int, kept: list[int] | None) -> None:
    """A detection that merely touches an ignored object is compared by its other pixels."""
    ignored = np.zeros(SIDE * SIDE, bool)
    ignored[13 : 13 + beside] = True
    true = Labelling((), ~ignored, (SIDE, SIDE), ignored)
    item = LabelledItem(1, "cup", np.arange(13 + beside - 5, 13 + beside))
    rest = labelled_part(Labelling((item,)), true).items

    assert [known.pixels.tolist() for known in rest if known.pixels is not None] == (
        [] if kept is None else [kept]
    )


def test_table_lists_every_difference_once(shapecat: Run, run: Path, truth: Path) -> None:
    out = run.parent / "out"
    result = shapecat("compare", run, truth, "--out", out)

    assert result.exit_code == 0, result.stderr
    rows = pq.read_table(out / "objects.parquet").to_pylist()
    listed = [
        (r["frame"], r["difference"], r["true_category"], r["category"], r["track"])
        for r in rows
        if r["difference"]
    ]
    assert sorted(listed, key=str) == sorted(
        [
            (0, "category", "box", "can", 2),
            (0, "missed", "box", None, None),
            (1, "category", "box", "can", 2),
            (2, "category", "box", "can", 2),
            (2, "identity", "cup", "cup", 4),
            (2, "surplus", None, "cup", None),
        ],
        key=str,
    )
    assert len(rows) == 10
    cut = next(r for r in rows if r["track"] == 2)
    assert (cut["f"], cut["iou"]) == (pytest.approx(24 / 28), pytest.approx(12 / 16))
    figures = json.loads((out / "comparison.json").read_text())
    assert figures["differences"] == {"category": 3, "missed": 1, "identity": 1, "surplus": 1}
    assert json.loads(shapecat("compare", run, truth, "--json").stdout) == figures
    page = (out / "comparison.html").read_text()
    assert page.count("<figure>") == 3
    captions = ("box mistaken for can #2", "missed box", "surplus cup", "cup now #4")
    for words in (*captions, "data:image"):
        assert words in page
    assert "6 differences: 3 category" in result.stdout
    assert "the recording is missing" in result.stderr


def differences(pairs: Sequence[tuple[LabelledItem, LabelledItem]]) -> list[str | None]:
    """Return the difference of the found and the true object in each frame."""
    compared = _ComparedFrames(iter(()))
    for k, (found, true) in enumerate(pairs):
        compared.add(("/d", k), START + k, Labelling((found,)), Labelling((true,)), 0)
    return [row.difference for row in compared.tally.rows]


def test_identity_switch_is_counted_once() -> None:
    """After the frame of the switch, the new track counts as the object's own."""
    cup = LabelledItem(11, "cup", np.array(CUP))
    tracks = (5, 5, 6, 6, 6, 5, 5)

    assert differences([(LabelledItem(track, "cup", cup.pixels), cup) for track in tracks]) == [
        None,
        None,
        "identity",
        None,
        None,
        "identity",
        None,
    ]


@pytest.mark.parametrize("other", [(6, "can"), (None, "cup"), (None, "can")])
def test_identity_switch_is_not_counted_beside_another_difference(
    other: tuple[int | None, str],
) -> None:
    """The table names one difference per object: a wrong category hides the switch.

    Only the tracking metrics count it then. A detection without a track is not a switch.
    """
    cup = LabelledItem(11, "cup", np.array(CUP))
    track, category = other
    later = [(track or 5, "cup")] * 2
    found = [LabelledItem(*item, cup.pixels) for item in ((5, "cup"), other, *later)]
    kinds = differences([(item, cup) for item in found])

    assert kinds == [None, None if category == "cup" else "category", None, None]


def test_page_has_each_metric_in_its_place(run: Path, truth: Path) -> None:
    """Metrics are calculated by hand above; tracks are those of the run, not of the truth."""
    found = compare(run, truth)
    values = {name.strip(): (value, meaning) for name, value, meaning in figure_rows(found)}
    rows = re.findall(r"<tr>(.*?)</tr>", format_page(found))
    cells = [re.findall(r"<td>(.*?)</td>", row) for row in rows]
    listed = {(row[0], row[1]): row[2:] for row in cells if len(row) == 8}

    assert values["frames"] == ("3", "the same in both")
    assert values["objects found"] == ("88.9 %", "8 of 9; 9 detections")
    assert values["overlap F"] == ("0.897", "precision 0.984, recall 0.824 of pixels")
    assert values["category right"] == ("50.0 %", "of 6 matched objects; box as can 3×")
    assert values["single views"][0] == "33.3 %"
    assert values["calibration error"][0] == "0.467"
    assert values["MOTA"] == ("0.778", "1 miss, 0 false positives, 1 identity switch")
    assert values["IDF1"][0] == "0.824"
    assert listed["0", "missed box"] == ["box", "", "", "", "", ""]
    assert listed["2", "cup now #4"] == ["cup", "cup", "#4", "0.90", "1.00", ""]
    assert listed["1", "box mistaken for can #2"] == ["box", "can", "#2", "0.90", "0.86", ""]


@pytest.mark.parametrize(("category", "text"), [("can", "0.99"), ("unknown", "")])
def test_page_words_confidences_like_the_report(category: str, text: str) -> None:
    """A confidence of 1.00 would pass for certainty.

    That of an unknown object is the confidence of its likeliest category, and is left out.
    """
    row = Difference("/d", 7, START, "surplus", track=22, category=category, confidence=0.9961)
    page = format_page(replace(worked(), rows=(row,)))
    cells = re.findall(r"<td>(.*?)</td>", page.rpartition("<table>")[2])

    assert cells == ["7", f"surplus {category} #22", "", category, "#22", text, "", ""]


def worked() -> Comparison:
    """Return a comparison whose metrics all differ, so that swapped ones are noticed."""
    head = "/d", 6, START
    rows = (
        Difference(*head, "outline", 11, "cup", 21, "cup", 0.91, 0.62, 0.45, 0.33),
        Difference(*head, "missed", true_track=12, true_category="can"),
        Difference("/d", 7, START, "surplus", track=22, category="bowl", confidence=0.52),
        Difference("/d", 7, START, None, 13, "box", 23, "box", 0.99, 0.98, 0.97, 0.96),
        Difference("/d", 8, START, "surplus", track=24, category="jar", confidence=0.43),
        Difference("/d", 9, START, "category", 14, "cup", 25, "can", 0.84, 0.89, 0.81, 0.74),
        Difference("/d", 9, START, "surplus", track=26, category="pot", confidence=0.35),
        Difference("/d", 9, START, "missed", true_track=15, true_category="a & b"),
        Difference("/d", 9, START, "identity", 16, "ball", 27, "ball", 0.76, 0.95, 0.91, 0.88),
    )
    captions = (
        Caption(20.0, 150.4, "left"), Caption(290.0, 4.0, "high"), Caption(144.0, 60.0, "in")
    )  # fmt: skip
    picture = DifferenceImage("/d", 9, "data:image/png;base64,AA", 300, 200, captions, rows[5:])
    taken_for = [
        {"true": true, "label": label, "n": n}
        for true, label, n in (
            ("cup", "can", 8),
            ("jar", "pot", 7),
            ("box", "can", 6),
            ("a", "b", 1),
        )
    ]
    figures = {
        "frames": {"compared": 31, "only_in_run": 4, "only_in_reference": 5},
        "objects": {"true": 90, "detections": 1093, "found": 81, "share_found": 0.9012},
        "overlap": {"f": 0.8123, "precision": 0.9348, "recall": 0.7234},
        "category": {
            "n": 70, "accuracy": 0.6543, "balanced": 0.6111, "view_accuracy": 0.5432,
            "view_balanced": 0.5222, "ece": 0.0678, "taken_for": taken_for,
        },
        "box_iou": {"n": 66, "mean": 0.4567},
        "tracking": {
            "idf1": 0.7111, "mota": 0.6222, "hota": 0.5333, "detection_accuracy": 0.4444,
            "association_accuracy": 0.3557, "switches": 2, "misses": 14, "false_positives": 1,
            "objects": 99,
        },
    }  # fmt: skip
    notes = ("The pictures lack depth: it <is> gone",)
    return Comparison("runs/lab", "truth/t.json", "COCO labels", figures, rows, (picture,), notes)


FIGURES = [
    ["frames", "31", "4 only in the run, 5 only in the reference"],
    ["objects found", "90.1 %", "81 of 90; 1,093 detections"],
    ["overlap F", "0.812", "precision 0.935, recall 0.723 of pixels"],
    [
        "category right", "65.4 %",
        "of 70 matched objects; cup as can 8×, jar as pot 7×, box as can 6×",
    ],
    ["single views", "54.3 %", "before fusion over the track"],
    ["calibration error", "0.068", "ECE of single views; 0 is perfect"],
    ["box IoU", "0.457", "mean of 66 pairs, in 3D"],
    ["IDF1", "0.711", "consistency of identities over time"],
    ["MOTA", "0.622", "14 misses, 1 false positive, 2 identity switches"],
    ["HOTA", "0.533", "detection 0.444, association 0.356"],
]  # fmt: skip


def test_command_prints_each_metric_under_its_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A table with swapped numbers or words would look plausible."""
    found = worked()
    import_module("shapecat.cli.compare")._print(found, figure_rows(found))
    printed = capsys.readouterr()
    first, _, head, *table, _, last = printed.out.splitlines()

    assert first == "runs/lab compared with truth/t.json (COCO labels)"
    assert head.split() == ["metric", "value", "meaning"]
    assert [re.split(r"\s{2,}", line.strip()) for line in table] == FIGURES
    assert last == "8 differences: 3 surplus, 2 missed, 1 outline, 1 category, 1 identity"
    assert printed.err == "The pictures lack depth: it <is> gone\n"


def test_page_without_differences_has_no_empty_table() -> None:
    same = tuple(row for row in worked().rows if not row.difference)
    page = format_page(replace(worked(), rows=same, pictures=()))

    assert "<p>No frame differs.</p>" in page
    assert "<p>0 differences. All objects are in objects.parquet.</p></body>" in page
    assert page.count("<table>") == 1


def test_page_shows_all_content_in_its_place() -> None:
    """Nothing may be lost, swapped or in another order; HTML characters must be escaped."""
    page = format_page(worked())
    figures, rows = (
        [re.findall(r"<t[hd]>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", table)]
        for table in re.findall(r"<table>(.*?)</table>", page)
    )
    text = re.findall(r"<(?:title|h1|h2|p|b)\b[^>]*>([^<]+)", page)
    legend = re.findall(r"rgb(\(.*?\))\"></i>(.*?)</span>", page)
    (svg,) = re.findall(r"<svg .*?</svg>", page)

    assert text == [
        "lab compared with t.json",
        "lab compared with t.json",
        "runs/lab · truth/t.json (COCO labels)",
        "The pictures lack depth: it &lt;is&gt; gone",
        "Frames that differ most",
        "The frame with the most differences in each twelfth of the run.",
        "/d frame 9",
        "Frame by frame",
        "8 differences. All objects are in objects.parquet.",
    ]
    assert [[cell.strip() for cell in row] for row in figures] == FIGURES
    assert rows == [
        ["frame", "difference", "true", "found", "track", "confidence", "overlap F", "box IoU"],
        ["6", "cup #21: outline differs", "cup", "cup", "#21", "0.91", "0.62", "0.33"],
        ["6", "missed can", "can", "", "", "", "", ""],
        ["7", "surplus bowl #22", "", "bowl", "#22", "0.52", "", ""],
        ["8", "surplus jar #24", "", "jar", "#24", "0.43", "", ""],
        ["9", "cup mistaken for can #25", "cup", "can", "#25", "0.84", "0.89", "0.74"],
        ["9", "surplus pot #26", "", "pot", "#26", "0.35", "", ""],
        ["9", "missed a &amp; b", "a &amp; b", "", "", "", "", ""],
        ["9", "ball now #27", "ball", "ball", "#27", "0.76", "0.95", "0.88"],
    ]
    assert legend == [
        (str(COLOURS["both"]), "both"),
        (str(COLOURS["missed"]), "missed: only in the reference"),
        (
            str(COLOURS["surplus"]),
            "surplus (false positive): only in the run, or on another object",
        ),
        (str(COLOURS["category"]), "wrong category"),
    ]
    # Text of a fixed size would hide a small picture.
    assert '<svg viewBox="0 0 300 200" style="font-size:7.0px"' in svg
    assert 'href="data:image/png;base64,AA" width="300" height="200"' in svg
    assert re.findall(r'<text x="(.*?)" y="(.*?)">(.*?)</text>', svg) == [
        ("290", "7", "high"), ("144", "60", "in"), ("20", "150", "left"),
    ]  # fmt: skip
    assert page.count(
        "cup mistaken for can #25; surplus pot #26; missed a &amp; b; ball now #27"
    ) == 2  # fmt: skip


def test_page_names_the_topics_if_there_are_several() -> None:
    """Both cameras have a frame 9."""
    found = worked()
    rows = (*found.rows, found.rows[-1]._replace(topic="/e"))
    page = format_page(replace(found, rows=rows))

    assert "<td>/d 9</td>" in page
    assert "<td>/e 9</td>" in page


def test_table_has_each_number_in_its_column(tmp_path: Path) -> None:
    """Other programs read the table by its column names."""
    found = worked()
    write_comparison(tmp_path / "out", found)
    rows = pq.read_table(tmp_path / "out" / "objects.parquet").to_pylist()
    content = json.loads((tmp_path / "out" / "comparison.json").read_text("utf-8"))

    assert rows == [pytest.approx(row._asdict()) for row in found.rows]
    assert list(content) == [
        "run", "reference", "kind", *found.figures, "differences", "notes"
    ]  # fmt: skip
    assert content["tracking"] == found.figures["tracking"]
    assert content["notes"] == list(found.notes)


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("session2_000012.png", ("/d", 12)),
        ("camera1/7_depth_12.v3.jpg", ("/d", 3)),
        (f"12_{START}_5.png", ("/d", 99)),
        ("20240101123456_000012.png", ("/d", 12)),
    ],
)
def test_frame_of_image_is_read_from_its_name(name: str, key: tuple[str, int]) -> None:
    """Names may begin with dates and camera numbers; a timestamp is recognised by its size."""
    images = [{"id": 1, "file_name": name, "width": 4, "height": 3}]
    labels = CocoLabels(Path("x.json"), {"categories": [], "annotations": [], "images": images})

    assert labels.at(key, START) is not None
    assert [labels.at(("/d", k), 0) is None for k in (1, 2, 5, 7)] == [True] * 4


@pytest.mark.parametrize(
    "places",
    [
        [{"file_name": "left_000004.png"}, {"file_name": "right_000004.png"}],
        [{"stamp_ns": START}, {"stamp_ns": START}],
        [{"stamp_ns": START, "frame": 4}, {"stamp_ns": START, "frame": 4}],
    ],
)
def test_coco_images_of_the_same_frame_are_refused(places: list[dict[str, Any]]) -> None:
    """Otherwise, the labels of one image would count for both."""
    images = [{"id": k, "width": 4, "height": 3, **place} for k, place in enumerate(places)]
    content = {"categories": [], "annotations": [], "images": images}

    with pytest.raises(RecordingError, match=r"x.json: frame .* of any topic is labelled twice"):
        CocoLabels(Path("x.json"), content)


def test_coco_rectangles_are_refused() -> None:
    """Tools write rectangles with an empty list of polygons: each object would seem missed."""
    item = {"id": 7, "image_id": 0, "category_id": 1, "bbox": [1, 1, 2, 1], "segmentation": []}
    content = {
        "categories": [{"id": 1, "name": "cup"}],
        "annotations": [item],
        "images": [{"id": 0, "width": 4, "height": 3, "stamp_ns": START}],
    }

    with pytest.raises(RecordingError, match=r"annotation 7 has no readable mask .*only a box"):
        CocoLabels(Path("x.json"), content).at(("/depth", 0), START)


def test_kitti_label_files_of_the_same_frame_are_refused(tmp_path: Path) -> None:
    """Otherwise, the labels of one file would count for both."""
    (tmp_path / "label_2").mkdir()
    for name in ("4", "000004"):
        (tmp_path / "label_2" / f"{name}.txt").touch()

    with pytest.raises(RecordingError, match="frame 4 of any topic is labelled twice"):
        KittiLabels(tmp_path)


def test_truth_skips_label_images_of_missing_frames(tmp_path: Path) -> None:
    """A run of every n-th frame must skip label images, which are read sequentially."""
    images = np.zeros((6, 3, 4), np.uint8)
    for k in range(6):
        images[k].flat[k + 2] = 7
    np.savez_compressed(tmp_path / "lab.labels.npz", labels=images)
    truth = [
        {"frame": k, "stamp_ns": START + STEP * k, "objects": true_objects()[:1]} for k in range(6)
    ]
    (tmp_path / "lab.truth.json").write_text(json.dumps(truth))
    reference = open_reference(tmp_path / "lab.mcap")

    for k in (1, 2, 4, 5):
        found = reference.at(("/d", 9), START + STEP * k)
        assert found is not None
        assert found.shape == (3, 4)
        assert [list(map(int, item.pixels)) for item in found.items if item.pixels is not None] == [
            [k + 2]
        ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parts": None}, "lacks 'parts'"),
        ({"ambiguous": None}, "lacks 'ambiguous'"),
        ({"box": {"center": [0, 0, 1], "size": [1, 1]}}, "is damaged"),
        ({"box": {"center": [0, 0, 1], "size": None, "orientation": [0, 0, 0, 1]}}, "is damaged"),
        ({"box": {"center": [0, 0, 1], "size": [10**400, 1, 1]}}, "is damaged"),
        ({"track": [11]}, "is damaged"),
    ],
)
def test_truth_without_a_field_is_refused_in_one_line(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    """Truth written by hand often lacks what only the simulator knows."""
    path = write_truth(tmp_path)
    truth = json.loads(path.read_text())
    first = truth[1]["objects"][0]
    truth[1]["objects"][0] = {k: v for k, v in (first | change).items() if v is not None}
    path.write_text(json.dumps(truth))

    with pytest.raises(RecordingError, match=f"lab.truth.json: the frame .*{message}"):
        open_reference(path).at(("/d", 1), START + STEP)


@pytest.mark.parametrize(
    "text",
    [
        "[" * 200_000,
        '{"a":' * 100_000,
        '[{"stamp_ns": 1e999, "objects": []}]',
        '[{"stamp_ns": 0, "frame": 1e999, "objects": []}]',
        coco_text(image={"height": "1e999"}),
        coco_text(image={"stamp_ns": "1e999"}),
        coco_text(image={"id": "[1]"}),
        coco_text(annotation={"track_id": "1e999"}),
        coco_text(annotation={"track_id": '"first"'}),
        coco_text(annotation={"attributes": "null"}),
    ],
)
def test_absurd_values_in_references_are_refused_in_one_line(tmp_path: Path, text: str) -> None:
    """JSON allows any nesting and any number, and Python has errors of its own for them."""
    path = write_truth(tmp_path)
    path.write_text(text)

    with pytest.raises(RecordingError, match=r"lab\.truth\.json: "):
        open_reference(path).at(("/d", 0), 0)


@pytest.mark.parametrize("place", [60, 500])
def test_damaged_label_images_are_reported_in_one_line(tmp_path: Path, place: int) -> None:
    """Damaged content has errors of its own, which appear when the file is opened or read."""
    images = np.random.default_rng(0).integers(0, 9, (4, 30, 40), np.uint8)
    path = tmp_path / "lab.labels.npz"
    np.savez_compressed(path, labels=images)
    content = bytearray(path.read_bytes())
    content[place : place + 40] = b"\xff" * 40
    path.write_bytes(content)
    truth = [{"frame": k, "stamp_ns": START + k, "objects": []} for k in range(4)]
    (tmp_path / "lab.truth.json").write_text(json.dumps(truth))

    with pytest.raises(RecordingError, match=r"not the labels|damaged at image"):
        open_reference(tmp_path / "lab.mcap").at(("/d", 3), START + 3)


@pytest.mark.parametrize(("side", "depth"), [(30, True), (5, True), (5, False)])
def test_labels_of_images_with_another_size_are_refused(side: int, depth: bool) -> None:
    """A colour image has other pixels than the depth image: its labels would match nothing.

    Truth of another recording may have another size, too, so the error names both causes.
    """
    camera = Camera(SIDE, SIDE, 20, 20, 5, 5)
    frame = Frame("/d", 0, START, START, "cam", np.ones((SIDE, SIDE), np.float32), camera)
    found = Labelling((LabelledItem(1, "cup", np.array(CUP)),))
    true = Labelling((LabelledItem(2, "cup", np.arange(side)),), None, (side, side))
    frames = iter([frame] if depth else [])

    with pytest.raises(
        RecordingError, match=rf"{side} x {side} pixels.*another recording.*--depth"
    ):
        _ComparedFrames(frames).add(("/d", 0), START, found, true, 0)


def test_picture_of_each_part_shows_its_worst_frame() -> None:
    """Of the frames in a twelfth of the run, the one with most differences is shown."""
    masks = np.arange(0, 20), np.arange(40, 90)
    compared = _ComparedFrames(iter(()))
    for k, names in enumerate((("can", "cup"), ("can", "can"), ("cup", "can"))):
        true = tuple(LabelledItem(j, "cup", mask) for j, mask in enumerate(masks))
        found = tuple(LabelledItem(j, name, masks[j]) for j, name in enumerate(names))
        both = Labelling(found), Labelling(true, None, (10, 10))
        compared.add(("/d", 7 + k), k, *both, 5)

    (picture,) = compared.pictures()
    assert (picture.frame, len(picture.rows)) == (8, 2)


def half_spaces(box: Box) -> np.ndarray:
    """Return the sides (6, 4) of a box in SciPy's form: a x + b y + c z + d <= 0."""
    axes = Rotation.from_quat(box.orientation).as_matrix().T
    normals = np.concatenate([axes, -axes])
    offsets = -normals @ box.center - np.tile(box.size / 2, 2)
    return np.column_stack([normals, offsets])


def test_iou_of_rotated_boxes_matches_half_space_intersection() -> None:
    """Boxes are rotated about any axis, and some are disjoint; SciPy gives the true volumes."""
    rng, met = np.random.default_rng(5), 0
    for _ in range(60):
        a, b = (
            Box(rng.uniform(-0.2, 0.2, 3), rng.uniform(0.1, 0.6, 3), quaternion)
            for quaternion in Rotation.random(2, random_state=rng).as_quat()
        )
        sides = np.concatenate([half_spaces(a), half_spaces(b)])
        wide = np.column_stack([sides[:, :3], np.ones(12)])
        inside = linprog([0, 0, 0, -1], wide, -sides[:, 3], bounds=[(None, None)] * 4)
        shared = 0.0
        if inside.x[3] > 1e-6:
            corners = HalfspaceIntersection(sides, inside.x[:3]).intersections
            shared, met = ConvexHull(corners).volume, met + 1
        expected = shared / (np.prod(a.size) + np.prod(b.size) - shared)
        assert box_iou(a, b) == pytest.approx(expected, rel=1e-4, abs=1e-9)
        assert box_iou(b, a) == pytest.approx(expected, rel=1e-4, abs=1e-9)

    assert 30 < met < 60


def test_overlap_fractions_use_their_own_counts() -> None:
    overlap = Overlap(30, 50, 40, 2, 5, 7) + Overlap(12, 13, 60, 1, 3, 2)

    assert overlap == Overlap(42, 63, 100, 3, 8, 9)
    assert overlap.precision == pytest.approx(42 / 63)
    assert (overlap.recall, overlap.share_found) == (0.42, 0.375)
    assert overlap.f == pytest.approx(84 / 163)


def test_each_part_of_the_run_has_one_picture(
    run: Path, truth: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three frames in two parts: the first part has frames 0 and 1, of which 0 differs more."""
    monkeypatch.setattr(comparing, "_PICTURES", 2)

    assert [picture.frame for picture in compare(run, truth).pictures] == [0, 2]


def test_captions_do_not_overlap() -> None:
    """In a pile, several captions begin at the same place."""
    texts = ("missed bowl", "surplus bowl #8", "missed plate", "surplus bowl #4")
    places = ((200, 100), (210, 104), (205, 96), (40, 101))
    captions = [Caption(*place, text) for place, text in zip(places, texts, strict=True)]
    placed = {text: (x, y) for x, y, text in place_captions(captions, 10.0, 430)}

    assert placed == {
        "missed plate": (205, 96),
        "surplus bowl #4": (46.5, 101),  # moved into the picture, but not down
        "missed bowl": (200, 107.5),
        "surplus bowl #8": (210, 119),
    }


def test_captions_are_centred_above_their_objects() -> None:
    """Objects without a track are identified by the order of the rows."""
    found = (
        LabelledItem(4, "cup", np.array(block(2, 5, 3, 4))),
        LabelledItem(None, "can", np.array(block(0, 0, 2, 1))),
        LabelledItem(None, "can", np.array(block(6, 7, 4, 2))),
    )
    true = (
        LabelledItem(None, "box", np.array(block(0, 0, 2, 1))),
        LabelledItem(None, "box", np.array(block(1, 3, 2, 2))),
        LabelledItem(None, "box", np.array(block(5, 9, 1, 1))),
    )
    head = ("/d", 0, 0)
    rows = [
        Difference(*head, "surplus", track=4, category="cup"),
        Difference(*head, None, true_category="box", category="can"),
        Difference(*head, "surplus", category="can"),
        Difference(*head, "missed", true_category="box"),
        Difference(*head, "missed", true_category="box"),
    ]

    assert [tuple(caption) for caption in _captions(rows, found, true, {1: 0}, SIDE)] == [
        (3, 1, "surplus cup #4"),
        (7.5, 3, "surplus can"),
        (1.5, -1, "missed box"),
        (5, 5, "missed box"),
    ]


def test_near_surfaces_that_face_the_camera_are_bright() -> None:
    """Half of the image is at 1 m, half at 2 m; missing depth is nearly black."""
    depth = np.full((6, 40), 1.0, np.float32)
    depth[:, 20:], depth[:, 38:] = 2.0, 0.0
    frame = Frame("/d", 0, 0, 0, "c", depth=depth, camera=Camera(40, 6, 300, 300, 20, 3))
    shades = _shades(frame, 6, 40).reshape(6, 40)
    slope = np.tile(np.linspace(1, 2, 40, dtype=np.float32), (6, 1))
    slope[:3] = 1.0
    inclined = Frame("/d", 0, 0, 0, "c", depth=slope, camera=frame.camera)
    lit = _shades(inclined, 6, 40).reshape(6, 40)

    assert np.unique(shades[:, :19]).tolist() == [47]  # of 48 shades, counted from 0
    assert np.unique(shades[:, 21:37]).tolist() == [23]
    assert np.unique(shades[:, 38:]).tolist() == [2]
    assert np.unique(lit[0]).tolist() == [47]
    # 26 mm per pixel at 1 m: 0.35 + 0.65 / sqrt(1 + (250 * 0.0256) ** 2) of the brightest
    assert lit[5, 0] == pytest.approx(47 * 0.45, abs=1)
    assert _shades(None, 2, 3).tolist() == [36] * 6


@pytest.mark.parametrize(("shift", "iou"), [(0.2, 1 / 3), (0.23, 17 / 63), (0.25, None)])
def test_boxes_are_matched_from_iou_of_a_quarter(shift: float, iou: float | None) -> None:
    """Hidden sides are estimates, so the limit is lower than for masks. Boxes have no F."""
    size, level = np.array([0.4, 0.2, 0.3]), np.array([0, 0, 0, 1])
    found = [LabelledItem(5, "cup", box=Box(np.array([0.1 + shift, 0.2, 1]), size, level))]
    true = [
        LabelledItem(None, "can"),
        LabelledItem(1, "cup", box=Box(np.array([0.1, 0.2, 1]), size, level)),
    ]
    matched = match_objects(found, true)

    assert matched.pairs == ({} if iou is None else {0: 1})
    assert (matched.f, matched.overlap) == (None, Overlap())
    assert iou is None or matched.similarity.tolist()[0] == pytest.approx([0, iou])


def test_truth_that_matches_no_detection_gives_a_warning(
    shapecat: Run, run: Path, truth: Path
) -> None:
    """Simulated recordings have equal stamps, so a wrong file would give meaningless metrics."""
    assert "from the same recording?" not in shapecat("compare", run, truth).output

    image = np.full(SIDE * SIDE, 3, np.uint8)
    image[block(6, 4, 3, 2)] = 7  # where the run has no detection
    np.savez(truth.with_name("lab.labels.npz"), labels=np.stack([image.reshape(10, 10)] * 3))
    assert f"is {truth} from the same recording?" in shapecat("compare", run, truth).output


def test_object_with_wrong_category_counts_as_found() -> None:
    """Without masks, the differences determine what is found."""
    kinds = [None, "category", "identity", "missed", "missed", "surplus", "missed", "surplus"]
    ious = [0.5, 0.0, *[None] * 6]  # boxes beside each other count, too
    rows = [
        Difference("/d", 0, START, kind, box_iou=iou) for kind, iou in zip(kinds, ious, strict=True)
    ]
    figures = figures_of(Tally(masks=False, rows=rows), NAMES, tracked=False)

    assert figures["objects"] == {"true": 6, "detections": 5, "found": 3, "share_found": 0.5}
    assert figures["box_iou"] == {"n": 2, "mean": 0.25}


def test_frames_without_objects_have_no_overlap() -> None:
    """An overlap of 0 would say that two empty tables have nothing in common."""
    for pixels, found in ((0, False), (4, True)):
        figures = figures_of(Tally(overlap=Overlap(found=pixels)), NAMES, tracked=False)
        assert (figures["overlap"] is not None) == found


class NamedFrames(Reference[str]):
    """A reference whose entries are categories, of one object in each frame."""

    def labelling(self, entry: str) -> Labelling:
        """Return an object of the category."""
        return Labelling((LabelledItem(None, entry),))


def test_labels_of_frame_match_its_topic_and_stamp() -> None:
    """Stamps are preferred to frame numbers, then labels of the topic to those of any topic."""
    names = {(None, 5): "any", ("/d", 5): "own", ("/d", START): "stamp", (None, START): "old"}
    labels = NamedFrames(Path("x"), (((*place, None), name) for place, name in names.items()))
    asked = ((("/d", 5), START), (("/e", 5), START), (("/d", 5), 1), (("/e", 5), 1), (("/e", 6), 1))

    found = [labels.at(*place) for place in asked]
    assert [item and item.items[0].category for item in found] == [
        "stamp",
        "old",
        "own",
        "any",
        None,
    ]


def test_unmatched_frames_are_reported_by_side(shapecat: Run, run: Path, truth: Path) -> None:
    """Swapped counts would make the user search for the gap in the wrong run."""
    entries = json.loads(truth.read_text())
    later = [{**entries[0], "stamp_ns": START + STEP * k} for k in (5, 6, 7, 8)]
    truth.write_text(json.dumps([*entries[:2], *later]))

    assert "1 only in the run, 4 only in the reference" in shapecat("compare", run, truth).stdout


def test_ambiguous_object_has_no_wrong_category(run: Path, truth: Path) -> None:
    """From this side the category is undecidable, so no answer counts as a difference."""
    table = run / "tracks.csv"
    table.write_text(table.read_text().replace("3,box,0.9,", "3,box,0.9,can"))

    assert compare(run, truth).as_dict()["differences"]["category"] == 3  # those of the other box


@pytest.mark.parametrize("overlaps", [(0.2, 0.8), (0.8, 0.2)])
def test_track_with_two_detections_uses_the_better_one(overlaps: tuple[float, float]) -> None:
    """Otherwise a fragment could change the identity of a found object."""
    detections = [LabelledItem(5, "cup"), LabelledItem(None, "cup"), LabelledItem(5, "cup")]
    similarity = np.array([[overlaps[0]], [0.9], [overlaps[1]]])
    frame = frame_identities(
        detections, [LabelledItem(1, "cup")], Matched({}, similarity, None, Overlap())
    )

    assert (frame.true, frame.found, frame.similarity.tolist()) == ([1], [5], [[0.8]])


def test_existing_output_folder_is_not_replaced(shapecat: Run, run: Path, truth: Path) -> None:
    (run.parent / "out").mkdir()
    (run.parent / "out" / "mine.txt").write_text("mine")
    result = shapecat("compare", run, truth, "--out", run.parent / "out")

    assert (result.exit_code, "--out" in result.stderr) == (1, True)
    assert [p.name for p in (run.parent / "out").iterdir()] == ["mine.txt"]


@pytest.mark.skipif(not SCORER.exists(), reason="the other scorer is not on this machine")
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # the scorer does not close its files
def test_metrics_match_another_scorer(
    run: Path, truth: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    labels = truth.with_name("lab.labels.npz")
    words = [SCORER, run / "detections.parquet", labels, truth, "--json"]
    monkeypatch.setattr(sys, "argv", list(map(str, words)))
    runpy.run_path(str(SCORER))
    theirs, ours = json.loads(capsys.readouterr().out), compare(run, truth).figures

    assert ours["overlap"]["f"] == pytest.approx(theirs["all"]["F"], abs=1e-3)
    assert ours["overlap"]["precision"] == pytest.approx(theirs["all"]["P"], abs=1e-3)
    assert ours["overlap"]["recall"] == pytest.approx(theirs["all"]["R"], abs=1e-3)
    assert ours["objects"]["share_found"] == pytest.approx(theirs["all"]["obj75"], abs=1e-3)
    assert ours["category"]["n"] == theirs["category"]["n"]
    assert ours["category"]["view_accuracy"] == pytest.approx(theirs["category"]["accuracy"], 1e-3)
    assert ours["category"]["view_balanced"] == pytest.approx(theirs["category"]["balanced"], 1e-3)


def test_run_differs_from_corrected_run_only_in_labels(shapecat: Run, run: Path) -> None:
    same = json.loads(shapecat("compare", run, run, "--json").stdout)
    assert (same["overlap"]["f"], same["differences"]) == (1, {})
    assert same["box_iou"] == {"n": 9, "mean": 1}

    other = write_run(run.parent / "other")
    text = (other / "tracks.csv").read_text()
    (other / "tracks.csv").write_text(text.replace("2,can,0.9,", "2,can,0.9,box") + "delete")
    changed = json.loads(shapecat("compare", run, other, "--json").stdout)
    assert changed["differences"] == {"category": 3, "surplus": 1}
    # The fraction found is of the true objects, not of the detections.
    assert changed["objects"] == {"true": 8, "detections": 9, "found": 8, "share_found": 1}


def test_runs_with_different_start_are_compared_by_stamp(run: Path) -> None:
    """Frames are numbered from the start, so equal numbers would be different images."""
    later = write_run(run.parent / "later", part=slice(1, 3))
    ends = compare(later, run), compare(run, later)

    assert [found.as_dict()["differences"] for found in ends] == [{}, {}]
    assert [found.figures["frames"] for found in ends] == [
        {"compared": 2, "only_in_run": 0, "only_in_reference": 1},
        {"compared": 2, "only_in_run": 1, "only_in_reference": 0},
    ]


@pytest.mark.parametrize(
    ("start_s", "name", "warned"), [(0.1, "1.png", True), (None, "1.png", False), (0.1, "", False)]
)
def test_frame_numbers_of_a_run_with_start_give_a_note(
    run: Path, start_s: float | None, name: str, *, warned: bool
) -> None:
    """Frame numbers of the whole recording would silently mean other images of the run."""
    about = json.loads((run / "run.json").read_text())
    about["options"]["start_s"] = start_s
    (run / "run.json").write_text(json.dumps(about))
    image = {"id": 1, "file_name": name or f"{START}.png", "width": 10, "height": 10}
    labels = run.parent / "coco.json"
    labels.write_text(json.dumps({"categories": [], "images": [image], "annotations": []}))

    assert any("counts from --start" in note for note in compare(run, labels).notes) == warned


def test_frames_of_runs_with_equal_stamps_are_told_apart(tmp_path: Path) -> None:
    """Some drivers write the same stamp into several messages."""
    run, same = (write_run(tmp_path / name, step=0) for name in ("lab", "same"))
    short = write_run(tmp_path / "short", step=0, part=slice(0, 1))
    found = compare(run, same), compare(run, short), compare(short, run)

    assert [each.as_dict()["differences"] for each in found] == [{}, {}, {}]
    assert [each.figures["frames"]["compared"] for each in found] == [3, 1, 1]


def test_merged_tracks_have_one_identity(run: Path, truth: Path) -> None:
    """The switch of a track that the user has repaired must not be reported."""
    text = (run / "tracks.csv").read_text()
    (run / "tracks.csv").write_text(text.replace("4,cup,0.9,", "4,cup,0.9,merge with 1"))

    found = compare(run, truth)

    assert found.figures["tracking"]["switches"] == 0
    assert {row.track for row in found.rows if row.true_track == 11} == {1}
    assert "identity" not in {row.difference for row in found.rows}


def test_merged_tracks_in_one_frame_are_one_object(run: Path) -> None:
    """All outputs join such tracks; two objects of one identity would count as tracking errors."""
    text = (run / "tracks.csv").read_text()
    (run / "tracks.csv").write_text(text.replace("3,box,0.9,", "3,box,0.9,merge with 2"))
    figures = compare(run, run).figures
    *_, (_, _, last) = run_labellings(read_complete(run))
    joined = last.items[1]
    assert joined.pixels is not None
    assert joined.box is not None
    assert joined.posterior is not None

    assert (figures["objects"]["true"], figures["tracking"]["idf1"]) == (7, 1)
    assert (joined.track, joined.category, joined.view_category) == (2, "can", "box")
    assert joined.pixels.tolist() == sorted([*LESS, *BOX])
    # Boxes of 0.1 by 0.2 by 0.3 with centres at x = 0.1 and 0.2; the vertical is y.
    np.testing.assert_allclose(joined.box.center, [0.15, 0, 1], atol=1e-6)
    np.testing.assert_allclose(sorted(joined.box.size), [0.2, 0.2, 0.3], atol=1e-6)
    np.testing.assert_allclose(joined.posterior, [0.1, 0.45, 0.45], atol=1e-6)


def test_detection_without_track_keeps_its_place(run: Path) -> None:
    """Tables of differences list objects in the order of the detections."""
    path = run / "tracks.parquet"
    rows = pq.read_table(path).to_pylist()
    pq.write_table(pa.Table.from_pylist(rows[1:], TRACKS), path)
    (_, _, first), *_ = run_labellings(read_complete(run))

    assert [(item.track, item.category) for item in first.items] == [(None, "cup"), (2, "can")]


def test_detection_without_track_is_compared_by_its_full_box(
    shapecat: Run, run: Path, truth: Path
) -> None:
    """The box of the visible part is smaller than the true one, which is a full box."""
    path = run / "tracks.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)  # of the first frame's cup
    path = run / "detections.parquet"
    rows = pq.read_table(path).to_pylist()
    full = {"center": [0.0, 0.05, 1.0], "size": [0.2, 0.3, 0.4], "orientation": [0, 0, 0, 1]}
    rows[0] |= {f"{name}_full": value for name, value in full.items()}
    pq.write_table(pa.Table.from_pylist(rows, DETECTIONS), path)
    content = json.loads(truth.read_text())
    true_box = full | {"size": [0.2, 0.3, 0.2]}  # half as high as the estimate
    content[0]["objects"][0]["box"] = true_box
    truth.write_text(json.dumps(content))
    found = json.loads(shapecat("compare", run, truth, "--json").stdout)

    assert found["box_iou"] == {"n": 1, "mean": pytest.approx(0.5, abs=1e-4)}


def test_track_of_missing_detection_is_refused(run: Path) -> None:
    """The object of the track would count as missed."""
    path = run / "detections.parquet"
    pq.write_table(pq.read_table(path).slice(1), path)

    with pytest.raises(OutputError, match="tables are inconsistent"):
        list(run_labellings(read_complete(run)))


def test_coco_masks_are_read_in_all_forms(shapecat: Run, run: Path) -> None:
    """Tools write a mask as a polygon, as run lengths, or as compressed run lengths."""
    mask = np.zeros(100, np.bool_)
    mask[CUP] = True
    columns = mask.reshape(10, 10).T.ravel()
    changes = np.flatnonzero(np.diff(np.concatenate([[False], columns, [False]]).astype(int)))
    counts = np.diff([0, *changes.tolist(), 100]).tolist()
    forms: list[Any] = [
        [CORNERS],
        {"size": [10, 10], "counts": counts},
        {"size": [10, 10], "counts": compressed(counts)},
    ]
    content = {
        "categories": [{"id": 4, "name": "cup"}],
        "images": [
            {"id": k, "file_name": f"{START + STEP * k}.png", "width": 10, "height": 10}
            for k in range(3)
        ],
        "annotations": [
            {"id": k, "image_id": k, "category_id": 4, "segmentation": form, "track_id": 1}
            for k, form in enumerate(forms)
        ],
    }
    (run.parent / "coco.json").write_text(json.dumps(content))
    found = json.loads(shapecat("compare", run, run.parent / "coco.json", "--json").stdout)

    assert found["kind"] == "COCO labels"
    assert found["objects"]["found"] == found["objects"]["true"] == 3
    assert found["overlap"]["recall"] == 1
    assert found["category"]["accuracy"] == 1
    assert found["tracking"]["switches"] == 1


def test_categories_that_the_model_lacks_are_named(run: Path) -> None:
    """Labels of another tool, say Cup for cup, would silently be missing from the metrics."""
    content = {
        "categories": [{"id": 4, "name": "Cup"}, {"id": 5, "name": "cup"}],
        "images": [
            {"id": k, "file_name": f"{START + STEP * k}.png", "width": 10, "height": 10}
            for k in range(3)
        ],
        "annotations": [
            {"id": k, "image_id": k, "category_id": 4 + (k > 1), "segmentation": [CORNERS]}
            for k in range(3)
        ],
    }
    (run.parent / "coco.json").write_text(json.dumps(content))
    found = compare(run, run.parent / "coco.json")

    assert found.figures["category"]["n"] == 1
    assert found.notes[-1] == (
        "The metrics of categories leave out 2 matched objects of Cup: the model has no such "
        "category."
    )


def compressed(counts: list[int]) -> str:
    """Return run lengths in the format of pycocotools (rleToString in maskApi.c)."""
    text = ""
    for k, count in enumerate(counts):
        value = count - (counts[k - 2] if k > 2 else 0)
        more = True
        while more:
            bits = value & 0x1F
            value >>= 5
            more = value != -1 if bits & 0x10 else value != 0
            text += chr((bits | 0x20 if more else bits) + 48)
    return text


def test_compressed_run_lengths_are_decoded() -> None:
    """The run lengths need differences of both signs, and several characters for one number."""
    counts = [3, 40, 1000, 5, 7, 900, 2, 1, 42]

    assert rle_mask(counts, 40, 50).area == 40 + 5 + 900 + 1
    assert parse_rle_text(compressed(counts)) == counts
    with pytest.raises(ValueError, match="64 bits"):
        parse_rle_text("P" * 10**6)  # such a number would take hours


@pytest.mark.parametrize(
    "counts",
    [
        [1999],
        [],
        [900, -100, 1200],
        [2**63 - 1, 2**63 - 1, 2002],  # 2000 modulo 2 to the power of 64
        [2**80, 2000 - 2**80],
        ["many"],
        [float("nan")],
        [float("inf")],
        7,
    ],
)
def test_run_lengths_that_do_not_fill_the_image_are_refused(tmp_path: Path, counts: Any) -> None:
    """Files of labels come from anywhere: a wrong sum would give a mask elsewhere, or a crash."""
    segmentation = {"size": [40, 50], "counts": counts}
    annotation = _Annotation({"id": 5, "segmentation": segmentation}, "cup", None)
    reference: Any = SimpleNamespace(path=tmp_path)
    with pytest.raises(RecordingError, match="annotation 5 has no readable mask"):
        CocoLabels._item(reference, annotation, 40, 50)


def test_filled_polygon_has_its_area() -> None:
    mask = filled_polygon(np.array([[3.0, 2.0], [40.0, 10.0], [12.0, 35.0]]), 50, 60)

    assert mask.sum() == pytest.approx(abs(37 * 33 - 9 * 8) / 2, rel=0.02)
    assert mask[10, 20]
    assert not mask[30, 30]


def test_filled_polygon_has_pixels_with_their_centre_inside() -> None:
    """Half a pixel is lost or gained at each side if the corner of a pixel counts instead."""
    mask = filled_polygon(np.array([[1.4, 0.6], [4.6, 0.6], [4.6, 3.4], [1.4, 3.4]]), 5, 7)

    assert np.argwhere(mask).tolist() == [[row, column] for row in (1, 2) for column in range(1, 5)]


def test_kitti_boxes_of_tilted_camera_survive_export_and_reading(
    shapecat: Run, guessed_run: Path, tmp_path: Path
) -> None:
    """A wrong axis or half a height would reduce the overlap."""
    done = shapecat("export", guessed_run, "--format", "kitti", "--out", tmp_path / "kitti")
    assert done.exit_code == 0, done.stderr
    labels = next((tmp_path / "kitti").iterdir())
    found = json.loads(shapecat("compare", guessed_run, labels, "--json").stdout)

    assert found["kind"] == "KITTI labels"
    assert (found["overlap"], found["tracking"]) == (None, None)
    assert found["box_iou"]["n"] == found["objects"]["true"] == found["objects"]["found"] > 5
    assert found["box_iou"]["mean"] > 0.995


def test_kitti_types_match_categories_of_run(run: Path) -> None:
    """A type cannot contain spaces, so an underscore may stand for one."""
    table = run / "tracks.csv"
    text = table.read_text().replace("1,cup,0.9,", "1,cup,0.9,wine_glass")
    table.write_text(text.replace("2,can,0.9,", "2,can,0.9,tea pot"))
    labels = run.parent / "kitti"
    (labels / "label_2").mkdir(parents=True)
    lines = [f"{name} 0 0 0 0 0 0 0 0.2 0.3 0.1 {x} 0.1 1 0\n" for name, x in
             (("wine_glass", 0), ("tea_pot", 0.1))]  # fmt: skip
    (labels / "label_2" / "000000.txt").write_text("".join(lines))
    found = compare(run, labels)

    assert found.figures["box_iou"] == {"n": 2, "mean": 1}
    assert [row.true_category for row in found.rows] == ["wine_glass", "tea pot"]
    assert found.as_dict()["differences"] == {}


def test_kitti_type_of_two_categories_stands_for_the_first(tmp_path: Path) -> None:
    """The categories of the model come first; a person may add one with another spelling."""
    (tmp_path / "label_2").mkdir()
    names = ("tea_pot", "cup", "wine_glass")
    lines = [f"{name} 0 0 0 0 0 0 0 0.2 0.3 0.1 0 0.1 1 0\n" for name in names]
    (tmp_path / "label_2" / "000003.txt").write_text("".join(lines))
    for first, second in (("tea pot", "tea_pot"), ("tea_pot", "tea pot")):
        found = KittiLabels(tmp_path, (first, "cup", second)).at(("/d", 3), START)
        assert found is not None
        assert [item.category for item in found.items] == [first, "cup", "wine glass"]


def test_labels_without_masks_may_end_with_an_empty_frame(run: Path) -> None:
    """Labels without masks give no overlap; that of the empty frame alone would be 0."""
    labels = run.parent / "kitti"
    (labels / "label_2").mkdir(parents=True)
    (labels / "label_2" / "000000.txt").write_text("cup 0 0 0 0 0 0 0 0.2 0.3 0.1 0 0.1 1 0\n")
    (labels / "label_2" / "000002.txt").write_text("")
    found = compare(run, labels).figures

    assert found["frames"]["compared"] == 2
    assert found["overlap"] is None
    assert found["objects"]["found"] == found["box_iou"]["n"] == 1


def test_kitti_dont_care_regions_are_not_objects(tmp_path: Path) -> None:
    """KITTI's own data marks ignored regions as DontCare; each would count as a missed object."""
    (tmp_path / "label_2").mkdir()
    lines = (
        "Car 0.00 0 -1.58 587.01 173.33 614.12 200.12 1.65 1.67 3.64 -0.65 1.71 46.70 -1.59",
        "DontCare -1 -1 -10 503.89 169.71 590.61 190.13 -1 -1 -1 -1000 -1000 -1000 -10",
    )
    (tmp_path / "label_2" / "000012.txt").write_text("\n".join(lines))
    found = KittiLabels(tmp_path).at(("/d", 12), START)

    assert found is not None
    assert [item.category for item in found.items] == ["Car"]


def test_labels_of_two_topics_are_not_mixed(tmp_path: Path) -> None:
    """Cameras triggered together give frames with equal stamps and numbers."""
    topics = {"/left": "cup", "/right": "wine glass", "/top": None}
    images = [
        {"id": k, "topic": topic, "stamp_ns": START, "file_name": "x", "width": 4, "height": 3}
        for k, topic in enumerate(topics)
    ]
    square = [[1, 0, 3, 0, 3, 2, 1, 2]]
    annotations = [
        {"id": k, "image_id": k, "category_id": k, "segmentation": square} for k in (0, 1)
    ]
    names = [{"id": k, "name": name} for k, name in enumerate(topics.values())]
    content = {"categories": names, "annotations": annotations, "images": images}
    (tmp_path / "label_2").mkdir()
    lines = [f"{k},{topic},7,{START}" for k, topic in enumerate(topics)]
    (tmp_path / "frames.csv").write_text("\n".join(["number,topic,frame,stamp_ns", *lines]))
    for k, name in enumerate(topics.values()):
        # Height 0.3, width 0.1, length 0.5; the bottom is in (1, 2, 4).
        line = f"{str(name).replace(' ', '_')} 0 0 0 0 0 0 0 0.3 0.1 0.5 1 2 4 0.6\n"
        (tmp_path / "label_2" / f"{k}.txt").write_text(line if name else "")

    for labels in (CocoLabels(Path("labels.json"), content), KittiLabels(tmp_path)):
        assert labels.frames == 3
        assert labels.at(("/bottom", 7), START) is None
        for topic, name in topics.items():
            found = labels.at((topic, 7), START)
            assert found is not None
            assert [item.category for item in found.items] == ([name] if name else [])
    found = KittiLabels(tmp_path).at(("/right", 7), START)
    assert found is not None
    box = found.items[0].box
    assert box is not None
    np.testing.assert_allclose([box.center, box.size], [[1, 1.85, 4], [0.5, 0.1, 0.3]], rtol=1e-6)


def test_labels_of_frames_with_equal_stamps_are_told_apart(tmp_path: Path) -> None:
    """Some drivers repeat stamps; by stamp alone, such frames would all get the same labels."""
    numbers = (3, 4, 6)  # frame 5 is not labelled, frame 6 has its own stamp
    stamps = {3: START, 4: START, 6: START + STEP}
    square = [[1, 0, 3, 0, 3, 2, 1, 2]]
    head = {"topic": "/d", "file_name": "x", "width": 4, "height": 3}
    images = [{**head, "id": k, "frame": k, "stamp_ns": stamps[k]} for k in numbers]
    annotations = [
        {"id": k, "image_id": k, "category_id": k, "segmentation": square} for k in numbers
    ]
    names = [{"id": k, "name": f"cup{k}"} for k in numbers]
    content = {"categories": names, "annotations": annotations, "images": images}
    (tmp_path / "label_2").mkdir()
    rows = [f"{k},/d,{k},{stamps[k]}" for k in numbers]
    (tmp_path / "frames.csv").write_text("\n".join(["number,topic,frame,stamp_ns", *rows]))
    for k in numbers:
        line = f"cup{k} 0 0 0 0 0 0 0 0.3 0.1 0.5 1 2 4 0.6\n"
        (tmp_path / "label_2" / f"{k}.txt").write_text(line)

    for labels in (CocoLabels(Path("labels.json"), content), KittiLabels(tmp_path)):
        found = [labels.at(("/d", k), START, repeated=True) for k in (3, 4, 5)]
        found += [labels.at(("/d", 9), START + STEP * k, repeated=k == 2) for k in (1, 2)]
        found.append(labels.at(("/d", 9), START + STEP, repeated=True))
        assert labels.frames == 3
        assert [one and one.items[0].category for one in found] == [
            "cup3", "cup4", None, "cup6", None, None
        ]  # fmt: skip


def test_images_of_other_recordings_are_left_out(run: Path) -> None:
    """Recordings of a data set may have equal stamps, as all simulated ones do.

    A single recording may have another name than the run: folders can be renamed.
    """
    square = [[0, 0, 4, 0, 4, 5, 0, 5]]
    head = {"topic": "/d", "frame": 0, "stamp_ns": START, "width": 10, "height": 10}
    names = ("first", "lab", "last")
    content: dict[str, Any] = {
        "categories": [{"id": k, "name": name} for k, name in enumerate(names)],
        "images": [{**head, "id": k, "recording": name} for k, name in enumerate(names)],
        "annotations": [
            {"id": k, "image_id": k, "category_id": k, "segmentation": square} for k in range(3)
        ],
    }
    (run.parent / "coco.json").write_text(json.dumps(content))
    found = compare(run, run.parent / "coco.json")

    assert {row.true_category for row in found.rows} == {None, "lab"}
    assert found.figures["frames"]["only_in_reference"] == 0
    with pytest.raises(RecordingError, match="images of first, lab, last, not of other"):
        compare(run.rename(run.parent / "other"), run.parent / "coco.json")

    content["images"] = [{**content["images"][2], "recording": "single"}]
    (run.parent / "coco.json").write_text(json.dumps(content))
    renamed = compare(run.parent / "other", run.parent / "coco.json")
    assert {row.true_category for row in renamed.rows} == {None, "last"}


def test_other_recordings_without_tracks_do_not_hide_tracking_metrics() -> None:
    """A data set joins recordings of which only some were labelled with tracks."""
    square = [[0, 0, 2, 0, 2, 2, 0, 2]]
    names = ("lab", "yard")
    content = {
        "categories": [{"id": 0, "name": "cup"}],
        "images": [
            {"id": k, "stamp_ns": START, "recording": name, "width": 5, "height": 3}
            for k, name in enumerate(names)
        ],
        "annotations": [
            {"image_id": 0, "category_id": 0, "segmentation": square, "track_id": 1},
            {"image_id": 1, "category_id": 0, "segmentation": square},
        ],
    }
    tracked = [CocoLabels(Path("a.json"), content, name).tracked for name in names]

    assert tracked == [True, False]


def test_recordings_of_runs_with_equal_names_are_told_apart(run: Path) -> None:
    """Two batches may each have a run ``lab``; frames of one must not count for the other."""
    head = {"recording": "lab", "topic": "/d", "frame": 0, "width": 10, "height": 10}
    content = {
        "categories": [],
        "images": [
            {**head, "id": k, "stamp_ns": START, "digest": digest}
            for k, digest in enumerate(("two", "one"))
        ],
        "annotations": [],
    }
    (run.parent / "coco.json").write_text(json.dumps(content))

    frames = compare(run, run.parent / "coco.json").figures["frames"]

    assert (frames["compared"], frames["only_in_reference"]) == (1, 0)


def test_labels_of_single_topic_fit_a_renamed_topic(tmp_path: Path) -> None:
    """An equal stamp is enough, an equal frame number is not."""
    (tmp_path / "label_2").mkdir()
    for name in ("000003", "000004"):
        (tmp_path / "label_2" / f"{name}.txt").write_text(
            f"cup{name[-1]} 0 0 0 0 0 0 0 0.3 0.1 0.5 1 2 4 0.6\n"
        )
    rows = ["number,topic,frame,stamp_ns", f"000003,/a,7,{START}", f"000004,/a,8,{START + STEP}"]
    (tmp_path / "frames.csv").write_text("\n".join(rows))
    labels = KittiLabels(tmp_path)
    found = labels.at(("/b", 3), START + STEP)

    assert found is not None
    assert [item.category for item in found.items] == ["cup4"]
    assert labels.at(("/b", 7), START + 1) is None


def refused(shapecat: Run, *words: object) -> tuple[int, str]:
    result = shapecat("compare", *words)
    assert result.stdout == ""
    assert result.stderr.count("\n") == 1
    return result.exit_code, result.stderr


def test_errors_are_one_line_with_reason_and_exit_code(
    shapecat: Run, run: Path, truth: Path, tmp_path: Path
) -> None:
    half = shutil.copytree(run, tmp_path / "half")
    (half / "tracks.parquet").unlink()
    lost = shutil.copytree(run, tmp_path / "lost")
    (lost / "tracks.csv").rename(lost / "tracks.original.csv")
    later = write_run(tmp_path / "later", digest="two", shift_ns=STEP // 2)
    (tmp_path / "odd.json").write_text('{"images": []}')
    coco = {"categories": [], "annotations": [], "images": [{"id": 1, "stamp_ns": START}]}
    (tmp_path / "no_size.json").write_text(json.dumps(coco))
    (tmp_path / "bad").mkdir()
    broken = write_truth(tmp_path / "bad")
    broken.with_name("lab.labels.npz").write_bytes(b"PK")

    for words, code, text in (
        ((tmp_path, truth), 1, "no run.json there"),
        ((half, truth), 1, "not complete"),
        ((lost, truth), 1, "tracks.csv: missing or empty; restore it from tracks.original.csv"),
        ((later, truth), 3, "no frame in common"),
        ((run, later), 1, "another recording"),
        ((run, tmp_path / "none.json"), 3, "nothing to compare with"),
        ((run, tmp_path / "odd.json"), 3, "lacks 'categories'"),
        ((run, broken), 3, "not the labels of a simulated recording"),
        ((run, tmp_path / "no_size.json"), 3, "COCO labels (it lacks 'height')"),
        ((run, truth, "--recording", tmp_path / "no.mcap"), 3, "no.mcap"),
    ):
        assert refused(shapecat, *words)[0] == code, words
        assert text in refused(shapecat, *words)[1]


def test_labels_of_another_topic_are_named(run: Path, tmp_path: Path) -> None:
    """The message listed the same timestamps for both, and left out what differs."""
    image = {"id": 1, "height": 3, "width": 4, "stamp_ns": START, "topic": "/left"}
    content = {"categories": [], "annotations": [], "images": [image]}
    (tmp_path / "coco.json").write_text(json.dumps(content))

    with pytest.raises(RecordingError, match=f"images {START} to {START} of /left, the run .* of "):
        compare(run, tmp_path / "coco.json")


@pytest.mark.parametrize("place", [".", "/"])
def test_folder_without_a_name_is_not_a_reference(shapecat: Run, run: Path, place: str) -> None:
    """A person in a folder of labels that shapecat cannot read gets a reason, no traceback."""
    assert refused(shapecat, run, place)[0] == 3


def test_current_folder_as_output_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Minutes of comparing must not be lost because the output cannot be written."""
    monkeypatch.chdir(tmp_path)

    with pytest.raises(OutputError, match="name a file or folder in it"):
        prepare_new(Path())


def test_split_object_is_visible_in_the_picture() -> None:
    """With unions of masks, an object in two halves would look correct."""
    true = Labelling((LabelledItem(1, "cup", np.arange(0, 60)),), None, (10, 10))
    halves = (LabelledItem(5, "can", np.arange(0, 40)), LabelledItem(6, "cup", np.arange(40, 70)))
    head = ("/d", 0, START)
    rows = [Difference(*head, "category", category="can"), Difference(*head, "surplus")]
    picture = draw_frame(("/d", 0), None, Labelling(halves), true, {0: 0}, rows)

    assert picture is not None
    content = base64.b64decode(picture.image.split(",")[1])
    pixels = np.array(Image.open(io.BytesIO(content)).convert("RGB")).reshape(100, 3)
    for part, name in ((slice(0, 40), "category"), (slice(40, 70), "surplus")):
        assert len(np.unique(pixels[part], axis=0)) == 1
        assert pixels[part][0].argmax() == np.argmax(COLOURS[name])
    assert (pixels[70:] == pixels[70]).all()
    assert len(np.unique(pixels, axis=0)) == 3


def test_tint_of_object_shows_its_own_difference() -> None:
    """Found and true objects may be in different order."""
    true = Labelling(
        (LabelledItem(1, "cup", np.arange(60, 90)), LabelledItem(2, "box", np.arange(0, 40)))
    )
    found = Labelling(
        (LabelledItem(5, "can", np.arange(0, 40)), LabelledItem(6, "cup", np.arange(60, 90)))
    )
    rows = [
        Difference("/d", 0, START, "category", category="can"),
        Difference("/d", 0, START, None),
    ]
    shape = Labelling(true.items, None, (10, 10))
    picture = draw_frame(("/d", 0), None, found, shape, {0: 1, 1: 0}, rows)

    assert picture is not None
    content = base64.b64decode(picture.image.split(",")[1])
    pixels = np.array(Image.open(io.BytesIO(content)).convert("RGB")).reshape(100, 3).astype(int)
    wrong, right = (pixels[k] - pixels[50] for k in (20, 75))
    assert wrong.argmax() == np.argmax(COLOURS["category"])
    assert right.argmax() == np.argmax(COLOURS["both"])


COCO: dict[str, Any] = {
    "categories": [{"id": 4, "name": "cup"}],
    "images": [
        {"id": 2, "file_name": "17.png", "height": 3, "width": 5},
        {"id": 3, "file_name": "9.png", "height": 3, "width": 5},
    ],
    "annotations": [
        {"id": 8, "image_id": 2, "category_id": 4, "segmentation": {"size": [3, 5], "counts": [15]}}
    ],
}


@pytest.mark.parametrize(
    ("part", "change", "reason"),
    [
        ("images", {"height": 0}, "a.json: image 2 is 5×0"),
        ("images", {"width": 10**8}, "a.json: image 2 is 100000000×3"),
        (
            "images",
            {"width": 7},
            "a.json: annotation 8 has no readable mask (ValueError('size [3, 5]",
        ),
        (
            "images",
            {"file_name": "first.png"},
            "the name 'first.png' holds neither a timestamp nor",
        ),
    ],
)
def test_coco_image_that_fits_no_frame_or_mask_is_refused(
    part: str, change: dict[str, Any], reason: str
) -> None:
    """Masks of another size would be compared with the wrong pixels."""
    changed = {**COCO, part: [COCO[part][0] | change, *COCO[part][1:]]}

    with pytest.raises((RecordingError, ValueError)) as error:
        CocoLabels(Path("a.json"), changed).at(("/d", 17), START)

    assert str(error.value).startswith(reason)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"images": [*COCO["images"], COCO["images"][0]]}, "several images have the id 2"),
        (
            {"annotations": [{**COCO["annotations"][0], "image_id": "2"}]},
            "no image has the id of an annotated one, such as '2'",
        ),
        (
            {"categories": [*COCO["categories"], {"id": 4, "name": "can"}]},
            "cup and can have the same id, 4",
        ),
    ],
)
def test_coco_ids_that_do_not_tell_items_apart_are_refused(
    change: dict[str, Any], reason: str
) -> None:
    """Merged files repeat ids: masks of one image would count for another, or for none at all."""
    with pytest.raises(RecordingError, match=f"^a.json: {reason}$"):
        CocoLabels(Path("a.json"), COCO | change)


def test_labels_of_other_frames_are_described_by_their_range(tmp_path: Path) -> None:
    """The error about labels of another recording names what they hold."""
    (tmp_path / "label_2").mkdir()
    assert CocoLabels(Path("a.json"), COCO).describe_frames() == "images 9 to 17"
    assert CocoLabels(Path("a.json"), COCO | {"images": []}).describe_frames() == "no images"
    assert KittiLabels(tmp_path).describe_frames() == "no frames"
    for name in ("000031", "000007"):
        (tmp_path / "label_2" / f"{name}.txt").write_text("")
    assert KittiLabels(tmp_path).describe_frames() == "frames 7 to 31"


@pytest.mark.parametrize(
    ("file", "content", "reason"),
    [
        ("label_2/first.txt", "", "not a folder of KITTI labels (invalid literal for int()"),
        ("frames.csv", "number,topic\n000007,/d\n", "not a folder of KITTI labels ('stamp_ns')"),
        ("frames.csv", "number,topic,stamp_ns\n000007,/d\n", "not a folder of KITTI labels ("),
        ("frames.csv", f"number,stamp_ns\n{'7' * 200_000},5\n", "not a folder of KITTI labels ("),
        ("label_2/000007.txt", "cup 0 0 0\n", "000007.txt: not a KITTI label file (not enough"),
        ("label_2/000007.txt", f"cup{' 1' * 13} inf\n", "000007.txt: not a KITTI label file ("),
        ("calib/000007.txt", "Tr_rect_to_sensor: 1 0 0\n", "000007.txt: not a KITTI label file ("),
        ("calib/000007.txt", f"Tr_rect_to_sensor:{' nan' * 12}\n", "000007.txt: not a KITTI lab"),
    ],
)
def test_damaged_kitti_labels_are_refused_with_the_file(
    tmp_path: Path, file: str, content: str, reason: str
) -> None:
    """KITTI labels are often edited by hand or by scripts."""
    for folder in ("label_2", "calib"):
        (tmp_path / folder).mkdir()
    (tmp_path / "label_2" / "000007.txt").write_text("cup 0 0 0 0 0 0 0 0.2 0.3 0.1 0 0.1 1 0\n")
    (tmp_path / file).write_text(content)

    with pytest.raises(RecordingError) as error:
        KittiLabels(tmp_path).at(("/d", 7), START)

    assert reason in str(error.value)
    assert str(error.value).startswith(str(tmp_path))


def test_label_images_that_end_early_or_are_not_images_are_refused(tmp_path: Path) -> None:
    """Frames without their labels would count as frames without objects."""
    images = np.arange(2 * 3 * 5, dtype=np.uint8).reshape(2, 3, 5)
    np.savez(tmp_path / "a.npz", labels=images)
    np.savez(tmp_path / "b.npz", labels=images.astype(np.int16))
    file = _LabelImages(tmp_path / "a.npz")

    np.testing.assert_array_equal(file.read(1), images[1])
    with pytest.raises(RecordingError, match=r"a.npz: ends before image 2; simulate the rec"):
        file.read(2)
    with pytest.raises(RecordingError, match=r"expected images of uint8, got \(2, 3, 5\) int16"):
        _LabelImages(tmp_path / "b.npz")


def test_run_with_frames_in_another_order_is_refused(run: Path) -> None:
    """Later frames of the run would count as frames without objects."""
    other = open_reference(run)
    stamps = read_stamps(run)
    frames = sorted((key, stamp) for key, stamp in stamps)

    (last_key, last), (first_key, first) = frames[-1], frames[0]
    assert other.at(last_key, last) is not None
    with pytest.raises(OutputError, match="its frames are in a different order; process it again"):
        other.at(first_key, first)
    assert other.describe_frames() == f"frames with stamps {first} to {last} of {first_key[0]}"
