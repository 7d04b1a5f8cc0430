"""Tests of finding recordings, recognising finished work, and the manifest of a batch."""

import json
import os
import re
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import CancelledError, Executor, Future
from contextlib import nullcontext
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import fsspec
import pytest
from xxhash import xxh3_128_hexdigest

from shapecat.batch import claims
from shapecat.batch.finding import find_recordings
from shapecat.batch.finding_urls import _combined_key
from shapecat.batch.ledger import Ledger, Outcome
from shapecat.batch.manifest import (
    Entry,
    FileManifest,
    Manifest,
    RemoteManifest,
    State,
    open_manifest,
)
from shapecat.batch.naming import existing_names, name_folders
from shapecat.batch.plans import _input_key, parse_shard, plan_batch, shard_of
from shapecat.batch.runs import _reporter, process_here, process_on
from shapecat.batch.sources import Source
from shapecat.batch.storage import Location, content_key
from shapecat.config import Settings, with_overrides
from shapecat.errors import ConfigError, OutputError, RecordingError, common_exit_code
from shapecat.executors import WorkerLostError
from shapecat.recordings import FrameRange
from shapecat.recordings.files import input_size
from shapecat.runs.folder import read_run, write_run
from shapecat.runs.identity import (
    ContentDigest,
    content_digest,
    file_stats,
    same_content,
    unchanged,
    work_id,
)
from shapecat.runs.jobs import (
    Job,
    Summary,
    describe_run,
    differences,
    discard_if_changed,
    summarize,
)
from shapecat.runs.perceive.resuming import has_work, require_resumable, resume
from shapecat.runs.run_info import RunInfo
from shapecat.system.files import partial_path
from tests.run_info import run_info

MODEL: Any = SimpleNamespace(model_id="m1", categories=("cup", "can"))


@pytest.fixture
def source(tmp_path: Path) -> Path:
    path = tmp_path / "lab.mcap"
    path.write_bytes(b"recording")
    return path


def planned(source: Path, **changes: Any) -> RunInfo:
    run = describe_run(Job(source, source.parent / "lab", **changes), MODEL)
    run["input"]["digest"] = "xxh3-128:0123"
    return run


