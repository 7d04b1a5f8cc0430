"""Tests of the served report: labels are written at once, and only the owner can write them."""

import csv
import http.client
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any
from urllib.parse import urlsplit

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import Result

from shapecat.errors import OutputError
from shapecat.outputs.report.serving import _names_this_machine, serve_reports
from shapecat.outputs.report.writing import Reports, RunReport, read_report
from shapecat.runs.labels.corrections import adopt_labels, read_labels
from shapecat.runs.labels.track_table import read_track_table
from tests.browser import Browser
from tests.track_tables import lines

Run = Callable[..., Result]

NAMES = ("cup", "can", "box", "bottle", "bowl", "plate", "ball")
TRACKS = 16
SAVED = (
    "return document.getElementById('saved').textContent === 'All corrections are in tracks.csv.'"
)


@pytest.fixture
def long_run(run: Path) -> Path:
    """Return a run with `TRACKS` tracks, copies of those found; its recording is missing."""
    rows = lines(run)
    tracks = pq.read_table(run / "tracks.parquet")
    many, tables = [], []
    for number in range(1, TRACKS + 1):
        row = rows[number % len(rows)]
        of_track = pa.compute.equal(tracks["track"], int(row["track"]))
        copy = tracks.filter(of_track)
        column = pa.array([number] * copy.num_rows, pa.int32())
        tables.append(copy.set_column(0, tracks.schema.field("track"), column))
        many.append(row | {"track": str(number)})
    for name in ("tracks.original.csv", "tracks.csv"):
        with (run / name).open("w", newline="") as file:
            writer = csv.DictWriter(file, list(many[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(many)
    pq.write_table(pa.concat_tables(tables), run / "tracks.parquet")
    return without_recording(run)


def without_recording(run: Path) -> Path:
    """Point a run to a missing recording; without pictures, its page is served sooner."""
    info = json.loads((run / "run.json").read_text())
    info["input"]["path"] = str(run / "gone.mcap")
    (run / "run.json").write_text(json.dumps(info))
    return run


class Server(subprocess.Popen[str]):
    """``shapecat report --serve`` in its own process, and the address it printed."""

    def __init__(self, *folders: Path) -> None:
        command = [sys.executable, "-m", "shapecat", "report", "--serve", *map(str, folders)]
        super().__init__(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.stdout is not None
        self.address = self.stdout.readline().strip()


@pytest.fixture
def served() -> Iterator[Callable[..., Server]]:
    servers: list[Server] = []

    def serve(*folders: Path) -> Server:
        servers.append(Server(*folders))
        return servers[-1]

    yield serve
    for server in servers:
        server.kill()
        server.communicate()


def labels_on_disk(run: Path) -> dict[int, str]:
    return read_track_table(run / "tracks.csv").labels


def order_of(browser: Browser) -> list[int]:
    script = "return [...document.querySelectorAll('.card')].map((card) => +card.dataset.track)"
    return [int(track) for track in browser.run(script)]


def key_of_other_category(category: str, number: int) -> int:
    """Return the digit key of a category other than ``category``; ``number`` varies the choice."""
    digit = 1 + number % len(NAMES)
    return digit if NAMES[digit - 1] != category else 1 + digit % len(NAMES)


def test_keyboard_corrections_survive_restart_of_server(browser: Browser, long_run: Path) -> None:
    """Corrections must be on disk when the page says so, not only when the server ends."""
    categories = {row.track: row.category for row in read_track_table(long_run / "tracks.csv").rows}
    wanted, keys = {}, []
    with serving(long_run) as (address, _):
        browser.open(address)
        for number, track in enumerate(order_of(browser)):
            digit = key_of_other_category(categories[track], number)
            keys += [str(digit), "Right"]
            wanted[track] = NAMES[digit - 1]
        browser.press(*keys)
        browser.wait(SAVED)
        on_disk = labels_on_disk(long_run)

    assert len(wanted) == TRACKS
    assert on_disk == wanted
    assert browser.console_messages() == []

    script = (
        "return Object.fromEntries([...document.querySelectorAll('.card.changed')].map("
        "(card) => [card.dataset.track, card.querySelector('.fix').textContent]))"
    )
    with serving(long_run) as (address, _):
        browser.open(address)
        shown = browser.run(script)
    assert {int(track): text for track, text in shown.items()} == {
        track: f"→ {label}" for track, label in wanted.items()
    }
    adopt_labels(long_run / "tracks.csv", long_run)  # as `shapecat annotate RUN` does
    assert {
        t: label.category for t, label in read_labels(long_run / "tracks.csv").items()
    } == wanted


@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=pytest.mark.many)])
def test_page_reports_corrections_lost_by_stopped_server(
    browser: Browser, served: Callable[..., Server], long_run: Path, *, killed: bool
) -> None:
    """Each correction must be on disk, or the page must report it and offer it in a table."""
    server = served(long_run) if killed else None
    with nullcontext((server.address, "")) if server else serving(long_run) as (address, _):
        browser.open(address)
        order = order_of(browser)
        browser.press(*["d", "Right"] * 9)
        if server:
            os.kill(server.pid, signal.SIGKILL)  # while requests may be on their way
            server.wait()
    browser.press(*["d", "Right"] * 4)
    browser.wait("return document.getElementById('saved').textContent.includes('does not answer')")
    browser.wait("return !document.getElementById('download').hidden")
    message = browser.run("return document.getElementById('saved').textContent")
    browser.click("#download")
    table = browser.downloaded()
    downloaded = read_track_table(table).labels
    table.unlink()

    on_disk = labels_on_disk(long_run)
    missing = [track for track in order[:13] if on_disk[track] != "delete"]
    assert set(order[9:13]) <= set(missing)
    assert int(message.split()[0]) >= len(missing)
    assert [track for track, label in downloaded.items() if label] == sorted(order[:13])


def test_label_cleared_after_server_has_stopped_is_in_table(
    browser: Browser, long_run: Path
) -> None:
    """The page offers the table to keep the correction, so the table must contain it."""
    with serving(long_run) as (address, _):
        browser.open(address)
        track = order_of(browser)[0]
        browser.press("d")
        browser.wait(SAVED)
        assert labels_on_disk(long_run)[track] == "delete"
    browser.press("Backspace")
    browser.wait("return !document.getElementById('download').hidden")
    browser.click("#download")
    table = browser.downloaded()
    adopt_labels(table, long_run)
    table.unlink()

    assert labels_on_disk(long_run)[track] == ""


LOADED = "return performance.getEntriesByType('resource').some((got) => /labels$/.test(got.name))"
"""Script: whether the page has requested the labels, as it does when it gets the focus."""
TROUBLE = {
    "its answer comes late": (
        "const answer = await real(...request);"
        "await new Promise((done) => setTimeout(done, 500)); return answer;"
    ),
    "it is lost": "throw new TypeError();",
}
"""What happens to the first correction that a page sends."""


@pytest.mark.parametrize("trouble", TROUBLE)
def test_later_corrections_survive_late_or_lost_answer(
    browser: Browser, run: Path, drawn: RunReport, trouble: str
) -> None:
    """A late answer must not undo later labels; a lost request is sent again."""
    with serving(run, drawn) as (address, _):
        browser.open(address)
        browser.run("dispatchEvent(new Event('focus'))")
        browser.wait(LOADED)
        browser.run(
            "const real = fetch; let sent = 0; window.answered = 0;"
            "window.fetch = async (...request) => {"
            "  const number = request[1]?.method === 'POST' ? ++sent : 0;"
            f" try {{ if (number === 1) {{ {TROUBLE[trouble]} }} return await real(...request); }}"
            "  finally { if (number) ++window.answered; } };"
        )
        first, second = order_of(browser)[:2]
        browser.press("d", "Right", "d")
        browser.wait("return window.answered >= 2")
        browser.wait(SAVED)
        for track in (first, second):
            fix = browser.run(f"return document.querySelector('#track-{track} .fix').textContent")
            assert fix == "→ delete"
    found = labels_on_disk(run)
    assert [found[track] for track in (first, second)] == ["delete", "delete"]


def ask(
    address: str,
    method: str = "GET",
    path: str | None = None,
    body: str | bytes | None = None,
    headers: dict[str, str] | None = None,
) -> tuple[int, str]:
    """Send a request without the checks of a browser; return status and text."""
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(parts.hostname or "", parts.port or 0)
    connection.request(method, parts.path if path is None else path, body, headers or {})
    answer = connection.getresponse()
    text = answer.read().decode()
    connection.close()
    return answer.status, text


@contextmanager
def serving(run: Path, drawn: RunReport | None = None) -> Iterator[tuple[str, str]]:
    """Serve a run in this process; give the URL of its page, and the path of its labels.

    ``drawn`` is the report of a run with the same tables, if there is one.
    """
    report = replace(drawn, folder=run) if drawn else read_report(run)
    with serve_reports(Reports([report])) as address:
        yield address, urlsplit(address).path.rpartition("/")[0] + "/labels"


def correction(track: int, label: str, seen: str = "") -> str:
    return json.dumps({"track": track, "label": label, "seen": seen})


@pytest.fixture(scope="module")
def site(
    guessed_run: Path, drawn: RunReport, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Path, str, str]]:
    """Serve a run that no test changes; return it, its page's URL, and the path of its labels."""
    run = tmp_path_factory.mktemp("site") / "ta ble#2"
    shutil.copytree(guessed_run, run)
    with serving(run, drawn) as (address, labels):
        yield run, address, labels


