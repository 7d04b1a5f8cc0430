"""Tests of recordings and results at URLs: no partial results, and no scratch files left."""

import csv
import dataclasses
import errno
import filecmp
import functools
import http.server
import io
import json
import os
import resource
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from click.testing import Result

from shapecat.batch import claims, storage
from shapecat.batch.claims import claimed
from shapecat.batch.finding import find_recordings
from shapecat.batch.finding_urls import stat_url
from shapecat.batch.manifest import Entry, RemoteManifest
from shapecat.batch.remote import _download, _fetch_run, process_remote, upload
from shapecat.batch.storage import Location, names_in
from shapecat.errors import OutputError, RecordingError, explained
from shapecat.runs.folder import RUN_FILES, made_by_run, read_run
from shapecat.runs.jobs import Job
from tests.object_storage import object_storage, requests
from tests.run_info import run_info
from tests.scenes import record

Run = Callable[..., Result]
OPTIONS = ("--no-rrd", "--jobs", 1)
FRAMES = 3


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files without logging."""

    def log_message(self, *_: Any) -> None:
        """Log nothing."""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served")
    record(folder / "a.mcap", FRAMES)
    record(folder / "b.bag", FRAMES, container="ros1")
    (folder / "broken.mcap").write_bytes(b"no")
    return folder


@pytest.fixture(scope="module")
def address(served: Path) -> Iterator[str]:
    handler = functools.partial(Quiet, directory=str(served))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="module")
def bucket(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Serve a bucket named lab; provide the log of its requests."""
    with object_storage(tmp_path_factory.mktemp("storage") / "log") as log:
        yield log


@pytest.fixture(autouse=True)
def own_scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Require that each test leaves scratch space empty."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten all waits for the storage and for claims."""
    monkeypatch.setattr(storage, "_WAITS_S", (0.01, 0.02))
    monkeypatch.setattr(claims, "_HEARTBEAT_S", 0.2)
    monkeypatch.setattr(claims, "_POLL_S", 0.1)
    monkeypatch.setattr(claims, "_STALE_S", 1.0)


def files(url: str) -> set[str]:
    """Return the paths of the files below a URL."""
    found = [name for name, _ in Location(url).walk()]
    return {name.partition(f"{url.partition('://')[2]}/")[2] for name in found}


def results(url: str) -> set[str]:
    """Return the files at a URL, without the parts of the manifest."""
    return {name for name in files(url) if not name.startswith(".manifest/")}


def test_recordings_of_server_are_processed_into_folder(
    shapecat: Run, address: str, served: Path, tmp_path: Path
) -> None:
    """The query of a signed URL must be neither in the name of the run nor in the output."""
    names = ("a.mcap", "b.bag?signature=4/2.mcap", "broken.mcap", "missing.mcap")
    urls = [f"{address}/{name}" for name in names]
    done = shapecat("process", *urls, "--out", tmp_path / "out", *OPTIONS)
    here = shapecat("process", served / "a.mcap", "--out", tmp_path / "here", *OPTIONS)

    assert (done.exit_code, here.exit_code) == (1, 0), done.output
    for name in ("broken.mcap", "missing.mcap"):
        assert f"{address}/{name}" in done.stderr
    assert {path.parent.name for path in (tmp_path / "out").glob("*/run.json")} == {"a", "b"}
    assert [line.split()[0] for line in done.stdout.splitlines()[1:3]] == ["a.mcap", "b.bag"]
    run = json.loads((tmp_path / "out" / "a" / "run.json").read_text())
    assert run["input"]["path"] == urls[0]
    tables = [tmp_path / out / "a" / "tracks.csv" for out in ("out", "here")]
    assert tables[0].read_bytes() == tables[1].read_bytes()
    again = shapecat("process", *urls[:2], "--out", tmp_path / "out", *OPTIONS)
    assert again.stdout.count("already complete") == 2


def test_page_without_links_is_an_empty_folder(
    shapecat: Run, address: str, served: Path, tmp_path: Path
) -> None:
    """Such a page ended the command with a traceback."""
    (served / "empty").mkdir()
    done = shapecat("process", f"{address}/empty/", "--out", tmp_path, *OPTIONS)
    (served / "empty").rmdir()

    assert done.exit_code == 3
    assert f"{address}/empty/: no recording found" in done.output


def test_names_on_server_are_decoded(
    shapecat: Run, address: str, served: Path, tmp_path: Path
) -> None:
    """Results were named ``my%20lab``, and a bag lacked the parts that its metadata names."""
    (served / "my lab.mcap").symlink_to(served / "a.mcap")
    bag = record(served / "\xfc 1", FRAMES, container="ros2")
    urls = [f"{address}/my%20lab.mcap", f"{address}/%C3%BC%201"]
    done = shapecat("process", *urls, "--out", tmp_path / "out", *OPTIONS)
    (served / "my lab.mcap").unlink()
    shutil.rmtree(bag)

    assert done.exit_code == 0, done.output
    assert "Warning" not in done.stderr
    runs = [read_run(tmp_path / "out" / name) for name in ("my lab", "\xfc 1")]
    assert [run["input"]["path"] for run in runs] == urls
    for hostile in ("%2e%2e", "a%2fb", "a%00", "a%ff"):
        assert names_in(f"http://host/{hostile}/{hostile}") == (hostile, hostile)


