"""Tests of the command line: invalid input is refused before work begins, and nothing is lost."""

import io
import json
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import unquote

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import Result

from shapecat.api import open_recording
from shapecat.errors import RecordingError
from shapecat.learning import load_model, save_model
from shapecat.runs.folder import read_run
from shapecat.system.standard_streams import forgive_stderr, require_stdout
from tests.processes import descendants, wait_for
from tests.scenes import record

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("door") / "lab.mcap", 4)


@pytest.fixture(scope="module")
def runs(shapecat: Run, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Process the recording into two runs in different folders."""
    out = tmp_path_factory.mktemp("runs")
    for name in ("a", "deep/c"):
        done = shapecat("process", recording, "--out", out / name, "--no-rrd", "--jobs", 1)
        assert done.exit_code == 0, done.stderr
    return out


def test_recording_given_twice_is_named(shapecat: Run, recording: Path, tmp_path: Path) -> None:
    """With one run for two names, the results of one name would seem to be lost."""
    link, folder, out = tmp_path / "b.mcap", tmp_path / "in", tmp_path / "out"
    folder.mkdir()
    file = folder / "a.mcap"
    shutil.copy(recording, file)
    link.symlink_to(file)
    words = ("--out", out, "--no-rrd", "--no-mcap")
    done = shapecat("process", link, folder, file, *words)

    assert done.exit_code == 0, done.stderr
    assert [path.name for path in out.iterdir()] == ["b"]
    assert done.stderr.splitlines()[0].endswith(f"; {file} is {link}")
    again = shapecat("process", folder, file, *words)  # under one name
    assert again.exit_code == 0, again.stderr
    assert " is " not in again.stderr


def test_inputs_without_a_recording_are_named(
    shapecat: Run, recording: Path, tmp_path: Path
) -> None:
    """A disk that is not mounted would seem to be processed."""
    mount, notes = tmp_path / "mount", tmp_path / "notes.txt"
    mount.mkdir()
    notes.write_text("none")
    words = (recording, "--out", tmp_path / "out", "--no-rrd", "--no-mcap", "--every", 2)

    done = [shapecat("process", *given, *words) for given in ((mount, notes), ())]

    assert [each.exit_code for each in done] == [0, 0]
    first = done[0].stderr.splitlines()[0]
    assert first.startswith("1 recording: ")
    assert first.endswith(f"; skipped 1 file of other formats; no recording in {mount}")
    assert "no recording" not in done[1].stderr


def test_results_do_not_replace_the_recording(shapecat: Run, tmp_path: Path) -> None:
    """A ROS 2 bag in --out is where its own results would be written."""
    bag, out = record(tmp_path / "in" / "day", 2, container="ros2"), tmp_path / "in"
    before = {path: path.read_bytes() for path in bag.iterdir()}

    for source, *options in ((out,), (bag, "--overwrite")):
        refused = shapecat("process", source, "--out", out, *options)
        assert refused.exit_code == 1
        assert refused.stderr == (
            f"Error: {bag}: the results would replace the recording itself; choose another --out\n"
        )
    assert {path: path.read_bytes() for path in bag.iterdir()} == before
    assert list(out.iterdir()) == [bag]
    missing = shapecat("process", out / "night", "--out", out)
    assert "night: does not exist" in missing.stderr


def test_batch_beside_a_foreign_manifest_is_refused(shapecat: Run, tmp_path: Path) -> None:
    """The lines of the batch would be appended to a file of another program."""
    out = tmp_path / "out"
    for file in (tmp_path / "in" / "a.mcap", tmp_path / "in" / "b.mcap", out / "manifest.jsonl"):
        file.parent.mkdir(exist_ok=True)
        file.write_text('{"hello": 1}\n')
    refused = shapecat("process", tmp_path / "in", "--out", out)

    assert refused.exit_code == 1
    assert refused.stderr == (
        f"Error: {out / 'manifest.jsonl'}: shapecat did not make this; choose another --out, or "
        "move it away\n"
    )
    assert [path.name for path in out.iterdir()] == ["manifest.jsonl"]
    assert (out / "manifest.jsonl").read_text() == '{"hello": 1}\n'


def test_info_lists_all_recordings_in_folder(shapecat: Run, tmp_path: Path) -> None:
    """A bag beside an MCAP file is not part of a ROS 2 recording, and must not be skipped."""
    record(tmp_path / "one.mcap", 2)
    record(tmp_path / "two.bag", 2, container="ros1")
    found = json.loads(shapecat("info", tmp_path, "--json").stdout)

    assert {Path(item["path"]).name: item["kind"] for item in found} == {
        "one.mcap": "mcap",
        "two.bag": "ros1",
    }


def test_info_continues_after_unreadable_recording(
    shapecat: Run, recording: Path, tmp_path: Path
) -> None:
    (tmp_path / "bad.mcap").write_text("no recording")
    result = shapecat("info", tmp_path / "bad.mcap", recording)

    assert result.exit_code == 1
    assert "bad.mcap" in result.stderr
    assert "/camera/depth/image_raw" in result.stdout


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--start", "1", "--end", "0.5"), "--end 0.5 is not after --start 1"),
        (("--end", "-1"), "--end"),
        (("--start", "nan"), "--start"),
        (("--start", "-2"), "--start"),
    ],
)
def test_impossible_time_range_is_wrong_usage(
    shapecat: Run, recording: Path, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    result = shapecat("process", recording, "--out", tmp_path / "out", *options)

    assert result.exit_code == 2
    assert words in result.stderr
    assert not (tmp_path / "out").exists()


def test_start_after_end_reports_the_end(shapecat: Run, recording: Path, tmp_path: Path) -> None:
    result = shapecat("process", recording, "--out", tmp_path / "out", "--start", 100)
    seconds = json.loads(shapecat("info", recording, "--json").stdout)[0]["seconds"]

    assert result.exit_code == 4
    assert f"--start 100 is after the end at {seconds:.1f} s" in result.stderr
    assert not (tmp_path / "out").exists()


@contextmanager
def new_logging() -> Iterator[None]:
    """Allow the command to set up logging, which it does once per process."""
    logger = logging.getLogger("shapecat")
    before = logger.level
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(logging.root, "handlers", [])
        logger.setLevel(logging.NOTSET)
        yield
        logger.setLevel(before)


@pytest.mark.parametrize("place", ["before", "after"])
def test_verbose_works_before_and_after_command(
    shapecat: Run, recording: Path, tmp_path: Path, place: str
) -> None:
    """An option accepted only before or only after the command seems to do nothing."""
    before, after = (["-v"], []) if place == "before" else ([], ["-v"])
    options = ("--out", tmp_path, "--no-rrd", "--jobs", "1", "--progress", "none")
    with new_logging():
        done = shapecat(*before, "process", recording, *after, *options)

    assert done.exit_code == 0
    for words in ("/camera/depth/image_raw", "perceive", "track", "annotated.mcap", "default"):
        assert words in done.stderr, done.stderr
    assert done.stderr.count("\n") < 20


def test_verbose_is_off_by_default(
    shapecat: Run, recording: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.ERROR):
        done = shapecat("process", recording, "--out", tmp_path, "--no-rrd", "--progress", "none")

    assert done.stderr == ""


@pytest.mark.parametrize(
    "command",
    [
        ("learn", "default", "DATA", "--out", "PLACE/mine.npz"),
        ("train", "DATA", "--out", "PLACE/mine.npz"),
        ("evaluate", "DATA", "--report", "PLACE/page.html"),
    ],
)
def test_unwritable_output_is_refused_before_reading_data(
    shapecat: Run, tmp_path: Path, command: tuple[str, ...]
) -> None:
    """Otherwise hours of training are lost. The data set does not exist; PLACE is a file."""
    (tmp_path / "file").write_text("")
    names = {"DATA": str(tmp_path / "none"), "PLACE": str(tmp_path / "file")}
    words = [names.get(word, word.replace("PLACE", names["PLACE"])) for word in command]
    result = shapecat(*words)

    assert result.exit_code in {1, 2}
    assert "cannot be written" in result.stderr
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("command", [("learn", "default"), ("train",)])
def test_existing_model_is_kept_unless_overwritten(
    shapecat: Run, tmp_path: Path, command: tuple[str, ...]
) -> None:
    """A model from hours of labelling would be replaced silently. The data set does not exist."""
    model = tmp_path / "mine.npz"
    save_model(model, load_model())
    content = model.read_bytes()
    words = (*command, tmp_path / "none", "--out", model)

    for option, said in (((), "exists already; choose another --out, or --overwrite it"),
                         (("--overwrite",), "none")):  # fmt: skip
        result = shapecat(*words, *option)
        assert result.exit_code in {1, 3}
        assert said in result.stderr
        assert ("exists already" in result.stderr) == (not option)
    assert model.read_bytes() == content


def test_missing_parent_folders_are_created(tmp_path: Path) -> None:
    from shapecat.system.files import require_writable  # noqa: PLC0415  beside its only use

    require_writable(tmp_path / "new" / "deep" / "mine.npz")

    assert list((tmp_path / "new" / "deep").iterdir()) == []


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("x.mcap", ("--format", "ros1"), "x.bag"),
        ("x.bag", ("--format", "mcap"), "x.mcap"),
        ("x.txt", (), "x.mcap"),
        ("x.bag", ("--format", "ros2"), "folder"),
    ],
)
def test_simulate_refuses_suffix_of_another_format(
    shapecat: Run, tmp_path: Path, name: str, options: tuple[str, ...], words: str
) -> None:
    result = shapecat("simulate", tmp_path / name, "--frames", 1, *options)

    assert result.exit_code == 2
    assert words in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("options", [(), ("--overwrite",)])
def test_simulate_offers_to_overwrite_only_recordings(
    shapecat: Run, tmp_path: Path, options: tuple[str, ...]
) -> None:
    """`--overwrite`, which was recommended, then refused the folder."""
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.txt").touch()
    result = shapecat("simulate", tmp_path / "thesis", "--frames", 1, *options)

    assert result.exit_code == 1
    assert "a folder that is not a recording; choose another name" in result.stderr
    assert "--overwrite" not in result.stderr


@pytest.mark.parametrize("folder", [".", "/", "..", "a/.."])
def test_simulate_needs_name_of_recording(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = shapecat("simulate", folder, "--frames", 1)

    assert result.exit_code == 2
    assert f"Error: {folder} is a folder: name a recording in it" in result.stderr


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("report", "a", "--port", "8000"), "--port needs --serve"),
        (("view", "a", "--web", "--screenshot", "a.png"), "--web and --screenshot exclude"),
        (("view", "a", "--screenshot", "a.txt"), "--screenshot a.txt: name it .png"),
        (("annotate", "a", "--labels", "."), "--labels .: is a folder; name the table in it"),
    ],
)
def test_option_without_effect_is_wrong_usage(
    shapecat: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    said: str,
) -> None:
    """Ignoring one of two options surprises whoever gave both."""
    monkeypatch.chdir(tmp_path)
    result = shapecat(*words)

    assert result.exit_code == 2
    assert said in result.stderr


@pytest.mark.parametrize(
    "words",
    [
        *(("info", ""), ("report", ""), ("view", ""), ("simulate", ""), ("annotate", "")),
        *(("evaluate", ""), ("compare", "", "t.json"), ("compare", "a", ""), ("scene", "")),
        *(("process", "", "--out", "q"), ("process", "a", "--out", "")),
        *(("process", "a", "--out", "q", name, "") for name in ("--model", "--config")),
        *(("export", "", "--format", "crops"), ("export", "a", "--recording", "")),
        *(("learn", "default", ""), ("train", "")),
    ],
)  # fmt: skip
def test_empty_path_is_wrong_usage(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    """An unset variable of a shell must not mean the current folder."""
    monkeypatch.chdir(tmp_path)
    result = shapecat(*words)

    assert result.exit_code == 2
    assert "the path is empty" in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        *(("info", "{url}"), ("report", "{url}"), ("simulate", "{url}.mcap", "--frames", "1")),
        *(("export", "a", "--format", "crops", "--out", "{url}"), ("train", "a", "--out", "{url}")),
        ("process", "a", "--out", "q", "--model", "{url}"),
    ],
)
def test_url_is_refused_where_it_would_be_a_local_path(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    """As paths, URLs lose a slash, and results would land in the local folder ``s3:``."""
    monkeypatch.chdir(tmp_path)
    result = shapecat(*(word.format(url="s3://lab/day") for word in words))

    assert result.exit_code == 2
    assert "s3://lab/day" in result.stderr
    assert "is a URL" in result.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["ANY_PATH", "PATH_OR_URL"])
def test_home_folder_is_expanded(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    """Bash leaves the ``~`` in ``--out=~/results``: tables and other files would be separated."""
    monkeypatch.setenv("HOME", "/home/robot")

    convert = getattr(import_module("shapecat.cli.options"), kind).convert

    given = ("~/results", "~", "~results", "a~/b")
    assert [os.fspath(convert(path, None, None)) for path in given] == [
        "/home/robot/results", "/home/robot", "~results", "a~/b",
    ]  # fmt: skip
    with pytest.raises(RecordingError, match="/home/robot/none"):
        open_recording("~/none.mcap")


@pytest.mark.parametrize("there", ["x.mcap", "x.truth.json", "x.labels.npz"])
def test_simulate_requires_overwrite_option(shapecat: Run, tmp_path: Path, there: str) -> None:
    (tmp_path / there).write_text("mine")
    result = shapecat("simulate", tmp_path / "x.mcap", "--frames", 1)

    assert result.exit_code == 2
    assert "--overwrite" in result.stderr
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(there, "mine")]

    assert shapecat("simulate", tmp_path / "x.mcap", "--frames", 1, "--overwrite").exit_code == 0
    assert (tmp_path / "x.mcap").read_bytes().startswith(b"\x89MCAP")


@pytest.mark.parametrize("name", ["thesis.txt", "lab.mcap", "lab.bag", "bag/lab_0.db3"])
def test_simulate_never_removes_foreign_folder(shapecat: Run, tmp_path: Path, name: str) -> None:
    """A folder of recordings must not be deleted like a single recording."""
    mine = tmp_path / "x" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    result = shapecat("simulate", tmp_path / "x", "--frames", 1, "--overwrite")

    assert result.exit_code == 1
    assert "a folder that is not a recording" in " ".join(result.stderr.split())
    assert mine.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [tmp_path / "x"]


def test_export_accepts_folders_but_refuses_equal_run_names(
    shapecat: Run, runs: Path, tmp_path: Path
) -> None:
    result = shapecat("export", runs / "a", runs / "deep" / "c" / "lab", "--format", "kitti",
                      "--out", tmp_path / "kitti")  # fmt: skip
    assert result.exit_code == 1
    assert "lab" in result.stderr  # both would be OUT/lab

    result = shapecat("export", runs / "a", "--format", "kitti", "--out", tmp_path / "kitti")
    assert result.exit_code == 0, result.stderr
    assert (tmp_path / "kitti" / "lab" / "label_2").is_dir()


class Links(HTMLParser):
    """Collects the targets of the links of a page."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.found: list[str] = []
        self.feed(page.read_text("utf-8"))

    def handle_starttag(self, _tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect an href."""
        self.found += [value for name, value in attrs if name == "href" and value]


@pytest.mark.usefixtures("without_pictures")
def test_index_of_scattered_runs_links_to_their_pages(shapecat: Run, runs: Path) -> None:
    folders = [runs / "a" / "lab", runs / "deep" / "c"]
    result = shapecat("report", *folders)

    assert result.exit_code == 0, result.stderr
    (index,) = runs.rglob("index.html")
    assert index.parent == runs
    links = [unquote(link) for link in Links(index).found if not re.match(r"[a-z]+:|#", link)]
    pages = {(index.parent / link).resolve() for link in links}
    names = ("a", "deep/c")
    assert pages == {(runs / name / "lab" / "report.html").resolve() for name in names}
    assert all(page.exists() for page in pages)
    for page in pages:
        back = [link for link in Links(page).found if link.endswith("index.html")]
        assert [(page.parent / unquote(link)).resolve() for link in back] == [index.resolve()]


@pytest.mark.usefixtures("without_pictures")
def test_index_of_links_is_beside_the_links(shapecat: Run, runs: Path, tmp_path: Path) -> None:
    """Beside the targets of the links, the index might be in the home folder."""
    chosen = tmp_path / "chosen"
    chosen.mkdir()
    for name in ("a", "deep/c"):
        (chosen / name[-1]).symlink_to(runs / name / "lab")
    (tmp_path / "way").symlink_to(chosen)
    result = shapecat("report", tmp_path / "way" / "a", chosen)

    assert result.exit_code == 0, result.stderr
    links = [link for link in Links(chosen / "index.html").found if link.endswith("report.html")]
    assert sorted(links) == ["a/report.html", "c/report.html"]
    assert "../index.html" in Links(chosen / "c" / "report.html").found


@pytest.mark.usefixtures("without_pictures")
def test_index_of_others_is_kept(shapecat: Run, runs: Path) -> None:
    """The folder of runs may be a web site; only an index that shapecat made is replaced."""
    index, pages = runs / "a" / "index.html", [*runs.rglob("*.html")]
    for page in pages:
        page.unlink()
    index.write_text("<html>my robots, not a shapecat report</html>")
    refused = shapecat("report", runs / "a")

    assert refused.exit_code == 1
    assert f"Error: {index}: shapecat did not make this" in refused.stderr
    assert [*runs.rglob("*.html")] == [index]
    assert "my robots" in index.read_text()
    index.write_text('<html>\n  <p class="kicker">shapecat report</p>\n</html>')
    for _ in range(2):
        assert shapecat("report", runs / "a").exit_code == 0
    assert 'href="lab/report.html"' in index.read_text()


def test_path_of_moved_recording_can_be_given(
    shapecat: Run, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even a relative path must be found by later commands, from any folder."""
    lab = tmp_path / "lab.mcap"
    lab.write_bytes(recording.read_bytes())
    shapecat("process", lab, "--out", tmp_path, "--no-rrd", "--jobs", 1)
    (tmp_path / "archive").mkdir()
    lab = lab.rename(tmp_path / "archive" / "renamed.mcap")

    lost = shapecat("annotate", tmp_path / "lab")
    assert lost.exit_code == 3
    assert "--recording" in lost.stderr
    crops = ("--format", "crops", "--out", tmp_path / "crops")
    assert "--recording" in shapecat("export", tmp_path / "lab", *crops).stderr

    other = record(tmp_path / "other.mcap", 5)
    wrong = shapecat("annotate", tmp_path / "lab", "--recording", other)
    assert (wrong.exit_code, "another recording" in wrong.stderr) == (1, True)
    exported = shapecat("export", tmp_path / "lab", *crops, "--recording", lab)
    assert exported.exit_code == 0, exported.stderr
    monkeypatch.chdir(lab.parent)
    assert shapecat("annotate", tmp_path / "lab", "--recording", lab.name).exit_code == 0
    monkeypatch.chdir(tmp_path)
    assert shapecat("annotate", tmp_path / "lab").exit_code == 0  # the new path is stored
    known, stat = read_run(tmp_path / "lab")["input"], lab.stat()
    assert known["path"] == str(lab.resolve())
    # With these, later commands need not read the whole recording again.
    assert known["files"] == [["renamed.mcap", stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns]]


def test_view_without_display_suggests_web_viewer(
    shapecat: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "review.rrd").write_bytes(b"RRF2")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"):
        monkeypatch.delenv(name, raising=False)
    result = shapecat("view", tmp_path)

    assert result.exit_code == 1
    assert "--web" in result.stderr
    assert result.stderr.count("\n") == 1


def test_view_distinguishes_missing_run_from_missing_review(
    shapecat: Run, runs: Path, tmp_path: Path
) -> None:
    """The error for a mistyped path or a folder of runs must not suggest processing again."""
    for path in (tmp_path / "nothing", runs, runs / "a"):
        result = shapecat("view", path)
        assert result.exit_code == 1
        assert f"{path}: no run.json there" in result.stderr

    result = shapecat("view", runs / "a" / "lab")
    assert result.exit_code == 1
    assert "no review there; process the recording without --no-rrd" in result.stderr


def test_view_opens_no_other_file_than_a_review(shapecat: Run, tmp_path: Path) -> None:
    """The viewer shows any file; of a recording or a table, that was no review."""
    (tmp_path / "lab.mcap").write_bytes(b"")
    result = shapecat("view", tmp_path / "lab.mcap", "--screenshot", tmp_path / "a.png")

    assert result.exit_code == 1
    assert "lab.mcap: no run.json there; expected a folder" in result.stderr
    assert not (tmp_path / "a.png").exists()


def test_place_without_run_names_one_nearby(shapecat: Run, tmp_path: Path) -> None:
    """Users name the folder above a run, or a run that was interrupted."""
    for name in (".c.partial", "b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").touch()

    above = shapecat("scene", tmp_path, "--frame", 0).stderr
    assert f"expected a folder made by `shapecat process`, such as {tmp_path / 'a'}\n" in above
    assert "this one is unfinished" in shapecat("scene", tmp_path / "c", "--frame", 0).stderr


@pytest.mark.parametrize(
    "error", [MemoryError("Unable to allocate 9 GiB"), RuntimeError("can't start new thread")]
)
def test_lack_of_memory_is_no_bug(
    shapecat: Run,
    recording: Path,
    tmp_path: Path,
    error: Exception,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Under `ulimit -v`, the command printed a traceback and called it a bug in shapecat."""
    with pytest.MonkeyPatch.context() as patch:
        refuse = Mock(side_effect=error)
        patch.setattr("shapecat.batch.runs.process", refuse)
        patch.setattr("shapecat.outputs.scene_tree.read_finished", refuse)
        results = [
            shapecat("process", recording, "--out", tmp_path / "out"),
            shapecat("scene", tmp_path, "--frame", 0),
        ]

    for result in results:
        assert result.exit_code == 1
        assert f"out of memory or threads ({error}); stop other programs" in result.stderr
    assert caplog.text == ""


def test_output_requested_later_is_added_to_run(
    shapecat: Run, recording: Path, runs: Path, tmp_path: Path
) -> None:
    """A review must not require processing everything again, or overwriting results."""
    shutil.copytree(runs / "a", tmp_path, dirs_exist_ok=True)
    lab = tmp_path / "lab"
    before = {path.name: path.stat().st_mtime_ns for path in lab.iterdir()}
    command = ("process", recording, "--out", tmp_path, "--jobs", 1)

    done = shapecat(*command)
    assert done.exit_code == 0, done.stderr
    after = {path.name: path.stat().st_mtime_ns for path in lab.iterdir()}
    assert after.keys() - before.keys() == {"review.rrd"}
    assert {name for name in before if after[name] != before[name]} == {"run.json"}
    assert read_run(lab)["options"]["rrd"]

    (lab / "annotated.mcap").unlink()
    assert shapecat(*command, "--no-rrd").exit_code == 0
    assert (lab / "annotated.mcap").is_file()
    assert (lab / "review.rrd").stat().st_mtime_ns == after["review.rrd"]


def test_refusal_names_differing_options(shapecat: Run, recording: Path, runs: Path) -> None:
    """Without the option that differs, one can only guess which command made the results."""
    options = ("--every", 2, "--no-color", "--set", "detection.min_points=7")
    result = shapecat("process", recording, "--out", runs / "a", *options)

    assert result.exit_code == 1
    differing = [
        "detection.min_points: 60 in the old run, 7 requested",
        "every: 1 in the old run, 2 requested",
        "color: default in the old run, none requested",
    ]
    assert f"({'; '.join(differing)})" in result.stderr


def listening_addresses(pid: int) -> set[str]:
    """Return the addresses on which a process and its children listen."""
    inodes = set()
    for process in [pid, *descendants(pid)]:
        for link in Path(f"/proc/{process}/fd").glob("*"):
            try:
                inodes.add(str(link.readlink()))
            except OSError:
                continue
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            _, local, _, state, *rest = line.split()
            if state == "0A" and f"socket:[{rest[5]}]" in inodes:
                found.add(local.partition(":")[0])
    return found


def test_web_viewer_listens_only_on_localhost(tmp_path: Path) -> None:
    """Other machines in the network must not be able to see the recordings."""
    import rerun as rr  # noqa: PLC0415  loads for a second

    stream = rr.RecordingStream("door")
    stream.save(tmp_path / "review.rrd")
    stream.log("a", rr.TextLog("b"))
    stream.disconnect()
    command = [sys.executable, "-m", "shapecat", "view", str(tmp_path), "--web"]
    viewer = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        assert viewer.stdout is not None
        url = viewer.stdout.readline()
        port = int(re.search(r"http://127\.0\.0\.1:(\d+)", url)[1])  # type: ignore[index]
        with socket.create_connection(("127.0.0.1", port), timeout=10):
            pass
        localhost = {"0100007F", "0000000000000000FFFF00000100007F", "0" * 24 + "01000000"}
        assert listening_addresses(viewer.pid)
        assert listening_addresses(viewer.pid) <= localhost
    finally:
        processes = descendants(viewer.pid)
        viewer.send_signal(signal.SIGINT)
        _, errors = viewer.communicate(timeout=60)
    assert (viewer.returncode, errors) == (0, "stopping the viewer\n")
    wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in processes))


@pytest.mark.parametrize("kind", ["plain", "rich", "none"])
def test_compile_notice_appears_once(capsys: pytest.CaptureFixture[str], kind: str) -> None:
    """Otherwise each recording and each worker would announce the compilation."""
    open_progress = import_module("shapecat.cli.progress").open_progress
    with open_progress(kind, []) as progress:
        for name in ("a", "b", "c"):
            progress.progress(name, "compile", 0, None)
        progress.progress("a", "compile", 120, None)
        for name in ("b", "c"):
            progress.progress(name, "wait for kernels", 121, None)  # for the worker of a

    assert capsys.readouterr().err.rstrip().splitlines() == [
        "compiling kernels, once per installation: about a minute",
        "120 kernels compiled",
    ]


def test_workers_that_wait_for_another_command_say_so_once(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is one line for all workers, every ten seconds."""
    module = import_module("shapecat.cli.progress")
    now = 50.0
    monkeypatch.setattr("shapecat.cli.progress.time.monotonic", lambda: now)
    with module.open_progress("plain", []) as progress:
        for now, name in ((60.0, "a"), (61.0, "b"), (70.0, "a"), (71.0, "b")):
            progress.progress(name, "wait for kernels", round(now), None)

    waiting = "waiting for another process that compiles kernels"
    assert capsys.readouterr().err.splitlines() == [
        f"{waiting}: 60 compiled",
        f"{waiting}: 70 compiled",
    ]


FIXTURE = str(Path(__file__).parents[1] / "fixtures" / "tabletop.mcap")


needs_full_device = pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="needs a device that is always full"
)


@needs_full_device
@pytest.mark.parametrize(
    ("words", "unbuffered"),
    [
        (("--help",), ""),
        (("--help",), "1"),
        (("info", FIXTURE), ""),
        pytest.param(("info", FIXTURE), "1", marks=pytest.mark.many),
    ],
)
def test_full_disk_behind_stdout_is_reported_in_one_line(
    words: tuple[str, ...], unbuffered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the write nor the flush at exit may print a traceback."""
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "shapecat", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )

    assert done.returncode == 1
    assert done.stderr == "Error: cannot write the output: No space left on device\n"


@pytest.mark.parametrize(
    "line", ["print_table(['recording'], [['lab']])", "print_json(list(range(99999)))"]
)
def test_reader_that_leaves_early_does_not_change_the_exit_code(line: str) -> None:
    """`process ... | head` would exit as if recordings had failed."""
    reader, pipe = os.pipe()
    os.close(reader)
    program = f"""
import sys
from shapecat.cli.render import for_any_reader, print_json, print_table
with for_any_reader():
    {line}
sys.exit(5)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], stdout=pipe, stderr=subprocess.PIPE, check=False
    )
    os.close(pipe)

    assert (done.returncode, done.stderr) == (5, b"")


EXPORT = """
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from shapecat.outputs.exports import formats
from shapecat.runs import finished

finished.find_runs = list
runs = [SimpleNamespace(name=name, folder=Path(name)) for name in "abc"]
import_module("shapecat.cli.export")._usable = lambda *_, **__: (runs, False)
formats.common_categories = lambda _: ()
formats.export_run = lambda run, *_, **__: print(run.name, file=sys.stderr) or 1
command = import_module("shapecat.cli.main").main
command(["export", "a", "b", "c", "--format", "kitti", "--out", "out"])
"""


def test_reader_that_leaves_early_does_not_end_an_export() -> None:
    """With `export ... | head -1`, only the first run would be exported."""
    reader, pipe = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", EXPORT], stdout=pipe, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(pipe)

    assert (done.returncode, done.stderr.split()) == (0, ["a", "b", "c"])


def test_closed_stdout_does_not_change_the_exit_code(tmp_path: Path) -> None:
    """Without stdout, `process` would crash after the work, and files would get its descriptor."""
    words = ["process", str(tmp_path / "missing.mcap"), "--out", str(tmp_path / "out")]
    command = ["sh", "-c", 'exec "$@" >&-', "sh", sys.executable, "-m", "shapecat", *words]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)

    assert done.returncode == 3
    assert done.stderr.count("\n") == 1, done.stderr