KNOWN = "/{token}/{page}"
FOREIGN_REQUESTS = {
    "no token": ("/{page}", {}),
    "another token": ("/AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA/{page}", {}),
    "a part of the token": ("/{token:.9}/{page}", {}),
    "the token as a query": ("/{page}?token={token}", {}),
    "another origin": (KNOWN, {"Origin": "http://evil.example"}),
    "a page of another port": (KNOWN, {"Origin": "http://127.0.0.1:1"}),
    "a page of no origin": (KNOWN, {"Origin": "null"}),
    "a name that was led here": (KNOWN, {"Host": "evil.example:80"}),
    "its own origin": (KNOWN, {"Host": "evil.example:80", "Origin": "http://evil.example:80"}),
    "a name that begins alike": (KNOWN, {"Host": "127.0.0.1.evil.example:80"}),
    "no host": (KNOWN, {"Host": ""}),
}
"""Path and headers of each request that must be refused."""


@pytest.mark.parametrize("stranger", FOREIGN_REQUESTS)
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_outsiders_are_refused(site: tuple[Path, str, str], method: str, stranger: str) -> None:
    """Any web page can send requests to this machine, even under its own host name."""
    run, address, labels = site
    template, headers = FOREIGN_REQUESTS[stranger]
    target = labels if method == "POST" else urlsplit(address).path
    _, token, page = target.split("/", 2)
    before = (run / "tracks.csv").read_bytes()
    path = template.format(token=token, page=page)
    status, text = ask(address, method, path, correction(1, "bowl"), headers)

    assert status == 403
    assert "card" not in text
    assert (run / "tracks.csv").read_bytes() == before