@pytest.mark.parametrize(
    "out",
    ["memory://results/first", pytest.param("s3://lab/results/first", marks=pytest.mark.many)],
)
@pytest.mark.usefixtures("bucket")
def test_folder_is_processed_into_storage_once(shapecat: Run, served: Path, out: str) -> None:
    done = shapecat("process", served, "--out", out, *OPTIONS)

    assert done.exit_code == 1, done.output
    expected = {"a", "b"}
    assert {name.partition("/")[0] for name in results(out)} == {*expected, "manifest.jsonl"}
    assert {"a/run.json", "a/annotated.mcap", "b/tracks.csv"} <= files(out)
    again = shapecat("process", served, "--out", out, *OPTIONS)
    assert again.stdout.count("already complete") == 2
    lines = (Location(out) / "manifest.jsonl").read() or b""
    known = {line["folder"]: line for line in map(json.loads, lines.splitlines())}
    states = {name: line["state"] for name, line in known.items()}
    assert states == {"a": "complete", "b": "complete", "broken": "failed"}
    assert known["a"]["frames"] == FRAMES
    other = shapecat("process", served / "a.mcap", "--out", out, *OPTIONS, "--set", "seed=1")
    assert other.exit_code == 1
    assert "--overwrite" in other.stderr


def test_results_without_manifest_are_not_repeated(
    shapecat: Run, served: Path, bucket: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A killed command cannot send the last lines of its manifest; the run folders must suffice."""
    for name in ("a.mcap", "b.bag"):
        (Location("s3://lab/again") / name).upload(served / name)
    command = ("process", "s3://lab/again/", "--out", "s3://lab/again/out", *OPTIONS)
    assert shapecat(*command).exit_code == 0
    for name in files("s3://lab/again/out"):
        if "manifest" in name:
            (Location("s3://lab/again/out") / name).remove()
    monkeypatch.setattr("shapecat.batch.remote.process", None)

    again = shapecat(*command)

    assert again.exit_code == 0, again.output
    assert again.stdout.count("already complete") == 2
    for name in "ab":
        assert len(requests(bucket, "PUT", f"/lab/again/out/{name}/run.json")) == 1


def test_patterns_and_folders_of_storage_are_expanded(served: Path) -> None:
    url = f"file://{served}"
    both = {f"{url}/a.mcap", f"{url}/broken.mcap"}

    assert {source.url for source in find_recordings([f"{url}/*.mcap"]).sources} == both
    every = {source.url for source in find_recordings([f"{url}/"]).sources}
    assert every == {*both, f"{url}/b.bag"}
    assert stat_url(f"{url}/a.mcap")[1] == (served / "a.mcap").stat().st_size
    assert stat_url(f"{url}/none.mcap") == ("", 0)


@pytest.mark.parametrize("lab", ["memory://marks", "s3://lab/marks"])
@pytest.mark.usefixtures("bucket")
def test_question_mark_in_storage_is_part_of_the_name(tmp_path: Path, lab: str) -> None:
    """It was taken for the query of a signed URL: names lost their ends and suffixes."""
    names = ["what?.mcap", "a#1%25+\xfc.mcap"]
    for name in names:
        (Location(lab) / name).write(name.encode())
    found = find_recordings([f"{lab}/"]).sources

    assert {source.stem for source in found} == {name.removesuffix(".mcap") for name in names}
    for source in found:
        file = _download(source.url, tmp_path)
        assert file.name == f"{source.stem}.mcap"
        assert file.read_text() == file.name
    assert names_in("s3://lab/day/a.mcap?versionId=4") == ("day", "a.mcap")


@pytest.mark.parametrize(
    "lab", ["memory://brackets", pytest.param("s3://lab/brackets", marks=pytest.mark.many)]
)
@pytest.mark.usefixtures("bucket")
def test_names_with_brackets_are_not_patterns(
    shapecat: Run, served: Path, tmp_path: Path, lab: str
) -> None:
    """Otherwise a run folder with brackets looks empty, and a user's files are overwritten."""
    names = ("take[1].mcap", "bag[2]/one.mcap", "bag[2]/metadata.yaml")
    for name in names[:2]:
        (Location(lab) / name).upload(served / "a.mcap")
    (Location(lab) / names[2]).write(b"rosbag2_bagfile_information:\n  version: 5\n")
    out = f"{lab}/out[3]"
    command = ("process", f"{lab}/", "--out", out, *OPTIONS)

    assert shapecat(*command).exit_code == 0
    assert {"take[1]/run.json", "bag[2]/run.json"} <= files(out)
    assert shapecat(*command).stdout.count("already complete") == 2
    assert [source.url for source in find_recordings([f"{lab}/{names[0]}"]).sources]
    Location(f"{lab}/bag[2]").download(tmp_path / "copy")
    assert {path.name for path in (tmp_path / "copy").iterdir()} == {"one.mcap", "metadata.yaml"}

    (Location(out) / "take[1]/run.json").remove()
    (Location(out) / "take[1]/thesis.txt").write(b"years of work")
    refused = shapecat(*command, "--overwrite")
    assert refused.exit_code == 1
    assert "shapecat did not make this" in refused.stderr


@pytest.mark.parametrize("place", ["memory://lab/mixed", "s3://lab/mixed"])
@pytest.mark.usefixtures("bucket")
def test_storage_is_searched_like_a_folder(place: str) -> None:
    """Results of earlier runs are not recordings; the folder of a ROS 2 bag is one recording."""
    root = Location(place)
    for name in (
        *("x.mcap", "d/y.bag", "bag/bag_0.db3", "bag/bag_1.db3", "bag/metadata.yaml"),
        *("out/x/annotated.mcap", "out/x/run.json", "half/x/annotated.mcap"),
        *("half/x/frames.parquet", "out/.x.old/annotated.mcap", "notes.txt"),
    ):
        (root / name).write(name.encode())
    (root / "bag/metadata.yaml").write(b"rosbag2_bagfile_information:\n")
    kept = find_recordings([f"{place}/"]).sources
    found = {source.url.replace(":///", "://"): source for source in kept}

    assert set(found) == {f"{place}/{name}" for name in ("x.mcap", "d/y.bag", "bag")}
    assert found[f"{place}/bag"].stem == "bag"
    assert found[f"{place}/bag"].bytes == len("bag/bag_0.db3") + len("bag/bag_1.db3")
    before = found[f"{place}/x.mcap"].key
    assert before == only_key(f"{place}/*.mcap")
    if place.startswith("s3"):  # fsspec's memory gives times of another type in listings
        assert before == stat_url(f"{place}/x.mcap")[0]
    (root / "x.mcap").write(b"other content")
    assert only_key(f"{place}/*.mcap") != before


def test_metadata_of_a_data_set_in_storage_makes_no_bag() -> None:
    """The recordings of a data set with a metadata.yaml were mixed in one run."""
    names = {"set/walk.mcap", "set/run.mcap", "set/bag"}
    for name in ("set/walk.mcap", "set/run.mcap", "set/bag/x.mcap"):
        (Location("memory://takes") / name).write(name.encode())
    (Location("memory://takes/set") / "metadata.yaml").write(b"license: MIT\n")
    noted = b"# " + 99 * b"note" + b"\nrosbag2_bagfile_information:\n"
    (Location("memory://takes/set/bag") / "metadata.yaml").write(noted)

    found = find_recordings(["memory://takes/"]).sources

    assert {source.url.replace(":///", "://") for source in found} == {
        f"memory://takes/{name}" for name in names
    }


@pytest.mark.parametrize("place", ["memory://unslashed", "s3://lab/unslashed"])
@pytest.mark.usefixtures("bucket")
def test_folder_at_url_is_searched_without_slash(place: str) -> None:
    """Such a folder was downloaded whole, and its recordings were mixed in one run."""
    bag = f"{place}/in/bag"  # of a killed recorder: without metadata
    for name in ("a.mcap", "b.mcap", "bag/bag_0.mcap", "bag/bag_1.mcap", "old[1]/c.mcap"):
        (Location(f"{place}/in") / name).write(name.encode())
    (Location(place) / "noted").write(b"a file")

    def stems(*sources: str) -> set[str]:
        return {source.stem for source in find_recordings(sources).sources}

    assert stems(f"{place}/in") == {"a", "b", "bag", "c"}
    assert stems(bag) == {"bag"}
    assert stems(f"{place}/in/old[1]") == {"c"}
    assert stems(f"{place}/noted", f"{place}/missing") == {"noted", "missing"}


@pytest.mark.parametrize("place", ["memory://typo", "s3://lab/typo"])
@pytest.mark.usefixtures("bucket")
def test_url_without_recordings_is_named_beside_others(
    caplog: pytest.LogCaptureFixture, place: str
) -> None:
    """A misspelt URL must fail like a missing file; its recordings were silently left out."""
    for name in ("in/a.mcap", "notes/n.txt"):
        (Location(place) / name).write(b"something")
    missing = [f"{place}/on/", f"{place}/on/*.mcap"]

    found = find_recordings([f"{place}/in/", *missing, f"{place}/notes/"]).sources

    assert [source.url for source in found][1:] == missing
    messages = [text for text in caplog.messages if place in text]
    assert messages == [f"{place}/notes/: no recording found"]


@pytest.mark.parametrize("place", ["memory://globbed", "s3://lab/globbed"])
@pytest.mark.usefixtures("bucket")
def test_pattern_at_url_finds_folders_as_a_shell_does(place: str) -> None:
    """If a pattern matched files and bags, the bags were left out without a warning."""
    for name in (
        *("in/a.mcap", "in/bag/bag_0.mcap", "in/bag/bag_1.mcap", "in/day[1]/b.bag", "in/n.txt"),
        *("in/done/annotated.mcap", "in/done/run.json", "in/.trash/c.mcap"),
    ):
        (Location(place) / name).write(name.encode())

    def found(pattern: str) -> list[str]:
        sources = find_recordings([f"{place}/{pattern}"]).sources
        return [source.url.replace(":///", "://").removeprefix(f"{place}/") for source in sources]

    every = ["in/a.mcap", "in/bag", "in/day[1]/b.bag"]
    assert found("in/*") == found("in*/") == every
    assert found("in/b*g") == ["in/bag"]
    assert found("in/*/*_0.mcap") == ["in/bag/bag_0.mcap"]
    assert found("**") == every


def test_folder_below_hidden_folder_is_searched() -> None:
    """Only hidden folders within the given one are left out."""
    root = Location("memory://lab/.staged/in")
    for name in ("a.mcap", ".trash/b.mcap", ".c.mcap"):
        (root / name).write(b"recording")

    assert [s.stem for s in find_recordings(["memory://lab/.staged/in/"]).sources] == ["a"]


def only_key(pattern: str) -> str:
    (source,) = find_recordings([pattern]).sources
    return source.key


def test_names_in_a_bucket_cannot_leave_the_folder(tmp_path: Path) -> None:
    """A bucket is not trusted: its keys may contain ``..``."""
    with fsspec.open("memory://hostile/bag/metadata.yaml", "wb") as file:
        file.write(b"files: []")
    store = fsspec.filesystem("memory").store
    store["/hostile/bag/../../evil"] = store["/hostile/bag/metadata.yaml"]
    try:
        with pytest.raises(RecordingError, match=r"leads out of the folder"):
            Location("memory://hostile/bag", RecordingError).download(tmp_path / "in" / "bag")
    finally:
        del store["/hostile/bag/../../evil"]
    assert not (tmp_path / "evil").exists()


def test_write_ahead_log_comes_with_its_database(tmp_path: Path) -> None:
    """The last messages of a killed recorder are only in the log."""
    for name in ("a.db3", "a.db3-wal", "b.db3"):
        with fsspec.open(f"memory://logs/{name}", "wb") as file:
            file.write(name.encode())
    for name in ("a.db3", "b.db3"):
        _download(f"memory://logs/{name}", tmp_path)

    assert {path.name for path in tmp_path.glob("*.db3*")} == {"a.db3", "a.db3-wal", "b.db3"}


def test_bag_in_bucket_is_processed(shapecat: Run, bucket: Path, tmp_path: Path) -> None:
    bag = record(tmp_path / "bag", 4, container="ros2")
    for file in bag.iterdir():
        (Location("s3://lab/bags/kitchen") / file.name).upload(file)
    for source in ("s3://lab/bags/", "s3://lab/bags/kitchen"):
        done = shapecat("process", source, "--out", tmp_path / "out", *OPTIONS)
        assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "out/kitchen/run.json").read_text())["counts"]["frames"] == 4
    assert requests(bucket, "GET", "metadata.yaml")


