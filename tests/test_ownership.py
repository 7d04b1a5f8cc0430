"""Tests that files of others are not touched, and that changed input is noticed."""

from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

from shapecat.runs.folder import read_run
from tests.scenes import record

Run = Callable[..., Result]
OPTIONS = ("--no-rrd", "--jobs", 1)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("ownership") / "lab.mcap", 4)


@pytest.mark.parametrize("option", ["--overwrite", "--no-mcap"])
@pytest.mark.parametrize("name", ["thesis.txt", "run.json", "tracks.csv"])
def test_folder_not_made_by_shapecat_is_refused(
    shapecat: Run, recording: Path, tmp_path: Path, option: str, name: str
) -> None:
    """A user's own folder must survive --overwrite, even if it resembles a run."""
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / name).write_text("{}")
    result = shapecat("process", recording, "--out", tmp_path, *OPTIONS, option)

    assert result.exit_code == 1
    assert f"{tmp_path / 'lab'}: shapecat did not make this" in result.stderr
    assert {path.name for path in tmp_path.rglob("*")} == {"lab", name}
    assert (tmp_path / "lab" / name).read_text() == "{}"


def test_overwrite_keeps_other_files_in_run_folder(
    shapecat: Run, recording: Path, tmp_path: Path
) -> None:
    shapecat("process", recording, "--out", tmp_path, *OPTIONS)
    (tmp_path / "lab" / "notes.txt").write_text("mine")
    before = read_run(tmp_path / "lab")
    result = shapecat("process", recording, "--out", tmp_path, *OPTIONS, "--overwrite")

    assert result.exit_code == 0
    assert (tmp_path / "lab" / "notes.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["lab"]
    after = read_run(tmp_path / "lab")
    assert before["id"] != after["id"]
    assert before["work"] == after["work"]


def test_recording_damaged_after_its_run_is_noticed(shapecat: Run, tmp_path: Path) -> None:
    """As the path is the same, the message must say that the content differs."""
    lab = record(tmp_path / "lab.bag", 12, container="ros1")  # uncompressed: only depth is damaged
    content = bytearray(lab.read_bytes())
    command = ("process", lab, "--out", tmp_path / "out", *OPTIONS)
    assert shapecat(*command).exit_code == 0
    middle = len(content) // 2
    content[middle : middle + 4096] = bytes(4096)
    lab.write_bytes(content)

    result = shapecat(*command)

    assert result.exit_code == 1
    assert "another input" in result.stderr
    assert "lab.bag with other content in the old run" in result.stderr
    assert "already complete" not in result.stdout


def test_copy_with_other_file_times_is_same_recording(
    shapecat: Run, recording: Path, tmp_path: Path
) -> None:
    command = ("process", tmp_path / "lab.mcap", "--out", tmp_path / "out", *OPTIONS)
    (tmp_path / "lab.mcap").write_bytes(recording.read_bytes())
    assert shapecat(*command).exit_code == 0
    (tmp_path / "lab.mcap").unlink()
    (tmp_path / "lab.mcap").write_bytes(recording.read_bytes())

    result = shapecat(*command)

    assert result.exit_code == 0, result.stderr
    assert "already complete" in result.stdout


def test_new_file_beside_parts_of_bag_is_not_a_change(shapecat: Run, tmp_path: Path) -> None:
    """A note or a thumbnail would keep corrected labels from being applied."""
    lab = record(tmp_path / "lab", 12, container="ros2")
    command = ("process", lab, "--out", tmp_path / "out", *OPTIONS)
    assert shapecat(*command).exit_code == 0
    (lab / "Thumbs.db").write_text("pictures")

    again, annotated = shapecat(*command), shapecat("annotate", tmp_path / "out" / "lab")

    assert "already complete" in again.stdout, again.stderr
    assert annotated.exit_code == 0, annotated.stderr


def test_each_failure_is_printed_once(shapecat: Run, recording: Path, tmp_path: Path) -> None:
    """Failures appear on stderr when they happen; the closing table must not repeat them."""
    (tmp_path / "lab.mcap").write_bytes(recording.read_bytes())
    for k in range(3):
        (tmp_path / f"bad{k}.mcap").write_text("no recording")
    result = shapecat("process", tmp_path, "--out", tmp_path / "out", *OPTIONS)

    assert result.exit_code == 1
    assert result.output.count("not a recording") == 3
    assert "bad" not in result.stdout
    assert "1 complete, 3 failed" in result.stdout