def test_unreadable_file_is_not_skipped(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Skipped, it would be missing from the results without a word; opened, it gives an error."""
    secret, note = source.with_name("secret"), source.with_name("note")
    secret.write_bytes(b"#ROSBAG V2.0\n")
    note.write_bytes(b"no recording")
    opened = Path.open

    def refuse(path: Path, *words: Any, **options: Any) -> Any:
        if path.name == "secret":
            raise PermissionError(path)
        return opened(path, *words, **options)

    monkeypatch.setattr(Path, "open", refuse)
    found = find_recordings([str(source), str(secret), str(note)])

    assert [kept.stem for kept in found.sources] == ["lab", "secret"]
    assert found.skipped == 1


def test_recordings_are_known_by_their_first_bytes(tmp_path: Path) -> None:
    """A recording without its usual suffix would be missing from the results."""
    starts = {"a": b"\x89MCAP0\r\n", "b": b"#ROSBAG V2.0\n", "c": b"SQLite format 3\0"}
    for name, content in {**starts, "d": b"SQLite", "e": b"MCAP", "f.mcap": b""}.items():
        (tmp_path / name).write_bytes(content)
    found = find_recordings(sorted(map(str, tmp_path.iterdir())))

    assert [kept.stem for kept in found.sources] == ["a", "b", "c", "f"]
    assert found.skipped == 2


def test_unreadable_folder_does_not_end_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The root of a disk has a folder lost+found, which only an administrator may read."""
    (tmp_path / "lost+found").mkdir()
    (tmp_path / "z.mcap").write_bytes(b"\x89MCAP")
    listed = Path.iterdir

    def refuse(path: Path) -> Any:
        if path.name == "lost+found":
            raise PermissionError(13, "Permission denied", str(path))
        return listed(path)

    monkeypatch.setattr(Path, "iterdir", refuse)

    assert [kept.stem for kept in find_recordings([str(tmp_path)]).sources] == ["z"]
    assert caplog.messages == [f"{tmp_path / 'lost+found'}: skipped: Permission denied"]


def test_compressed_recordings_in_a_folder_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Packed to save space, they would be missing from the results without a word."""
    for name in ("a.mcap", "b.mcap.zstd", "c.bag.gz", "notes.txt.gz"):
        (tmp_path / name).write_bytes(b"x")

    found = find_recordings([str(tmp_path)])

    assert [kept.stem for kept in found.sources] == ["a"]
    assert [text.partition(": ")[0] for text in caplog.messages] == [
        str(tmp_path / name) for name in ("b.mcap.zstd", "c.bag.gz")
    ]


def test_compressed_recordings_in_storage_are_named(caplog: pytest.LogCaptureFixture) -> None:
    """Compressed recordings would be missing without a word; in a bag, files may be compressed."""
    names = ("a.mcap", "b.mcap.zstd", "c.bag.gz", "bag/metadata.yaml", "bag/bag_0.db3.zstd")
    for name in names:
        with fsspec.open(f"memory://packed/{name}", "wb") as file:
            file.write(b"rosbag2_bagfile_information:\n")

    found = find_recordings(["memory://packed/"])

    assert [kept.url for kept in found.sources] == [
        "memory:///packed/a.mcap",
        "memory:///packed/bag",
    ]
    assert [text.partition(": ")[0] for text in caplog.messages] == [
        "memory:///packed/b.mcap.zstd", "memory:///packed/c.bag.gz"
    ]  # fmt: skip


def test_files_of_a_bag_are_not_counted_as_skipped(tmp_path: Path) -> None:
    """A shell pattern may list the files of a bag beside the bag."""
    bag, note = tmp_path / "bag", tmp_path / "note.txt"
    bag.mkdir()
    files = [bag / "bag_0.db3", bag / "metadata.yaml", note]
    for file in files:
        file.write_bytes(b"no recording by itself")
    found = find_recordings([str(path) for path in (bag, *files)])

    assert [kept.path for kept in found.sources] == [str(bag)]
    assert found.skipped == 1


CHANGES: Mapping[str, Mapping[str, Any]] = {
    "settings": {"settings": Settings(seed=8)},
    "start": {"frame_range": FrameRange(start_s=0.5)},
    "end": {"frame_range": FrameRange(end_s=0.5)},
    "every": {"frame_range": FrameRange(every=3)},
    "up": {"up": "imu"},
    "fixed frame": {"fixed_frame": "odom"},
    "topics": {"topics": ("/a",)},
}


@pytest.mark.parametrize("name", CHANGES)
def test_other_options_give_other_work_id(source: Path, name: str) -> None:
    """Results of other options under the same name would pass for the requested ones."""
    run, other = planned(source), planned(source, **CHANGES[name])

    assert not differences(run, planned(source))
    assert differences(run, other)
    assert work_id(run) != work_id(other)


@pytest.mark.parametrize("key", ["model", "version", "content"])
def test_other_model_version_or_content_gives_other_work_id(source: Path, key: str) -> None:
    run, other = planned(source), planned(source)
    if key == "model":
        other["model"] = {**other["model"], "id": "m2"}
        assert differences(run, other)
    elif key == "version":
        other["versions"] = {**other["versions"], "shapecat": "0.0.1"}
    else:
        other["input"] = {**other["input"], "digest": "xxh3-128:4567"}

    assert work_id(run) == work_id(planned(source))
    assert work_id(run) != work_id(other)


@pytest.mark.parametrize("name", ["color", "mcap", "rrd", "boxes"])
def test_output_options_keep_work_id(source: Path, name: str) -> None:
    """Labels must still apply after the recording is processed again with other outputs."""
    changed: Any = {"color": {"color": ""}, "mcap": {"mcap": False}, "rrd": {"rrd": False}}
    changed["boxes"] = {"settings": with_overrides(Settings(), ["outputs.boxes=visible"])}
    run, other = planned(source), planned(source, **changed[name])

    assert work_id(run) == work_id(other)
    assert differences(run, other)  # a run without colour does not count as one with it


def test_summary_has_total_seconds(source: Path) -> None:
    """The sum of all entries would count each phase twice."""
    run = planned(source)
    run["seconds"] = {"perceive": 3.5, "track": 1.25, "compile": 0.75, "total": 8.0}
    run["warnings"] = ["tilted"]
    found = summarize(run, processed=False)

    assert (found.seconds, found.warnings, found.processed) == (8.0, ("tilted",), False)


def test_rewritten_recording_counts_as_changed(source: Path) -> None:
    """New permissions are no change, although they renew the inode time."""
    before = file_stats(source)
    source.chmod(0o600)
    assert unchanged(before, source)

    source.write_bytes(b"another!!")
    os.utime(source, ns=(3, before[0][2] + 1))

    assert not unchanged(before, source)
    source.write_bytes(b"longer recording")
    os.utime(source, ns=(3, before[0][2]))
    assert not unchanged(before, source)
    source.unlink()
    assert not unchanged(before, source)


def test_content_is_compared_if_only_times_differ(source: Path) -> None:
    """Labels would be drawn on another recording of the same name and length."""
    known = planned(source)["input"]
    known["digest"] = content_digest(source)
    os.utime(source, ns=(3, 4))
    assert same_content(known, source, lambda: content_digest(source))

    source.write_bytes(b"recordinG")
    assert not same_content(known, source, lambda: content_digest(source))


def test_content_is_compared_if_copy_keeps_times(source: Path) -> None:
    """After `cp -p` or `rsync -t`, only the inode time of another recording differs."""
    known, stat = planned(source)["input"], source.stat()
    known["digest"] = content_digest(source)
    while source.stat().st_ctime_ns == stat.st_ctime_ns:  # until the file system sets a new time
        source.write_bytes(b"recordinG")
        os.utime(source, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    assert not same_content(known, source, lambda: content_digest(source))


def test_only_files_of_a_bag_count_as_its_content(tmp_path: Path) -> None:
    """File managers and editors leave files in the folder, whose names need not be UTF-8."""
    bag, others = tmp_path / "bag", (".DS_Store", ".bag_0.mcap.swp", os.fsdecode(b"n\xff.txt"))
    bag.mkdir()
    for name in ("bag_0.mcap", "bag_1.db3.zstd", "metadata.yaml"):
        (bag / name).write_bytes(name.encode())
    known: Any = {"files": file_stats(bag), "digest": content_digest(bag)}
    for name in others:
        (bag / name).write_bytes(b"something else")

    assert unchanged(known["files"], bag)
    assert same_content(known, bag, lambda: "")
    assert content_digest(bag) == known["digest"]
    (bag / "bag_1.db3.zstd").rename(bag / "bag_2.db3.zstd")
    assert not unchanged(known["files"], bag)
    (bag / "bag_2.db3.zstd").rename(bag / "bag_1.db3.zstd")
    assert unchanged(known["files"], bag)
    (bag / "bag_1.db3.zstd").write_bytes(b"longer than before")
    assert not unchanged(known["files"], bag)
    assert not same_content(known, bag, lambda: content_digest(bag))


def test_digest_covers_the_whole_recording(tmp_path: Path) -> None:
    """Labels would be drawn on another recording that begins in the same way."""
    path = tmp_path / "lab.mcap"
    for content in (b"short", b"short\0", bytes(range(256)) * 10_000 + b"end"):
        path.write_bytes(content)
        assert content_digest(path) == f"xxh3-128:{xxh3_128_hexdigest(content)}"

    digests = set[str]()
    for parts in ({"a_0": b"12", "a_1": b"3"}, {"a_0": b"1", "a_1": b"23"},
                  {"b_0": b"12", "b_1": b"3"}, {"a_0": b"3", "a_1": b"12"}):  # fmt: skip
        bag = tmp_path / f"bag {len(digests)}"
        bag.mkdir()
        for name, content in parts.items():
            (bag / f"{name}.mcap").write_bytes(content)
        digests.add(content_digest(bag))
    assert len(digests) == 4


@pytest.mark.parametrize("whole", [True, False])
def test_write_ahead_log_is_content_of_its_database(tmp_path: Path, *, whole: bool) -> None:
    """Messages in the log are read, so results without them are those of another recording."""
    base, log = tmp_path / "bag" / "a.db3", tmp_path / "bag" / "a.db3-wal"
    base.parent.mkdir()
    base.write_bytes(b"database")
    source = base.parent if whole else base
    known: Any = {"files": file_stats(source), "digest": content_digest(source)}
    log.touch()  # readers of SQLite leave an empty one
    assert unchanged(known["files"], source)
    assert content_digest(source) == known["digest"]

    log.write_bytes(b"more messages")
    assert not unchanged(known["files"], source)
    assert not same_content(known, source, lambda: content_digest(source))
    assert input_size(source) == 21


def test_unneeded_digest_is_stopped(source: Path) -> None:
    """Stopping must not fail before the thread starts, and must end a thread that runs."""
    before = threading.active_count()
    with ContentDigest(source):
        assert threading.active_count() == before
    with ContentDigest(source) as content:
        content.start()
    assert threading.active_count() == before
    with ContentDigest(source) as content:
        assert content.result() == content_digest(source)


@pytest.mark.parametrize(
    ("known", "asked", "made"),
    [
        (("in1", "w1"), ("in1", "w1"), True),
        (("in2", "w1"), ("in1", "w1"), False),
        (("in1", "w2"), ("in1", "w1"), False),
        (("", ""), ("", ""), False),  # nothing is known
        (("", "w1"), ("", "w1"), False),  # only half is known
        (("in1", ""), ("in1", ""), False),
    ],
)
def test_results_at_url_must_match_input_and_work(
    source: Path, known: tuple[str, str], asked: tuple[str, str], *, made: bool
) -> None:
    run, job = planned(source), Job(source, source, input_key=asked[0], work_key=asked[1])
    assert not job.made(run)
    run["origin"] = {"input": known[0], "work": known[1]}

    assert job.made(run) is made


def test_bag_is_the_same_recording_through_links_and_within(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bag that a killed recorder left without metadata would get another run for each name."""
    bag = tmp_path / "data" / "walk"
    bag.mkdir(parents=True)
    (bag / "walk_0.mcap").write_bytes(b"\x89MCAP")
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "monday").symlink_to(bag)
    monkeypatch.chdir(bag)

    for named in (bag, tmp_path / "links", Path()):
        (source,) = find_recordings([str(named)]).sources
        assert (source.stem, source.parent, Path(source.path).resolve()) == ("walk", "data", bag)


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("in/*.mcap", ["in/a.mcap", "in/b[1].mcap"]),
        ("in/b[1].mcap", ["in/b[1].mcap"]),  # a name, although the pattern means b1.mcap
        ("in/[ab].mcap", ["in/a.mcap"]),
        ("in/?.mcap", ["in/a.mcap"]),
        ("in/*", ["in/a.mcap", "in/b[1].mcap", "in/bag"]),
        ("in/ba*", ["in/bag"]),
        ("**/*_?.mcap", ["in/bag/bag_0.mcap", "in/bag/bag_1.mcap"]),
        ("**", ["in/a.mcap", "in/b[1].mcap", "in/bag"]),
        ("in/*.bag", ["in/*.bag"]),
    ],
)
def test_pattern_that_no_shell_expanded_is_expanded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pattern: str, found: list[str]
) -> None:
    """A quoted pattern, or one that a script passes, would be reported as a missing file."""
    names = ("a.mcap", "b[1].mcap", ".c.mcap", "n.txt", "bag/bag_0.mcap", "bag/bag_1.mcap")
    for name in (*names, "done/old.mcap", "done/run.json"):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"\x89MCAP" if name.endswith(".mcap") else b"")
    monkeypatch.chdir(tmp_path)

    assert [source.path for source in find_recordings([pattern]).sources] == found


