"""Tests of the numbers on the pages of a report, worked out by hand."""

import base64
import io
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from shapecat.colour.masks import Mask
from shapecat.outputs.colours import colour_of
from shapecat.outputs.png import png
from shapecat.outputs.report import choosing
from shapecat.outputs.report.cards import Card, TrackCounts, _few, card_html
from shapecat.outputs.report.choosing import Choice, _areas, choose_frames
from shapecat.outputs.report.images import Crop, FramePicture, _border_share, _hidden_share, encode
from shapecat.outputs.report.page import Listed, _strip, index_page, run_page
from shapecat.outputs.report.pictures import (
    Pictures,
    StripFrame,
    TrackPictures,
    _Collector,
    _points,
    _strip_frame,
)
from shapecat.outputs.report.surfaces import Snapshot, SurfaceDrawing, _palette, _uri, draw
from shapecat.outputs.report.tracks import Detected, Timeline, read_timelines
from shapecat.outputs.report.writing import RunReport, _faces, read_report
from shapecat.runs.finished import FinishedRun, read_finished
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.labels.track_table import TrackRow, TrackTable
from shapecat.runs.tables.schemas import FRAMES, TRACKS
from shapecat.types import (
    Box,
    Camera,
    Frame,
    ImageMasks,
    LabelledFrame,
    LabelledObject,
    NeuralGas,
)

NAMES = ("cup", "can", "box")
UP = np.array([0, -1, 0])


def test_card_shows_views_times_and_sorted_posterior() -> None:
    """Frames without a detection are not views."""
    seen = np.array([True, True, False, False, True, False])
    causal = np.tile([0.2, 0.5, 0.3], (6, 1))
    line = Timeline(np.array([1.0, 1.5, 2.0, 2.5, 3.2, 3.9]), seen, causal, (), causal[-1])
    row = TrackRow(2, 4, "can", 0.5, "", "/d", {"novelty": "0.31"})
    card = card_html(Card(row, line, None), NAMES, ("unknown", *NAMES), 4.0)

    assert "3 views · 1.0–3.2 s · novelty 0.31" in card
    assert re.findall(r'data-label="(\w+)"', card)[:3] == ["can", "box", "cup"]
    assert re.findall(r"<kbd>(\d)</kbd>", card) == ["2", "3", "1"]
    bars = re.findall(r'class="seen" x="([\d.]+)" y="38" width="([\d.]+)"', card)
    assert bars == [("75.0", "37.5"), ("240.0", "1.5")]


def text_of(html: str) -> list[str]:
    """Return the visible text of HTML, in order."""
    return [part.strip() for part in re.split(r"<[^>]*>", html) if part.strip()]


def worked_card() -> Card:
    """Return a card with a posterior that changes from cup to can, and no two equal numbers."""
    causal = [[0.7, 0.2, 0.1], [0.5, 0.3, 0.2], [0.5, 0.3, 0.2], [0.16, 0.58, 0.26]]
    seen = np.array([True, False, True, False])
    line = Timeline(
        np.array([1.0, 1.5, 2.5, 3.2]), seen, np.array(causal), (), np.array(causal[-1])
    )
    sides = tuple(SurfaceDrawing(n, f"data:{n}", f"M{n}", f"N{n}") for n in ("front", "top"))
    pictures = TrackPictures(Crop("data:crop", 60, 40, "M1 2L3 4"), sides, (0.123, 0.071, 0.234))
    return Card(TrackRow(2, 17, "can", 0.644, "", "/d", {"novelty": "0.31"}), line, pictures)


