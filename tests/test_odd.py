"""Every odd recording ends as documented, and everything missing is reported."""

from pathlib import Path

import pytest

from tests import odd
from tests.zoo import FRAMES, ZOO


@pytest.mark.parametrize("name", ZOO)
def test_zoo(name: str, tmp_path: Path) -> None:
    exhibit = ZOO[name]

    verdict = odd.examine(exhibit.write(tmp_path), tmp_path / "out", "--jobs", "1")

    assert (verdict.code, verdict.frames) == (exhibit.code, exhibit.frames), verdict.message
    assert exhibit.said in verdict.message
    assert "\n" not in verdict.message
    assert (verdict.message == "") is (exhibit.said == "")
    if verdict.code == 0 and "cloud of" in name:
        assert verdict.frames + verdict.skipped == FRAMES
    if verdict.code:
        assert not (tmp_path / "out").exists()


EXPECTED = {"watercan.bag": 0, "asci-file.txt": 3, "empty-file.bag": 3, "metadata.yaml": 3}


@pytest.mark.skipif(not odd.COLLECTION.exists(), reason="needs the collection of odd recordings")
def test_collection(tmp_path: Path) -> None:
    for number, path in enumerate(odd.recordings(odd.COLLECTION)):
        verdict = odd.examine(path, tmp_path / str(number))

        assert verdict.code == EXPECTED.get(path.name, 4), (path, verdict)
        assert "\n" not in verdict.message