@contextmanager
def unwritable_stderr(how: str) -> Iterator[None]:
    """Close stderr during the block, or connect it to a full disk or to a pipe without reader."""
    before, (reader, pipe) = os.dup(2), os.pipe()
    os.close(reader)
    with Path("/dev/full").open("w") as full:
        if how == "closed":
            os.close(2)
        else:
            os.dup2(pipe if how == "pipe" else full.fileno(), 2)
    try:
        yield
    finally:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
            if sys.stderr is not None:
                sys.stderr.flush()  # what could not be written is still in its buffer
        os.dup2(before, 2)
        os.close(before)
        os.close(pipe)


@needs_full_device
@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("jsonl", "full"),
        ("auto", "closed"),
        ("jsonl", "pipe"),
        pytest.param("rich", "full", marks=pytest.mark.many),
    ],
)
def test_unwritable_stderr_does_not_end_the_work(
    recording: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    kind: str,
    how: str,
) -> None:
    """A log may fill its disk, or a terminal be closed; recordings must be processed anyway."""
    bad = tmp_path / "bad.mcap"
    bad.write_text("no recording")
    words = ["process", str(recording), str(bad), "--out", str(tmp_path / "out"), "--no-rrd"]
    words += ["--no-mcap", "--jobs", "1", "--progress", kind]
    command = import_module("shapecat.cli.main").main
    monkeypatch.setattr(sys, "stderr", None if how == "closed" else sys.__stderr__)
    with unwritable_stderr(how), pytest.raises(SystemExit) as ended:
        forgive_stderr()
        command(words, prog_name="shapecat")

    assert ended.value.code == 1
    assert "1 complete, 1 failed" in capfd.readouterr().out


