"""Tests that replacing a run processes frames again only if they may change."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from shapecat import pipeline
from shapecat.config import Settings, with_overrides
from shapecat.errors import OutputError
from shapecat.recordings import FrameRange
from shapecat.runs.folder import previous_path, read_run, write_run
from shapecat.runs.identity import file_stats
from shapecat.runs.jobs import Job, discard_if_changed
from shapecat.runs.labels.track_table import read_track_table
from shapecat.runs.tables.segments import list_segments
from shapecat.system.files import partial_path
from tests.conftest import Guesser
from tests.track_tables import untimed_table

TABLES = ("frames", "detections", "planes", "masks", "tracks")


class PerceivedError(Exception):
    """Frames were perceived."""


@pytest.fixture
def job(coloured_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Job:
    """Return the job of a finished run with colour, whose folder may be replaced."""
    monkeypatch.setattr(pipeline, "load_model", lambda _path: Guesser())
    folder = tmp_path / "out" / "table"
    shutil.copytree(coloured_run, folder)
    source = Path(read_run(folder)["input"]["path"])
    return Job(source=source, folder=folder, overwrite=True, rrd=False)


@pytest.fixture
def perceiving_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_work: Any) -> None:
        raise PerceivedError

    monkeypatch.setattr(pipeline, "perceive_all", refuse)


def changed(*overrides: str) -> Settings:
    return with_overrides(Settings(), overrides)


@pytest.mark.usefixtures("perceiving_fails")
def test_changed_tracking_settings_give_tables_of_new_run(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames are not processed again, but every table must be that of a new run."""
    before = read_run(job.folder)
    write_run(job.folder, {**before, "warnings": ["frames 2 and 3 are tilted"]})
    job = replace(job, settings=changed("tracking.gate_m=0.001", "outputs.boxes=visible"))
    tracked = untimed_table(job.folder, "tracks")

    pipeline.process(job)

    run = read_run(job.folder)
    monkeypatch.undo()
    monkeypatch.setattr(pipeline, "load_model", lambda _path: Guesser())
    pipeline.process(replace(job, folder=tmp_path / "new"))
    for name in TABLES:
        assert untimed_table(job.folder, name).equals(untimed_table(tmp_path / "new", name)), name
    assert not untimed_table(job.folder, "tracks").equals(tracked)
    new = read_run(tmp_path / "new")
    assert new["counts"] | {"resumed": 4} == run["counts"]
    assert run["id"] != before["id"]
    for name in ("work", "input", "settings", "options", "fixed_frame", "up", "color"):
        assert run[name] == new[name], name  # type: ignore[literal-required]  # one of its keys
    assert run["warnings"] == ["frames 2 and 3 are tilted", *new["warnings"]]


@pytest.mark.usefixtures("perceiving_fails")
@pytest.mark.parametrize(
    "change",
    [
        {},
        {"settings": changed("detection.min_points=61", "tracking.gate_m=0.1")},
        {"settings": changed("seed=1")},
        {"settings": changed("tracking.gate_m=0.1"), "frame_range": FrameRange(every=2)},
        {"settings": changed("tracking.gate_m=0.1"), "color": ""},
        {"settings": changed("tracking.gate_m=0.1"), "up": "0,0,1"},
    ],
    ids=["nothing", "detection", "seed", "every", "color", "up"],
)
def test_options_that_affect_frames_process_them_again(job: Job, change: dict[str, Any]) -> None:
    """`--overwrite` without any change must process the frames again, too."""
    with pytest.raises(PerceivedError):
        pipeline.process(replace(job, **change))


def truncate(folder: Path) -> None:
    path = folder / "detections.parquet"
    path.write_bytes(path.read_bytes()[:-100])


def lose_rows(folder: Path) -> None:
    path = folder / "frames.parquet"
    pq.write_table(pq.read_table(path)[:3], path)


def lose_masks(folder: Path) -> None:
    (folder / "masks.parquet").unlink()


def other_version(folder: Path) -> None:
    run = read_run(folder)
    write_run(folder, {**run, "versions": {**run["versions"], "shapecat": "0.0.1"}})


