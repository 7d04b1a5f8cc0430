"""Tests of the report: the content of the page, and its behaviour in a browser if there is one."""

import base64
import errno
import io
import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import Result
from PIL import Image
from scipy import ndimage

from shapecat.api import open_run
from shapecat.cameras.colour import ColourImage, ColourView
from shapecat.colour.masks import Mask
from shapecat.outputs.colouring import Coloured
from shapecat.outputs.counts import plural
from shapecat.outputs.report import read_reports
from shapecat.outputs.report.cards import Card
from shapecat.outputs.report.choosing import choose_frames
from shapecat.outputs.report.images import (
    Crop,
    FramePicture,
    crop_of,
    encode,
    prepare_picture,
    worth_of,
)
from shapecat.outputs.report.page import run_page
from shapecat.outputs.report.pictures import TrackPictures
from shapecat.outputs.report.surfaces import SIDE, Snapshot, draw
from shapecat.outputs.report.tracks import Timeline, read_timelines
from shapecat.outputs.report.writing import Reports, RunReport
from shapecat.outputs.wording import caption, confidence_text, time_span
from shapecat.runs.finished import FinishedRun, read_finished
from shapecat.runs.labels.corrections import adopt_labels, read_labels, relabel
from shapecat.runs.labels.meaning import find_misread
from shapecat.runs.labels.track_table import (
    TrackRow,
    TrackTable,
    read_track_table,
    with_label,
    write_track_table,
)
from shapecat.types import Box, Camera, Frame, LabelledFrame, LabelledObject, NeuralGas
from tests.browser import Browser

Run = Callable[..., Result]


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found
    content: dict[str, Any] = json.loads(found[1])
    return content


def test_every_track_has_card_with_pictures(reported_run: Path) -> None:
    text = (reported_run / "report.html").read_text("utf-8")
    table = read_track_table(reported_run / "tracks.csv")

    assert re.findall(r'<article class="card" id="track-(\d+)"', text) == [
        str(row.track) for row in table.rows
    ]
    assert text.count('class="side"') == 3 * len(table.rows)
    assert text.count('class="crop"') == len(table.rows)
    assert text.count("<polyline") >= len(table.rows)
    assert [row["track"] for row in data_of(text)["rows"]] == [str(r.track) for r in table.rows]
    assert "drawn from their meshes" not in text
    assert text.count(", shaded depth</span>") == text.count('class="caption"') == 8


def test_page_loads_no_external_files(reported_run: Path) -> None:
    """The page must open on a robot without a network."""
    text = (reported_run / "report.html").read_text("utf-8")

    assert not re.findall(r'(?:src|href)="(?!data:|#|\.\./)', text)
    assert "http" not in re.sub(r"http-equiv", "", text)
    assert "connect-src 'none'" in text
    assert "@import" not in text
    assert "url(" not in text


def test_uncertain_labels_are_not_shown_as_certain(run: Path, drawn: RunReport) -> None:
    header, *lines = (run / "tracks.csv").read_text().splitlines()
    track, column = (header.split(",").index(name) for name in ("track", "confidence"))
    shown = {}
    for k, (confidence, text) in enumerate([(0.995, "0.99"), (0.999, "0.99"), (1, "1.00")]):
        cells = lines[k].split(",")
        cells[column] = str(confidence)
        lines[k], shown[cells[track]] = ",".join(cells), text
        assert caption(3, "cup", confidence) == f"#3 cup {text}"
    assert caption(4, "unknown", 0.97) == "#4 unknown"  # the confidence is that of another category
    for name in ("tracks.original.csv", "tracks.csv"):
        (run / name).write_text("\n".join([header, *lines]) + "\n")
    page = replace(drawn, folder=run).page()

    cards = dict(re.findall(r'id="track-(\d+)".*?<span class="sure">(.*?)</span>', page, re.DOTALL))
    assert {track: cards[track] for track in shown} == shown
    assert "100 %" not in page


def test_page_shows_current_labels(run: Path, drawn: RunReport) -> None:
    """A server uses the same report for hours, while other programs edit tracks.csv."""
    report = replace(drawn, folder=run)
    before = report.page(), report.listed("").tally.categories
    track = read_track_table(run / "tracks.csv").rows[0].track
    relabel(run, {track: "teapot"})
    after = report.page(), report.listed("").tally.categories

    assert ["teapot" in page for page, _ in (before, after)] == [False, True]
    assert [counts["teapot"] for _, counts in (before, after)] == [0, 1]


def test_page_of_table_saved_by_spreadsheet_has_the_values_of_the_run(
    run: Path, drawn: RunReport
) -> None:
    """Sorting the table or dropping columns must not change the order or the facts of cards."""
    whole = data_of(replace(drawn, folder=run).page())
    table = read_track_table(run / "tracks.csv")
    rows = sorted(table.rows, key=lambda row: row.track)
    assert rows != list(table.rows)
    lines = [f"{row.track};{row.category};{row.confidence};note;" for row in rows]
    text = "\n".join(["Track;Category;Confidence;mine;Label", *lines])
    (run / "tracks.csv").write_text(text.replace(".", ","))
    page = replace(drawn, folder=run).page()
    found = data_of(page)

    cards = [int(track) for track in re.findall(r'class="card" id="track-(\d+)"', page)]
    assert cards == [row.track for row in table.rows]
    assert "novelty" in page
    assert found["columns"] == [*whole["columns"], "mine"]
    assert [row["cells"][:-1] for row in found["rows"]] == [row["cells"] for row in whole["rows"]]