def test_card_has_right_values() -> None:
    """Bars show the last posterior, of all views, even if the track coasts at its end.

    On the timeline, 300 wide and 4 s long, probability 0 is at y = 33 and 1 at y = 2.
    """
    card = card_html(worked_card(), NAMES, ("unknown", *NAMES), 4.0)
    article = re.search(r"<article [^>]*>", card)
    lines = re.findall(r'<polyline points="(.*?)" stroke="(.*?)"', card)
    bars = re.findall(r'data-label="(\w+)" style="--c:(#\w+);--w:([\d.]+%)"', card)

    assert text_of(card) == [
        "can", "0.64", "#17",
        "posterior over time; the bar below shows when the object was seen",
        "2", "can", "0.58", "3", "box", "0.26", "1", "cup", "0.16",
        "2 views · 1.0–2.5 s · 12 × 7 × 23 cm · novelty 0.31", "unknown", "delete",
    ]  # fmt: skip
    assert article is not None
    for name, value in (
        ("track", "17"), ("category", "can"), ("confidence", "0.644"), ("first", "1")
    ):  # fmt: skip
        assert f'data-{name}="{value}"' in article[0]
    assert bars == [
        ("can", "#46a758", "58.0%"), ("box", "#3e82f6", "26.0%"), ("cup", "#e5484d", "16.0%")
    ]  # fmt: skip
    assert lines == [
        ("75,29.9 112.5,26.8 187.5,26.8 240,24.9", "#3e82f6"),
        ("75,26.8 112.5,23.7 187.5,23.7 240,15", "#46a758"),
        ("75,11.3 112.5,17.5 187.5,17.5 240,28", "#e5484d"),
    ]
    assert re.findall(r'class="seen" x="(.*?)" y="38" width="(.*?)"', card) == [
        ("75.0", "1.5"), ("187.5", "1.5")
    ]  # fmt: skip
    assert re.findall(r'src="(.*?)"', card) == ["data:crop", "data:front", "data:top"]
    assert re.findall(r'viewBox="([\d ]+)"', card)[:2] == ["0 0 60 40", "0 0 160 160"]
    assert re.findall(r'<path (?:class="nodes" )?d="(.*?)"/>', card) == [
        "M1 2L3 4", "Mfront", "Nfront", "Mtop", "Ntop"
    ]  # fmt: skip
    assert re.findall(r'title="(front|top)"', card) == ["front", "top"]


@pytest.mark.parametrize("topics", [("/d", "/d"), ("/d", "/e")])
def test_strip_boxes_have_right_positions(topics: tuple[str, str]) -> None:
    """Boxes are in fractions: left and width of the image's width, top and height of its height.

    Topics are named if there are several. Captions have two decimals, as frames may be less than
    0.1 s apart, and say if the picture is shaded depth.
    """
    boxes = {17: (50, 30, 20, 15), 99: (1, 2, 3, 4)}
    few = StripFrame("data:few", 200, 100, 0.52, topics[0], boxes)
    many = StripFrame("data:many", 100, 80, 3.48, topics[1], {k: (k, 4, 8, 6) for k in range(5)})
    many = many._replace(shaded=True)
    strip = _strip([few, many], [worked_card()])
    names = ["0.52 s /d", "3.48 s /e"] if topics[0] != topics[1] else ["0.52 s", "3.48 s"]
    names[1] += ", shaded depth"

    assert text_of(strip) == ["#17", "can", names[0], names[1]]  # 99 has no card
    assert re.findall(r'data-track="(\d+)" style="(.*?)"', strip) == [
        ("17", "left:25.0%;top:30.0%;width:10.0%;height:15.0%;--c:#46a758")
    ]
    assert re.findall(r'class="(frame.*?)" style="(.*?)" data-name="(.*?)"', strip) == [
        ("frame", "--ratio:2.0000", names[0]), ("frame crowded", "--ratio:1.2500", names[1])
    ]  # fmt: skip
    assert re.findall(r'src="(.*?)"', strip) == ["data:few", "data:many"]


