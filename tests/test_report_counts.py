"""Tests that all pages of a report have the same counts, those of the corrected table."""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from shapecat.outputs.report.writing import Reports, RunReport
from shapecat.runs.labels.corrections import relabel
from tests.browser import Browser
from tests.track_tables import lines

Tiles = dict[str, str]


@pytest.fixture
def labelled(run: Path) -> dict[int, str]:
    """Return labels of every kind, for tracks of the run; the first two tracks are merged."""
    a, b, c, d, e, *_ = (int(line["track"]) for line in lines(run))
    other = "bowl" if lines(run)[2]["category"] != "bowl" else "can"
    return {a: f"merge with {b}", b: "mug", c: other, d: "delete", e: "unknown"}


def of_page(text: str) -> tuple[Tiles, dict[str, int]]:
    """Return the tiles of a page, and its filters with their counts."""
    tiles = dict(re.findall(r"<dt>(tracks|uncertain)</dt><dd>(\d+)</dd>", text))
    chips = re.findall(r'data-category="([^"]+)" aria-pressed.*?<b>(\d+)</b>', text)
    return tiles, {name: int(count) for name, count in chips}


def counted(run: Path) -> tuple[int, int, Counter[str]]:
    """Count the objects, uncertain tracks and categories in tracks.csv, with its labels applied."""
    rows = {int(line["track"]): line for line in lines(run)}
    assert all(row["label"].count("merge") <= 1 for row in rows.values())
    kept = [r for r in rows.values() if r["label"] != "delete" and "merge" not in r["label"]]
    unsure = [
        row
        for row in rows.values()
        if not row["label"] and (row["category"] == "unknown" or float(row["confidence"]) < 0.8)
    ]
    return len(kept), len(unsure), Counter(row["label"] or row["category"] for row in kept)


def test_page_and_index_count_the_labelled_tracks(
    run: Path, drawn: RunReport, labelled: dict[int, str]
) -> None:
    """Both must count them after the corrections: the page once counted them as before."""
    relabel(run, labelled)
    objects, unsure, categories = counted(run)
    page, index = Reports([replace(drawn, folder=run)], indexed=True).write()
    tiles, chips = of_page(page.read_text())

    assert objects == len(lines(run)) - 2
    assert tiles == {"tracks": str(objects), "uncertain": str(unsure)}
    assert tiles == of_page(index.read_text())[0]
    assert {name: count for name, count in chips.items() if count} == categories
    words = ", ".join(f"{name} {count}" for name, count in categories.items())
    (listed,) = re.findall(r'class="share">.*?</div><p class="muted">(.*?)</p>', index.read_text())
    assert sorted(listed.split(", ")) == sorted(words.split(", "))


def test_counts_follow_corrections_on_the_page(
    browser: Browser, run: Path, drawn: RunReport, labelled: dict[int, str]
) -> None:
    """The page must count like one written after the corrections; undo must restore its counts."""
    reports = Reports([replace(drawn, folder=run)])
    (page,) = reports.write()
    script = """
        const tile = (name) => [...document.querySelectorAll(".tiles dt")].find(
            (one) => one.textContent === name).nextElementSibling.textContent;
        const chips = [...document.querySelectorAll(".chip")].map(
            (one) => [one.dataset.category, +one.querySelector("b").textContent]);
        return [tile("tracks"), tile("uncertain"), chips];
    """
    browser.open(page)
    before = browser.run(script)
    for track, label in reversed(labelled.items()):
        browser.type(f"#track-{track} .other", f"{label}\n")
    after = browser.run(script)
    shown = {name: count for name, count in after[2] if count}

    relabel(run, labelled)
    objects, unsure, categories = counted(run)
    assert (after[:2], shown) == ([str(objects), str(unsure)], categories)
    assert before != after
    browser.click(".chip[data-category='mug']")  # hides both cards of the merged tracks
    hidden = "return [...document.querySelectorAll('.card[hidden]')].map((c) => +c.dataset.track)"
    assert sorted(browser.run(hidden)) == sorted(list(labelled)[:2])
    browser.click(".chip[data-category='mug']")
    for _ in labelled:
        browser.click("#undo")
    undone = browser.run(script)
    assert undone[:2] == before[:2]
    assert {n: k for n, k in undone[2] if k} == {n: k for n, k in before[2] if k}
    assert browser.console_messages() == []