def test_confidence_text_is_same_after_rounding_in_table() -> None:
    """Cards show the confidence beside the unrounded posterior; the two must not differ."""
    for value in np.random.default_rng(0).uniform(0, 0.99, 2000).tolist():
        assert confidence_text(value) == confidence_text(float(f"{value:.3f}"))
        assert abs(float(confidence_text(value)) - value) < 0.0056


def test_plurals_and_time_spans_are_correct(reported_run: Path) -> None:
    assert (plural(1, "view"), plural(0, "view")) == ("1 view", "0 views")
    assert (time_span(34.0, 34.04), time_span(0.5, 2)) == ("34.0 s", "0.5–2.0 s")
    text = (reported_run / "report.html").read_text("utf-8")

    assert "95th percentile" in text
    outdated = ("1 views", "of work", "looked at", "by first sight", "in all", "95 %", "#graphs")
    assert [phrase for phrase in outdated if phrase in text] == []


def test_names_are_escaped_in_page(run: Path) -> None:
    """Topics and categories may come from strangers; scripts in them must not be executed."""
    evil = "</script><img src=x onerror=alert(1)>"
    info = json.loads((run / "run.json").read_text())
    info["warnings"] = [evil]
    info["options"]["topics"] = [evil]
    info["model"]["categories"][0] = evil
    table = (run / "tracks.csv").read_text().splitlines()
    table[1] = table[1].replace(table[1].split(",")[4], evil)
    (run / "tracks.csv").write_text("\n".join(table) + "\n")
    timelines = read_timelines(run)
    rows = read_track_table(run / "tracks.csv")
    finished = FinishedRun(run, info, rows, {})

    text = run_page(
        finished, [Card(r, timelines[r.track], None) for r in rows.rows], [], {}, length_s=1.0
    )

    assert "<img src=x" not in text
    assert text.count("</script>") == 2
    assert data_of(text)["rows"][0]["category"] == evil


def test_surfaces_are_drawn_from_meshes_without_recording(run: Path) -> None:
    """The page told the reader to give an option that `report` does not have."""
    info = json.loads((run / "run.json").read_text())
    info["input"]["path"] = str(run / "gone.mcap")
    (run / "run.json").write_text(json.dumps(info))

    (report,) = read_reports([run]).runs
    text = report.page()

    assert "surfaces are drawn from their meshes" in text
    assert "gone.mcap" in text
    assert "if it was moved, run `shapecat annotate` with --recording PATH first" in text
    assert text.count('class="side"') == 3 * len(read_track_table(run / "tracks.csv").rows)
    assert 'class="crop"' not in text
    assert 'id="strip"' not in text
    assert report.listed("x").faces
    assert report.listed("x").warnings == text.count("<li>⚠") == len(info["warnings"]) + 1


@pytest.mark.usefixtures("without_pictures")
def test_index_lists_runs_and_links_to_them(
    shapecat: Run, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = run.with_name("ta ble#2")
    shutil.copytree(run, other)
    (run.parent / ".table.partial").mkdir()
    (run.parent / ".table.partial" / "run.json").write_text("{}")

    monkeypatch.chdir(run.parents[1])
    result = shapecat("report", run.parent.name)

    assert result.exit_code == 0, result.output
    names = ("ta ble#2/report.html", "table/report.html", "index.html")
    assert result.stdout.splitlines() == [f"{run.parent.name}/{name}" for name in names]
    text = (run.parent / "index.html").read_text("utf-8")
    links = re.findall(r'class="run" href="([^"]+)"', text)
    assert links == ["ta%20ble%232/report.html", "table/report.html"]
    assert 'href="../index.html"' in (run / "report.html").read_text("utf-8")
    assert shapecat("report", run.parent.parent / "nothing").exit_code == 1


@pytest.mark.usefixtures("without_pictures")
def test_index_tells_runs_of_the_same_name_apart(run: Path, tmp_path: Path) -> None:
    """Runs of one recording with different settings have the same name, in different folders."""
    runs = [tmp_path / name for name in ("first/lab", "#2/lab", "#2/shelf")]
    for folder in runs:
        shutil.copytree(run, folder)

    names = re.findall(r"<h3>(.*?)</h3>", read_reports(runs).index())
    assert names == ["first/lab", "#2/lab", "shelf"]


@pytest.mark.usefixtures("without_pictures")
def test_damaged_run_does_not_prevent_pages_of_others(shapecat: Run, run: Path) -> None:
    """One bad label among many runs left all of them without a page."""
    bad, broken = (run.with_name(name) for name in ("another", "broken"))
    for folder in (bad, broken):
        shutil.copytree(run, folder)
    table = read_track_table(bad / "tracks.csv")
    first, *rest = table.rows
    rows = (with_label(first, "merge with 999"), *rest)
    write_track_table(bad / "tracks.csv", replace(table, rows=rows))
    (broken / "run.json").write_text("{}")
    index = run.parent / "index.html"
    result = shapecat("report", run.parent)

    assert result.exit_code == 1
    assert result.stdout.splitlines() == [str(run / "report.html"), str(index)]
    assert "there is no track #999" in result.stderr
    assert [f"Error: {folder}/" in result.stderr for folder in (bad, broken)] == [True, True]
    assert re.findall(r'class="run" href="([^"]+)"', index.read_text("utf-8")) == [
        "table/report.html"
    ]
    assert 'href="../index.html"' in (run / "report.html").read_text("utf-8")

    index.unlink()
    result = shapecat("report", bad, broken)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr.count("Error: ") == 2
    assert not index.exists()


@pytest.mark.usefixtures("without_pictures")
def test_index_names_recordings_that_failed(shapecat: Run, run: Path) -> None:
    """An index of finished runs alone looks as if the whole batch had succeeded."""
    states = [
        ("table", "failed"),  # processed since, by a command of its own
        ("b", "planned"), ("b", "failed"), ("c", "failed"), ("c", "complete"),
        ("<a>", "failed"), ("d", "running"),
    ]  # fmt: skip
    lines = [json.dumps({"folder": name, "state": state}) for name, state in states]
    manifest = run.parent / "manifest.jsonl"
    manifest.write_text("\n".join(['[{"', "7", *lines, '{"folder": "e", "sta']))
    done = [shapecat("report", run.parent)]
    index = (run.parent / "index.html").read_text("utf-8")
    manifest.unlink()
    done += [shapecat("report", run.parent)]

    assert [each.exit_code for each in done] == [0, 0]
    assert "<li>⚠ 2 recordings failed: &lt;a&gt;, b (manifest.jsonl)</li>" in index
    assert "failed" not in (run.parent / "index.html").read_text("utf-8")


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize(
    ("code", "said"),
    [
        (errno.EACCES, "Permission denied; copy the folder to a place where you may write\n"),
        (errno.EROFS, "Read-only file system; copy the folder to a place where you may write\n"),
        (errno.ENOSPC, "No space left on device\n"),
    ],
)
def test_report_in_read_only_folder_names_a_remedy(
    shapecat: Run, run: Path, monkeypatch: pytest.MonkeyPatch, code: int, said: str
) -> None:
    """Runs on a shared disk may be read-only, and the page is written into the run folder."""

    def refuse(*_: Any) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "write_text", refuse)
    done = shapecat("report", run)

    assert done.exit_code == 1
    assert done.stderr == f"Error: {run / 'report.html'}: cannot be written: {said}"