def test_owner_is_served_under_both_host_names(site: tuple[Path, str, str]) -> None:
    _, address, labels = site
    port = urlsplit(address).port
    for host in (
        f"127.0.0.1:{port}",
        f"localhost:{port}",
        "localhost:9000",
        "localhost",
    ):  # the last two as through a tunnel
        for origin in ({}, {"Origin": f"http://{host}"}):
            assert ask(address, headers={"Host": host, **origin})[0] == 200
    assert json.loads(ask(address, path=labels)[1])["labels"]
    assert ask(address, path=labels + "x")[0] == 404
    assert ask(address, "POST", labels + "x", correction(1, "bowl"))[0] == 404
    assert ask(address, path=labels.replace("labels", "tracks.csv"))[0] == 404
    assert ask(address, path=labels.replace("labels", "../../run.json"))[0] == 404


@pytest.mark.parametrize(
    ("host", "here"),
    [
        *((host, True) for host in ("127.0.0.1", "127.0.0.1:80", "localhost", "localhost:8080")),
        *((host, True) for host in ("[::1]", "[::1]:8080")),
        *((host, False) for host in ("", ":80", "127.0.0.2", "localhost.evil.example", "[::2]:80")),
        *((host, False) for host in ("::1", "evil.example", "evil.example:127.0.0.1")),
    ],
)
def test_host_may_have_no_port(host: str, here: bool) -> None:
    """Browsers omit port 80, and every page of a server on this port was refused."""
    assert _names_this_machine(host) == here


def test_server_listens_on_one_address_only(site: tuple[Path, str, str]) -> None:
    """A server that listens on all addresses would answer on 127.0.0.2, too."""
    with socket.socket() as other, pytest.raises(ConnectionRefusedError):
        other.connect(("127.0.0.2", urlsplit(site[1]).port))


