"""Tests of run folders, digests of the input, locks and scratch folders: nothing is lost."""

import errno
import os
import shutil
import socket
from contextlib import nullcontext
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from shapecat.errors import OutputError, RecordingError
from shapecat.recordings.files import input_files
from shapecat.runs.finished import find_usable, open_source
from shapecat.runs.folder import (
    RUN_FILES,
    clear,
    previous_path,
    read_run,
    recover,
    require_ours,
    staged,
    write_run,
    writing_outputs,
)
from shapecat.runs.identity import content_digest, file_stats, new_id, same_content
from shapecat.system.files import (
    BusyError,
    complete_folder,
    holding,
    partial_path,
    replacing,
    require_writable,
    scratch_folder,
)
from tests.run_info import run_info


def test_staged_folder_appears_complete(tmp_path: Path) -> None:
    folder = tmp_path / "out" / "lab"
    with staged(folder) as hidden:
        (hidden / "a").write_text("1")
        assert not folder.exists()

    assert (folder / "a").read_text() == "1"
    assert [p.name for p in folder.parent.iterdir()] == ["lab"]


def test_marker_of_a_cleared_folder_is_removed_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a kill in between, shapecat would take the rest for somebody else's files."""
    for name in (*RUN_FILES, ".tracks.csv.partial", "notes.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "segments" / "000000").mkdir(parents=True)
    left: list[set[str]] = []
    unlink = Path.unlink

    def remove(path: Path, *, missing_ok: bool = False) -> None:
        unlink(path, missing_ok=missing_ok)
        left.append({item.name for item in tmp_path.iterdir()})

    monkeypatch.setattr(Path, "unlink", remove)
    clear(tmp_path)

    assert left[-1] == {"notes.txt"}
    assert left[-2] == {"notes.txt", "run.json"}


def test_error_leaves_nothing(tmp_path: Path) -> None:
    """Parent folders that were made for the run are removed too."""
    with pytest.raises(RuntimeError), staged(tmp_path / "out" / "deep" / "lab") as hidden:
        (hidden / "a").write_text("1")
        raise RuntimeError

    assert list(tmp_path.iterdir()) == []


def test_unwritable_path_is_reported_with_reason(tmp_path: Path) -> None:
    """Users need no error number, and "File exists" would not say what hinders them."""
    (tmp_path / "file").write_text("")
    below, missing = tmp_path / "file" / "model.npz", tmp_path / "none"

    with pytest.raises(OutputError) as error:
        require_writable(below)
    assert str(error.value) == f"{below}: cannot be written: {below.parent} is not a folder"
    with pytest.raises(OutputError) as error, replacing(below) as path:
        path.touch()
    assert str(error.value) == f"{below}: cannot be written: Not a directory"
    with pytest.raises(OutputError) as error, holding(missing):
        pass
    assert str(error.value) == f"{missing}: No such file or directory"


def make_run(folder: Path, **files: str) -> Path:
    """Make a run folder as an earlier run left it; ``files`` are texts by name, with _ for dots."""
    folder.mkdir(parents=True)
    run = run_info(id=new_id())
    write_run(folder, run)
    for name, text in files.items():
        (folder / name.replace("_", ".")).write_text(text)
    return folder


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir() if path.name != "run.json"}


def test_old_results_stay_until_new_ones_are_complete(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "lab", tracks_csv="old")
    with pytest.raises(RuntimeError), staged(folder) as hidden:
        (hidden / "tracks.csv").write_text("new")
        raise RuntimeError

    assert contents(folder) == {"tracks.csv": "old"}

    with staged(folder) as hidden:
        (hidden / "frames.parquet").write_text("new")

    assert [p.name for p in tmp_path.iterdir()] == ["lab"]
    assert contents(folder) == {"frames.parquet": "new"}


@pytest.mark.parametrize("name", ["lab", ".lab.partial"])
@pytest.mark.parametrize("file", ["thesis.txt", "run.json", "tracks.csv"])
def test_foreign_folder_is_not_touched(tmp_path: Path, name: str, file: str) -> None:
    """Not even a folder that looks like a run folder, but has no id, may be touched."""
    (tmp_path / name).mkdir()
    (tmp_path / name / file).write_text("{}")
    with pytest.raises(OutputError, match="did not make this"), staged(tmp_path / "lab"):
        pytest.fail("must not begin")

    assert {path.name: path.read_text() for path in (tmp_path / name).iterdir()} == {file: "{}"}
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("content", ['{"id": "0', '{"id": "0123456789abcdef"}'])
def test_run_with_unusable_description_is_called_so(tmp_path: Path, content: str) -> None:
    """The message said that shapecat did not make a folder that it did make."""
    (tmp_path / "run.json").write_text(content)
    with pytest.raises(OutputError, match=r"its run\.json is damaged or from another version"):
        require_ours(tmp_path)