def decode(image: str) -> np.ndarray:
    opened = Image.open(io.BytesIO(base64.b64decode(image.partition(",")[2])))
    return np.asarray(opened.convert("RGBA")).astype(int)


def ball(count: int = 4000) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    points *= 0.05 / np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] += 0.05
    return points


def test_ball_is_drawn_round_and_lit_from_above() -> None:
    gas = NeuralGas(ball(60), np.array([[0, 1], [2, 3]]))
    for picture in draw(Snapshot(ball(), gas, np.array([1.0, 0.3, 0.6])), (200, 60, 60)):
        image = decode(picture.image)
        solid = image[..., 3] > 0
        rows, columns = np.nonzero(solid)
        width, height = np.ptp(columns), np.ptp(rows)
        assert image.shape == (SIDE, SIDE, 4)
        assert abs(int(width) - int(height)) <= 4
        assert solid.sum() == pytest.approx(np.pi / 4 * width * height, rel=0.08)
        assert width > 0.8 * SIDE
        red = image[..., 0]
        upper, lower = rows < rows.mean(), rows > rows.mean()
        assert (
            red[rows[upper], columns[upper]].mean() > 1.05 * red[rows[lower], columns[lower]].mean()
        )
        assert picture.edges.count("M") == 2
        assert picture.neurons.count("M") == 60


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_objects_with_few_points_are_drawn(count: int) -> None:
    gas = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))

    assert len(draw(Snapshot(ball(5)[:count], gas, np.ones(3)), (1, 2, 3))) == 3


def depth_frame(depth: np.ndarray) -> Frame:
    height, width = depth.shape
    camera = Camera(width, height, 300, 300, width / 2, height / 2)
    return Frame("/d", 0, 0, 0, "camera", depth=depth, camera=camera)


def view(blur: float = 0, left: int = 60, top: int = 50, hidden: float = 0, side: int = 80) -> Any:
    """Return a view of a square in a striped photo; lengths in pixels, ``hidden`` a fraction."""
    stripes = 127 + 100 * np.sign(np.sin(np.arange(240) / 3))
    photo = ndimage.gaussian_filter(np.tile(stripes, (180, 1)), blur)
    mask = Mask(left, top, np.ones((side, side), bool))
    colour = np.repeat(photo[..., None], 3, axis=2).astype(np.uint8)
    return FramePicture((mask,), np.array([hidden]), depth_frame(np.ones((180, 240))), colour)


@pytest.mark.parametrize(
    "worse",
    [
        {"blur": 3},
        *({"left": 0}, {"top": 0}, {"left": 160}, {"top": 100}),
        {"hidden": 0.3},
        {"side": 30},
    ],
)
def test_blurred_cut_occluded_or_small_views_score_lower(worse: dict[str, Any]) -> None:
    assert worth_of(view(**worse), 0) < 0.9 * worth_of(view(), 0)


@pytest.mark.parametrize(("left", "top"), [(140, 5), (5, 95)])
def test_views_near_image_border_score_no_lower(left: int, top: int) -> None:
    assert worth_of(view(left=left, top=top), 0) > 0.97 * worth_of(view(), 0)


def test_invisible_object_scores_zero() -> None:
    empty = Mask(0, 0, np.zeros((0, 0), bool))
    assert worth_of(replace(view(), masks=(empty,)), 0) == 0


