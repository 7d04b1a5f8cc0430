"""The report: what is on the page, and in a browser where there is one."""

import base64
import io
import json
import re
import shutil
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from click.testing import Result

from shapecat.outputs.report import write_report, write_reports
from shapecat.outputs.report_drawing import SIDE, Snapshot, draw
from shapecat.outputs.report_page import Card, run_page
from shapecat.outputs.report_tracks import Course, read_courses
from shapecat.outputs.rereading import FinishedRun, read_finished
from shapecat.runs.corrections import read_labels
from shapecat.runs.track_table import TrackRow, TrackTable, read_track_table
from shapecat.types import NeuralGas

Run = Callable[..., Result]


@pytest.fixture
def run(guessed_run: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "out" / "table"
    shutil.copytree(guessed_run, folder)
    return folder


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found
    content: dict[str, Any] = json.loads(found[1])
    return content


def test_every_track_has_a_card_with_three_pictures(run: Path) -> None:
    (page,) = write_reports([run])
    text = page.read_text("utf-8")
    table = read_track_table(run / "tracks.csv")

    assert page == run / "report.html"
    assert re.findall(r'<article class="card" id="track-(\d+)"', text) == [
        str(row.track) for row in table.rows
    ]
    assert text.count("data:image/png;base64,") == 3 * len(table.rows)
    assert text.count("<polyline") >= len(table.rows)
    assert [row["track"] for row in data_of(text)["rows"]] == [str(r.track) for r in table.rows]
    assert "drawn from their graphs" not in text


def test_page_needs_nothing_from_outside(run: Path) -> None:
    """It is opened from a stick on a robot without network."""
    (page,) = write_reports([run])
    text = page.read_text("utf-8")

    assert not re.findall(r'(?:src|href)="(?!data:|#|\.\./)', text)
    assert "http" not in re.sub(r"http-equiv", "", text)
    assert "@import" not in text
    assert "url(" not in text


def test_names_cannot_break_the_page(run: Path) -> None:
    """Names of topics and categories come from recordings and models of others."""
    evil = "</script><img src=x onerror=alert(1)>"
    about = json.loads((run / "run.json").read_text())
    about["warnings"] = [evil]
    about["options"]["topics"] = [evil]
    about["model"]["categories"][0] = evil
    table = (run / "tracks.csv").read_text().splitlines()
    table[1] = table[1].replace(table[1].split(",")[4], evil)
    (run / "tracks.csv").write_text("\n".join(table) + "\n")
    courses = read_courses(run)
    rows = read_track_table(run / "tracks.csv")
    finished = FinishedRun(run, about, {})

    text = run_page(finished, rows, [Card(r, courses[r.track], (), None) for r in rows.rows], {})

    assert "<img src=x" not in text
    assert text.count("</script>") == 2
    assert data_of(text)["rows"][0]["category"] == evil


def test_without_the_recording_objects_are_drawn_from_their_graphs(run: Path) -> None:
    about = json.loads((run / "run.json").read_text())
    about["input"]["path"] = str(run / "gone.mcap")
    (run / "run.json").write_text(json.dumps(about))

    listed = write_report(run)
    text = (run / "report.html").read_text("utf-8")

    assert "objects are drawn from their graphs" in text
    assert "gone.mcap" in text
    assert text.count("data:image/png;base64,") == 3 * len(
        read_track_table(run / "tracks.csv").rows
    )
    assert listed.faces


def test_index_lists_runs_and_links_to_them(shapecat: Run, run: Path) -> None:
    other = run.with_name("ta ble#2")
    shutil.copytree(run, other)
    (run.parent / ".table.partial").mkdir()
    (run.parent / ".table.partial" / "run.json").write_text("{}")

    result = shapecat("report", run.parent)

    assert result.exit_code == 0, result.output
    text = (run.parent / "index.html").read_text("utf-8")
    links = re.findall(r'class="run" href="([^"]+)"', text)
    assert links == ["ta%20ble%232/report.html", "table/report.html"]
    assert 'href="../index.html"' in (run / "report.html").read_text("utf-8")
    assert shapecat("report", run.parent.parent / "nothing").exit_code == 1


def decode(image: str) -> np.ndarray:
    opened = pytest.importorskip("PIL.Image").open(
        io.BytesIO(base64.b64decode(image.partition(",")[2]))
    )
    return np.asarray(opened.convert("RGBA")).astype(int)


def ball(count: int = 4000) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    points *= 0.05 / np.linalg.norm(points, axis=1, keepdims=True)
    points[:, 2] += 0.05
    return points


def test_a_ball_is_drawn_round_and_lit_from_above() -> None:
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
def test_drawing_takes_any_object(count: int) -> None:
    gas = NeuralGas(np.zeros((0, 3)), np.zeros((0, 2)))

    assert len(draw(Snapshot(ball(5)[:count], gas, np.ones(3)), (1, 2, 3))) == 3


def many_tracks(folder: Path, count: int) -> str:
    """Return a page with full pictures, graphs and time lines for many tracks."""
    rng = np.random.default_rng(1)
    edges = np.unique(np.sort(rng.integers(0, 80, (230, 2)), axis=1), axis=0)
    gas = NeuralGas(ball(80), edges[edges[:, 0] < edges[:, 1]])
    pictures = draw(Snapshot(ball(), gas, np.array([1.0, 0.3, 0.6])), (200, 60, 60))
    cards = []
    for track in range(1, count + 1):
        causal = rng.dirichlet(np.ones(7), 300)
        course = Course(np.arange(300) / 10, rng.random(300) < 0.9, causal, ())
        cells = {"track": str(track), "category": "cup", "confidence": ".5", "label": ""}
        row = TrackRow(track + 1, track, "cup", 0.5, "", "/d", cells)
        cards.append(Card(row, course, pictures, (0.1, 0.1, 0.1)))
    table = TrackTable(
        ("track", "category", "confidence", "label"), tuple(c.row for c in cards), ()
    )
    return run_page(FinishedRun(folder, read_finished(folder).run, {}), table, cards, {})


class Browser:
    """A headless Chromium, driven over the WebDriver protocol."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        driver = shutil.which("chromedriver")
        if driver is None or not (shutil.which("chromium") or shutil.which("google-chrome")):
            pytest.skip("no Chromium with its driver on this machine")
        self._base = f"http://127.0.0.1:{port}"
        self.downloads = folder / "downloads"
        self.downloads.mkdir()
        self._process = subprocess.Popen(
            [driver, f"--port={port}"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        arguments = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--window-size=1400,1000",
            f"--user-data-dir={folder / 'profile'}",
        ]
        options = {"args": arguments, "binary": shutil.which("chromium") or "google-chrome"}
        wanted = {
            "goog:chromeOptions": options,
            "goog:loggingPrefs": {"browser": "ALL"},
            "timeouts": {"pageLoad": 60000},
        }
        for _ in range(100):
            try:
                self.session = self._send(
                    "POST", "/session", {"capabilities": {"alwaysMatch": wanted}}
                )["sessionId"]
                break
            except ConnectionError:
                time.sleep(0.1)
            except urllib.error.URLError:
                time.sleep(0.1)
        where = {"behavior": "allow", "downloadPath": str(self.downloads)}
        self.cdp("Browser.setDownloadBehavior", where)

    def close(self) -> None:
        """End the browser and its driver."""
        try:
            self._send("DELETE", f"/session/{self.session}")
        finally:
            self._process.terminate()
            self._process.wait(10)

    def _send(self, method: str, path: str, body: object = None) -> Any:
        content = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(self._base + path, content, headers, method=method)  # noqa: S310  our own driver
        with urllib.request.urlopen(request, timeout=90) as answer:  # noqa: S310  the same
            return json.load(answer)["value"]

    def _ask(self, method: str, path: str, body: object = None) -> Any:
        return self._send(method, f"/session/{self.session}{path}", body)

    def open(self, page: Path) -> None:
        """Load a page from its file."""
        self._ask("POST", "/url", {"url": page.as_uri()})

    def run(self, script: str) -> Any:
        """Return what a script returns."""
        return self._ask("POST", "/execute/sync", {"script": script, "args": []})

    def _find(self, selector: str) -> str:
        found = self._ask("POST", "/element", {"using": "css selector", "value": selector})
        return str(next(iter(found.values())))

    def click(self, selector: str) -> None:
        """Click an element as a person does."""
        self._ask("POST", f"/element/{self._find(selector)}/click", {})

    def type(self, selector: str, text: str) -> None:
        """Type into an element."""
        self._ask("POST", f"/element/{self._find(selector)}/value", {"text": text})

    def cdp(self, command: str, parameters: object) -> Any:
        """Send a command of the DevTools protocol."""
        return self._ask("POST", "/goog/cdp/execute", {"cmd": command, "params": parameters})

    def complaints(self) -> list[str]:
        """Return warnings and errors of the console."""
        return [entry["message"] for entry in self._ask("POST", "/se/log", {"type": "browser"})]

    def downloaded(self) -> Path:
        """Wait for a download to be complete."""
        for _ in range(100):
            found = list(self.downloads.glob("*.csv"))
            if found:
                return found[0]
            time.sleep(0.05)
        pytest.fail("nothing was downloaded")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    opened = Browser(tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


def test_corrections_clicked_in_a_browser_are_adopted(
    browser: Browser, shapecat: Run, run: Path
) -> None:
    """From click to annotated.mcap: what the page writes is what `annotate` reads."""
    (page,) = write_reports([run])
    rows = read_track_table(run / "tracks.csv").rows
    a, b, c, d, e = (row.track for row in rows[:5])
    other = "bowl" if rows[0].category != "bowl" else "can"
    browser.open(page)
    assert browser.run("return document.body.dataset.ready") == "yes"

    browser.click(f"#track-{a} button[data-label='{other}']")
    browser.click(f"#track-{b} button[data-label='delete']")
    browser.type(f"#track-{c} .other", "wine glass\n")
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
    result = shapecat("annotate", run, "--labels", table)
    table.unlink()

    assert result.exit_code == 0, result.output
    labels = read_labels(run / "tracks.csv")
    assert labels[a].category == labels[d].category == other
    assert (labels[d].track, labels[c].category, labels[e].confidence) == (a, "wine glass", 1.0)
    assert b not in labels
    assert browser.complaints() == []

    write_reports([run])
    browser.open(page)
    assert browser.run("return document.querySelectorAll('.changed').length") == 4


def test_filters_in_a_browser(browser: Browser, run: Path) -> None:
    (page,) = write_reports([run])
    rows = read_track_table(run / "tracks.csv").rows
    browser.open(page)
    browser.run("localStorage.clear()")
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
    drawn = "return getComputedStyle(document.querySelector('.side svg')).display"
    browser.run(choose % "changed")
    assert browser.run(shown) == [rows[1].track]
    browser.run(choose % "open")
    assert rows[1].track not in browser.run(shown)
    assert browser.run(drawn) == "block"
    browser.click("#graphs")
    assert browser.run(drawn) == "none"
    assert browser.complaints() == []


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_can_be_read_in_both_themes(browser: Browser, run: Path, theme: str) -> None:
    """Contrast of text on its background: at least 4.5, as WCAG AA asks."""
    (page,) = write_reports([run])
    features = [{"name": "prefers-color-scheme", "value": theme}]
    browser.cdp("Emulation.setEmulatedMedia", {"features": features})
    browser.open(page)
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
    browser.cdp("Emulation.setEmulatedMedia", {"features": []})
    for selector, front, back in pairs:
        a, b = sorted((luminance(front), luminance(back)), reverse=True)
        assert (a + 0.05) / (b + 0.05) >= 4.5, (selector, front, back)
    page_is_dark = luminance(pairs[0][2]) < 0.1
    assert page_is_dark == (theme == "dark")


def luminance(colour: str) -> float:
    parts = np.array(list(map(float, re.findall(r"[\d.]+", colour)))[:3]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_five_hundred_tracks_open_at_once(browser: Browser, run: Path) -> None:
    text = many_tracks(run, 500)
    page = run / "many.html"
    page.write_text(text, "utf-8")
    seconds = []
    for _ in range(3):
        browser.open(page)
        assert browser.run("return document.querySelectorAll('.card').length") == 500
        seconds.append(
            browser.run("return performance.getEntriesByType('navigation')[0].loadEventEnd") / 1000
        )

    assert len(text.encode()) < 30e6
    assert min(seconds) < 3


def test_a_run_without_tracks_has_a_page(run: Path) -> None:
    (run / "tracks.csv").write_text((run / "tracks.csv").read_text().splitlines()[0] + "\n")
    table = pq.read_table(run / "tracks.parquet")
    pq.write_table(table.slice(0, 0), run / "tracks.parquet")

    assert write_report(run).categories.total() == 0
    assert "<article" not in (run / "report.html").read_text("utf-8")