def test_file_or_link_at_target_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "lab").write_text("mine")
    (tmp_path / "link").symlink_to(make_run(tmp_path / "elsewhere"))
    (tmp_path / "broken").symlink_to(tmp_path / "disk that is not mounted")
    for name in ("lab", "link", "broken"):
        with pytest.raises(OutputError, match="did not make this"), staged(tmp_path / name):
            pytest.fail("must not begin")

    assert (tmp_path / "lab").read_text() == "mine"
    assert (tmp_path / "elsewhere" / "run.json").exists()


def test_run_is_replaced_after_its_outputs_are_written(tmp_path: Path) -> None:
    """Otherwise `annotate` ends by writing the old run.json into the new run."""
    make_run(tmp_path / "lab", tracks_parquet="old")

    def replace_it() -> None:
        with staged(tmp_path / "lab") as hidden:
            write_run(hidden, run_info(id=new_id()))
            (hidden / "tracks.parquet").write_text("new")

    replacing = Thread(target=replace_it)
    with writing_outputs(tmp_path / "lab"):
        replacing.start()
        replacing.join(0.3)
        assert contents(tmp_path / "lab")["tracks.parquet"] == "old"
    replacing.join()

    assert contents(tmp_path / "lab")["tracks.parquet"] == "new"


def test_user_files_move_to_new_results(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "lab", tracks_csv="old", notes_txt="mine")
    (folder / "photos").mkdir()
    (folder / "photos" / "a.jpg").write_text("picture")
    with staged(folder) as hidden:
        (hidden / "tracks.csv").write_text("new")

    assert [p.name for p in tmp_path.iterdir()] == ["lab"]
    assert (folder / "photos" / "a.jpg").read_text() == "picture"
    assert (folder / "notes.txt").read_text() == "mine"
    assert (folder / "tracks.csv").read_text() == "new"


def test_nothing_of_a_replaced_run_is_moved_to_the_new_one(tmp_path: Path) -> None:
    """The old report would show old tracks and labels as if they belonged to the new run."""
    folder = make_run(tmp_path / "lab")
    for name in (
        *("frames.parquet", "detections.parquet", "planes.parquet", "masks.parquet"),
        *("tracks.parquet", "tracks.csv", "tracks.original.csv", "tracks.previous.csv"),
        *("report.html", "annotated.mcap", "review.rrd"),
    ):
        (folder / name).write_text("old")
        partial_path(folder / name).write_text("half")
    for name in ("segments", "revisions"):
        (folder / name / "000000").mkdir(parents=True)

    with staged(folder) as hidden:
        write_run(hidden, run_info(id=new_id()))

    assert [p.name for p in folder.iterdir()] == ["run.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["lab"]


def test_kill_between_renames_loses_neither_folder(tmp_path: Path) -> None:
    """The old folder is restored; the new one stays until its run resumes."""
    folder = make_run(tmp_path / "lab", tracks_csv="old")
    make_run(partial_path(folder), tracks_csv="new")
    folder.rename(previous_path(folder))

    recover(folder)

    assert contents(folder) == {"tracks.csv": "old"}
    assert contents(partial_path(folder)) == {"tracks.csv": "new"}


def test_recovery_removes_old_folder_but_keeps_user_files(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "lab", tracks_csv="new")
    make_run(previous_path(folder), tracks_csv="old", notes_txt="mine")

    recover(folder)

    assert [p.name for p in tmp_path.iterdir()] == ["lab"]
    assert contents(folder) == {"tracks.csv": "new", "notes.txt": "mine"}


def test_recovery_keeps_old_results_beside_a_foreign_folder(tmp_path: Path) -> None:
    """After a kill, a user may make a folder of that name; the only results must not be lost."""
    folder = tmp_path / "lab"
    make_run(previous_path(folder), tracks_csv="old")
    folder.mkdir()
    (folder / "photo.jpg").write_text("mine")

    recover(folder)

    assert contents(folder) == {"photo.jpg": "mine"}
    assert contents(previous_path(folder)) == {"tracks.csv": "old"}


def test_resumable_work_stays_after_error(tmp_path: Path) -> None:
    folder = tmp_path / "out" / "lab"
    with (
        pytest.raises(OutputError, match=r"No space left.*is kept"),
        staged(folder, worth_keeping=lambda hidden: (hidden / "work").exists()) as hidden,
    ):
        (hidden / "work").write_text("hours")
        raise OSError(errno.ENOSPC, "No space left on device")

    assert (partial_path(folder) / "work").read_text() == "hours"


def test_unwritable_output_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="cannot write the results"),
        staged(tmp_path / "file" / "x"),
    ):
        pass