@pytest.mark.parametrize(
    ("left", "top", "wide", "high", "shape", "size"),
    [
        (60, 50, 80, 80, (180, 240), (256, 256)),
        (0, 0, 80, 80, (180, 240), (256, 256)),
        (160, 100, 80, 80, (180, 240), (256, 256)),
        (40, 90, 150, 30, (180, 240), (256, 205)),  # its square would be 225 pixels high
        (90, 40, 30, 150, (240, 180), (205, 256)),
        (10, 5, 220, 170, (180, 240), (256, 192)),  # the whole image
        (3, 170, 5, 8, (180, 240), (256, 256)),  # at least 24 pixels
    ],
)
def test_crop_shows_object_and_outline(
    left: int, top: int, wide: int, high: int, shape: tuple[int, int], size: tuple[int, int]
) -> None:
    """The object may be at the border of the image, or nearly as large as the image."""
    photo = np.zeros((*shape, 3), np.uint8)
    photo[top : top + high, left : left + wide] = (250, 40, 40)
    mask = Mask(left, top, np.ones((high, wide), bool))
    crop = crop_of(replace(view(), masks=(mask,), colour=photo), 0)
    image = decode(crop.image)
    red = image[..., 0] > 128
    corners = np.array(re.findall(r"(\d+) (\d+)", crop.outline), int)
    rows, columns = np.nonzero(red)

    assert (crop.width, crop.height) == image.shape[1::-1] == size
    assert abs(corners.min(axis=0) - [columns.min(), rows.min()]).max() <= 3
    assert abs(corners.max(axis=0) - [columns.max(), rows.max()]).max() <= 3
    scale = 256 / min(max(1.5 * max(wide, high), 24), max(shape))
    assert abs(np.ptp([columns, rows], axis=1) - np.array([wide, high]) * scale).max() <= 3


def labelled(*indices: np.ndarray, up: Sequence[int] = (0, -1, 0)) -> LabelledFrame:
    gas = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))
    box = Box(np.array([0, 0, 1]), np.full(3, 0.1), np.array([0, 0, 0, 1]))
    items = [
        LabelledObject(k, "cup", 0.9, box, pixels.astype(np.uint32), gas, np.ones(1), np.ones(1))
        for k, pixels in enumerate(indices)
    ]
    return LabelledFrame(
        "/d", 0, 0, 0, "camera", None, (), tuple(items), (), {}, np.asarray(up, np.float32)
    )


def test_only_nearer_objects_occlude() -> None:
    depth = np.full((120, 160), 1.2, np.float32)
    depth[40:80, 40:80] = 1.0
    depth[40:80, 80:120] = 0.8  # in front of the right side of the first
    number = np.arange(depth.size).reshape(depth.shape)
    both = labelled(number[40:80, 40:80].ravel(), number[40:80, 80:120].ravel())
    found = prepare_picture(both, depth_frame(depth), None)

    assert found is not None
    assert found.hidden == pytest.approx([0.25, 0])
    assert [mask.box for mask in found.masks] == [(40, 40, 40, 40), (80, 40, 40, 40)]


def test_depth_is_drawn_as_shaded_relief() -> None:
    """Opposite slopes differ in brightness; missing depth is dark."""
    v, u = np.mgrid[:120, :160]
    depth = 1 / (1 / 1.5 + 0.002 * np.hypot(u - 80, v - 60).clip(20, 40))
    depth[:, 150:] = 0
    found = prepare_picture(labelled(), depth_frame(depth.astype(np.float32)), None)

    assert found is not None
    image = found.pixels()
    assert image.shape == (120, 160, 3)
    assert image[:, 150:].max() < 30
    up, down = image[25:38, 75:85].mean(), image[82:95, 75:85].mean()
    assert abs(up - down) > 20