@pytest.mark.parametrize("way", ["link", "folder", "link to folder", "here"])
def test_recording_is_named_by_its_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    """git-annex and DVC store a file under its digest, and put a link with its name in place."""
    store, links = tmp_path / "store", tmp_path / "links"
    for folder in (store, links):
        folder.mkdir()
    for stem, digest in (("monday", "3f9c0a"), ("night.bag", "b77e1d")):
        (store / f"{digest}.bag").write_bytes(b"#ROSBAG V2.0\n" + digest.encode())
        (links / f"{stem}.bag").symlink_to(Path("..", "store", f"{digest}.bag"))
    (tmp_path / "again").symlink_to(links)
    monkeypatch.chdir(links)
    named = {
        "link": [str(links / "monday.bag"), str(links / "night.bag.bag")],
        "folder": [str(links)],
        "link to folder": [str(tmp_path / "again")],
        "here": ["."],
    }[way]

    found = find_recordings(named).sources

    assert [source.stem for source in found] == ["monday", "night.bag"]
    assert [Path(source.path).stem for source in found] == ["monday", "night.bag"]
    assert [Path(source.path).resolve().stem for source in found] == ["3f9c0a", "b77e1d"]
    assert find_recordings(named[:1]).sources[0] == found[0]


def test_recordings_of_equal_names_are_told_apart_by_folders_of_their_links(tmp_path: Path) -> None:
    """The folders of the files that the links point to have names that say nothing to a user."""
    for day, digest in (("monday", "3f9c0a"), ("tuesday", "b77e1d")):
        store, folder = tmp_path / "store" / digest[:2], tmp_path / day
        store.mkdir(parents=True)
        folder.mkdir()
        (store / f"{digest}.mcap").write_bytes(b"\x89MCAP" + digest.encode())
        (folder / "lab.mcap").symlink_to(store / f"{digest}.mcap")

    found = find_recordings([str(tmp_path / "monday"), str(tmp_path / "tuesday")]).sources

    assert [source.parent for source in found] == ["monday", "tuesday"]


def test_looping_links_are_followed_once(tmp_path: Path) -> None:
    """Two links to their own folder made the search endless, one gave paths of 40 links."""
    (tmp_path / "z").mkdir()
    for name in ("lab.mcap", "z/kitchen.mcap"):
        (tmp_path / name).write_bytes(b"\x89MCAP")
    for link, target in (("again", "."), ("first", "z"), ("self.mcap", "self.mcap")):
        (tmp_path / link).symlink_to(target)

    found = [source.path for source in find_recordings([str(tmp_path)]).sources]

    assert [str(Path(path).relative_to(tmp_path)) for path in found] == [
        "lab.mcap",
        "z/kitchen.mcap",
        "self.mcap",  # which is reported when it is opened
    ]


def test_recording_found_under_several_names_is_processed_once(tmp_path: Path) -> None:
    """Two run folders of one recording would be counted, and trained on, twice."""
    data, other = tmp_path / "data", tmp_path / "other"
    for folder, name in ((data, "a.mcap"), (data, "b.mcap"), (other, "a.mcap")):
        folder.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"\x89MCAP")
    (other / "linked.mcap").symlink_to(data / "b.mcap")
    named = [data, data / "a.mcap", data / ".." / "data" / "a.mcap", other]

    found = find_recordings(list(map(str, named))).sources

    assert sorted(Path(source.path) for source in found) == [
        data / "a.mcap", data / "b.mcap", other / "a.mcap"
    ]  # fmt: skip
    assert sorted(source.stem for source in found) == ["a", "a", "b"]


def partial(folder: Path, run: RunInfo) -> None:
    (folder / "segments" / "000000").mkdir(parents=True)
    write_run(folder, run)


def test_partial_results_count_as_work(source: Path, tmp_path: Path) -> None:
    """A full disk after an hour must not cost that hour."""
    run = planned(source)
    (tmp_path / "begun").mkdir()
    write_run(tmp_path / "begun", run)
    partial(tmp_path / "perceiving", run)
    run["seconds"]["perceive"] = 1.5
    (tmp_path / "perceived").mkdir()
    write_run(tmp_path / "perceived", run)

    names = ("nothing", "begun", "perceiving", "perceived")
    assert [has_work(tmp_path / name) for name in names] == [False, False, True, True]


def test_partial_run_of_same_work_resumes(source: Path, tmp_path: Path) -> None:
    folder, run = tmp_path / "half", planned(source)
    partial(folder, run)

    assert resume(folder, planned(source), source, lambda: "")["id"] == run["id"]
    assert (folder / "segments" / "000000").exists()


def test_partial_run_resumes_with_other_outputs(source: Path, tmp_path: Path) -> None:
    """Requesting a review must not process frames again."""
    folder, run = tmp_path / "half", planned(source, rrd=False)
    partial(folder, run)

    resumed = resume(folder, planned(source), source, lambda: "")

    assert (resumed["id"], resumed["options"]["rrd"]) == (run["id"], True)


def test_partial_run_resumes_with_other_tracking(source: Path, tmp_path: Path) -> None:
    """Hours of perceived frames would be lost, or the command refused, because of a new gate."""
    job = Job(source, tmp_path / "lab", with_overrides(Settings(), ["tracking.gate_m=0.3"]))
    folder = partial_path(job.folder)
    partial(folder, planned(source))
    wanted = planned(source)
    wanted["settings"]["tracking"] = job.settings.as_dict()["tracking"]

    require_resumable(job, wanted, lambda: "")
    resume(folder, wanted, source, lambda: "")

    assert has_work(folder)
    assert read_run(folder)["settings"]["tracking"]["gate_m"] == 0.3


def test_partial_run_resumes_with_copy_of_its_recording(source: Path, tmp_path: Path) -> None:
    """A copy has another time: taken for another recording, it would cost the work done so far."""
    folder, run = tmp_path / "half", planned(source)
    partial(folder, run)
    os.utime(source, (1, 1))

    resumed = resume(folder, planned(source), source, lambda: run["input"]["digest"])

    assert resumed["id"] == run["id"]
    discard_if_changed(folder, resumed, source)
    assert has_work(folder)


@pytest.mark.parametrize(
    ("what", "asks"),
    [
        ("model", "model: m2 in the old run, m1 requested"),
        ("settings", "seed: 99 in the old run, 0 requested"),
        ("other", "input: /data/lab.mcap in the old run"),
        ("shapecat", ""),
        ("numpy", ""),
        ("content", ""),
    ],
)
def test_partial_run_of_other_work_is_discarded(
    source: Path, tmp_path: Path, what: str, asks: str
) -> None:
    """Otherwise half of the tables would come from another model or version.

    Work that the old command could continue, as with another --end, is not discarded unasked.
    """
    job = Job(source, tmp_path / "lab")
    folder, run = partial_path(job.folder), planned(source)
    if what == "model":
        run["model"] = {**run["model"], "id": "m2"}
    elif what == "settings":
        run["settings"] = {**run["settings"], "seed": 99}
    elif what in ("content", "other"):
        run["input"] = {**run["input"], "files": [["lab.mcap", 5, 1, 1]]}
        run["input"]["path"] = "/data/lab.mcap" if what == "other" else run["input"]["path"]
    else:
        run["versions"] = {**run["versions"], what: "0.0.1"}
    partial(folder, run)
    wanted = planned(source)

    refused = f"({asks}); repeat its command"
    with pytest.raises(OutputError, match=re.escape(refused)) if asks else nullcontext():
        require_resumable(job, wanted, lambda: "xxh3-128:other")
    require_resumable(replace(job, overwrite=True), wanted, lambda: "")

    assert resume(folder, wanted, source, lambda: "xxh3-128:other")["id"] == wanted["id"]
    assert not (folder / "segments").exists()
    assert read_run(folder)["id"] == wanted["id"]