def test_stderr_can_be_flushed_when_python_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python 3.13 flushes stderr after setting the module's names to None, and prints any error."""
    monkeypatch.setattr(sys, "stderr", sys.__stderr__)
    forgive_stderr()
    module = import_module("shapecat.system.standard_streams")
    for name in [name for name in vars(module) if not name.startswith("__")]:
        monkeypatch.setattr(module, name, None)
    sys.stderr.write("")
    sys.stderr.flush()


COMPLAIN = """
import sys, types, shapecat.__main__ as entry

def main(**_):
    print("x" * 99_999, file=sys.stderr)
    print("worked")
    sys.exit(3)

entry.import_module = lambda _: types.SimpleNamespace(main=main)
entry.run()
"""


def test_names_that_the_terminal_cannot_show_are_escaped(
    monkeypatch: pytest.MonkeyPatch, recording: Path, tmp_path: Path
) -> None:
    """A name in another alphabet must not end a command, nor make its JSON invalid."""
    path = shutil.copy(recording, tmp_path / "é机.mcap")
    printed = []
    for words in (["info", str(path)], ["info", str(path), "--json"]):
        output = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(output, "latin-1"))
        require_stdout()
        with pytest.raises(SystemExit):
            import_module("shapecat.cli.main").main(words, prog_name="shapecat")
        printed.append(output.getvalue().decode("latin-1"))

    assert "é\\u673a.mcap" in printed[0]
    assert Path(json.loads(printed[1].encode())[0]["path"]) == path
    assert printed[1].isascii()