@pytest.mark.parametrize("served", [False, True])
def test_run_page_has_right_values(*, served: bool) -> None:
    info: Any = {
        "input": {"path": "/data/lab.mcap", "bytes": 12_340_000, "digest": "xxh3-128:77"},
        "options": {"topics": ["/d", "/e"]},
        "counts": {"frames": 61, "detections": 143, "skipped": {"too few points": 5}},
        "model": {"id": "m-7", "categories": list(NAMES)},
        "warnings": ["it <was> dark"],
        "seconds": {"total": 15.67, "perceive": 12.34},
        "fixed_frame": "map",
        "up": {"source": "imu"},
        "color": {"/d": "/rgb", "/e": "/rgb", "/f": None},  # sensors may share a colour camera
        "versions": {"shapecat": "1.2", "python": "3.13"},
    }
    table = TrackTable(("track", "label"), (worked_card().row,), ())
    lab = FinishedRun(Path("out/my lab"), info, table, {17: TrackLabel(17, "mug", 1.0)})
    stages = {"detect": np.array([0.0021, 0.0042, 0.1044]), "rest": np.array([])}
    text = run_page(
        lab, [worked_card()], [], stages,
        length_s=4.3, notes=["a note"], index="../i.html", served=served,
    )  # fmt: skip
    facts = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text.partition("Glossary")[0]))
    (times,) = re.findall(r"<h2>Time</h2><table>(.*?)</table>", text)
    cells = [
        re.findall(r"<t[hd]>(.*?)</t[hd]>", line) for line in re.findall(r"<tr>.*?</tr>", times)
    ]
    (instruction,) = re.findall(
        r'</div>\s*<p class="muted">(.*?)</code>', text[text.index("confusion") :]
    )
    option = "" if served else " --labels ~/Downloads/tracks-….csv"

    assert facts == {
        "frames": "61", "length": "4.3 s", "detections": "143", "tracks": "1", "uncertain": "1",
        "model": "m-7", "categories": "cup, can, box", "fixed frame": "map", "up": "imu",
        "colour images": "/rgb", "skipped frames": "5 too few points", "shapecat": "1.2",
        "python": "3.13", "input digest": "xxh3-128:77",
    }  # fmt: skip
    assert "/data/lab.mcap · 12.3 MB · /d, /e" in text
    assert re.findall(r"<li>⚠ (.*?)</li>", text) == ["it &lt;was&gt; dark", "a note"]
    assert '<a href="../i.html">all runs</a>' in text
    assert cells == [
        ["stage, per frame", "median, ms", "95th percentile, ms"],
        ["detect", "4.2", "94.4"],
        ["rest", "0.0", "0.0"],
        ["phase", "total, s", ""],
        ["perceive", "12.3", ""],
        ["total", "15.7", ""],
    ]
    assert text_of(instruction)[-1] == f"shapecat annotate &#x27;out/my lab&#x27;{option}"
    assert ("already in tracks.csv" in instruction) == served
    assert ("connect-src 'self'" in text) == served
    assert re.findall(r'<option value="(unknown|cup|can|box|mug)">', text) == [
        "unknown", "cup", "can", "box", "mug"
    ]  # fmt: skip
    assert re.findall(r'data-category="(\w+)" aria-pressed', text) == ["mug"]
    data = json.loads(re.findall(r'id="data">(.*?)</script>', text)[0])
    assert data["served"] is served
    assert data["categories"] == ["unknown", "cup", "can", "box", "mug"]
    assert data["rows"] == [{"track": "17", "category": "can", "label": "", "cells": ["", ""]}]


def test_stages_are_in_milliseconds_and_phases_in_seconds(run: Path) -> None:
    finished = read_finished(run)
    finished.info["seconds"] = {"perceive": 12.34}
    text = run_page(finished, [], [], {"detect": np.array([0.002, 0.004, 0.104])}, length_s=1.0)

    assert "<td>detect</td><td>4.0</td><td>94.0</td></tr>" in text
    assert "<td>perceive</td><td>12.3</td><td></td></tr>" in text


def test_page_without_tracks_does_not_blame_the_filter(run: Path) -> None:
    text = run_page(read_finished(run), [], [], {}, length_s=1.0)

    assert "No objects were found." in text
    assert "filter." not in text.partition("<script")[0]


def test_timelines_end_with_the_last_track(run: Path) -> None:
    """The scale is the same on all cards, and no line is drawn beyond its card."""
    ends = {4: [1.0, 2.5], 5: [0.5, 6.25], 6: [3.0]}
    cards = [
        Card(
            TrackRow(2, track, "can", 0.5, "", "/d", {}),
            Timeline(
                np.array(at),
                np.ones(len(at), bool),
                np.tile([0.2, 0.5, 0.3], (len(at), 1)),
                (),
                np.array([0.2, 0.5, 0.3]),
            ),
            None,
        )
        for track, at in ends.items()
    ]
    text = run_page(read_finished(run), cards, [], {}, length_s=9.0)
    lines = re.findall(r'<polyline points="([^"]+)"', text)

    assert [line.split()[0].split(",")[0] for line in lines[::3]] == ["48", "24", "144"]
    assert [line.split()[-1].split(",")[0] for line in lines[::3]] == ["120", "300", "144"]