@pytest.mark.parametrize(
    ("body", "status"),
    [
        ("", 400),
        ("[]", 400),
        ("{" * 5000, 400),
        ('{"track": 1, "label": "cup"}', 400),
        ('{"track": true, "label": "cup", "seen": ""}', 400),
        ('{"track": "1", "label": "cup", "seen": ""}', 400),
        ('{"track": 1, "label": null, "seen": ""}', 400),
        ("x" * 70000, 413),
        (correction(999, "cup"), 409),
        (correction(1, "cupp"), 409),
        (correction(1, "merge with 1"), 409),
        (correction(1, "merge with 999"), 409),
        (correction(1, "cup,delete"), 409),
        (correction(1, "cup", seen="bowl"), 409),
    ],
)
def test_invalid_correction_is_not_written(
    site: tuple[Path, str, str], body: str, status: int
) -> None:
    run, address, labels = site
    before = (run / "tracks.csv").read_bytes()
    found, text = ask(address, "POST", labels, body)

    assert found == status
    assert status != 409 or json.loads(text)["problem"]
    assert (run / "tracks.csv").read_bytes() == before


def test_correction_is_on_disk_before_confirmation(run: Path, drawn: RunReport) -> None:
    first = (run / "tracks.csv").read_bytes()
    with serving(run, drawn) as (address, labels):
        for label, seen in (
            ("wine glass", ""),
            ("merge with #2", "wine glass"),
            ("", "merge with #2"),
        ):
            status, text = ask(address, "POST", labels, correction(1, label, seen))
            assert status == 200
            assert labels_on_disk(run)[1] == label
            assert json.loads(text)["labels"]["1"] == label
    assert (run / "tracks.original.csv").read_bytes() == first


def test_page_of_replaced_run_changes_nothing(run: Path, drawn: RunReport) -> None:
    """Tracks of a run that was processed again have other numbers: labels would be misplaced."""
    with serving(run, drawn) as (address, labels):
        text = (run / "run.json").read_text("utf-8")
        work = json.loads(text)["work"]
        (run / "run.json").write_text(text.replace(work, "0" * len(work)), "utf-8")
        before = (run / "tracks.csv").read_bytes()
        answers = [
            ask(address, "POST", labels, correction(1, "delete")),
            ask(address, "GET", labels),
            ask(address),
        ]

    assert [status for status, _ in answers] == [500, 500, 500]
    assert all("was processed again" in text for _, text in answers)
    assert (run / "tracks.csv").read_bytes() == before


def test_replaced_run_does_not_keep_other_pages_from_being_written(
    run: Path, drawn: RunReport
) -> None:
    """When a server ends, it must write all other pages, whatever became of one run."""
    gone = replace(drawn, folder=run.with_name("gone"))
    with pytest.raises(OutputError, match="gone"):
        Reports([gone, replace(drawn, folder=run)], indexed=True).write()

    assert (run / "report.html").is_file()
    index = (run.parent / "index.html").read_text("utf-8")
    assert f"{run.name}/report.html" in index
    assert "gone/report.html" not in index


def test_simultaneous_corrections_are_all_written(run: Path, drawn: RunReport) -> None:
    """Each correction rewrites the whole table: without a lock, one would undo another."""
    tracks = list(labels_on_disk(run))
    with serving(run, drawn) as (address, labels), serving(run, drawn) as (again, others):
        places = [(address, labels), (again, others)]

        def correct(job: tuple[int, int]) -> int:
            track, number = job
            place, path = places[number % 2]
            return ask(place, "POST", path, correction(track, NAMES[number % 7]))[0]

        with ThreadPoolExecutor(8) as pool:
            assert set(pool.map(correct, zip(tracks, range(len(tracks)), strict=True))) == {200}
    assert labels_on_disk(run) == {t: NAMES[n % 7] for n, t in enumerate(tracks)}


def test_two_tabs_do_not_overwrite_each_other(
    browser: Browser, run: Path, drawn: RunReport
) -> None:
    first, second, third = list(labels_on_disk(run))[:3]
    with serving(run, drawn) as (address, _):
        browser.open(address)
        one, two = browser.tabs()[0], browser.tab()
        browser.switch_to(two)
        browser.open(address)
        late = "addEventListener('focus', (event) => event.stopImmediatePropagation(), true)"
        browser.run(late)  # or it would request the labels on focus
        browser.switch_to(one)
        browser.click(f"#track-{first} [data-label='unknown']")
        browser.wait(SAVED)
        browser.switch_to(two)
        browser.click(f"#track-{first} [data-label='delete']")
        browser.wait("return document.querySelector('#said').textContent.includes('not changed')")
        fix = f"return document.querySelector('#track-{first} .fix').textContent"

        assert labels_on_disk(run)[first] == "unknown"
        assert browser.run(fix) in {"→ unknown", "✓"}
        assert "unknown" in browser.run("return document.querySelector('#said').textContent")

        browser.click(f"#track-{first} [data-label='delete']")  # allowed, as it now shows the label
        browser.click(f"#track-{second} [data-label='unknown']")
        browser.wait(SAVED)
        browser.close_tab()
        browser.switch_to(one)
        browser.click(f"#track-{third} [data-label='unknown']")
        browser.wait(SAVED)
        browser.wait(f"{fix} === '→ delete'")  # the answer includes the labels of the other tab
    found = labels_on_disk(run)
    assert [found[track] for track in (first, second, third)] == ["delete", "unknown", "unknown"]