@pytest.mark.parametrize(
    "name",
    [
        "segments/000000/frames.arrow",
        "revisions/000000/planes.arrow",
        "planes.parquet",
        "tracks.parquet",
    ],
)
def test_truncated_partial_run_is_discarded(source: Path, tmp_path: Path, name: str) -> None:
    """After a power cut with --no-fsync, each further command would stop at the same file."""
    folder, wanted = tmp_path / "half", planned(source)
    partial(folder, planned(source))
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(b"")

    assert resume(folder, wanted, source, lambda: "")["id"] == wanted["id"]
    assert not (folder / name).exists()


def status_of(job: Job, source: Path, out: Path) -> str:
    with plan_batch(job, [str(source.parent)], str(out)) as batch:
        return next(task.status for task in batch.tasks if task.job.folder.name == source.stem)


def test_batch_checks_results_of_other_model_settings_or_content(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plan opens no recording: it relies on the manifest and run.json."""
    (source.parent / "other.mcap").write_bytes(b"another")
    out, job = tmp_path / "out", Job(Path(), Path(), mcap=False, rrd=False)
    (out / "lab").mkdir(parents=True)
    write_run(out / "lab", planned(source))
    model = SimpleNamespace(model_id="m1")
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: model)
    with plan_batch(job, [str(source.parent)], str(out)) as batch:
        (task,) = (task for task in batch.tasks if task.job.folder.name == "lab")
        batch.manifest.record(
            [Entry("lab", "lab.mcap", "complete", input=task.source.key, work=task.work)]
        )

    assert status_of(job, source, out) == "complete"
    model.model_id = "m2"
    assert status_of(job, source, out) == "check"
    model.model_id = "m1"
    assert status_of(Job(Path(), Path(), settings=Settings(seed=3), rrd=False), source, out) != (
        "complete"
    )
    run = read_run(out / "lab")
    for path, status in (("/gone/lab.mcap", "check"), (str(source), "complete")):
        run["input"]["path"] = path  # the check stores where the recording is now
        write_run(out / "lab", run)
        assert status_of(job, source, out) == status
    source.write_bytes(b"recordinG")
    assert status_of(job, source, out) == "check"


def test_batch_notices_replaced_recording_with_same_times(source: Path, tmp_path: Path) -> None:
    """After `rsync -t`, only the inode time of another recording differs."""
    (source.parent / "other.mcap").write_bytes(b"another")

    def key() -> str:
        with plan_batch(Job(Path(), Path()), [str(source.parent)], str(tmp_path / "out")) as batch:
            return next(task.source.key for task in batch.tasks if task.source.path == str(source))

    before, stat = key(), source.stat()
    assert key() == before
    while source.stat().st_ctime_ns == stat.st_ctime_ns:  # until the file system sets a new time
        source.write_bytes(b"recordinG")
        os.utime(source, ns=(stat.st_atime_ns, stat.st_mtime_ns))

    assert key() != before


def test_key_of_bag_covers_all_its_files(tmp_path: Path) -> None:
    """A bag whose last part was copied again, or arrived later, must not pass for complete."""
    bag = tmp_path / "bag"
    bag.mkdir()
    keys = []
    for name, content in (("bag_0", b"one"), ("bag_1", b"three"), ("bag_1", b"seventy")):
        (bag / f"{name}.mcap").write_bytes(content)
        keys.append(_input_key(bag))

    assert [size for _, size in keys] == [3, 8, 10]
    assert len({key for key, _ in keys}) == 3


@pytest.mark.parametrize(
    ("noted", "there", "status"),
    [
        (("annotated.mcap", "review.rrd"), ("annotated.mcap", "review.rrd"), "complete"),
        (("annotated.mcap", "review.rrd"), ("annotated.mcap",), "check"),  # a user removed it
        (("annotated.mcap",), ("annotated.mcap", "review.rrd"), "check"),  # `annotate` was killed
        ((), (), "check"),
    ],
)
def test_batch_checks_run_without_its_outputs(
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    noted: tuple[str, ...],
    there: tuple[str, ...],
    status: str,
) -> None:
    """A manifest does not notice later changes to a run folder."""
    (source.parent / "other.mcap").write_bytes(b"another")
    out, job, run = tmp_path / "out", Job(Path(), Path()), planned(source)
    (out / "lab").mkdir(parents=True)
    write_run(out / "lab", {**run, "seconds": dict.fromkeys(noted, 1.5)})
    for name in there:
        (out / "lab" / name).write_bytes(b"something")
    partial_path(out / "lab").mkdir()  # may remain after a kill, and must not matter
    model = SimpleNamespace(model_id="m1")
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: model)
    with plan_batch(job, [str(source.parent)], str(out)) as batch:
        (task,) = (task for task in batch.tasks if task.name == "lab")
        batch.manifest.record(
            [Entry("lab", "lab.mcap", "complete", input=task.source.key, work=task.work)]
        )

    assert status_of(job, source, out) == status
    assert status_of(replace(job, overwrite=True), source, out) == "resume"


CHANGED: Mapping[str, Callable[[RunInfo], object]] = {
    "settings": lambda run: run["settings"].update({"seed": 8}),
    "model": lambda run: run["model"].update({"id": "m2"}),
    "range": lambda run: run["options"].update({"end_s": 3.0}),
    "topics": lambda run: run["options"].update({"topics": ["/b"]}),
}


@pytest.mark.parametrize("topics", [("a",), ()])
@pytest.mark.parametrize("name", [None, *CHANGED])
def test_batch_notices_run_that_was_replaced_alone(
    source: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    name: str | None,
    topics: tuple[str, ...],
) -> None:
    """A command for one recording, and Python, replace a run without a line in the manifest."""
    (source.parent / "other.mcap").write_bytes(b"another")
    out, job = tmp_path / "out", Job(Path(), Path(), topics=topics, mcap=False, rrd=False)
    (out / "lab").mkdir(parents=True)
    run = planned(source, topics=("/a",))  # as the topic is called in the recording
    if name is not None:
        CHANGED[name](run)
    write_run(out / "lab", run)
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    with plan_batch(job, [str(source.parent)], str(out)) as batch:
        (task,) = (task for task in batch.tasks if task.name == "lab")
        batch.manifest.record([replace(task.entry(), state="complete")])

    fits = name is None or (name == "topics" and not topics)  # without a request, any topic fits
    assert status_of(job, source, out) == ("complete" if fits else "check")


@pytest.mark.parametrize(
    ("there", "status"),
    [
        (lambda origin: run_info(origin=origin), "complete"),
        (lambda origin: run_info(origin={**origin, "work": "other"}), "check"),
        (lambda origin: {"origin": origin}, "check"),  # not a description of a run
        (None, "check"),  # the files of an interrupted run
    ],
)
def test_batch_notices_run_at_url_that_was_replaced(
    source: Path, monkeypatch: pytest.MonkeyPatch, there: Callable[..., Any] | None, status: str
) -> None:
    """A command for one recording writes no manifest; one with shards writes a different one."""
    (source.parent / "other.mcap").write_bytes(b"another")
    out, job = f"memory://replaced-{id(there)}", Job(Path(), Path())
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    (Location(out) / "lab" / "frames.parquet").write(b"table")
    with plan_batch(job, [str(source.parent)], out) as batch:
        (task,) = (task for task in batch.tasks if task.name == "lab")
        batch.manifest.record([replace(task.entry(), state="complete")])
    if there is not None:
        run = there({"input": task.source.key, "work": task.work})
        (Location(out) / "lab" / "run.json").write(json.dumps(run).encode())

    with plan_batch(job, [str(source.parent)], out) as batch:
        assert {task.name: task.status for task in batch.tasks}["lab"] == status


def ignore(*_: object) -> None:
    """Ignore progress."""


def overwritten(sources: Path, out: Path, *, most: int = 9, **changes: Any) -> dict[str, Any]:
    """Overwrite runs until ``most`` are complete; return the status that each had in the plan."""
    job = Job(Path(), Path(), mcap=False, rrd=False, overwrite=True, **changes)
    with plan_batch(job, [str(sources)], str(out)) as batch:
        list(islice(process_here(batch.tasks, ignore, manifest=batch.manifest), most))
        return {task.name: task.status for task in batch.tasks}


def test_interrupted_overwriting_continues(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command repeated after an interruption keeps what it finished; another one replaces all."""
    (source.parent / "other.mcap").write_bytes(b"another")
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)

    def attempt(job: Job, *_: object, **__: object) -> Outcome:
        job.folder.mkdir(parents=True, exist_ok=True)
        write_run(job.folder, planned(job.source, frame_range=job.frame_range))
        counts = {"frames": 3, "tracks": {"cup": 2}}
        return Outcome(job, Summary(counts, 1.5, ()))

    monkeypatch.setattr("shapecat.batch.runs.attempt", attempt)
    out = tmp_path / "out"
    second = FrameRange(every=2)
    overwritten(source.parent, out)
    assert overwritten(source.parent, out, most=1) == {"lab": "new", "other": "new"}

    assert overwritten(source.parent, out, most=1, discard_labels=True)["lab"] == "new"
    assert overwritten(source.parent, out, most=1, discard_labels=True)["lab"] == "complete"
    assert overwritten(source.parent, out, most=1, frame_range=second)["lab"] == "new"
    for _ in range(2):  # interrupted again, before the next is complete
        assert overwritten(source.parent, out, most=1, frame_range=second)["lab"] == "complete"
    (out / "lab" / "run.json").unlink()
    assert overwritten(source.parent, out, most=0, frame_range=second)["lab"] == "new"
    assert overwritten(source.parent, out, frame_range=second) == {"lab": "new", "other": "new"}
    assert overwritten(source.parent, out, frame_range=second) == {"lab": "new", "other": "new"}


