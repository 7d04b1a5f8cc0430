"""Tests of the whole pipeline, on simulated recordings and on real data if present."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from mcap.reader import make_reader
from numpy.testing import assert_allclose

from shapecat.config import Settings, with_overrides
from shapecat.errors import ModelError
from shapecat.perception import Perceiver
from shapecat.pipeline import annotate, annotate_again, process
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.simulation import simulate
from tests.conftest import Guesser
from tests.mcap_files import read_ros, summary_of
from tests.odd_recordings import mcap
from tests.scenes import record
from tests.track_tables import rows, untimed_table

Run = Callable[..., Result]
FILES = {
    "run.json",
    "frames.parquet",
    "detections.parquet",
    "planes.parquet",
    "tracks.parquet",
    "tracks.csv",
    "tracks.original.csv",
    "annotated.mcap",
    "review.rrd",
}


@pytest.fixture(scope="module")
def recording(shapecat: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("simulated") / "table.mcap"
    assert shapecat("simulate", path, "--frames", 12, "--seed", 3).exit_code == 0
    return path


@pytest.fixture(scope="module")
def run_folder(shapecat: Run, recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    result = shapecat("process", recording, "--out", out)
    assert result.exit_code == 0, result.output
    return out / "table"


def messages(path: Path) -> Counter[tuple[str, int, int, bytes]]:
    with path.open("rb") as file:
        return Counter(
            (channel.topic, message.log_time, message.publish_time, message.data)
            for _, channel, message in make_reader(file, validate_crcs=True).iter_messages()
        )


def test_run_folder_has_exactly_the_documented_files(run_folder: Path) -> None:
    assert {path.name for path in run_folder.iterdir()} == FILES
    assert [path.name for path in run_folder.parent.iterdir()] == ["table"]


def test_originals_are_kept_and_annotations_decode(recording: Path, run_folder: Path) -> None:
    assert not messages(recording) - messages(run_folder / "annotated.mcap")

    topics = ["/shapecat/detections", "/shapecat/scene"]
    found = {topic: read_ros(run_folder / "annotated.mcap", topic) for topic in topics}
    assert {topic: len(messages) for topic, messages in found.items()} == dict.fromkeys(topics, 12)
    assert sum(len(message.detections) for _, message in found[topics[0]]) > 60


def test_objects_are_detected_categorized_and_tracked(recording: Path, run_folder: Path) -> None:
    """Objects are found in 9 of 10 frames, and 85 % of them get the correct category."""
    truth = json.loads(recording.with_suffix(".truth.json").read_text())
    labels = np.load(recording.with_suffix(".labels.npz"))["labels"]
    track_of = {
        (row["frame"], row["detection"]): row["track"] for row in rows(run_folder, "tracks")
    }
    visible, found, tracks = Counter[int](), Counter[int](), dict[int, Counter[int]]()
    names: dict[int, str] = {}
    by_frame: dict[int, list[dict[str, Any]]] = {}
    for row in rows(run_folder, "detections", "frame", "detection", "indices"):
        by_frame.setdefault(row["frame"], []).append(row)
    for frame in truth:
        image = labels[frame["frame"]].ravel()
        for item in frame["objects"]:
            if item["pixels"] < 200:
                continue
            names[item["track"]] = item["category"]
            visible[item["track"]] += 1
            for row in by_frame.get(frame["frame"], []):
                inside = int((image[row["indices"]] == item["label"]).sum())
                if 2 * inside > len(row["indices"]) + item["pixels"] - inside:
                    found[item["track"]] += 1
                    track = track_of.get((frame["frame"], row["detection"]))
                    tracks.setdefault(item["track"], Counter())[track or 0] += 1

    assert set(names.values()) >= {"cup", "can", "box", "bottle", "bowl", "plate", "ball"}
    assert all(found[k] >= 0.9 * visible[k] for k in visible), (found, visible, names)
    assert all(len(ids) == 1 for ids in tracks.values()), "identity switch"
    final = final_labels(run_folder)
    correct = [final[next(iter(ids))] == names[k] for k, ids in tracks.items()]
    assert np.mean(correct) >= 0.85


def final_labels(folder: Path) -> dict[int, str]:
    lines = (folder / "tracks.csv").read_text().splitlines()
    header = lines[0].split(",")
    table = [dict(zip(header, line.split(","), strict=True)) for line in lines[1:]]
    return {int(row["track"]): row["category"] for row in table}


def test_objects_without_surface_are_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Too few points have no descriptor: a category would be guessed from an empty one."""

    class CertainGuesser(Guesser):
        def predict(self, descriptors: Any) -> Any:
            """Guess a category even from an empty descriptor."""
            return super().predict(descriptors + 1)

    monkeypatch.setattr("shapecat.pipeline.load_model", lambda _path: CertainGuesser())
    monkeypatch.setattr("shapecat.perception.reconstruct", lambda *_, **__: None)
    process(Job(record(tmp_path / "lab.mcap", 3), tmp_path / "out", mcap=False, rrd=False))

    found = rows(tmp_path / "out", "detections")
    assert len(found) > 6
    assert {row["category"] for row in found} == {"unknown"}
    assert_allclose([row["posterior"] for row in found], 1 / len(Guesser.categories), rtol=1e-6)
    assert {*final_labels(tmp_path / "out").values()} == {"unknown"}


