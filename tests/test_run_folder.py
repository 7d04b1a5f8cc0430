from pathlib import Path

import pytest

from shapecat.errors import OutputError
from shapecat.files import replacing
from shapecat.runs.folder import digest, read_run, staged, write_run


def test_folder_appears_whole(tmp_path: Path) -> None:
    folder = tmp_path / "out" / "lab"
    with staged(folder) as hidden:
        (hidden / "a").write_text("1")
        assert not folder.exists()

    assert (folder / "a").read_text() == "1"
    assert [p.name for p in folder.parent.iterdir()] == ["lab"]


def test_nothing_is_left_after_an_error(tmp_path: Path) -> None:
    """Also not the output folder that had to be made."""
    with pytest.raises(RuntimeError), staged(tmp_path / "out" / "deep" / "lab") as hidden:
        (hidden / "a").write_text("1")
        raise RuntimeError

    assert list(tmp_path.iterdir()) == []


def test_old_results_stay_until_the_new_are_complete(tmp_path: Path) -> None:
    folder = tmp_path / "lab"
    folder.mkdir()
    (folder / "a").write_text("old")
    with pytest.raises(RuntimeError), staged(folder) as hidden:
        (hidden / "a").write_text("new")
        raise RuntimeError

    assert (folder / "a").read_text() == "old"

    with staged(folder) as hidden:
        (hidden / "b").write_text("new")

    assert [p.name for p in tmp_path.iterdir()] == ["lab"]
    assert [p.name for p in folder.iterdir()] == ["b"]


def test_an_unwritable_place_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(OutputError, match="cannot write the results"),
        staged(tmp_path / "file" / "x"),
    ):
        pass


def test_replacing_keeps_the_old_file_on_error(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as hidden:
        hidden.write_text("half")
        raise RuntimeError

    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_run_json_round_trip_and_foreign_folder(tmp_path: Path) -> None:
    write_run(tmp_path, {"input": {"path": "ü"}})

    assert read_run(tmp_path) == {"input": {"path": "ü"}}

    (tmp_path / "run.json").write_text("[]")
    with pytest.raises(OutputError, match="not a description"):
        read_run(tmp_path)
    with pytest.raises(OutputError, match=r"no run\.json"):
        read_run(tmp_path / "nowhere")


def test_digest_sees_size_head_and_tail(tmp_path: Path) -> None:
    path = tmp_path / "f"
    seen = set()
    for content in (b"", b"a", b"a" * 3_000_000, b"a" * 2_999_999 + b"b", b"a" * 3_000_001):
        path.write_bytes(content)
        seen.add(digest(path))

    assert len(seen) == 5