@pytest.mark.usefixtures("bucket")
def test_empty_objects_that_stand_for_folders_are_ignored(made: Path, tmp_path: Path) -> None:
    """The web console of S3 makes them; bags could not be downloaded, nor runs uploaded."""
    system: Any = fsspec.filesystem("s3")
    for key in ("marked/bag/", "marked/bag/sub/", "marked/out/run/"):
        system.call_s3("put_object", Bucket="lab", Key=key, Body=b"")
    (Location("s3://lab/marked/bag") / "bag_0.mcap").write(b"part")

    Location("s3://lab/marked/bag").download(tmp_path / "bag")
    with claimed("s3://lab/marked/out/run", "one") as claim:
        upload(made, "s3://lab/marked/out/run", claim)

    assert [path.name for path in (tmp_path / "bag").iterdir()] == ["bag_0.mcap"]
    assert Location("s3://lab/marked").names() == {"bag", "out"}


def answer(status: int) -> Exception:
    error = Exception("the storage says so")
    error.status = status  # type: ignore[attr-defined]  # as in errors of aiohttp
    return error


@pytest.mark.parametrize(
    ("error", "passes"),
    [
        *((answer(status), True) for status in (429, 500, 503)),
        *((answer(status), False) for status in (400, 401, 403, 404)),
        (TimeoutError(), True),
        (ConnectionResetError(), True),
        (type("ServerDisconnectedError", (Exception,), {})(), True),
        (OSError(errno.EBUSY, "slow down"), True),
        (OSError(errno.EACCES, "not allowed"), False),
        (ValueError("bucket"), False),
    ],
    ids=str,
)
def test_only_temporary_errors_are_retried(error: Exception, *, passes: bool) -> None:
    """A busy server must not end a batch, and wrong credentials must not delay it."""
    assert storage._is_transient(error) is passes