def test_camera_motion_is_compensated(run_folder: Path) -> None:
    """With transforms, an object at rest has a constant position."""
    run = json.loads((run_folder / "run.json").read_text())
    assert run["fixed_frame"] == "map"
    assert run["up"]["source"].startswith("transforms")
    assert run["warnings"] == []
    places: dict[int, list[Any]] = {}
    for row in rows(run_folder, "tracks"):
        places.setdefault(row["track"], []).append(row["center_fixed"])
    spread = [np.ptp(np.array(place), axis=0).max() for place in places.values()]
    assert np.median(spread) < 0.03


@pytest.mark.parametrize(("container", "name"), [("ros1", "table.bag"), ("ros2", "table")])
def test_other_containers_give_same_detections(
    shapecat: Run, tmp_path: Path, run_folder: Path, container: str, name: str
) -> None:
    path = tmp_path / name
    options = ("--frames", 3, "--seed", 3, "--format", container)  # the first of the recording
    assert shapecat("simulate", path, *options).exit_code == 0
    assert shapecat("process", path, "--out", tmp_path / "out", "--no-rrd").exit_code == 0

    assert_same_detections(run_folder, tmp_path / "out" / "table", atol=1e-6)


def test_clouds_give_same_detections_as_depth_images(
    shapecat: Run, tmp_path: Path, run_folder: Path
) -> None:
    path = tmp_path / "table.mcap"
    assert shapecat("simulate", path, "--frames", 3, "--seed", 3, "--clouds").exit_code == 0
    result = shapecat("process", path, "--out", tmp_path / "out", "--no-rrd")
    assert result.exit_code == 0, result.output

    assert_same_detections(run_folder, tmp_path / "out" / "table", atol=2e-3)


def assert_same_detections(expected: Path, actual: Path, *, atol: float) -> None:
    columns = ("frame", "detection", "center", "category", "posterior", "novelty")
    want, have = (rows(folder, "detections", *columns) for folder in (expected, actual))
    have_frames = {row["frame"] for row in have}
    want = [row for row in want if row["frame"] in have_frames]
    assert len(want) == len(have) > 0
    assert_allclose([r["center"] for r in have], [r["center"] for r in want], atol=atol)
    assert [r["category"] for r in have] == [r["category"] for r in want]
    if atol < 1e-5:
        for name in ("posterior", "novelty"):
            assert_allclose([r[name] for r in have], [r[name] for r in want], atol=1e-4)


def test_same_input_gives_same_tables(
    shapecat: Run, recording: Path, run_folder: Path, tmp_path: Path
) -> None:
    assert shapecat("process", recording, "--out", tmp_path, "--no-rrd").exit_code == 0

    for name in ("frames", "detections", "planes", "tracks"):
        here, again = (untimed_table(folder, name) for folder in (run_folder, tmp_path / "table"))
        assert here.equals(again), name
    assert (run_folder / "tracks.csv").read_text() == (tmp_path / "table/tracks.csv").read_text()