def other_content(folder: Path) -> None:
    run = read_run(folder)
    run["input"] |= {"files": [["table.mcap", 5, 1, 1]], "digest": "xxh3-128:0123"}
    write_run(folder, run)


@pytest.mark.usefixtures("perceiving_fails")
@pytest.mark.parametrize("damage", [truncate, lose_rows, lose_masks, other_version, other_content])
def test_unusable_tables_are_not_reused(job: Job, damage: Callable[[Path], None]) -> None:
    """Half of the results would come from another version or recording, or be missing."""
    damage(job.folder)
    with pytest.raises(PerceivedError):
        pipeline.process(replace(job, settings=changed("tracking.gate_m=0.1")))


def test_replaced_run_stays_complete_if_new_run_fails(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old tables are hard links in the new folder, and must not be truncated there."""
    before = {name: untimed_table(job.folder, name) for name in TABLES}

    def fail(*_args: Any, **_options: Any) -> None:
        msg = "full disk"
        raise OutputError(msg)

    monkeypatch.setattr(pipeline, "annotate", fail)
    with pytest.raises(OutputError, match="full disk"):
        pipeline.process(replace(job, settings=changed("tracking.gate_m=0.1")))
    assert all(untimed_table(job.folder, name).equals(before[name]) for name in TABLES)


@pytest.mark.usefixtures("perceiving_fails")
def test_removed_output_is_written_again(job: Job) -> None:
    """The run would count as complete without its annotated recording."""
    mcap, tracks = job.folder / "annotated.mcap", job.folder / "tracks.csv"
    mcap.unlink(missing_ok=True)
    known = tracks.stat().st_mtime_ns
    run = read_run(job.folder)
    run["seconds"] |= {"annotated.mcap": 1.5, "review.rrd": 1.5}
    write_run(job.folder, run)

    pipeline.process(replace(job, overwrite=False, rrd=False))

    assert mcap.read_bytes().endswith(b"\x89MCAP0\r\n")
    assert tracks.stat().st_mtime_ns == known


@pytest.mark.usefixtures("perceiving_fails")
@pytest.mark.parametrize("gone", [True, False])
def test_finished_run_follows_its_recording(job: Job, tmp_path: Path, *, gone: bool) -> None:
    """Reports and exports would not find a moved recording, although the run is complete."""
    first, moved = tmp_path / "first.mcap", tmp_path / "moved.mcap"
    shutil.copyfile(job.source, moved)
    if not gone:
        shutil.copyfile(job.source, first)
    run = read_run(job.folder)
    run["input"] |= {"path": str(first), "files": file_stats(job.source)}
    write_run(job.folder, run)

    summary = pipeline.process(replace(job, source=moved, overwrite=False, rrd=False, mcap=False))

    assert not summary.processed
    stored = read_run(job.folder)["input"]
    assert stored["path"] == str(moved if gone else first)
    assert stored["files"] == file_stats(moved if gone else job.source)


@pytest.mark.usefixtures("perceiving_fails")
def test_finished_run_that_a_kill_moved_away_is_complete(job: Job) -> None:
    """A run has a hidden name while it is replaced; after a kill, hours of work were repeated."""
    known = read_run(job.folder)["id"]
    job.folder.rename(previous_path(job.folder))

    summary = pipeline.process(replace(job, overwrite=False, rrd=False))

    assert not summary.processed
    assert read_run(job.folder)["id"] == known
    assert not previous_path(job.folder).exists()


@pytest.mark.parametrize("total", [None, 950.0])
def test_seconds_of_killed_run_count_once(
    job: Job, total: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill may come before or after the total, which includes the phases, is written."""
    job = replace(job, settings=changed("tracking.gate_m=0.1"))

    def kill(*_args: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "annotate", kill)
    with pytest.raises(KeyboardInterrupt):
        pipeline.process(job)
    hidden = partial_path(job.folder)
    run = read_run(hidden)
    run["seconds"] = dict.fromkeys(run["seconds"], 100.0) | ({"total": total} if total else {})
    write_run(hidden, run)
    monkeypatch.undo()
    monkeypatch.setattr(pipeline, "load_model", lambda _path: Guesser())

    pipeline.process(job)

    before = total or 100 * len(run["seconds"])
    assert before < read_run(job.folder)["seconds"]["total"] < before + 90


def test_interrupted_run_keeps_its_frames_if_tracking_changes(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames were perceived with the same settings; only what follows must be done again."""
    half = replace(job, folder=tmp_path / "half", overwrite=False, rrd=False)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pipeline, "annotate", interrupt)
        pipeline.process(half)
    before = read_run(partial_path(half.folder))
    assert {"track", "labels"} <= before["seconds"].keys()
    other = replace(half, settings=changed("tracking.gate_m=0.001", "outputs.boxes=visible"))
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "perceive_all", None)
        pipeline.process(other)

    pipeline.process(replace(other, folder=tmp_path / "new"))
    run, new = read_run(half.folder), read_run(tmp_path / "new")
    for name in TABLES:
        assert untimed_table(half.folder, name).equals(untimed_table(tmp_path / "new", name)), name
    assert run["counts"] == new["counts"] | {"resumed": 4}
    assert (run["settings"], run["work"]) == (new["settings"], new["work"])
    assert run["seconds"]["perceive"] == before["seconds"]["perceive"]
    assert run["seconds"]["track"] != before["seconds"]["track"]
    assert run["id"] != before["id"]


def give_label(folder: Path, label: str) -> None:
    """Set the label of track 1; an empty one removes it."""
    rows = [row for row in read_track_table(folder / "tracks.csv").rows if row.track == 1]
    assert len(rows) == 1
    lines = (folder / "tracks.csv").read_text("utf-8").splitlines()
    at = lines[0].split(",").index("label")
    for k, line in enumerate(lines):
        cells = line.split(",")
        if cells[0] == "1":
            lines[k] = ",".join([*cells[:at], label, *cells[at + 1 :]])
    (folder / "tracks.csv").write_text("\n".join(lines) + "\n", "utf-8")


def labels(folder: Path) -> set[str]:
    return {row.label for row in read_track_table(folder / "tracks.csv").rows} - {""}


@pytest.mark.usefixtures("perceiving_fails")
@pytest.mark.parametrize(("later", "kept"), [("bowl", {"bowl"}), ("", set()), ("vase", {"vase"})])
def test_labels_given_after_an_interruption_are_transferred(
    job: Job, monkeypatch: pytest.MonkeyPatch, later: str, kept: set[str]
) -> None:
    """Users may label the replaced run until the new one is complete; no label may be lost."""
    job = replace(job, settings=changed("tracking.gate_m=0.1"), rrd=False, mcap=False)
    give_label(job.folder, "vase")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pipeline, "annotate", interrupt)
        pipeline.process(job)
    assert labels(job.folder) == labels(partial_path(job.folder)) == {"vase"}
    give_label(job.folder, later)

    summary = pipeline.process(job)

    assert labels(job.folder) == kept
    assert bool(summary.corrections) == bool(kept)


@pytest.mark.usefixtures("perceiving_fails")
def test_unreadable_labels_are_reported_before_frames_are_perceived(job: Job) -> None:
    """Otherwise the command would fail only after hours, at its end."""
    (job.folder / "tracks.csv").write_text("")

    with pytest.raises(OutputError, match="no column"):
        pipeline.process(replace(job, settings=changed("detection.min_points=70")))


def interrupt(*_: Any, **__: Any) -> None:
    raise KeyboardInterrupt


@pytest.mark.usefixtures("perceiving_fails")
def test_labels_given_while_outputs_are_written_are_transferred(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writing outputs takes minutes; labels given meanwhile must not be lost."""
    job = replace(job, settings=changed("tracking.gate_m=0.1"), rrd=False)
    written, write = [], pipeline.annotate

    def annotate(folder: Path, recording: Any, run: Any, observe: Any) -> None:
        if "annotated.mcap" not in run["seconds"]:
            written.append(labels(folder))
        write(folder, recording, run, observe)
        if len(written) == 1:
            give_label(job.folder, "vase")

    monkeypatch.setattr(pipeline, "annotate", annotate)
    pipeline.process(job)

    assert written == [set(), {"vase"}]
    assert labels(job.folder) == {"vase"}


@pytest.mark.usefixtures("perceiving_fails")
@pytest.mark.parametrize("before", ["", "bowl"])
def test_labels_given_until_the_run_is_replaced_are_transferred(
    job: Job, monkeypatch: pytest.MonkeyPatch, before: str
) -> None:
    """The page of the replaced run accepts labels while the outputs are written a second time."""
    job = replace(job, settings=changed("tracking.gate_m=0.1"), rrd=False, mcap=False)
    give_label(job.folder, before)
    checks = []

    def check(*arguments: Any) -> None:
        discard_if_changed(*arguments)
        checks.append(arguments)
        if len(checks) == 2:  # after the outputs
            give_label(job.folder, "vase")

    monkeypatch.setattr(pipeline, "discard_if_changed", check)
    summary = pipeline.process(job)

    assert labels(job.folder) == {"vase"}
    assert summary.corrections is not None
    assert [item["label"] for item in summary.corrections["transferred"]] == ["vase"]
    assert read_run(job.folder).get("corrections") == summary.corrections


@pytest.mark.usefixtures("perceiving_fails")
def test_outputs_of_killed_annotation_are_completed_with_its_options(
    job: Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise outputs would have the old labels and boxes, and the old path of the recording."""
    moved, written = tmp_path / "moved.mcap", []
    shutil.copyfile(job.source, moved)
    give_label(job.folder, "vase")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("shapecat.outputs.review.writing.write_review", interrupt)
        pipeline.annotate_again(job.folder, None, boxes="visible", recording=moved)
    for output in ("annotation.annotated_mcap.write_annotated", "review.writing.write_review"):

        def note(*_: Any, run: Any, output: str = output, **__: Any) -> None:
            written.append((output, run["boxes"], run["input"]["path"]))

        monkeypatch.setattr(f"shapecat.outputs.{output}", note)

    pipeline.process(replace(job, overwrite=False))

    asked = ("visible", str(moved.resolve()))
    assert written == [
        ("review.writing.write_review", *asked),
        ("annotation.annotated_mcap.write_annotated", *asked),
    ]
    assert labels(job.folder) == {"vase"}


def test_kill_right_after_new_labels_leaves_outputs_to_be_written(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the next command would call them complete, although they have the old labels."""
    give_label(job.folder, "vase")
    real = pipeline._apply_labels

    def apply(*arguments: Any, **options: Any) -> None:
        real(*arguments, **options)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pipeline, "_apply_labels", apply)
        pipeline.annotate_again(job.folder, None)
    assert not {"review.rrd", "annotated.mcap"} & read_run(job.folder)["seconds"].keys()

    pipeline.process(replace(job, overwrite=False))

    assert {"review.rrd", "annotated.mcap"} <= read_run(job.folder)["seconds"].keys()


def test_refused_labels_leave_the_run_complete(job: Job, tmp_path: Path) -> None:
    """A typo would have the next command write the outputs, for hours in a long recording."""
    before = read_run(job.folder)
    wrong = tmp_path / "wrong.csv"
    wrong.write_text("track,category,confidence,label\n999,cup,0.5,vase\n")
    with pytest.raises(OutputError):
        pipeline.annotate_again(job.folder, wrong)

    assert read_run(job.folder) == before


def test_segments_are_in_the_order_of_the_recording_on_any_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some file systems list names by their hashes: frames would go back and forth in time."""
    for name in ("000032", "000000", "000016"):
        (tmp_path / name).mkdir()
    glob = Path.glob
    monkeypatch.setattr(Path, "glob", lambda *given: sorted(glob(*given), reverse=True))

    assert [segment.name for segment in list_segments(tmp_path)] == ["000000", "000016", "000032"]