def test_listings_are_read_in_pages(bucket: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage, "_PAGE", 3)
    for k in range(10):
        (Location("s3://lab/pages") / f"{k}" / "x.mcap").write(b"x")
    (Location("s3://lab/pages-beside") / "x.mcap").write(b"x")  # not in the folder

    assert Location("s3://lab/pages").names() == set("0123456789")
    assert len(find_recordings(["s3://lab/pages/"]).sources) == 10
    assert len(requests(bucket, "GET", "/lab")) >= 8


@pytest.fixture(scope="module")
def made(served: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run folder as a worker writes it to scratch space."""
    folder = tmp_path_factory.mktemp("made") / "run"
    process_remote(Job(served / "a.mcap", folder, rrd=False), lambda *_: None, cores=1, batch="")
    return folder


def test_copy_of_recording_finds_its_results_at_the_url(
    shapecat: Run, made: Path, served: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A copy has another key than its original: the command failed instead of finding the run.

    Finding the run costs a download, which must not be repeated.
    """
    url = "memory://copied/a"
    with claimed(url, "one") as claim:
        upload(made, url, claim)
    command = ("process", served / "a.mcap", "--out", "memory://copied", *OPTIONS)

    done = shapecat(*command)

    assert done.exit_code == 0, done.output
    assert "already complete" in done.stdout
    monkeypatch.setattr("shapecat.batch.remote.process", None)
    assert shapecat(*command).exit_code == 0


def test_run_at_url_may_have_more_outputs_than_wanted(
    shapecat: Run, made: Path, served: Path
) -> None:
    """As in a local folder, a run with annotated.mcap is also complete with `--no-mcap`."""
    with claimed("memory://more/a", "one") as claim:
        upload(made, "memory://more/a", claim)

    done = shapecat("process", served / "a.mcap", "--out", "memory://more", *OPTIONS, "--no-mcap")

    assert done.exit_code == 0, done.output
    assert "already complete" in done.stdout


PLACES = ["memory://half/run", pytest.param("s3://lab/half/run", marks=pytest.mark.many)]


@pytest.mark.parametrize("url", PLACES)
@pytest.mark.usefixtures("bucket")
def test_interrupted_upload_shows_no_run(
    made: Path, monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    """run.json must appear after all other files, and annotated.mcap not count as a recording."""
    names = {path.name for path in made.iterdir()}
    sent = Location.upload
    for cut in range(len(names)):
        left = [cut]

        def failing(self: Location, file: Path, left: list[int] = left) -> None:
            left[0] -= 1
            if left[0] < 0:
                msg = "the connection broke"
                raise OutputError(msg)
            sent(self, file)

        with monkeypatch.context() as patch, claimed(url, "one") as claim:
            patch.setattr(Location, "upload", failing)
            with pytest.raises(OutputError, match="broke"):
                upload(made, url, claim)
        assert "run.json" not in files(url)
        assert len(files(url)) == cut
        with pytest.raises(RecordingError, match="no recording found"):
            find_recordings([url.removesuffix("run")])

    with claimed(url, "one") as claim:
        upload(made, url, claim)
    assert files(url) == names
    assert files(url.removesuffix("/run")) == {f"run/{name}" for name in names}


@pytest.mark.parametrize(
    "url", ["memory://old/run", pytest.param("s3://lab/old/run", marks=pytest.mark.many)]
)
@pytest.mark.usefixtures("bucket")
def test_labels_survive_killed_replacement(
    shapecat: Run, served: Path, monkeypatch: pytest.MonkeyPatch, url: str
) -> None:
    """After a kill, the old run is gone and the new one not yet there; corrections must survive."""
    out, place = url.removesuffix("/run"), Location(url)
    shutil.copy(served / "a.mcap", served / "run.mcap")
    command = ("process", served / "run.mcap", "--out", out, *OPTIONS)
    assert shapecat(*command).exit_code == 0
    (place / "tracks.csv").write(labelled((place / "tracks.csv").read() or b"", "cup"))
    with monkeypatch.context() as patch:
        patch.setattr(Location, "upload", fail)
        assert shapecat(*command, "--overwrite").exit_code != 0
    assert (place / "run.json").read() is None
    (served / "run.mcap").touch()

    done = shapecat(*command)

    (served / "run.mcap").unlink()
    assert done.exit_code == 0, done.output
    assert "transferred 1 of 1" in done.stderr
    assert not [name for name in files(out) if name.startswith(".run.old")]


def labelled(table: bytes, label: str) -> bytes:
    """Return tracks.csv with a label for its first track."""
    rows = list(csv.DictReader(io.StringIO(table.decode())))
    rows[0]["label"] = label
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def fail(*_: object, **__: object) -> None:
    msg = "no space"
    raise OutputError(msg)


@pytest.mark.parametrize("folder", ["memory://renewed", "file://{}/renewed"])
def test_upload_removes_files_of_replaced_run(made: Path, tmp_path: Path, folder: str) -> None:
    """Masks or a report of earlier settings would contradict the new tables.

    On a disk, the folder that keeps the replaced tables meanwhile must be created first.
    """
    folder = folder.format(tmp_path)
    url, names = f"{folder}/run", {path.name for path in made.iterdir()}
    assert "review.rrd" not in names
    for name in RUN_FILES:
        (Location(url) / name).write(b"{}")

    with claimed(url, "one") as claim:
        upload(made, url, claim)

    assert files(folder) == {f"run/{name}" for name in names}


def test_labels_that_were_not_transferred_stay_at_the_url(made: Path, tmp_path: Path) -> None:
    """The labels were left in scratch space, which is removed."""
    place, copy = Location("memory://kept/run"), "tracks.previous-3fa2b1c0.csv"
    shutil.copytree(made, tmp_path / "run")
    (tmp_path / "run" / copy).write_text("labels")
    for folder in (tmp_path / "run", made):
        with claimed(place.url, "one") as claim:
            upload(folder, place.url, claim)
        (place / "run.json").remove()  # as if interrupted

    assert (place / copy).read() == b"labels"


def test_json_names_the_run_at_its_url(shapecat: Run, served: Path) -> None:
    """Runs had a name, but no URL, and runs that were already complete had no warnings."""
    out = ("--out", "memory://named", *OPTIONS, "--json", "--progress", "jsonl")
    command = ("process", served / "a.mcap", served / "b.bag", *out)
    first, again = shapecat(*command), shapecat(*command)
    runs = json.loads(first.stdout)

    assert [run["folder"] for run in runs] == ["memory://named/a", "memory://named/b"]
    assert json.loads(again.stdout) == [{**run, "processed": False} for run in runs]
    events = [json.loads(line) for line in first.stderr.splitlines()]
    assert {e["folder"] for e in events if e["event"] == "ended"} == {run["folder"] for run in runs}


@pytest.mark.parametrize("content", [b"{}", b'{"id": "0', b""])
def test_unusable_run_at_url_is_named(shapecat: Run, served: Path, content: bytes) -> None:
    """The message named a folder in scratch space, which is gone."""
    (Location("memory://unusable/a") / "run.json").write(content)

    done = shapecat("process", served / "a.mcap", "--out", "memory://unusable", *OPTIONS)

    assert done.exit_code == 1
    assert only_error(done).startswith("Error: memory://unusable/a/run.json: not a description of")


def test_run_of_another_version_at_url_can_be_overwritten(tmp_path: Path) -> None:
    """Such a run was refused even with --overwrite, so its labels could not be transferred."""
    url = "memory://earlier/run"
    run = run_info()
    del run["options"]["color"]
    (Location(url) / "run.json").write(json.dumps(run).encode())
    job = Job(Path("a.mcap"), tmp_path / "run", target=url)

    with pytest.raises(OutputError, match="another version"):
        _fetch_run(job)
    job = dataclasses.replace(job, folder=tmp_path / "again", overwrite=True)
    assert _fetch_run(job) == (job, None)
    assert made_by_run(job.folder) is not None


def test_full_scratch_is_not_blamed_on_the_url(
    own_scratch: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Users were told that the bucket has no space left."""

    def process(job: Job, *_: object, **__: object) -> None:
        with explained(f"{job.folder}: cannot write the results", OutputError):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("shapecat.batch.remote.process", process)
    job = Job(Path("a.mcap"), Path("lab"), target="memory://full/lab")

    with pytest.raises(OutputError, match=r"No space left on device.*TMPDIR") as raised:
        process_remote(job, lambda *_: None, cores=1, batch="one")

    assert str(own_scratch) in str(raised.value)


def test_foreign_folder_is_not_touched(made: Path) -> None:
    (Location("memory://theirs/run") / "thesis.txt").write(b"years of work")
    with (
        claimed("memory://theirs/run", "one") as claim,
        pytest.raises(OutputError, match="did not make this"),
    ):
        upload(made, "memory://theirs/run", claim)

    assert files("memory://theirs") == {"run/thesis.txt"}


@pytest.mark.parametrize("url", ["memory://claims/run", "s3://lab/claims/run"])
@pytest.mark.usefixtures("bucket")
def test_only_one_process_claims_a_folder(url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "_STALE_S", 60.0)  # on a busy machine, a beat may come late
    with claimed(url, "one"), pytest.raises(OutputError, match="another process is writing"):
        claims.Claim(url, "two")
    with claimed(url, "two") as claim:
        assert not claim.inherited
    assert files(url.removesuffix("/run")) == set()


@pytest.mark.parametrize("request_", ["read", "write"])
def test_claim_is_renewed_after_a_refused_heartbeat(
    monkeypatch: pytest.MonkeyPatch, request_: str
) -> None:
    """After a short outage, another machine would process the same recording."""
    works, refusals, renewed = getattr(Location, request_), [OutputError("403")], threading.Event()

    def ask(self: Location, *content: bytes) -> Any:
        if refusals:
            raise refusals.pop()
        renewed.set()
        return works(self, *content)

    monkeypatch.setattr(claims, "_HEARTBEAT_S", 0.01)
    monkeypatch.setattr(Location, request_, ask)
    with claimed("memory://refused/run", "one"):
        assert renewed.wait(60)

    assert files("memory://refused") == set()


@pytest.mark.parametrize("request_", ["read", "remove"])
def test_claim_that_cannot_be_removed_goes_stale(
    monkeypatch: pytest.MonkeyPatch, request_: str
) -> None:
    """A refused request at the very end made a complete run fail."""
    with claimed(f"memory://left-{request_}/run", "one"):
        monkeypatch.setattr(Location, request_, fail)
    monkeypatch.undo()

    assert files(f"memory://left-{request_}") == {".run.claim"}


@pytest.mark.parametrize("content", [b"5", b"[" * 100_000])
def test_damaged_claim_is_taken_over(monkeypatch: pytest.MonkeyPatch, content: bytes) -> None:
    """Nobody renews a damaged claim; it would keep its run from being processed."""
    monkeypatch.setattr(claims, "_STALE_S", 0.02)
    monkeypatch.setattr(claims, "_POLL_S", 0.01)
    (Location("memory://damaged-claims") / ".run.claim").write(content)

    assert claims.Claim("memory://damaged-claims/run", "one").inherited


def test_claim_of_dead_process_is_taken_over(
    made: Path, bucket: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker presumed dead may wake up: its results must not mix with the new ones."""
    monkeypatch.setattr(claims, "_STALE_S", 0.2)
    url = "s3://lab/late/run"
    first = claims.Claim(url, "one")  # it sends no heartbeat
    system: Any = fsspec.filesystem("s3")
    for name in ("run", "run10"):  # one of them belongs to a live process
        key = f"late/{name}/annotated.mcap"
        system.call_s3("create_multipart_upload", Bucket="lab", Key=key)
    with claimed(url, "two") as second:
        assert second.inherited
        upload(made, url, second)
        (left,) = system.list_multipart_uploads("lab")
        assert left["Key"] == "late/run10/annotated.mcap"
        assert not first.renew()
        with pytest.raises(OutputError, match="taken over"):
            upload(made, url, first)
    first.release()
    assert files("s3://lab/late") == {f"run/{path.name}" for path in made.iterdir()}
    assert len(requests(bucket, "PUT", "/late/run/run.json")) == 1


def test_upload_stops_when_claim_is_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run.json of the first process would complete a run with files of two processes."""
    url, sent = "memory://taken/run", Location.upload
    made, followers = tmp_path / "run", list[claims.Claim]()
    made.mkdir()
    for name in ("frames.parquet", "run.json", "tracks.csv"):
        (made / name).write_text(name)

    def lose(self: Location, file: Path) -> None:
        sent(self, file)
        followers.append(claims.Claim(url, "one"))

    monkeypatch.setattr(Location, "upload", lose)
    first = claims.Claim(url, "one")
    with pytest.raises(OutputError, match="taken over"):
        upload(made, url, first)

    assert files(url) == {"frames.parquet", "tracks.csv"}
    followers[-1].require()


@pytest.mark.usefixtures("bucket")
def test_batch_takes_over_its_own_claims_at_once() -> None:
    first = claims.Claim("s3://lab/same/run", "one")
    second = claims.Claim("s3://lab/same/run", "one")
    assert (first.inherited, second.inherited) == (False, True)
    first.release()  # it wakes up, but the claim is no longer its own
    second.require()
    second.release()
    assert files("s3://lab/same") == set()


def entry(name: str, state: Any) -> Entry:
    return Entry(name, f"{name}.mcap", state, "input", "work")


@pytest.mark.usefixtures("bucket")
def test_manifest_in_bucket_has_lines_of_all_writers() -> None:
    """With two commands at once, one of them killed, no sent line may be lost."""
    url = "s3://lab/manifests"
    killed = RemoteManifest(url)
    killed.record([entry("a", "complete"), entry("b", "running")])
    killed.send()
    with RemoteManifest(url) as first:
        assert first.entries["a"].state == "complete"
        second = RemoteManifest(url)
        second.record([entry("c", "complete")])
        second.send()
        first.record([entry("b", "complete")])
    with RemoteManifest(url) as third:
        found = {name: known.state for name, known in third.entries.items()}
    assert found == dict.fromkeys("abc", "complete")
    merged = (Location(url) / "manifest.jsonl").read() or b""
    assert sorted(json.loads(line)["folder"] for line in merged.splitlines()) == ["a", "b", "c"]
    assert RemoteManifest(url, "1-of-4").entries == {}


@pytest.mark.parametrize("last", ["failed", "complete"])
def test_later_of_two_writers_decides(last: str) -> None:
    """Parts of the manifest are read in order of their names, but the latest line must count."""
    url, times = f"memory://later-{last}", {last: "2026-01-01T12:00:05", "planned": "2026-01-01T12"}
    for writer, (state, time) in zip("ab", times.items(), strict=True):
        line = {"folder": "lab", "recording": "lab.mcap", "state": state, "time": time}
        (Location(url) / ".manifest/all" / f"{writer}.jsonl").write(json.dumps(line).encode())

    assert RemoteManifest(url).entries["lab"].state == last


def test_manifest_parts_stay_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sent whole with each line, the manifest of a large batch would outweigh its results."""
    monkeypatch.setattr("shapecat.batch.manifest._PART_BYTES", 2000)
    written = RemoteManifest("memory://parts")
    for k in range(100):
        written.record([entry(f"{k}", "complete")])
        written.send()
    sizes = [info["size"] for _, info in Location("memory://parts/.manifest").walk()]

    assert max(sizes) < 2500
    assert len(sizes) > 5
    assert len(RemoteManifest("memory://parts").entries) == 100


def test_unreachable_server_is_reported(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be downloaded"):
        Location("http://127.0.0.1:9/x.mcap").download(tmp_path / "x.mcap")


def only_error(result: Result) -> str:
    errors = [line for line in result.stderr.splitlines() if line.startswith("Error: ")]
    assert len(errors) == 1, result.stderr
    assert "Traceback" not in result.output
    assert "bug" not in result.output
    return errors[0]


@pytest.mark.parametrize("source", ["s3://none/", "s3://none/*.mcap", "s3://none/a.mcap"])
@pytest.mark.usefixtures("bucket")
def test_missing_bucket_is_reported_in_one_line(shapecat: Run, tmp_path: Path, source: str) -> None:
    read = shapecat("process", source, "--out", tmp_path, *OPTIONS)
    assert read.exit_code == 3
    assert source.rstrip("/") in only_error(read)


def test_missing_result_bucket_is_not_created(shapecat: Run, bucket: Path, served: Path) -> None:
    """A misspelt bucket must be reported before a frame is read."""
    for recordings in ([served], [served / "a.mcap"]):
        done = shapecat("process", *recordings, "--out", "s3://none/out", *OPTIONS)
        assert done.exit_code == 1
        assert "s3://none/out: cannot be listed: The specified bucket does not exist" in only_error(
            done
        )
    assert not requests(bucket, "PUT", "/none")


@pytest.mark.usefixtures("bucket")
def test_missing_credentials_are_reported_in_one_line(
    shapecat: Run, served: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    system: Any = fsspec.get_filesystem_class("s3")
    for out, sources in (("s3://lab/none", [served]), (str(tmp_path), ["s3://lab/x.mcap"])):
        system.clear_instance_cache()
        done = shapecat("process", *sources, "--out", out, *OPTIONS)
        assert done.exit_code in {1, 3}
        assert "credentials" in only_error(done)
    system.clear_instance_cache()


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@pytest.mark.usefixtures("bucket")
@pytest.mark.parametrize("size", [0, 1, 9000 * 2**24, 9000 * 2**24 + 1, 5 * 2**40])
def test_number_of_upload_parts_is_limited(size: int) -> None:
    """S3 accepts a limited number of parts, but small parts would need more requests."""
    part = Location("s3://lab/large")._in_parts(size)["chunksize"]

    assert part >= 16 * 2**20
    assert -(-size // part) <= 9000


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mebibytes", "most_mb"), [(20, None), pytest.param(60, 45, marks=pytest.mark.many)]
)
def test_large_files_are_streamed(
    bucket: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    mebibytes: int,
    most_mb: int | None,
) -> None:
    """The review.rrd of an hour does not fit into memory, so it is transferred in parts."""
    monkeypatch.setattr(storage, "_PART_BYTES", 5 * 2**20)
    large = tmp_path / "large"
    block = os.urandom(2**20)
    with large.open("wb") as file:
        for _ in range(mebibytes):
            file.write(block)
    place = Location(f"s3://lab/{mebibytes}")
    before = peak_mb()
    place.upload(large)
    place.download(tmp_path / "back")

    assert most_mb is None or peak_mb() - before < most_mb
    assert filecmp.cmp(tmp_path / "back", large, shallow=False)
    assert len(requests(bucket, "PUT", f"/lab/{mebibytes}")) == mebibytes / 5