def test_complete_run_is_not_processed_again(
    shapecat: Run, recording: Path, run_folder: Path
) -> None:
    before = (run_folder / "run.json").stat().st_mtime_ns
    again = shapecat("process", recording, "--out", run_folder.parent)
    assert again.exit_code == 0
    assert "already complete" in again.stdout
    assert (run_folder / "run.json").stat().st_mtime_ns == before

    other = shapecat("process", recording, "--out", run_folder.parent, "--set", "seed=1")
    assert other.exit_code == 1
    assert "--overwrite" in other.stderr


def test_corrected_label_appears_in_annotations(
    shapecat: Run, recording: Path, tmp_path: Path
) -> None:
    assert shapecat("process", recording, "--out", tmp_path, "--end", 0.1).exit_code == 0
    folder = tmp_path / "table"
    lines = (folder / "tracks.csv").read_text().splitlines()
    cells = lines[1].split(",")
    cells[lines[0].split(",").index("label")] = "heirloom"
    corrected = tmp_path / "corrected.csv"
    corrected.write_text("\n".join([lines[0], ",".join(cells), *lines[2:]]) + "\n")

    result = shapecat("annotate", folder, "--labels", corrected)

    assert result.exit_code == 0, result.output
    names = Counter[str]()
    for _, message in read_ros(folder / "annotated.mcap", "/shapecat/detections"):
        names.update(d.results[0].hypothesis.class_id for d in message.detections)
    assert names["heirloom"] >= 1


@pytest.mark.parametrize(
    ("content", "code"), [(None, 3), (b"", 3), (b"hello, this is a text\n", 3)]
)
def test_invalid_recording_is_refused_in_one_line(
    shapecat: Run, tmp_path: Path, content: bytes | None, code: int
) -> None:
    """The exit code is the documented one, and no file is left."""
    for name in ("x.mcap", "x.bag", "x.db3", "x.txt"):
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        result = shapecat("process", path, "--out", tmp_path / "out")
        assert result.exit_code == code, (name, result.output)
        assert result.stderr.count("\n") == 1, result.stderr
        assert str(path) in result.stderr
        assert not (tmp_path / "out").exists()


def test_unknown_topic_or_late_start_fails(shapecat: Run, tmp_path: Path, recording: Path) -> None:
    result = shapecat("process", recording, "--out", tmp_path / "out", "--topic", "/none")
    assert result.exit_code == 4
    assert "/camera/depth/image_raw" in result.stderr
    assert not (tmp_path / "out").exists()

    late = shapecat("process", recording, "--out", tmp_path / "out", "--start", 1000)
    assert late.exit_code == 4
    assert not (tmp_path / "out").exists()


def test_repeated_warning_is_stored_once(tmp_path: Path) -> None:
    """Every command that writes outputs opens the recording again, with the same warnings."""
    recording: Any = SimpleNamespace(warnings=["no index", "skipped 3"])
    run: Any = {
        "settings": {"outputs": {}},
        "counts": {"frames": 0},
        "options": {"rrd": False, "mcap": False},
        "warnings": ["skipped 3", "tilted"],
    }
    annotate(tmp_path, recording, run)
    annotate(tmp_path, recording, run)

    assert run["warnings"] == ["skipped 3", "tilted", "no index"]


