"""Tests of processing damaged and unusual recordings: exit codes, frames and messages."""

from pathlib import Path

import pytest

from tests import odd
from tests.odd_recordings import CASES, FRAMES


@pytest.mark.parametrize("name", CASES)
def test_odd_recording_has_expected_outcome(name: str, tmp_path: Path) -> None:
    case = CASES[name]

    verdict = odd.examine(case.write(tmp_path), tmp_path / "out", "--jobs", "1")

    assert (verdict.code, verdict.frames) == (case.code, case.frames), verdict.message
    assert case.reported in verdict.message
    assert "\n" not in verdict.message
    assert (verdict.message == "") is (case.reported == "")
    if verdict.code == 0 and "cloud of" in name:
        assert verdict.frames + verdict.skipped == FRAMES
    if verdict.code:
        assert not (tmp_path / "out").exists()


EXPECTED = {"watercan.bag": 0, "asci-file.txt": 3, "empty-file.bag": 3, "metadata.yaml": 3}


@pytest.mark.many  # the cases above are of the same kinds
@pytest.mark.skipif(not odd.COLLECTION.exists(), reason="needs the collection of odd recordings")
def test_collected_recording_has_expected_exit_code(tmp_path: Path) -> None:
    for number, path in enumerate(odd.recordings(odd.COLLECTION)):
        verdict = odd.examine(path, tmp_path / str(number))

        assert verdict.code == EXPECTED.get(path.name, 4), (path, verdict)
        assert "\n" not in verdict.message