def test_card_of_a_single_frame_has_no_timeline() -> None:
    """A plot over no time is an empty box."""
    card = worked_card()
    causal = card.timeline.causal[:1]
    line = Timeline(np.zeros(1), np.ones(1, bool), causal, (), causal[0])
    text = card_html(replace(card, timeline=line), NAMES, ("unknown", *NAMES), 0.0)

    assert 'class="line"' not in text
    assert "1 view · 0.0 s" in text
    assert 'class="line"' in card_html(card, NAMES, ("unknown", *NAMES), 4.0)


def test_long_timeline_includes_both_ends() -> None:
    """The last posterior of a track is the one that counts."""
    assert _few(80).tolist() == list(range(80))
    assert _few(3).tolist() == [0, 1, 2]
    some = _few(1001)
    assert (len(some), some[0], some[-1]) == (80, 0, 1000)
    assert set(np.diff(some)) == {12, 13}


def test_index_sums_its_runs() -> None:
    listed = []
    for k, (frames, unsure, checked) in enumerate([(7, 2, 5), (40, 1, 0)]):
        counts = Counter({"cup": 3 + k, "can": 6})
        info = {"counts": {"frames": frames}, "seconds": {"total": 12.34}}
        tally = TrackCounts(counts, unsure, checked)
        listed.append(Listed(f"{k}.html", f"run {k}", info, tally, k, ("data:p",)))
    text = index_page("runs", listed)

    tiles = dict(re.findall(r"<dt>(\w+)</dt><dd>(\d+)</dd>", text))
    assert tiles == {
        "recordings": "2", "frames": "47", "tracks": "19", "uncertain": "3", "checked": "5"
    }  # fmt: skip
    assert "can 12, cup 7" in text
    assert "7 frames · processed in 12.3 s · 2 uncertain · 5 checked</p>" in text
    assert "40 frames · processed in 12.3 s · 1 uncertain · <span" in text
    assert "⚠ 1 warning</span>" in text
    assert "can 6, cup 4" in text


def test_index_orders_categories_of_equal_counts() -> None:
    """Labels come from a set, whose order differs from one process to the next."""
    info = {"counts": {"frames": 1}, "seconds": {}}
    pages = [
        index_page(
            "runs", [Listed("0.html", "run 0", info, TrackCounts(Counter(names), 0, 0), 0, ())]
        )
        for names in (["cup", "can", "box", "box"], ["box", "can", "cup", "box"])
    ]

    assert pages[0] == pages[1]
    assert "box 2, can 1, cup 1" in pages[0]


def test_index_counts_tracks_left_to_check(run: Path) -> None:
    """A labelled track is no longer uncertain."""
    header, *lines = (run / "tracks.csv").read_text().splitlines()
    names = header.split(",")
    rows = [dict(zip(names, line.split(","), strict=True)) for line in lines]
    for k, row in enumerate(rows):
        row |= {"confidence": "0.5" if k < 3 else "0.9", "label": "cup" if k in {1, 4} else ""}
        row["category"] = "can"
    table = [header, *(",".join(row[name] for name in names) for row in rows)]
    for file in ("tracks.original.csv", "tracks.csv"):
        (run / file).write_text("\n".join(table) + "\n")

    listed = RunReport(run, "", read_timelines(run), Pictures({}, []), {}, 0.0).listed("x").tally
    assert (listed.unsure, listed.checked) == (2, 2)
    assert listed.categories == {"can": len(rows) - 2, "cup": 2}


def test_merged_tracks_count_once_in_index(run: Path) -> None:
    """Three tracks are merged, and a fourth is deleted."""
    rows = (run / "tracks.csv").read_text().splitlines()
    at = rows[0].split(",").index("label")
    names = [row.split(",")[0] for row in rows[1:]]
    labels = ["mug", *[f"merge with {names[0]}"] * 2, "delete"]
    for k, label in enumerate(labels, start=1):
        cells = rows[k].split(",")
        rows[k] = ",".join([*cells[:at], label, *cells[at + 1 :]])
    (run / "tracks.csv").write_text("\n".join(rows) + "\n")
    listed = RunReport(run, "", read_timelines(run), Pictures({}, []), {}, 0.0).listed("x").tally

    assert listed.categories["mug"] == 1
    assert listed.categories.total() == len(names) - 3
    assert listed.checked == 4