def test_damaged_colour_image_is_replaced_by_depth() -> None:
    """One image that was not written completely must not cost the whole report."""
    depth = np.full((48, 64), 1.2, np.float32)
    image = ColourImage("/color", 0, 0, "camera", "png", 64, 48, 0, b"\x89PNG\r\n")
    coloured = Coloured(ColourView(image), (Mask(3, 4, np.ones((5, 6), bool)),))
    pixels = np.arange(depth.size).reshape(depth.shape)[10:20, 30:44].ravel()
    found = prepare_picture(labelled(pixels), depth_frame(depth), coloured)

    assert found is not None
    assert [mask.box for mask in found.masks] == [(30, 10, 14, 10)]
    assert found.pixels().shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("right", "down", "away"),
    [((1, 0, 0), (0, 1, 0), (0, 0, 1)), ((0, -1, 0), (0, 0, -1), (1, 0, 0))],
    ids=["camera", "lidar"],
)
def test_unorganised_cloud_is_drawn_upright(
    right: Sequence[int], down: Sequence[int], away: Sequence[int]
) -> None:
    """The axes of a lidar differ from those of a camera: its clouds would lie on their side."""
    x, y = np.random.default_rng(0).uniform(0, 1, (2, 60000))
    pole = abs(x - 0.5) < 0.05
    y[~pole] = 0.5 + 0.5 * y[~pole]  # a low wall with a pole
    wall = np.stack([2 * x - 1, y - 0.5, np.full_like(x, 2)], axis=1)
    points = (wall @ np.array([right, down, away])).astype(np.float32)
    up = [-value for value in down]
    frame = Frame("/d", 0, 0, 0, "lidar", points=points)
    found = prepare_picture(labelled(np.flatnonzero(pole), up=up), frame, None)

    assert found is not None
    left, _, width, height = found.masks[0].box
    rows, columns = found.shape
    assert (left + width / 2) / columns == pytest.approx(0.5, abs=0.05)
    assert height > 0.9 * rows
    assert width < 0.2 * columns
    image = found.pixels()
    assert image[: rows // 3, : columns // 4].max() < 30  # nothing above the wall


def recorded(run: Path, seconds: float) -> np.ndarray:
    """Return the colour image (h, w, 3) nearest to a time since the first frame, by the API."""
    frames = list(open_run(run).frames())
    times = [(frame.stamp_ns - frames[0].stamp_ns) * 1e-9 for frame in frames]
    colour = frames[int(np.argmin(np.abs(np.subtract(times, seconds))))].color
    assert colour is not None
    return colour.astype(int)


def test_frames_and_crops_are_in_colour(coloured_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "table"
    shutil.copytree(coloured_run, run)
    (report,) = read_reports([run]).runs
    pictures = report.pictures
    frame = pictures.frames[0]
    image = decode(frame.image)
    colours = [decode(item.crop.image)[..., :3] for item in pictures.tracks.values() if item.crop]

    assert len(pictures.frames) == 4
    assert not any(frame.shaded for frame in pictures.frames)
    assert image.shape[:2] == (frame.height, frame.width)
    difference = np.abs(recorded(run, frame.seconds) - image[..., :3])
    assert np.quantile(difference, 0.999) <= 30  # loss of WebP; the next frame differs by 77
    assert len(colours) == len(pictures.tracks) > 3
    assert all(np.ptp(colour, axis=2).max() > 30 for colour in colours)
    shown = set().union(*(frame.boxes for frame in pictures.frames))
    assert shown == set(report.timelines)
    for left, top, width, height in frame.boxes.values():
        assert 0 <= left < left + width <= frame.width
        assert 0 <= top < top + height <= frame.height


def test_frame_strip_covers_run_and_its_tracks(run: Path) -> None:
    timelines = read_timelines(run)
    chosen = choose_frames(run, timelines)
    once = {key[:2]: key for line in timelines.values() for key in line.keys}

    assert len(chosen.strip) == 8  # of eight frames
    assert max(map(len, chosen.candidates.values())) <= len(timelines)
    looks = Counter(track for tracks in chosen.candidates.values() for track in tracks)
    assert set(looks) == set(timelines)
    assert max(looks.values()) <= 4
    assert set(chosen.candidates) <= set(once)


def many_tracks(folder: Path, count: int) -> str:
    """Return a page with full pictures, meshes and time lines for many tracks."""
    rng = np.random.default_rng(1)
    edges = np.unique(np.sort(rng.integers(0, 80, (230, 2)), axis=1), axis=0)
    gas = NeuralGas(ball(80), edges[edges[:, 0] < edges[:, 1]])
    surfaces = draw(Snapshot(ball(), gas, np.array([1.0, 0.3, 0.6])), (200, 60, 60))
    photo = ndimage.gaussian_filter(rng.uniform(0, 255, (256, 256, 3)), (1.5, 1.5, 0))
    crop = Crop(*encode(photo.astype(np.uint8), quality=82), "M1 1 9 9Z")
    pictures = TrackPictures(crop, surfaces, (0.1, 0.1, 0.1))
    cards = []
    for track in range(1, count + 1):
        causal = rng.dirichlet(np.ones(7), 300)
        line = Timeline(np.arange(300) / 10, rng.random(300) < 0.9, causal, (), causal[-1])
        cells = {"track": str(track), "category": "cup", "confidence": ".5", "label": ""}
        row = TrackRow(track + 1, track, "cup", 0.5, "", "/d", cells)
        cards.append(Card(row, line, pictures))
    table = TrackTable(
        ("track", "category", "confidence", "label"), tuple(c.row for c in cards), ()
    )
    return run_page(
        FinishedRun(folder, read_finished(folder).info, table, {}), cards, [], {}, length_s=1.0
    )


def test_corrections_made_in_browser_are_adopted(
    browser: Browser, shapecat: Run, run: Path, drawn: RunReport
) -> None:
    """Corrections would be lost if `annotate` could not read the table that the page writes."""
    (page,) = Reports([replace(drawn, folder=run)]).write()
    rows = read_track_table(run / "tracks.csv").rows
    a, b, c, d, e = (row.track for row in rows[:5])
    other = "bowl" if rows[0].category != "bowl" else "can"
    browser.open(page)
    assert browser.run("return document.body.dataset.ready") == "yes"

    browser.click(f"#track-{a} button[data-label='{other}']")
    browser.click(f"#track-{b} button[data-label='delete']")
    browser.type(f"#track-{c} .other", "Weingläser\n")
    browser.type(f"#track-{d} .other", f"merge with {a}\n")
    browser.click(f"#track-{e} button[data-label='{rows[4].category}']")
    browser.type(f"#track-{rows[5].track} .other", "merge with 999\n")

    assert (
        browser.run(f"return document.querySelector('#track-{a} .fix').textContent") == f"→ {other}"
    )
    assert browser.run("return document.querySelectorAll('.confusion .wrong').length") >= 3
    assert "1 of 5" in browser.run("return document.querySelector('#verdict').textContent")

    browser.open(page)  # a reload keeps the corrections
    assert browser.run("return document.querySelectorAll('.changed').length") == 4
    browser.click("#download")
    table = browser.downloaded()
    # A second table of the same name would be renamed, and the command apply the first.
    command = browser.run("return document.querySelector('#command').textContent")
    assert command == f"shapecat annotate {run} --labels ~/Downloads/{table.name}"
    assert re.fullmatch(r"tracks-\d{14}\.csv", table.name)
    assert table.read_bytes().startswith(b"\xef\xbb\xbf")  # so that Excel shows the umlaut
    result = shapecat("annotate", run, "--labels", table)
    table.unlink()

    assert result.exit_code == 0, result.output
    labels = read_labels(run / "tracks.csv")
    assert labels[a].category == labels[d].category == other
    assert (labels[d].track, labels[c].category, labels[e].confidence) == (a, "Weingläser", 1.0)
    assert b not in labels
    assert browser.console_messages() == []

    Reports([replace(drawn, folder=run)]).write()
    browser.open(page)
    assert browser.run("return document.querySelectorAll('.changed').length") == 4


def changes(browser: Browser) -> dict[int, str]:
    """Return the text about the label on each changed card of the open page, by track."""
    script = (
        "return [...document.querySelectorAll('.card.changed')].map("
        "(card) => [+card.dataset.track, card.querySelector('.fix').textContent])"
    )
    return dict(browser.run(script))


def test_new_page_keeps_corrections_not_downloaded(
    browser: Browser, run: Path, drawn: RunReport
) -> None:
    """If a label was given elsewhere, corrections of other tracks must not be lost."""
    reports = Reports([replace(drawn, folder=run)])
    (page,) = reports.write()
    a, b = (row.track for row in read_track_table(run / "tracks.csv").rows[:2])
    browser.open(page)
    for track in (a, b):
        browser.click(f"#track-{track} button[data-label='delete']")
    relabel(run, {b: "teapot"})
    reports.write()
    browser.open(page)

    assert changes(browser) == {a: "→ delete", b: "→ teapot"}
    assert browser.console_messages() == []


def test_label_that_is_cleared_after_download_is_cleared_in_run(
    browser: Browser, reported_run: Path, tmp_path: Path
) -> None:
    """A label that one downloaded table brought to the run was not cleared by the next."""
    run = tmp_path / "table"
    shutil.copytree(reported_run, run)
    page = run / "report.html"
    a, b = (row.track for row in read_track_table(run / "tracks.csv").rows[:2])
    browser.open(page)
    for expected in ("delete", ""):
        for track in (a, b):
            browser.click(f"#track-{track} button[data-label='delete']")  # the second click clears
            browser.open(page)
        for _ in range(2):  # a table may also be lost
            browser.click("#download")
            table = browser.downloaded().rename(tmp_path / "corrected.csv")
        adopt_labels(table, run)
        labels = read_track_table(run / "tracks.csv").labels
        assert (labels[a], labels[b]) == (expected, expected)


def test_two_tabs_keep_corrections_of_both(browser: Browser, reported_run: Path) -> None:
    """Each tab overwrote the corrections of the other, which were lost when both were closed."""
    page = reported_run / "report.html"
    a, b, c = (row.track for row in read_track_table(reported_run / "tracks.csv").rows[:3])
    browser.open(page)
    browser.click(f"#track-{c} button[data-label='delete']")
    one, two = browser.tabs()[0], browser.tab()
    browser.switch_to(two)
    browser.open(page)
    browser.switch_to(one)
    browser.click(f"#track-{a} button[data-label='delete']")
    browser.switch_to(two)
    browser.click(f"#track-{b} button[data-label='delete']")
    browser.click(f"#track-{c} button[data-label='delete']")  # clears it
    browser.open(page)

    assert changes(browser) == {a: "→ delete", b: "→ delete"}


def test_new_name_has_its_key_after_reload(browser: Browser, reported_run: Path) -> None:
    """A new name was listed nowhere, so it had to be typed again for the next object."""
    page = reported_run / "report.html"
    a, b = (row.track for row in read_track_table(reported_run / "tracks.csv").rows[:2])
    browser.open(page)
    browser.type(f"#track-{a} .other", "mug\n")
    browser.open(page)
    browser.run(f"document.getElementById('track-{b}').focus()")
    browser.press("8")

    assert changes(browser) == {a: "→ mug", b: "→ mug"}
    assert "8 mug" in browser.run("return document.getElementById('digits').textContent")


def test_label_that_begins_with_new_counts_under_its_category(
    browser: Browser, reported_run: Path
) -> None:
    """A model that knows *pan* was counted as wrong where a person had written `new pan`."""
    a, b, c = read_track_table(reported_run / "tracks.csv").rows[:3]
    browser.open(reported_run / "report.html")
    for row, label in ((a, f"new {a.category}"), (b, "new pan"), (c, "pan")):
        browser.type(f"#track-{row.track} .other", f"{label}\n")

    assert changes(browser) == {b.track: "→ pan", c.track: "→ pan"}
    assert "1 of 3" in browser.run("return document.querySelector('#verdict').textContent")
    script = "return [...document.querySelectorAll('.confusion tr:first-child th')]"
    columns = browser.run(f"{script}.map((cell) => cell.textContent)")
    assert sorted(columns) == sorted(["", a.category, "pan"])


def test_escape_leaves_label_as_it_was(browser: Browser, reported_run: Path) -> None:
    """Escape applied the text typed so far, and a field with an invalid label kept the focus."""
    a, b, c = (row.track for row in read_track_table(reported_run / "tracks.csv").rows[:3])
    browser.open(reported_run / "report.html")
    browser.click(f"#track-{a} button[data-label='delete']")
    browser.type(f"#track-{b} .other", "mug\n")
    for keys in ("npen", "m2", "m9x"):
        for track in (a, b, c):
            browser.run(f"document.getElementById('track-{track}').focus()")
            browser.press(*keys, "Escape")
            browser.wait(f"return document.activeElement.id === 'track-{track}'")

        assert changes(browser) == {a: "→ delete", b: "→ mug"}, keys
        fields = "return [...document.querySelectorAll('.other')].map((one) => one.value)"
        assert list(filter(None, browser.run(fields))) == ["mug"], keys
        assert browser.run("return document.querySelectorAll('.other:invalid').length") == 0, keys


def test_focus_leaves_text_field_before_next_key(browser: Browser, reported_run: Path) -> None:
    """The focus moved away too late, and so left the field that the next key had opened."""
    browser.open(reported_run / "report.html")
    track = read_track_table(reported_run / "tracks.csv").rows[0].track
    browser.run(
        "window.press = (key, isComposing) => document.activeElement.dispatchEvent("
        "new KeyboardEvent('keydown', { key, bubbles: true, cancelable: true, isComposing }))"
    )
    focused = "return document.activeElement.id || document.activeElement.className"
    for key, changed in (("Escape", {}), ("Enter", {track: "→ mug"})):
        browser.type(f"#track-{track} .other", "mug")

        # The key ends a composed character.
        assert browser.run(f"press('{key}', true); {focused}") == "other", key
        assert changes(browser) == {}, key
        assert browser.run(f"press('{key}', false); {focused}") == f"track-{track}", key
        assert changes(browser) == changed, key


LABELS = (
    *(
        "marge with {b}",
        "merge_with_{b}",
        "mergewith {b}",
        "new marge with 2",
        "\uff43\uff55\uff50",
    ),
    *("cup", "CUP", "boxx", "new boxx", "cups", "cpu", "pan", "New  pot", "bowling ball", "botle"),
    *(
        "wine glass",
        "glas",
        "café",
        "cafe\u0301",
        "क\u093cलम",
        "стакан",
        "杯",
        "a",
        "x_",
        "x-",
        "é",
    ),
    *("9 pin", "_x", "½ cup", "m²", "cup!", "50%", "pen=1", "a,b", "-", "new", "new ", "new 7up"),
    *("a" * 60, "a" * 61, "new " + "b" * 60, "new " + "b" * 61),
    *("none", "DontCare", "new none", "NA", "new nan", "null", "nant"),
    *("delete", "Delete", "delte", "del", "remove", "removed"),
    *("merge", "merger", "merge 3", "merged x", "mergers", "merge with", "merge with 999"),
    *("new delete", "new del", "new Remove", "new merge with {b}", "new merger", "new removal"),
    *(
        "Merged into #{b}",
        "merge with {b}.0",
        "merge with 0{b}",
        "merge with {b}x",
        "merge-7",
        "merged7",
    ),
    *("merge with {a}", "merge with {b}", "merge with {c}", "merge with {d}", "merge with {e}"),
)
"""Labels for track a: b has a new name, c is deleted, d merges with a, e has another topic."""


def test_page_and_annotate_accept_the_same_labels(
    browser: Browser, run: Path, drawn: RunReport
) -> None:
    """One label that `annotate` refuses costs all corrections of a downloaded table."""
    a, b, c, d, e = (row.track for row in read_track_table(run / "tracks.csv").rows[:5])
    for name in ("tracks.csv", "tracks.original.csv"):
        table = read_track_table(run / name)
        moved = (
            replace(row, cells={**row.cells, "topic": "/other"}) if row.track == e else row
            for row in table.rows
        )
        write_track_table(run / name, replace(table, rows=tuple(moved)))
    info = json.loads((run / "run.json").read_text())
    (run / "run.json").write_text(json.dumps(info | {"fixed_frame": None}))
    assert relabel(run, {b: "new pan", c: "delete", d: f"merge with {a}"}) == {}
    (page,) = Reports([replace(drawn, folder=run)]).write()
    labels = [label.format(a=a, b=b, c=c, d=d, e=e) for label in LABELS]
    browser.open(page)
    accepted = browser.run(
        f"const field = document.querySelector('#track-{a} .other');"
        f"return {json.dumps(labels)}.filter((label) => {{"
        "  field.value = label;"
        "  field.dispatchEvent(new Event('change', { bubbles: true }));"
        "  if (field.validity.valid) document.getElementById('undo').click();"
        "  return field.validity.valid; });"
    )
    rows = read_track_table(run / "tracks.csv").rows
    readable = [
        label
        for label in labels
        if not find_misread(
            [with_label(row, " ".join(label.split())) if row.track == a else row for row in rows],
            info["model"]["categories"],
            one_frame=False,
        )
    ]

    assert accepted == readable
    assert 15 < len(accepted) < len(labels) - 15


def test_page_refuses_to_delete_a_track_that_others_are_merged_with(
    browser: Browser, reported_run: Path
) -> None:
    """Labels given by keys must be checked like typed ones, and typed ones in any letter case."""
    page = reported_run / "report.html"
    a, b = (row.track for row in read_track_table(reported_run / "tracks.csv").rows[:2])
    browser.open(page)
    browser.type(f"#track-{a} .other", f"merge with {b}\n")
    browser.run(f"document.getElementById('track-{b}').focus()")
    browser.press("d")
    assert changes(browser) == {a: f"→ merge with {b}"}
    said = browser.run("return document.getElementById('said').textContent")
    assert said == f"#{b}: #{a}: #{b} is deleted."

    browser.type(f"#track-{b} .other", "Delete\n")
    assert b not in changes(browser)
    browser.press("Escape")
    browser.run(f"document.getElementById('track-{a}').focus()")
    browser.press("Backspace")
    browser.type(f"#track-{b} .other", "Delete\n")
    assert changes(browser) == {b: "→ delete"}
    assert browser.run("return document.querySelectorAll('.card.deleted').length") == 1


def test_corrections_are_kept_for_one_run_only(run: Path, drawn: RunReport) -> None:
    """Tracks of a run processed again have other numbers: corrections would be misplaced."""
    work = drawn.work[:-1] + ("1" if drawn.work.endswith("0") else "0")
    keys = [data_of(replace(drawn, folder=run).page())["key"]]
    relabel(run, {read_track_table(run / "tracks.csv").rows[0].track: "teapot"})
    keys.append(data_of(replace(drawn, folder=run).page())["key"])
    for name in ("run.json", "tracks.csv", "tracks.original.csv"):
        text = (run / name).read_text("utf-8")
        (run / name).write_text(text.replace(drawn.work, work), "utf-8")
    keys.append(data_of(replace(drawn, folder=run, work=work).page())["key"])

    assert keys[0] == keys[1] != keys[2]


def test_filters_select_cards(browser: Browser, reported_run: Path) -> None:
    page = reported_run / "report.html"
    rows = read_track_table(reported_run / "tracks.csv").rows
    browser.open(page)
    shown = (
        "return [...document.querySelectorAll('.card:not([hidden])')].map(c => +c.dataset.track)"
    )
    assert browser.run(shown) == [row.track for row in rows]

    category = rows[0].category
    browser.click(f".chip[data-category='{category}']")
    assert browser.run(shown) == [row.track for row in rows if row.category != category]
    browser.click(f".chip[data-category='{category}']")

    middle = sorted(row.confidence for row in rows)[len(rows) // 2]
    slide = (
        "const s = document.getElementById('confidence'); s.value = %d;"
        "s.dispatchEvent(new Event('input'))"
    )
    browser.run(slide % (100 * middle))
    limit = int(100 * middle) / 100
    assert browser.run(shown) == [row.track for row in rows if row.confidence <= limit]
    browser.run(slide % 100)

    browser.click(f"#track-{rows[1].track} button[data-label='unknown']")
    choose = (
        "const s = document.getElementById('state'); s.value = '%s';"
        "s.dispatchEvent(new Event('change'))"
    )
    display = "return getComputedStyle(document.querySelector('.side svg')).display"
    browser.run(choose % "changed")
    assert browser.run(shown) == [rows[1].track]
    browser.run(choose % "open")
    assert rows[1].track not in browser.run(shown)
    assert browser.run(display) == "block"
    browser.click("#meshes")
    assert browser.run(display) == "none"
    assert browser.console_messages() == []


def test_keys_label_no_hidden_card(browser: Browser, reported_run: Path) -> None:
    """The current card stayed current when a filter hid it, and got the label unseen."""
    browser.open(reported_run / "report.html")
    rows = read_track_table(reported_run / "tracks.csv").rows
    shown = next(row.track for row in rows if row.category != rows[0].category)
    browser.click(f".chip[data-category='{rows[0].category}']")
    browser.run("document.activeElement.blur()")
    browser.press("d")
    assert changes(browser) == {shown: "→ delete"}

    for row in rows:
        browser.run(
            f"const chip = document.querySelector(\".chip[data-category='{row.category}']\");"
            "if (chip.getAttribute('aria-pressed') === 'true') chip.click()"
        )
    browser.press("Backspace")
    assert changes(browser) == {shown: "→ delete"}
    browser.click(f".chip[data-category='{rows[0].category}']")
    browser.run("document.activeElement.blur()")
    browser.press("d")
    assert changes(browser) == {shown: "→ delete", rows[0].track: "→ delete"}
    assert browser.console_messages() == []


def test_text_is_readable_in_both_themes(browser: Browser, reported_run: Path) -> None:
    """WCAG AA asks for a contrast of at least 4.5."""
    browser.open(reported_run / "report.html")
    for theme in ("light", "dark"):
        features = [{"name": "prefers-color-scheme", "value": theme}]
        browser.cdp("Emulation.setEmulatedMedia", {"features": features})
        pairs = browser.run("""
            const seen = [];
            for (const s of ["h1", ".muted", ".number", ".bars span:last-child", ".tiles dt",
                             "#download", ".chip b", ".actions button", "code"]) {
              const e = document.querySelector(s);
              let back = e, colour = "rgba(0, 0, 0, 0)";
              while (back && colour === "rgba(0, 0, 0, 0)") {
                colour = getComputedStyle(back).backgroundColor; back = back.parentElement; }
              seen.push([s, getComputedStyle(e).color, colour]);
            }
            return seen;
        """)
        for selector, front, back in pairs:
            a, b = sorted((luminance(front), luminance(back)), reverse=True)
            assert (a + 0.05) / (b + 0.05) >= 4.5, (theme, selector, front, back)
        page_is_dark = luminance(pairs[0][2]) < 0.1
        assert page_is_dark == (theme == "dark")
    browser.cdp("Emulation.setEmulatedMedia", {"features": []})


def luminance(colour: str) -> float:
    parts = np.array(list(map(float, re.findall(r"[\d.]+", colour)))[:3]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_page_of_many_tracks_opens(browser: Browser, run: Path) -> None:
    """The docs promise at most 70 kB per object."""
    text = many_tracks(run, 150)
    page = run / "many.html"
    page.write_text(text, "utf-8")
    browser.open(page)

    assert len(text.encode()) < 150 * 70e3
    assert browser.run("return document.querySelectorAll('.card').length") == 150
    assert browser.run("return document.body.dataset.ready") == "yes"


@pytest.mark.parametrize("table", ["tracks", "detections", "frames"])
@pytest.mark.parametrize("words", [["report"], ["annotate"]])
def test_damaged_table_is_reported_by_name(
    shapecat: Run, run: Path, tmp_path: Path, words: list[str], table: str
) -> None:
    """A disk error in one file must not end in a traceback."""
    folder = tmp_path / "damaged"
    shutil.copytree(run, folder)
    content = (folder / f"{table}.parquet").read_bytes()
    (folder / f"{table}.parquet").write_bytes(content[:-40] + bytes(40))
    result = shapecat(*words, folder)

    assert result.exit_code == 1
    assert f"{table}.parquet: not a readable table of a run folder" in result.stderr


def test_run_without_tracks_has_a_page(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The frames are shown all the same; how they are drawn does not matter here."""
    monkeypatch.setattr(
        "shapecat.outputs.report.images._shaded",
        lambda frame, _window: np.zeros((*frame.depth.shape, 3), np.uint8),
    )
    header = (run / "tracks.csv").read_text().splitlines()[0]
    for name in ("tracks.original.csv", "tracks.csv"):
        (run / name).write_text(header + "\n")
    table = pq.read_table(run / "tracks.parquet")
    pq.write_table(table.slice(0, 0), run / "tracks.parquet")
    (report,) = read_reports([run]).runs

    assert report.listed("x").tally.categories.total() == 0
    assert "<article" not in report.page()
    assert report.page().count('class="frame"') == 8