def test_replacing_keeps_old_file_on_error(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as hidden:
        hidden.write_text("half")
        raise RuntimeError

    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_run_json_round_trips_and_is_validated(tmp_path: Path) -> None:
    run = run_info(input={"path": "ü"})
    write_run(tmp_path, run)

    assert read_run(tmp_path) == run

    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(OutputError, match="not a description"):
        read_run(tmp_path)
    with pytest.raises(OutputError, match=r"no run\.json"):
        read_run(tmp_path / "nowhere")


def test_unreadable_run_json_is_not_called_missing(tmp_path: Path) -> None:
    """Users without permission to read it looked for another folder."""
    (tmp_path / "run.json").mkdir()  # permissions do not bind the administrator

    with pytest.raises(OutputError, match=r"run\.json: cannot be read: Is a directory"):
        read_run(tmp_path)
    with pytest.raises(OutputError, match=r"no run\.json there"):
        read_run(tmp_path / "missing")


def test_recording_at_url_is_missing_under_its_url(tmp_path: Path) -> None:
    """The URL lost a slash in the message, which must also name the command for this run."""
    url = "s3://lab/in/a.mcap"
    write_run(tmp_path, run_info(input={"path": url}))

    with (
        pytest.raises(RecordingError, match=f"^{url}: the recording is at a URL"),
        open_source(read_run(tmp_path)),
    ):
        pytest.fail("it is not on this machine")
    (tmp_path / "tracks.csv").write_text("track,category,confidence,label\n")
    shutil.copy(tmp_path / "tracks.csv", tmp_path / "tracks.original.csv")
    found, (error,) = find_usable([tmp_path])
    assert found == []
    assert f"{url}: the recording is at a URL" in str(error)
    assert f"`shapecat annotate {tmp_path} --recording PATH`" in str(error)


@pytest.mark.parametrize("length", [249, 253, 300])
def test_name_too_long_for_hidden_folder_is_explained(tmp_path: Path, length: int) -> None:
    """Recordings of robots may have long names, and the hidden folders add nine characters."""
    folder = tmp_path / ("n" * length)
    with pytest.raises(OutputError, match=r"n: .*: File name too long"):
        recover(folder)
        with staged(folder):
            pytest.fail("there is no such folder")


def test_longest_name_of_a_recording_is_read(tmp_path: Path) -> None:
    """Its write-ahead log has a name too long for the disk; looking for it ended in a traceback."""
    path = tmp_path / ("n" * 250 + ".mcap")
    path.write_bytes(b"abc")

    assert input_files(path) == [path]


def test_digest_covers_whole_file(tmp_path: Path) -> None:
    path = tmp_path / "f"
    whole = b"a" * 3_000_000
    contents = [b"", b"a", whole, whole + b"a"]
    for at in (0, 1, *range(99_999, len(whole), 100_000)):
        damaged = bytearray(whole)
        damaged[at] = 0
        contents.append(bytes(damaged))
    digests = set()
    for content in contents:
        path.write_bytes(content)
        digests.add(content_digest(path))

    assert len(digests) == len(contents)


def test_folder_digest_covers_names_and_file_boundaries(tmp_path: Path) -> None:
    digests = set()
    for k, files in enumerate(
        (
            {"a.db3": "xy", "b.db3": "z"},
            {"a.db3": "x", "b.db3": "yz"},
            {"a.db3": "xy", "c.db3": "z"},
        )
    ):
        (tmp_path / str(k)).mkdir()
        for name, text in files.items():
            (tmp_path / str(k) / name).write_text(text)
        digests.add(content_digest(tmp_path / str(k)))

    assert len(digests) == 3


def test_content_is_read_only_if_file_times_differ(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_text("abc")
    known: Any = {"files": file_stats(path), "digest": content_digest(path)}

    def read() -> str:
        reads.append(path)
        return content_digest(path)

    reads: list[Path] = []
    assert same_content(known, path, read)
    assert not reads

    path.rename(tmp_path / "g")
    path = tmp_path / "g"
    assert same_content(known, path, read)
    assert len(reads) == 1

    stat = path.stat()
    path.write_text("xyz")
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert not same_content(known, path, read)


def test_file_is_flushed_before_and_after_renaming(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power cut could leave an incomplete file under its final name."""
    path, flushed = tmp_path / "f", []

    def fsync(number: int) -> None:
        flushed.append((str(Path(f"/proc/self/fd/{number}").readlink()), path.exists()))

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.delenv("SHAPECAT_FSYNC")
    with replacing(path) as hidden:
        hidden.write_text("all")

    assert flushed == [(str(partial_path(path)), False), (str(tmp_path), True)]

    monkeypatch.setenv("SHAPECAT_FSYNC", "0")
    with replacing(path) as hidden:
        hidden.write_text("more")

    assert len(flushed) == 2


@pytest.mark.parametrize(("code", "raised"), [(errno.EIO, True), (errno.EINVAL, False)])
def test_failing_disk_is_an_error_but_a_disk_without_flush_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, raised: bool
) -> None:
    """A file that was not stored would count as complete; some network disks cannot flush."""

    def fsync(_number: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.delenv("SHAPECAT_FSYNC")
    outcome = pytest.raises(OutputError, match="cannot be written") if raised else nullcontext()
    with outcome, replacing(tmp_path / "f") as hidden:
        hidden.write_text("all")

    assert (tmp_path / "f").exists() is not raised


def test_remains_of_a_killed_process_are_not_part_of_a_folder(tmp_path: Path) -> None:
    """A run that was killed while it wrote a segment could not be resumed."""
    folder = tmp_path / "0001"
    partial_path(folder).mkdir()
    (partial_path(folder) / "half.parquet").touch()

    with complete_folder(folder) as hidden:
        (hidden / "frames.parquet").touch()

    assert [path.name for path in folder.iterdir()] == ["frames.parquet"]


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder in which temporary folders are made."""
    folder = tmp_path / "tmp"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


@pytest.mark.parametrize("case", ["no locks", "robot2", "robot", "robot1"])
def test_scratch_that_may_be_in_use_is_not_removed(
    temporary: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    """An unpacked recording would vanish while another command reads it.

    On NFS, a lock on a folder is known to its own machine only; and the name of a machine may begin
    with that of another.
    """

    def no_locks(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr("socket.gethostname", lambda: "robot1-2")
    if case == "no locks":
        monkeypatch.setattr("fcntl.flock", no_locks)
    with scratch_folder() as mine:
        os.utime(mine, (0, 0))
        if case != "no locks":
            monkeypatch.setattr("socket.gethostname", lambda: case)
            monkeypatch.setattr("fcntl.flock", lambda *_: None)
        with scratch_folder():
            assert mine.exists()
    assert not list(temporary.iterdir())


def test_locks_leave_no_open_file(temporary: Path) -> None:
    """If locks are refused, or end in errors, again and again, a process runs out of open files.

    After an error, it would also keep the lock until it ends.
    """

    def open_files() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    used = temporary / f"shapecat-scratch-{socket.gethostname()}+used"
    used.mkdir()
    os.utime(used, (0, 0))
    before = open_files()
    with pytest.raises(OSError, match="no disk"), holding(used):
        with pytest.raises(BusyError), holding(used, wait=False):
            pass
        with scratch_folder():  # would remove it if it were not locked
            pass
        assert open_files() == before + 1
        raise OSError("no disk")  # noqa: EM101, TRY003  any error
    assert open_files() == before
    with holding(used, wait=False):
        assert used.exists()


def test_scratch_of_killed_processes_is_removed(temporary: Path) -> None:
    name = f"shapecat-scratch-{socket.gethostname()}+"
    old, new = temporary / f"{name}old", temporary / f"{name}new"
    for left in (old, new):
        left.mkdir()
    os.utime(old, (0, 0))
    with scratch_folder() as mine:
        os.utime(mine, (0, 0))
        with scratch_folder() as other:
            assert mine.exists()
            assert other.exists()
        assert not old.exists()
    assert [*temporary.iterdir()] == [new]  # its process may not have locked it yet