def test_detection_with_number_zero_is_a_view(run: Path) -> None:
    """Only a row without a detection number is not a view; 0 must not be taken for none."""
    table = pq.read_table(run / "tracks.parquet")
    rows = table.to_pylist()
    rows[3]["detection"] = None
    pq.write_table(pa.Table.from_pylist(rows, table.schema), run / "tracks.parquet")
    assert any(row["detection"] == 0 for row in rows)
    for track, line in read_timelines(run).items():
        found = [row["detection"] is not None for row in rows if row["track"] == track]
        assert sorted(line.seen.tolist()) == sorted(found)


def test_track_times_count_from_first_frame_of_run(tmp_path: Path) -> None:
    """Nothing is found in the first frame, and rows are not in the order of time."""
    start, step = 7_000_000_000, 500_000_000
    frames = [{"topic": "/d", "frame": k, "stamp_ns": start + step * k} for k in (1, 0, 3, 2)]
    rows: list[dict[str, Any]] = [
        {"track": 9, "frame": 2, "detection": 1, "posterior": [0.3, 0.7]},
        {"track": 4, "frame": 3, "detection": None, "posterior": [0.8, 0.2]},
        {"track": 4, "frame": 1, "detection": 0, "posterior": [0.6, 0.4]},
    ]
    tracks = [{"topic": "/d", "stamp_ns": start + step * row["frame"], **row} for row in rows]
    for name, content, schema in (("frames", frames, FRAMES), ("tracks", tracks, TRACKS)):
        complete = [dict.fromkeys(schema.names) | row for row in content]
        pq.write_table(pa.Table.from_pylist(complete, schema), tmp_path / f"{name}.parquet")
    lines = read_timelines(tmp_path)

    assert lines.keys() == {4, 9}
    assert (lines[4].seconds.tolist(), lines[9].seconds.tolist()) == ([0.5, 1.5], [1.0])
    assert (lines[4].seen.tolist(), lines[9].seen.tolist()) == ([True, False], [True])
    np.testing.assert_allclose(lines[4].causal, [[0.6, 0.4], [0.8, 0.2]])
    assert lines[4].keys == (("/d", 1, 0), ("/d", 3, -1))


def test_bars_have_the_confidence_of_the_table_if_the_clock_was_set_back(tmp_path: Path) -> None:
    """The latest stamp is then that of an earlier frame, with fewer views."""
    stamps, shares = (0, 4, 8, 1, 2), (0.3, 0.4, 0.45, 0.6, 0.9)
    for name, schema in (("frames", FRAMES), ("tracks", TRACKS)):
        rows = [
            dict.fromkeys(schema.names)
            | {"topic": "/d", "frame": k, "stamp_ns": 10**9 * stamp}
            | ({"track": 9, "detection": 0, "posterior": [p, 1 - p]} if name == "tracks" else {})
            for k, (stamp, p) in enumerate(zip(stamps, shares, strict=True))
        ]
        pq.write_table(pa.Table.from_pylist(rows, schema), tmp_path / f"{name}.parquet")
    line = read_timelines(tmp_path)[9]
    row = TrackRow(2, 9, "cup", 0.9, "", "/d", {})
    bars = re.findall(r"--w:([\d.]+%)", card_html(Card(row, line, None), ("cup", "can"), (), 8.0))

    assert line.seconds.tolist() == [0, 1, 2, 4, 8]
    np.testing.assert_allclose(line.causal[:, 0], [0.3, 0.6, 0.9, 0.4, 0.45])
    assert bars == ["90.0%", "10.0%"]


@pytest.mark.usefixtures("without_pictures")
def test_length_is_that_of_the_run(run: Path) -> None:
    """The last object may leave long before the end, and there may be none."""
    table = pq.read_table(run / "frames.parquet")
    times = pa.array([7_000_000_000 + 1_500_000_000 * k for k in range(table.num_rows)])
    column = table.schema.get_field_index("log_time_ns")
    pq.write_table(table.set_column(column, "log_time_ns", times), run / "frames.parquet")

    length_s = 1.5 * (table.num_rows - 1)
    assert f"<dt>length</dt><dd>{length_s:.1f} s</dd>" in read_report(run).page()