@pytest.mark.slow
@pytest.mark.usefixtures("without_pictures")
def test_interrupted_server_writes_corrections_into_page(
    shapecat: Run, run: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A page that is mailed afterwards must show the corrections."""
    addresses = SimpleQueue[str]()

    @contextmanager
    def serve(*given: Any, **options: Any) -> Iterator[str]:
        with serve_reports(*given, **options) as address:
            addresses.put(address)
            yield address

    def correct_and_interrupt() -> None:
        address = addresses.get(timeout=60)
        try:
            assert urlsplit(address).path.endswith("/index.html")
            page = address.replace("index.html", "table/report.html")
            assert ask(page, "GET")[0] == 200
            labels = urlsplit(page).path.replace("report.html", "labels")
            assert ask(page, "POST", labels, correction(1, "teapot"))[0] == 200
            assert "1 checked" in ask(address)[1]
        finally:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("shapecat.outputs.report.serving.serve_reports", serve)
    with ThreadPoolExecutor(1) as pool:
        visit = pool.submit(correct_and_interrupt)
        done = shapecat("report", "--serve", run.parent)
    visit.result()

    assert done.exit_code == 0  # the command asks users to end it this way
    assert done.stdout.count("\n") == 1
    assert capfd.readouterr().err == "stopping the server\n"
    assert "corrections are written to tracks.csv as you make them" in done.stderr
    assert '"label":"teapot"' in (run / "report.html").read_text("utf-8")
    assert "1 checked" in (run.parent / "index.html").read_text("utf-8")


def test_taken_port_is_refused(shapecat: Run, long_run: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        result = shapecat("report", long_run, "--serve", "--port", taken.getsockname()[1])

    assert result.exit_code == 2
    assert "in use" in result.stderr
    assert shapecat("report", long_run, "--port", 8000).exit_code == 2


def test_keys_undo_move_and_open(browser: Browser, reported_run: Path) -> None:
    """Keys must also work in a page that is opened from a file, without a server."""
    browser.open(reported_run / "report.html")
    a, b, c = order_of(browser)[:3]
    ring = "return getComputedStyle(document.activeElement).outlineWidth"
    assert browser.run(ring) == "3px"

    def press_and_wait(*keys: str, track: int, label: str, focus: int) -> None:
        """Press keys; wait until the label of a track and the focus are as they should be."""
        browser.press(*keys)
        shown = f"document.querySelector('#track-{track} .fix').textContent === '{label}'"
        browser.wait(f"return {shown} && document.activeElement.dataset.track === '{focus}'")

    press_and_wait("Right", "Down", "Up", "Left", "Right", "d", track=b, label="→ delete", focus=b)
    press_and_wait("Left", "Control+z", track=b, label="", focus=b)  # focuses the undone card
    press_and_wait("Enter", track=b, label="✓", focus=b)
    press_and_wait("m", *str(a), "Enter", track=b, label=f"→ merge with #{a}", focus=b)
    press_and_wait("Backspace", track=b, label="", focus=b)
    press_and_wait("n", *"mug", "Enter", track=b, label="→ mug", focus=b)
    press_and_wait("Right", "8", track=c, label="→ mug", focus=c)  # a new name gets a key
    press_and_wait("u", track=c, label="", focus=c)
    press_and_wait("u", track=b, label="", focus=b)

    browser.press("f")
    browser.wait("return document.getElementById('large').open")
    where = "return document.getElementById('where').textContent"
    before = browser.run(where)
    browser.press("Right")
    browser.wait(f"{where} !== '{before}'")
    assert browser.run("return document.querySelectorAll('#stage .box').length") > 0
    browser.press("Escape")
    browser.wait("return !document.getElementById('large').open")
    assert browser.console_messages() == []