@needs_full_device
@pytest.mark.parametrize("how", ["full", "closed", "pipe"])
def test_unwritable_stderr_keeps_exit_code(how: str) -> None:
    """Python flushes stderr at the end; if that fails, the code becomes 120."""
    with unwritable_stderr(how):
        done = subprocess.run([sys.executable, "-c", COMPLAIN], stdout=subprocess.PIPE, check=False)

    assert (done.returncode, done.stdout) == (3, b"worked\n")


@pytest.mark.parametrize("below", [[1, 0], [99, None]])
def test_scene_of_damaged_table_is_refused(
    shapecat: Run, guessed_run: Path, tmp_path: Path, below: list[int | None]
) -> None:
    """Two objects on each other would give an endless loop, an object on nothing a crash."""
    folder = tmp_path / "run"
    shutil.copytree(guessed_run, folder)
    table = pq.read_table(folder / "detections.parquet")
    at = table.column_names.index("on_detection")
    column = pa.array([*below, *[None] * (table.num_rows - 2)], pa.int32())
    pq.write_table(table.set_column(at, "on_detection", column), folder / "detections.parquet")
    frame = table["frame"][0].as_py()

    done = shapecat("scene", folder, "--frame", frame)

    assert done.exit_code != 0
    assert "has objects on nothing; process the recording again" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    "words",
    [
        ("report", "bad"),
        ("export", "bad", "--format", "crops", "--out", "good/crops"),
        ("annotate", "bad"),
        ("annotate", "good", "--recording", "bad.mcap"),
        ("compare", "good", "bad"),
        ("compare", "good", "good", "--out", "bad"),
        ("scene", "bad", "--frame", "0"),
        ("view", "bad", "--screenshot", "good.png"),
        ("view", "good", "--screenshot", "bad.png"),
    ],
    ids=" ".join,
)
def test_path_that_is_not_utf8_is_refused_in_one_line(
    shapecat: Run, guessed_run: Path, tmp_path: Path, words: tuple[str, ...]
) -> None:
    """Arrow and Rerun cannot open such a path, and would end with a traceback."""
    strange = tmp_path / os.fsdecode(b"k\xfcche")
    for parent in (tmp_path, strange):
        shutil.copytree(guessed_run, parent / "run")
        (parent / "run" / "review.rrd").touch()
    shutil.copy(read_run(guessed_run)["input"]["path"], strange / "r.mcap")
    places = {"good": tmp_path / "run", "bad": strange / "run", "bad.mcap": strange / "r.mcap"}
    places |= {"good.png": tmp_path / "x.png", "bad.png": strange / "x.png"}

    done = shapecat(*(places.get(word, word) for word in words))

    assert done.exit_code == (3 if "bad.mcap" in words else 1)
    assert "k\ufffdche/" in done.stderr
    assert done.stderr.endswith(": the path is not valid UTF-8; rename it\n")
    assert done.stderr.count("\n") == 1