def test_strip_is_sorted_by_time(run: Path) -> None:
    """Frames of several sensors are not logged in the order of their stamps."""
    timelines = read_timelines(run)
    strip = list(choose_frames(run, timelines).strip.items())
    table = pq.read_table(run / "frames.parquet")
    pq.write_table(table.take(list(range(table.num_rows))[::-1]), run / "frames.parquet")

    assert list(choose_frames(run, timelines).strip.items()) == strip


def test_strip_frames_show_new_tracks_first() -> None:
    """Of 3 frames, that with most new tracks is shown; ties go to most tracks, then the middle."""
    stamps = [(7_000_000_000 + 500_000_000 * k, ("/d", k)) for k in range(36)]
    tracks = {0: {1}, 1: {1, 2}, 3: {1, 2}, 5: {3}, 6: {1}, 7: {2}, 8: {3}, 9: {1, 2, 3}, 10: {1}}
    strip = choosing._strip(stamps, {("/d", k): seen for k, seen in tracks.items()})

    frames = [1, 5, 7, 9, *range(13, 36, 3)]
    assert strip == {("/d", k): pytest.approx(0.5 * k) for k in frames}


@pytest.mark.parametrize("flag", ["touches_border", "occluded", "image border"])
def test_whole_views_are_preferred_to_larger_cut_ones(
    run: Path, flag: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The crop of a card should show the whole object, also if the colour image cuts it."""
    table = pq.read_table(run / "detections.parquet")
    areas = dict[Detected, tuple[float, bool]]()
    monkeypatch.setattr(choosing, "_areas", lambda _: areas)
    timelines = read_timelines(run)
    track, line = max(timelines.items(), key=lambda item: len(item[1].keys))
    owned = {key: k for k, key in enumerate(line.keys)}
    rows = table.to_pylist()
    for row in rows:
        key = (row["topic"], row["frame"], row["detection"])
        cut = owned.get(key, 1) % 2 == 0
        row |= {"points": 3000 if cut else 1000, "touches_border": False, "occluded": False}
        if flag in row:
            row[flag] = cut
        else:
            areas[key] = (row["points"], cut)
    pq.write_table(pa.Table.from_pylist(rows, table.schema), run / "detections.parquet")
    chosen = choose_frames(run, timelines).candidates
    views = [k for (topic, frame, _), k in owned.items() if track in chosen.get((topic, frame), ())]

    assert len(line.keys) == 8
    assert len(views) == 4
    assert all(k % 2 for k in views)


def test_the_largest_masks_of_a_track_are_not_shown() -> None:
    """They often include some table; complete views are preferred in each quarter of the track."""
    sizes = [500, 530, 2000, 510, 520, 540]
    views = [choosing._View(("/d", k), size, complete=True) for k, size in enumerate(4 * sizes)]
    cut = [choosing._View(("/d", k), 9000.0 + k, complete=False) for k in range(30, 40)]
    complete_last = [*cut, choosing._View(("/d", 44), 60.0, complete=True)]

    assert [view.key[1] for view in choosing._representative_views(views)] == [5, 11, 17, 23]
    assert [view.key[1] for view in choosing._representative_views(complete_last)] == [
        31,
        34,
        37,
        44,
    ]


@pytest.mark.parametrize(
    ("box", "cut"),
    [
        ((0, 9, 7, 5), True),
        ((9, 0, 7, 5), True),
        ((33, 9, 7, 5), True),
        ((9, 25, 7, 5), True),
        ((1, 1, 38, 28), False),
    ],
)
def test_mask_can_be_cut_by_each_image_border(box: tuple[int, int, int, int], cut: bool) -> None:
    """The image has 40 by 30 pixels; the odd runs are the pixels of the mask."""
    counts = np.array([100, 4, 36, 5, 1055], np.uint32)
    masks = ImageMasks("/c", 1, 2, "camera", 40, 30, {3: box}, {3: counts})

    assert _areas(iter([(("/d", 8), masks)])) == {("/d", 8, 3): (9.0, cut)}


def test_border_share_counts_sides_at_the_border() -> None:
    """The mask has 5, 6, 1 and 2 pixels on its left, upper, right and lower side."""
    pixels = np.array(
        [
            [1, 1, 1, 1, 1, 1, 0],
            [1, 1, 1, 1, 1, 1, 1],
            [1, 1, 0, 0, 0, 0, 0],
            [1, 1, 0, 0, 0, 0, 0],
            [1, 1, 1, 1, 0, 0, 0],
            [0, 0, 1, 1, 0, 0, 0],
        ],
        bool,
    )
    padded = np.pad(pixels, 1).astype(int)
    outline = sum(int(np.abs(np.diff(padded, axis=axis)).sum()) for axis in (0, 1))
    places = {(0, 9): 5, (9, 0): 6, (33, 9): 1, (9, 24): 2, (33, 24): 3, (9, 9): 0}
    for (left, top), cut in places.items():
        share = _border_share(Mask(left, top, pixels), 30, 40)
        assert share == pytest.approx(cut / outline), (left, top)


def test_only_clearly_nearer_neighbours_occlude() -> None:
    """Of ten edges of the mask, the left ones border the same surface, the right an occluder."""
    depth = np.full((8, 9), 2.0, np.float32)
    depth[2:5, 3:5] = 1.0
    depth[2:5, 2] = 0.98  # within 15 mm and 1.5 % it may be noise or a slope
    depth[2:5, 5] = 0.96
    depth[1, 3] = 0.0  # missing depth occludes nothing
    pixels = np.flatnonzero(depth == 1.0)

    assert _hidden_share(depth, pixels) == pytest.approx(3 / 10)
    # First the occluder is at the image border, then the object.
    for columns, share in ((3, 3 / 10), (4, 0)):
        moved = np.roll(depth, columns, axis=1)
        found = _hidden_share(moved, np.flatnonzero(moved == 1.0))
        assert found == pytest.approx(share)


def test_only_pixels_with_depth_are_drawn() -> None:
    """Masks include pixels whose depth is missing."""
    camera = Camera(3, 2, 2.0, 2.0, 1.0, 0.5)
    depth = np.array([[1.5, 0, 1.5], [2.5, 2.5, 0]], np.float32)
    frame = Frame("/d", 0, 0, 0, "camera", depth=depth, camera=camera)
    gas = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))
    box = Box(np.array([0, 0, 1]), np.full(3, 0.1), np.array([0, 0, 0, 1]))
    item = LabelledObject(5, "cup", 0.9, box, np.arange(1, 5), gas, np.ones(1), np.ones(1))

    expected = [[0.75, -0.375, 1.5], [-1.25, 0.625, 2.5], [0, 0.625, 2.5]]
    np.testing.assert_allclose(_points(frame, item), expected)


def test_card_without_recording_shows_view_with_most_points() -> None:
    gas = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))
    box = Box(np.array([0, 0, 1]), np.full(3, 0.1), np.array([0, 0, 0, 1]))
    taken = _Collector(Choice({("/d", k): frozenset({5}) for k in range(4)}, {}))
    for k, points in enumerate((5, 9, 7)):
        item = LabelledObject(5, "cup", 0.9, box, np.arange(points), gas, np.ones(1), np.ones(1))
        other = replace(item, track=6, indices=np.arange(99))  # not wanted from this frame
        frame = LabelledFrame("/d", k, k, k, "camera", None, (), (other, item), (), {}, UP)
        taken.add(frame, None, None)

    assert {track: best.item.indices.size for track, best in taken.best.items()} == {5: 9}


def test_drawings_show_sensor_side_and_top_view() -> None:
    """Right is to the viewer's right, and nearer is lower."""
    ends = [[0.1, 0, 0], [-0.1, 0, 0], [0, 0.07, 0], [0, 0, 0.12]]
    gas = NeuralGas(np.array(ends), np.array([[0, 1]]))
    shot = Snapshot(np.zeros((0, 3), np.float32), gas, np.array([2.0, 0.0, 1.5]))
    spots = [
        np.array(re.findall(r"M(-?\d+) (-?\d+)h0", picture.neurons), int)
        for picture in draw(shot, (200, 60, 60))
    ]
    (near, far, right, top), from_side, (low, high, east, middle) = spots

    assert abs(near[0] - far[0]) < 5 < right[0] - near[0]
    assert top[1] < far[1] < right[1] < near[1]
    assert from_side[0, 0] < from_side[3, 0] < from_side[1, 0]  # from 70 degrees to its left
    assert from_side[3, 1] < from_side[:3, 1].min()
    assert abs(low[0] - high[0]) < 5 < east[0] - low[0]
    assert high[1] < middle[1] < low[1]


def thumbnails(
    found: Sequence[tuple[str, float]],
    labels: Mapping[int, TrackLabel],
    missing: Sequence[int] = (),
) -> list[tuple[int, tuple[int, ...]]]:
    """Return track number and RGB colour of each thumbnail, as read from its picture.

    ``found`` are category and confidence of each track; tracks in ``missing`` have no picture.
    """
    line = Timeline(np.zeros(0), np.zeros(0, bool), np.zeros((0, 3)), (), np.zeros(3))
    cards = []
    for k, (category, confidence) in enumerate(found):
        palette, alpha = _palette(colour_of(category))
        image = _uri(png(np.full((1, 1 + k), 11, np.uint8), palette, alpha))
        pictures = TrackPictures(None, (SurfaceDrawing("", image, "", ""),), (1.0, 1.0, 1.0))
        row = TrackRow(k, k, category, confidence, "", "/d", {})
        cards.append(Card(row, line, None if k in missing else pictures))
    images = [base64.b64decode(face.partition(",")[2]) for face in _faces(cards, labels)]
    decoded = [np.array(Image.open(io.BytesIO(image)).convert("RGB")) for image in images]
    return [(image.shape[1] - 1, tuple(image[0, 0].tolist())) for image in decoded]


def test_thumbnails_are_most_confident_of_each_category() -> None:
    """The most confident of the other tracks follow, up to six thumbnails."""
    found = [("cup", 0.6), ("can", 0.7), ("cup", 0.95), ("cup", 0.9), ("unknown", 0.3)]
    found += [("can", 0.8), ("cup", 0.5), ("cup", 0.4)]
    labels = {k: TrackLabel(k, *track) for k, track in enumerate(found)}

    assert [k for k, _ in thumbnails(found, labels)] == [2, 5, 4, 3, 1, 0]
    assert [k for k, _ in thumbnails(found, labels, [2])] == [3, 5, 4, 1, 0, 6]


def test_thumbnails_show_what_labels_say() -> None:
    """Deleted and merged tracks were shown, and renamed ones in the colour of the old category."""
    found = [("cup", 0.99), ("can", 0.6), ("can", 0.9), ("box", 0.5), ("can", 0.8)]
    ball = TrackLabel(3, "ball", 1.0)
    labels = {1: TrackLabel(1, "can", 0.6), 2: ball, 3: ball, 4: TrackLabel(4, "can", 0.8)}
    shown = thumbnails(found, labels)

    assert [k for k, _ in shown] == [3, 4, 1]
    assert [colour for _, colour in shown[:2]] == [
        tuple(_palette(colour_of(name))[0][11]) for name in ("ball", "can")
    ]
    assert [k for k, _ in thumbnails(found, labels, [3])] == [2, 4, 1]  # 2 is merged with it


def test_strip_boxes_scale_with_their_images() -> None:
    """A wide image is reduced for the page, and its boxes with it."""
    camera = Camera(1200, 900, 800.0, 800.0, 600.0, 450.0)
    frame = Frame("/d", 0, 0, 0, "camera", depth=np.ones((900, 1200)), camera=camera)
    gas = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2), int))
    box = Box(np.array([0, 0, 1]), np.full(3, 0.1), np.array([0, 0, 0, 1]))
    item = LabelledObject(5, "cup", 0.9, box, np.arange(3), gas, np.ones(1), np.ones(1))
    labelled = LabelledFrame("/d", 0, 0, 0, "camera", None, (), (item,), (), {}, UP)
    photo = np.zeros((900, 1200, 3), np.uint8)
    view = FramePicture((Mask(300, 90, np.ones((180, 240), bool)),), np.zeros(1), frame, photo)
    picture = _strip_frame(labelled, view, 0.0)
    _, width, height = encode(photo)

    assert (picture.width, picture.height) == (width, height)
    assert width < 1200
    shares = np.divide(picture.boxes[5], (width, height, width, height))
    np.testing.assert_allclose(shares, [0.25, 0.1, 0.2, 0.2], atol=0.002)


def test_facts_of_page_match_run_json(drawn: RunReport) -> None:
    info = json.loads((drawn.folder / "run.json").read_text())
    text = drawn.page()

    for name in ("frames", "detections"):
        assert f"<dt>{name}</dt><dd>{info['counts'][name]}</dd>" in text
    assert f"<dt>tracks</dt><dd>{len(drawn.timelines)}</dd>" in text