def test_review_is_told_which_scenes_need_a_place(
    guessed_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise scenes without a pose are drawn at the origin of the fixed frame."""
    folder = shutil.copytree(guessed_run, tmp_path / "table")
    run = read_run(folder)
    run["seconds"].pop("review.rrd", None)
    run["options"] |= {"mcap": False, "rrd": True}
    asked: list[Any] = []

    def draw(*given: Any) -> tuple[Any, ...]:
        asked.append(given)
        return ()

    monkeypatch.setattr("shapecat.outputs.review.scenes.with_clouds", draw)
    monkeypatch.setattr("shapecat.outputs.review.writing.write_review", lambda *_, **__: None)
    recording: Any = SimpleNamespace(path=tmp_path / "table.mcap", warnings=[])
    annotate(folder, recording, run)

    ((_, source, about, placed),) = asked
    assert (source, about) == (recording, run)
    assert set(placed) == set(run["options"]["topics"])


def test_damage_found_while_recording_is_rewritten_is_reported(
    guessed_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All messages are read only when annotated.mcap is added to the finished run."""
    folder = shutil.copytree(guessed_run, tmp_path / "table")
    run = read_run(folder)
    del run["seconds"]["annotated.mcap"]
    run["options"] |= {"mcap": True, "rrd": False}
    recording: Any = SimpleNamespace(warnings=["no index"], topics=())
    monkeypatch.setattr(
        "shapecat.outputs.annotation.annotated_mcap.write_annotated",
        lambda source, *_, **__: source.warnings.append("skipped the chunk at byte 7"),
    )
    annotate(folder, recording, run)

    assert run["warnings"][-2:] == ["no index", "skipped the chunk at byte 7"]
    assert read_run(folder)["warnings"] == run["warnings"]


def test_annotated_copy_of_damaged_recording_is_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other readers stop at a damaged chunk, which only the first reading of the frames detects."""
    monkeypatch.setattr("shapecat.pipeline.load_model", lambda _path: Guesser())
    source = mcap(tmp_path, frames=4, chunk_size=20_000)
    whole = messages(source)
    chunk = sorted(c.chunk_start_offset for c in summary_of(source).chunk_indexes)[2]
    data = bytearray(source.read_bytes())
    data[chunk + 3000] ^= 0xFF
    source.write_bytes(data)
    job = Job(source=source, folder=tmp_path / "out" / "a", rrd=False)

    def kept() -> int:
        return (messages(job.folder / "annotated.mcap") & whole).total()

    process(job)
    readable = kept()
    assert 0 < readable < whole.total()
    annotate_again(job.folder, None)
    assert kept() == readable
    moved = with_overrides(Settings(), ["tracking.gate_m=0.1"])
    process(replace(job, settings=moved, overwrite=True))
    assert kept() == readable
    assert read_run(job.folder)["counts"]["resumed"] == 3  # frames are not read again


def test_bad_recording_does_not_stop_the_others(
    shapecat: Run, recording: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"no")
    options, out = ("--end", 0.1, "--json", "--jobs", 1), tmp_path / "out"
    result = shapecat("process", bad, recording, "--out", out, *options)

    assert result.exit_code == 1
    (summary,) = json.loads(result.stdout)
    assert summary["counts"]["frames"] > 0
    (again,) = json.loads(shapecat("process", bad, recording, "--out", out, *options).stdout)
    assert again == {**summary, "processed": False}  # including what the manifest lacks
    assert {path.name for path in out.iterdir()} == {"table", "manifest.jsonl"}


def test_annotations_of_earlier_run_are_reported(
    shapecat: Run, guessed_run: Path, tmp_path: Path
) -> None:
    """All messages are kept, so viewers show the objects of both runs."""
    result = shapecat("process", guessed_run / "annotated.mcap", "--out", tmp_path, "--no-rrd")
    first, second = (
        json.loads((folder / "run.json").read_text())["warnings"]
        for folder in (guessed_run, tmp_path / "annotated")
    )

    assert result.exit_code == 0, result.output
    assert not any("earlier run" in warning for warning in first)
    assert sum("has the annotations of an earlier run" in warning for warning in second) == 1


def test_commands_accept_run_without_objects(shapecat: Run, tmp_path: Path) -> None:
    """Empty tables must not be shaped as if they had a row."""
    path = simulate(tmp_path / "bare.mcap", scene="empty", frames=3, seed=2)
    result = shapecat("process", path, "--out", tmp_path)
    assert result.exit_code == 0, result.output

    folder = tmp_path / "bare"
    assert {file.name for file in folder.iterdir()} == FILES
    assert len(rows(folder, "frames")) == 3
    assert not rows(folder, "detections")
    assert not rows(folder, "tracks")
    for command in (
        ("annotate", folder, "--labels", folder / "tracks.csv"),
        ("report", folder),
        ("scene", folder, "--frame", 0),
        ("export", folder, "--format", "kitti", "--out", tmp_path / "kitti"),
        ("export", folder, "--format", "crops", "--out", tmp_path / "crops"),
    ):
        again = shapecat(*command)
        assert again.exit_code == 0, (command, again.output)


def detections(shapecat: Run, recording: Path, out: Path) -> dict[int, list[dict[str, Any]]]:
    """Process a recording; return its detections by the time of their frame."""
    done = shapecat("process", recording, "--out", out, "--no-rrd", "--no-mcap")
    assert done.exit_code == 0, done.output
    found: dict[int, list[dict[str, Any]]] = {}
    for row in rows(out / recording.stem, "detections"):
        found.setdefault(row["stamp_ns"], []).append(row)
    return found


@pytest.fixture(scope="module")
def of_depth_images(
    shapecat: Run, real_data: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[int, list[dict[str, Any]]]:
    return detections(
        shapecat, real_data / "osd_learn/depth.mcap", tmp_path_factory.mktemp("depth")
    )


@pytest.mark.many  # `test_clouds_give_same_detections_as_depth_images` simulates them
@pytest.mark.parametrize("name", ["clouds.mcap", "clouds.bag", "clouds_ros2"])
def test_real_clouds_give_same_objects_as_depth_images(
    shapecat: Run,
    real_data: Path,
    of_depth_images: dict[int, list[dict[str, Any]]],
    tmp_path: Path,
    name: str,
) -> None:
    """Centres agree within 2 mm, and categories are equal, in every container."""
    have = detections(shapecat, real_data / "osd_learn" / name, tmp_path)

    assert have
    assert set(have) <= set(of_depth_images)
    for stamp, found in have.items():
        wanted = of_depth_images[stamp]
        assert_allclose([r["center"] for r in found], [r["center"] for r in wanted], atol=2e-3)
        assert [r["category"] for r in found] == [r["category"] for r in wanted]


def test_process_that_perceives_frames_has_model_and_settings_of_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The process reads the model file again, which may have been replaced since the run began."""
    models: dict[Path | None, Any] = {
        Path(f"{name}.npz"): SimpleNamespace(model_id=name) for name in ("one", "two")
    }
    monkeypatch.setattr("shapecat.perception.load_model", models.__getitem__)
    for name, seed in (("one", 3), ("two", 3), ("two", 4)):
        path = Path(f"{name}.npz")
        sent = Perceiver(models[path], Settings(seed=seed), path)
        assert deepcopy(sent) == sent  # restored in the same way as in another process

    replaced: Any = SimpleNamespace(model_id="before")
    with pytest.raises(ModelError, match=r"two\.npz: has changed since the run began"):
        deepcopy(Perceiver(replaced, Settings(), Path("two.npz")))


def test_output_added_later_leaves_others_to_be_annotated(
    shapecat: Run, guessed_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that forgot its annotated.mcap would leave the old labels there after a correction."""
    monkeypatch.setattr("shapecat.pipeline.load_model", lambda _path: Guesser())
    folder = shutil.copytree(guessed_run, tmp_path / "table")
    source = read_run(folder)["input"]["path"]
    added = shapecat("process", source, "--out", tmp_path, "--no-mcap")
    assert added.exit_code == 0, added.output
    assert (folder / "review.rrd").exists()

    categories = final_labels(folder)
    lines = [f"{track},{name},0.5,mug" for track, name in categories.items()]
    text = "\n".join(["track,category,confidence,label", *lines])
    (tmp_path / "labels.csv").write_text(text)
    done = shapecat("annotate", folder, "--labels", tmp_path / "labels.csv")
    assert done.exit_code == 0, done.output

    found = read_ros(folder / "annotated.mcap", "/shapecat/detections")
    names = {d.results[0].hypothesis.class_id for _, message in found for d in message.detections}
    assert names == {"mug"}