def test_overwriting_again_after_a_failure_replaces_all(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A failed recording is no interruption: the same command, given again, replaces all runs."""
    (source.parent / "broken.mcap").write_bytes(b"damaged")
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    begun: list[str] = []

    def attempt(job: Job, *_: object, **__: object) -> Outcome:
        begun.append(job.source.stem)
        if job.source.stem == "broken":
            return Outcome(job, message="broken.mcap: no recording", code=3)
        job.folder.mkdir(parents=True, exist_ok=True)
        write_run(job.folder, planned(job.source))
        counts = {"frames": 3, "tracks": {"cup": 2}}
        return Outcome(job, Summary(counts, 1.5, ()))

    monkeypatch.setattr("shapecat.batch.runs.attempt", attempt)
    out = tmp_path / "out"
    statuses = [overwritten(source.parent, out) for _ in range(3)]

    assert statuses == [{"lab": "new", "broken": "new"}] + 2 * [{"lab": "new", "broken": "retry"}]
    assert sorted(begun) == 3 * ["broken"] + 3 * ["lab"]


def test_times_of_manifest_are_in_utc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Machines in different time zones write one manifest, of which the latest entry counts."""
    monkeypatch.setenv("TZ", "Asia/Kathmandu")
    time.tzset()
    try:
        manifest = FileManifest(tmp_path / "manifest.jsonl")
        manifest.record([Entry("a", "a.mcap", "complete")])
    finally:
        monkeypatch.undo()
        time.tzset()

    assert manifest.entries["a"].time.endswith("+00:00")


def test_full_disk_leaves_no_partial_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The next line would be appended to the part of a line that fit on the disk."""
    path = tmp_path / "manifest.jsonl"
    FileManifest(path).record([Entry("a", "a.mcap", "complete")])
    whole = path.read_bytes()
    write = os.write

    def fill(file: int, content: bytes) -> int:
        if len(content) > 20:
            return write(file, content[:20])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("shapecat.system.files.os.write", fill)
        with pytest.raises(OutputError, match="No space left"):
            FileManifest(path).record([Entry("b", "b" * 200, "failed")])
    assert path.read_bytes() == whole

    FileManifest(path).record([Entry("c", "c.mcap", "planned")])
    assert [json.loads(line)["folder"] for line in path.read_text().splitlines()] == ["a", "c"]


def test_partial_line_of_crash_does_not_lose_next_entry(tmp_path: Path) -> None:
    path = tmp_path / "manifest.jsonl"
    path.write_bytes(b'{"folder": "a", "recording": "a.mcap", "state": "comp')
    FileManifest(path).record([Entry("b", "b.mcap", "failed", tries=2, exit_code=3, message="bad")])

    entry = FileManifest(path).entries["b"]
    assert (entry.state, entry.tries, entry.exit_code, entry.message) == ("failed", 2, 3, "bad")
    assert list(FileManifest(path).entries) == ["b"]


OURS = b'{"folder": "a", "recording": "a.mcap", "state": "comp'
"""A line that a crash cut off."""


@pytest.mark.parametrize("place", ["folder", "url"])
@pytest.mark.parametrize(
    ("content", "is_ours"),
    [
        (b'{"hello": 1}\n', False),
        (b"hello", False),
        (b'\n{"audio": "a.wav"}\n{"audio', False),
        (OURS, True),
        (OURS[:5], True),
        (b"\0" * 40 + OURS + b'\n{"hello": 1}\n', True),
        (b"\0" * 40, True),
        (b'{"folder": "a", "state": "planned", "later": 1}\n', True),  # of another version
        (b"", True),
        (b"\n", True),
    ],
)
def test_manifest_of_another_program_is_refused(
    tmp_path: Path, place: str, content: bytes, *, is_ours: bool
) -> None:
    """Lines would be appended to a file of another program, or at a URL replace it."""
    out = str(tmp_path) if place == "folder" else f"memory://manifests-{content[:60].hex()}"
    file = Path(out, "manifest.jsonl") if place == "folder" else Location(out) / "manifest.jsonl"
    file.write_bytes(content) if isinstance(file, Path) else file.write(content)
    name = file if isinstance(file, Path) else file.url

    if is_ours:
        with open_manifest(out) as manifest:
            manifest.record([Entry("b", "b.mcap", "complete")])
        assert list(open_manifest(out).entries) == ["b"]
        return
    message = f"{name}: shapecat did not make this; choose another --out, or move it away"
    with pytest.raises(OutputError, match=f"^{re.escape(message)}$"):
        open_manifest(out)
    assert (file.read_bytes() if isinstance(file, Path) else file.read()) == content


def test_last_line_of_a_recording_counts(tmp_path: Path) -> None:
    path = tmp_path / "manifest.jsonl"
    for state in get_args(State):
        FileManifest(path).record([Entry("a", "a.mcap", state)])

    assert FileManifest(path).entries["a"].state == get_args(State)[-1]


def test_manifest_with_undecodable_name_is_read_by_other_programs(tmp_path: Path) -> None:
    """One name that is not UTF-8 would make the whole manifest unreadable, as for pandas."""
    path, name = tmp_path / "manifest.jsonl", os.fsdecode(b"caf\xe9")
    FileManifest(path).record([Entry("café", "café.mcap", "planned"), Entry(name, name, "failed")])
    lines = path.read_text("utf-8").splitlines()

    assert [json.loads(line)["folder"] for line in lines] == ["café", name]
    assert set(FileManifest(path).entries) == {"café", name}


def test_entry_with_zero_tracks_is_not_read_as_unknown(tmp_path: Path) -> None:
    """If zero tracks were read as unknown, the run would be opened again to count them."""
    path = tmp_path / "manifest.jsonl"
    FileManifest(path).record([Entry("a", "a.mcap", "complete", seconds=0.0, frames=3, tracks={})])
    read = FileManifest(path).entries["a"]

    assert (read.seconds, read.frames, read.tracks) == (0, 3, {})


@pytest.mark.parametrize("part_bytes", [1, 10**6])
def test_manifest_at_url_ends_as_one_file(monkeypatch: pytest.MonkeyPatch, part_bytes: int) -> None:
    """Only the last line of each recording is kept, also of two with the same millisecond."""
    monkeypatch.setattr("shapecat.batch.manifest._PART_BYTES", part_bytes)
    place = f"memory://one-file-{part_bytes}"
    with RemoteManifest(place) as manifest:
        states: tuple[tuple[str, State], ...] = (
            ("a", "running"),
            ("b", "failed"),
            ("a", "complete"),
        )
        manifest.record([Entry(name, f"{name}.mcap", state) for name, state in states])
        manifest.send()
    lines = (Location(place) / "manifest.jsonl").read() or b""
    with RemoteManifest(f"{place}-none"):
        pass

    found = {known["folder"]: known["state"] for known in map(json.loads, lines.splitlines())}
    assert found == {"a": "complete", "b": "failed"}
    assert len(lines.splitlines()) == 2
    assert {n: e.state for n, e in RemoteManifest(place).entries.items()} == found
    assert (Location(f"{place}-none") / "manifest.jsonl").read() is None


def test_lines_recorded_while_sending_go_into_next_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A megabyte takes a while to send; lines of recordings that end meanwhile would be lost."""
    monkeypatch.setattr("shapecat.batch.manifest._PART_BYTES", 1)
    place, write = "memory://meanwhile", Location.write
    manifest = RemoteManifest(place)
    late = [Entry("b", "b.mcap", "complete")]

    def write_slowly(self: Location, content: bytes) -> None:
        write(self, content)
        manifest.record([late.pop()] if late else [])

    monkeypatch.setattr(Location, "write", write_slowly)
    manifest.record([Entry("a", "a.mcap", "complete")])
    manifest.send()
    manifest.send()

    assert RemoteManifest(place).entries.keys() == {"a", "b"}


def test_grown_part_of_manifest_is_read_again() -> None:
    """Of two shards that end at the same time, the last one writes the entries of both."""
    place = "memory://grown"
    with RemoteManifest(place) as one, RemoteManifest(place) as other:
        one.record([Entry("a", "a.mcap", "running")])
        one.send()
        other._read_parts()
        one.record([Entry("a", "a.mcap", "complete")])
        one.send()
        other.record([Entry("b", "b.mcap", "complete")])
        other.__exit__()
        lines = (Location(place) / "manifest.jsonl").read() or b""

    found = {known["folder"]: known["state"] for known in map(json.loads, lines.splitlines())}
    assert found == {"a": "complete", "b": "complete"}


def test_entries_of_other_work_are_replaced(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise the manifest would keep the keys of old settings, and all work be repeated."""
    (source.parent / "other.mcap").write_bytes(b"another")
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    out = str(source.parent / "out")
    with plan_batch(Job(Path(), Path()), [str(source.parent)], out) as batch:
        (task,) = (task for task in batch.tasks if task.name == "lab")
        manifest = batch.manifest
        ledger = Ledger(manifest)
        manifest.record([Entry("lab", "lab.mcap", "planned", task.source.key, "old work")])
        ledger.record_planned([task])
        assert manifest.entries["lab"].work == task.work
        manifest.record([Entry("lab", "lab.mcap", "complete", "old input", task.work)])
        ledger.begin(task)
        counts = {"frames": 3, "tracks": {"cup": 2}}
        ledger.record_outcome(task, Outcome(task.job, Summary(counts, 1.5, ())))

    assert manifest.entries["lab"].input == task.source.key
    assert manifest.entries["lab"].state == "complete"


def test_earlier_outcome_is_known_without_a_manifest(tmp_path: Path) -> None:
    """On a full disk, the manifest is given up, but complete runs must count as complete."""
    job = Job(Path("lab.mcap"), tmp_path / "lab")
    task: Any = SimpleNamespace(name="lab", job=job)
    missing = Ledger(Manifest()).earlier_outcome(task)
    job.folder.mkdir()
    write_run(job.folder, run_info(counts={"frames": 3, "tracks": {"cup": 2}}, seconds={}))
    found = Ledger(Manifest()).earlier_outcome(task)

    assert (missing.code, "no run.json there" in missing.message) == (1, True)
    assert found.summary is not None
    assert (found.summary.counts["frames"], found.summary.processed) == (3, False)


def test_run_stores_absolute_path(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run may be annotated and exported from another current folder."""
    monkeypatch.chdir(source.parent)

    assert planned(Path(source.name))["input"]["path"] == str(source.resolve())


@pytest.mark.parametrize(
    ("option", "model_id", "other"),
    [
        ({"topics": ("/front",)}, "m1", True),
        ({"up": "imu"}, "m1", True),
        ({"fixed_frame": "odom"}, "m1", True),
        ({"color": ""}, "m1", True),
        ({"frame_range": FrameRange(start_s=1.5)}, "m1", True),
        ({"frame_range": FrameRange(end_s=2.5)}, "m1", True),
        ({"frame_range": FrameRange(every=3)}, "m1", True),
        ({"settings": Settings(seed=3)}, "m1", True),
        ({"settings": with_overrides(Settings(), ["detection.max_range_m=1.5"])}, "m1", True),
        ({}, "m2", True),  # trained again, and saved under the same name
        ({"model": Path("copy.npz")}, "m1", False),
        ({"model": Path("copy.npz")}, "m2", True),
    ],
)
@pytest.mark.parametrize(
    ("named", "model", "place"),
    [
        ("lab.mcap", None, "memory://work"),
        ("lab.mcap", Path("mine.npz"), "memory://work"),
        ("lab.mcap", Path("mine.npz"), "out"),
        (".", None, "out"),
    ],
)
def test_other_frames_model_or_settings_are_other_work(
    source: Path,
    monkeypatch: pytest.MonkeyPatch,
    option: dict[str, Any],
    model_id: str,
    *,
    other: bool,
    named: str,
    model: Path | None,
    place: str,
) -> None:
    """Results at a URL, and those of an interrupted --overwrite, are told apart by ``work`` alone.

    If it was equal, old results would be kept. A copy of the model does not change it.
    """
    monkeypatch.chdir(source.parent)
    (source.parent / "other.mcap").write_bytes(b"another")
    first = Job(Path(), Path(), model=model)
    keys = set()
    for job, content in ((first, "m1"), (replace(first, **option), model_id)):
        loaded = SimpleNamespace(model_id=content)
        monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path, found=loaded: found)
        with plan_batch(job, [named], place) as batch:
            keys |= {task.work for task in batch.tasks}
            assert {task.job.model_id for task in batch.tasks} == {content}

    assert len(keys) == 1 + other


INFO: Mapping[str, Any] = {"size": 7, "ETag": "e1", "mtime": 1.5}


@pytest.mark.parametrize(
    ("changes", "other"),
    [
        ({"size": 8}, True),
        ({"ETag": "e2"}, True),
        ({"mtime": 2.5}, False),  # a copy of the same content
        ({"ETag": None, "mtime": 2.5}, True),
        ({"ETag": None, "size": 8}, True),
    ],
)
def test_content_key_changes_with_content_at_url(
    changes: Mapping[str, Any], *, other: bool
) -> None:
    """Size or ETag change the key, and the time of writing does only without an ETag."""
    first = {**INFO, "ETag": None} if "ETag" in changes and changes["ETag"] is None else INFO
    infos = (
        {k: v for k, v in info.items() if v is not None} for info in (first, {**INFO, **changes})
    )
    before, after = map(content_key, infos)

    assert (before != after) is other


@pytest.mark.parametrize("name", ["Last-Modified", "Content-MD5", "Digest"])
def test_content_key_changes_with_headers_of_a_web_server(name: str) -> None:
    """Many servers send no ETag: a recording replaced by one of equal size would seem complete."""
    assert content_key({"size": 7, name: "one"}) != content_key({"size": 7, name: "two"})


def test_content_of_same_size_is_not_trusted(
    source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A web server may state only the size of a recording, or for a signed URL nothing at all."""
    (source.parent / "other.mcap").write_bytes(b"another")
    out, job = tmp_path / "out", Job(Path(), Path(), mcap=False, rrd=False)
    (out / "lab").mkdir(parents=True)
    write_run(out / "lab", planned(source))
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    key = content_key({"size": 7, "name": "lab.mcap"})
    monkeypatch.setattr("shapecat.batch.plans._input_key", lambda _path: (key, 7))
    with plan_batch(job, [str(source.parent)], str(out)) as batch:
        batch.manifest.record([replace(task.entry(), state="complete") for task in batch.tasks])

    assert status_of(job, source, out) == "check"
    assert _combined_key(["a", key]) == ""


def test_key_of_bag_at_url_covers_all_its_files() -> None:
    """The storage may list the files of a bag in any order."""
    keys = [_combined_key(keys) for keys in ("ab", "ac", "db", "ba")]

    assert len(set(keys)) == 3
    assert keys[3] == keys[0]


@pytest.mark.parametrize(
    ("error", "begun", "tries"),
    [
        (CancelledError(), False, 1),  # it only waited for the lost scheduler
        (CancelledError(), True, 2),  # it may have killed the machine
        (WorkerLostError(), False, 2),
        (WorkerLostError(), True, 2),
    ],
)
def test_lost_recording_counts_as_tried_if_it_had_started(
    source: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, *, begun: bool, tries: int
) -> None:
    """Otherwise a recording that kills its machine would be tried forever."""
    (source.parent / "other.mcap").write_bytes(b"another")
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    out = str(source.parent / "out")
    with plan_batch(Job(Path(), Path()), [str(source.parent)], out) as batch:
        (task,) = (task for task in batch.tasks if task.name == "lab")
        ledger = Ledger(batch.manifest)
        ledger.record_planned(batch.tasks)
        ledger.begin(task)
        for _ in range(3 * begun):  # reports of progress come a few times a second
            ledger.record_running("lab")
        assert ledger.record_lost(task, error)
        ledger.begin(task)
        ledger.record_running("lab")
        if tries == 2:
            assert not ledger.record_lost(task, error)
        ledger.record_outcome(task, Outcome(task.job, message="gave up", code=1))
    path = Path(out) / "manifest.jsonl"
    entry = FileManifest(path).entries["lab"]

    assert (entry.state, entry.tries, entry.message) == ("failed", tries, "gave up")
    assert path.read_text().count('"running"') == 1 + begun


@pytest.mark.parametrize(
    ("codes", "expected"),
    [((0, 0), 0), ((0, 3), 1), ((3, 3), 3), ((4, 1), 1), ((3, 4), 1), ((2,), 2), ((), 0)],
)
def test_batch_exit_code_combines_outcomes(codes: tuple[int, ...], expected: int) -> None:
    """Different failures give 1, not the code of one of them."""
    assert common_exit_code(codes) == expected


def test_shards_are_disjoint_in_any_order_of_recordings() -> None:
    """Machines may list a folder in different orders."""
    named = [(name, Source(f"{name}.mcap", "", name, "")) for name in "dbeac"]
    first, second = shard_of(named, 0, 2), shard_of(named[::-1], 1, 2)

    assert [name for name, _ in first] == ["a", "c", "e"]
    assert [name for name, _ in second] == ["b", "d"]


class NameCollector(Executor):
    """Collects the names of submitted recordings."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def submit(self, _fn: Any, /, *args: Any, **_kwargs: Any) -> Future[Any]:
        """Fail at once."""
        self.names.append(args[0].folder.name)
        future: Future[Any] = Future()
        future.set_result(Outcome(args[0], message="nothing was done", code=1))
        return future


def test_largest_recordings_start_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Started last, a long one would keep a whole cluster waiting."""
    monkeypatch.setattr(
        "shapecat.batch.plans.load_model", lambda _path: SimpleNamespace(model_id="m1")
    )
    for name, size in (("a", 20), ("b", 3000), ("c", 400)):
        (tmp_path / f"{name}.mcap").write_bytes(bytes(size))
    executor = NameCollector()
    with plan_batch(Job(Path(), Path()), [str(tmp_path)], str(tmp_path / "out")) as batch:
        list(process_on(executor, batch.tasks, ignore, manifest=batch.manifest))

    assert executor.names == ["b", "c", "a"]


def test_recording_is_complete_in_manifest_before_outcome_is_returned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch stopped at this moment must not repeat the recording."""
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    counts = {"frames": 3, "tracks": {"cup": 2}}

    def attempt(job: Job, *_: object, **__: object) -> Outcome:
        return Outcome(job, Summary(counts, 1.5, ()))

    monkeypatch.setattr("shapecat.batch.runs.attempt", attempt)
    for name in ("a", "b"):
        (tmp_path / f"{name}.mcap").write_bytes(b"\x89MCAP")
    out = tmp_path / "out"
    with plan_batch(Job(Path(), Path()), [str(tmp_path)], str(out)) as batch:
        first = next(process_here(batch.tasks, ignore, manifest=batch.manifest))
        lines = FileManifest(out / "manifest.jsonl").entries

    entry = lines.pop(first.job.folder.name)
    assert (entry.state, entry.seconds, entry.frames) == ("complete", 1.5, 3)
    assert entry.tracks == {"cup": 2}
    assert [other.state for other in lines.values()] == ["planned"]


def test_worker_reports_progress_at_intervals_and_at_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without the last frame, a recording would look unfinished while its outputs are written."""
    sent, clock = list[Any](), [10.0]
    monkeypatch.setattr("shapecat.batch.runs.send_progress", lambda *words: sent.append(words))
    monkeypatch.setattr("shapecat.batch.runs.time", SimpleNamespace(monotonic=lambda: clock[0]))
    observe = _reporter("lab", "here")
    for clock[0], phase, done in (
        (10.0, "perceive", 1), (10.1, "perceive", 2), (10.25, "perceive", 3),
        (10.3, "perceive", 4), (10.35, "perceive", 5), (10.4, "track", 0),
    ):  # fmt: skip
        observe(phase, done, 5)

    assert sent == [
        ("here", ("lab", phase, done, 5))
        for phase, done in (("perceive", 1), ("perceive", 3), ("perceive", 5), ("track", 0))
    ]


def test_recordings_with_equal_names_get_different_folders() -> None:
    """The name of the parent folder distinguishes recordings; a number alone would not."""
    folders = name_folders(["x", "x", "x", "y"], ["a", "b", "a", "a"])

    assert folders == ["a_x", "b_x", "a_x_3", "y"]


def test_new_recording_does_not_get_existing_folder() -> None:
    """Two recordings would be written to one folder, and one of them lost."""
    folders = name_folders(["x", "x", "x"], ["a", "a", "b"], {1: "a_x"})

    assert folders == ["a_x_1", "a_x", "b_x"]


@pytest.mark.parametrize("state", ["complete", "killed", "failed"])
@pytest.mark.parametrize(
    ("way", "name"), [("whole", "lab"), ("relative", "lab_2"), ("link", "monday_lab_3")]
)
def test_run_keeps_folder_when_recording_of_same_name_is_added(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, way: str, name: str, state: str
) -> None:
    """Otherwise the recording has a second run, without labels, and counts twice in each export.

    run.json has the absolute path without links, however the user names the recording. Also, work
    of a killed run would be orphaned, and each command would count another failed recording.
    """
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "lab.mcap").write_bytes(day.encode())
    out = str(tmp_path / "out")
    path = str((tmp_path / "monday" / "lab.mcap").resolve())
    folder = tmp_path / "out" / name
    folder = partial_path(folder) if state == "killed" else folder
    (tmp_path / "linked").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path)
    place = {"whole": tmp_path, "relative": Path(), "link": tmp_path / "linked"}[way]
    if state == "failed":
        (tmp_path / "out").mkdir()
        with open_manifest(out) as manifest:
            manifest.record([Entry(name, str(place / "monday" / "lab.mcap"), "failed")])
    else:
        folder.mkdir(parents=True)
        write_run(folder, run_info(input={"path": path}))
    days = [str(place / day / "lab.mcap") for day in ("tuesday", "monday")]

    with plan_batch(Job(Path(), Path()), days, out) as batch:
        assert [task.name for task in batch.tasks] == ["tuesday_lab", name]


def test_copy_of_run_keeps_its_name(tmp_path: Path) -> None:
    """A copy whose name ends like that of the run would be overwritten instead of the run."""
    for name in ("a copy of monday_lab", "monday_lab"):
        (tmp_path / "out" / name).mkdir(parents=True)
        path = str((tmp_path / "monday" / "lab.mcap").resolve())
        write_run(tmp_path / "out" / name, run_info(input={"path": path}))
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "lab.mcap").write_bytes(day.encode())
    sources = find_recordings([str(tmp_path / day) for day in ("monday", "tuesday")]).sources

    assert existing_names(
        sources, str(tmp_path / "out"), {"a copy of monday_lab", "monday_lab"}, {}
    ) == {0: "monday_lab"}


def test_recording_of_a_batch_keeps_its_name_alone(tmp_path: Path) -> None:
    """Processing a recording of a batch again, by itself, must not make a second run."""
    (tmp_path / "monday").mkdir()
    (tmp_path / "monday" / "lab.mcap").write_bytes(b"recording")
    name, out = "monday_lab", tmp_path / "out"
    path = (tmp_path / "monday" / "lab.mcap").resolve()
    (out / name).mkdir(parents=True)
    write_run(out / name, run_info(input={"path": str(path)}))
    sources = find_recordings([str(path)]).sources

    assert existing_names(sources, str(out), {name}, {}) == {0: name}
    assert existing_names(sources, str(out), {name, "lab"}, {}) == {}
    write_run(out / name, run_info(input={"path": "/another/monday/lab.mcap"}))
    assert existing_names(sources, str(out), {name}, {}) == {}


@pytest.mark.parametrize("known_from", ["all", "1-of-2", "link", "relative path", "run.json"])
def test_run_at_url_keeps_folder_when_recording_of_same_name_is_added(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, known_from: str
) -> None:
    """All shards must agree on the names, or some recordings would be in none of them."""
    monkeypatch.setattr("shapecat.batch.plans.load_model", lambda _path: MODEL)
    for day in ("monday", "tuesday"):
        (tmp_path / day).mkdir()
        (tmp_path / day / "lab.mcap").write_bytes(day.encode())
    out, path = f"memory://added-{known_from[:3]}", str(tmp_path / "monday" / "lab.mcap")
    noted = known_from in {"all", "1-of-2"}
    (tmp_path / "linked").symlink_to(tmp_path)
    run = {} if noted else run_info(input={"path": path})
    (Location(out) / "lab" / "run.json").write(json.dumps(run).encode())
    monkeypatch.chdir(tmp_path / "tuesday")  # where the relative path leads to the other one
    if known_from != "run.json":
        through_link = str(tmp_path / "linked" / "monday" / "lab.mcap")
        recording = {"relative path": "lab.mcap", "link": through_link}.get(known_from, path)
        with RemoteManifest(out, known_from if noted else "") as manifest:
            manifest.record([Entry("lab", recording, "complete")])
    days = [str(tmp_path / day / "lab.mcap") for day in ("tuesday", "monday")]

    names = []
    for shard in ("0/2", "1/2"):
        with plan_batch(Job(Path(), Path()), days, out, shard=shard) as batch:
            names += [(task.name, task.source.path) for task in batch.tasks]
    assert dict(names) == {"lab": path, "tuesday_lab": days[0]}


def test_recording_at_url_keeps_the_folder_of_its_run() -> None:
    """Otherwise a new recording of the same name would get the folder, and overwrite its run."""
    place, out = "memory://named-recordings", "memory://named-results"
    for day in ("monday", "tuesday"):
        (Location(place) / day / "lab.mcap").write(day.encode())
    sources = find_recordings([f"{place}/monday", f"{place}/tuesday"]).sources
    with RemoteManifest(out) as manifest:
        manifest.record([Entry("lab", sources[1].url, "complete")])

    assert existing_names(sources, out, {"lab"}, {}) == {1: "lab"}
    for content in (b"[", b"[" * 100_000):  # a run that cannot be read
        (Location(out) / "monday_lab" / "run.json").write(content)
        assert existing_names(sources, out, {"lab", "monday_lab"}, {}) == {1: "lab"}


def test_numbered_folder_name_may_already_be_taken() -> None:
    """Two recordings in one folder would be confused, and one would be lost."""
    folders = name_folders(["a_x_3", "x", "x", "a_x_4", "x"], ["b", "a", "a", "b", "a"])

    assert folders == ["a_x_3", "a_x", "a_x_4", "a_x_4_4", "a_x_5"]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("2", "expected I/N, for example 2/4"),
        ("-1/4", "expected I/N, for example 2/4"),
        ("1/x", "expected I/N, for example 2/4"),
        ("5/4", "expected I from 0 to 3 or from 1 to 4"),
        ("1/0", "expected I/N, for example 2/4"),
    ],
)
def test_wrong_shard_is_refused(text: str, told: str) -> None:
    """Machines would process nothing, or the same recordings twice."""
    with pytest.raises(ConfigError) as error:
        parse_shard(text)

    assert str(error.value) == f"--shard {text}: {told}"


class _Answers:
    """The object of a claim in a storage that gives prepared answers, one after the other."""

    def __init__(self, created: list[bool], contents: list[bytes | None]) -> None:
        self.created, self.contents, self.written = created, contents, list[bytes]()

    def __truediv__(self, _: str) -> "_Answers":
        return self

    def create(self, content: bytes) -> bool:
        self.written.append(content)
        return self.created.pop(0)

    def read(self) -> bytes | None:
        return self.written[0] if self.contents[0] == b"own" else self.contents.pop(0)


@pytest.mark.parametrize(
    ("created", "contents"),
    [
        ([False], [b"own"]),  # it was created, but the answer was lost
        ([False, True], [None]),  # it was given up meanwhile
        ([False, True], [b'{"owner": "x", "batch": "two"}', None]),  # it is given up later
    ],
    ids=["lost", "free", "freed"],
)
def test_claim_that_nobody_holds_is_not_taken_from_a_dead_process(
    monkeypatch: pytest.MonkeyPatch, created: list[bool], contents: list[bytes | None]
) -> None:
    """The files of the run would be mistaken for those of a worker that died."""
    storage = _Answers(created, contents)
    monkeypatch.setattr(claims, "Location", lambda *_: storage)
    monkeypatch.setattr(claims, "_POLL_S", 0.001)

    assert not claims.Claim("memory://lab/run", "one").inherited
    assert not created


def test_recording_that_vanishes_while_it_is_processed_is_named(tmp_path: Path) -> None:
    """A drive may be unplugged; all recordings lost in this way would have the same digest."""
    with (
        ContentDigest(tmp_path / "gone.mcap") as content,
        pytest.raises(RecordingError, match=r"gone\.mcap: cannot be read: No such file"),
    ):
        content.result()
