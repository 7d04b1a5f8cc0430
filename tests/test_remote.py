"""Recordings and results at URLs: nothing half-done is seen, nothing is left in scratch."""

import functools
import http.server
import json
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from shapecat.batch.remote import download, finish_upload, list_urls, look_at, scratch, upload
from shapecat.errors import OutputError, RecordingError
from tests.scenes import record

fsspec = pytest.importorskip("fsspec")

Run = Callable[..., Result]
OPTIONS = ("--no-rrd", "--jobs", 1)


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files without telling."""

    def log_message(self, *_: Any) -> None:
        """Say nothing."""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("served")
    record(folder / "a.mcap", 6)
    record(folder / "b.bag", 6, container="ros1")
    (folder / "broken.mcap").write_bytes(b"no")
    return folder


@pytest.fixture(scope="module")
def address(served: Path) -> Iterator[str]:
    handler = functools.partial(Quiet, directory=str(served))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(autouse=True)
def own_scratch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Whatever a test does, nothing stays in scratch."""
    folder = tmp_path / "scratch"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


def files(url: str) -> set[str]:
    system, path = fsspec.core.url_to_fs(url)
    return {name.removeprefix(path).lstrip("/") for name in system.find(path)}


def test_from_a_server_to_a_folder(
    shapecat: Run, address: str, served: Path, tmp_path: Path
) -> None:
    urls = [f"{address}/{name}" for name in ("a.mcap", "b.bag", "broken.mcap", "missing.mcap")]
    done = shapecat("process", *urls, "--out", tmp_path / "out", *OPTIONS)
    here = shapecat("process", served / "a.mcap", "--out", tmp_path / "here", *OPTIONS)

    assert (done.exit_code, here.exit_code) == (1, 0), done.output
    for name in ("broken.mcap", "missing.mcap"):
        assert f"{address}/{name}" in done.stderr
    run = json.loads((tmp_path / "out" / "a" / "run.json").read_text())
    assert run["input"]["path"] == urls[0]
    tables = [tmp_path / out / "a" / "tracks.csv" for out in ("out", "here")]
    assert tables[0].read_bytes() == tables[1].read_bytes()
    again = shapecat("process", *urls[:2], "--out", tmp_path / "out", *OPTIONS)
    assert again.stdout.count("already complete") == 2


def test_from_a_folder_to_a_storage_and_on(shapecat: Run, served: Path) -> None:
    out = "memory://results/first"
    done = shapecat("process", served, "--out", out, *OPTIONS)

    assert done.exit_code == 1, done.output
    expected = {"a", "b"}
    assert {name.partition("/")[0] for name in files(out)} == {*expected, "manifest.jsonl"}
    assert {"a/run.json", "a/annotated.mcap", "b/tracks.csv"} <= files(out)
    again = shapecat("process", served, "--out", out, *OPTIONS)
    assert again.stdout.count("already complete") == 2
    other = shapecat("process", served / "a.mcap", "--out", out, *OPTIONS, "--set", "seed=1")
    assert other.exit_code == 1
    assert "--overwrite" in other.stderr


def test_patterns_and_folders_of_a_storage(served: Path) -> None:
    url = f"file://{served}"
    both = {f"{url}/a.mcap", f"{url}/broken.mcap"}

    assert set(list_urls(f"{url}/*.mcap", {".mcap"})) == both
    assert set(list_urls(f"{url}/", {".mcap"})) == both
    assert look_at(f"{url}/a.mcap")[1] == (served / "a.mcap").stat().st_size
    assert look_at(f"{url}/none.mcap") == ("", 0)


def test_upload_shows_nothing_before_it_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("run.json", "tracks.csv"):
        (folder / name).write_text(name)
    system = fsspec.filesystem("memory")
    with monkeypatch.context() as patch:
        patch.setattr(type(system), "put_file", fail)
        with pytest.raises(OutputError, match="cannot be uploaded"):
            upload(folder, "memory://half/run")
    assert not system.exists("/half/run/run.json")

    upload(folder, "memory://half/run")

    assert files("memory://half/run") == {"run.json", "tracks.csv"}
    assert files("memory://half") == {"run/run.json", "run/tracks.csv"}


def test_a_strangers_place_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{}")
    system = fsspec.filesystem("memory")
    system.pipe_file("/theirs/run/thesis.txt", b"years of work")
    with pytest.raises(OutputError, match="did not make this"):
        upload(tmp_path, "memory://theirs/run")

    assert files("memory://theirs") == {"run/thesis.txt"}


def test_an_upload_that_was_killed_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has taken the old run.json away, so that nobody takes half of each for a run."""
    system = fsspec.filesystem("memory")
    system.pipe_file("/killed/run/run.json", b"old")
    system.pipe_file("/killed/run/notes.txt", b"mine")
    for name in ("run.json", "tracks.csv"):
        (tmp_path / name).write_text("new")
    with monkeypatch.context() as patch:
        patch.setattr(type(system), "mv", fail)
        with pytest.raises(OutputError, match="cannot be uploaded"):
            upload(tmp_path, "memory://killed/run")
    assert files("memory://killed/run") == {"notes.txt"}

    finish_upload("memory://killed/run")

    assert files("memory://killed") == {f"run/{n}" for n in ("run.json", "tracks.csv", "notes.txt")}
    assert system.cat_file("/killed/run/run.json") == b"new"


def fail(*_: object, **__: object) -> None:
    msg = "no space"
    raise OSError(msg)


def test_scratch_of_killed_processes_is_removed(own_scratch: Path) -> None:
    (own_scratch / "shapecat-scratch-left").mkdir()
    with scratch() as mine:
        with scratch() as other:
            assert mine.exists()
            assert other.exists()
        assert not (own_scratch / "shapecat-scratch-left").exists()


def test_server_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be downloaded"):
        download("http://127.0.0.1:9/x.mcap", tmp_path)
