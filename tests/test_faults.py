"""Tests of the command under a few faults, and of the checks, which must detect damage."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from shapecat.pipeline import process
from shapecat.runs.jobs import Job
from tests.faults import invariants
from tests.faults.cases import FaultRunner, SkippedError
from tests.faults.injection import Ended
from tests.faults.scenarios import SCENARIOS, Scenario
from tests.scenes import record

TABLE = Scenario("table", ("table.mcap",))
CASES = (
    *(("interrupt", 1), ("interrupt", 2), ("double", 1), ("terminate", 1)),
    *(("kill", 1), ("kill", 2), ("enospc", 1), ("eio", 1), ("short", 1), ("clock", 1)),
)


@pytest.fixture(scope="module")
def runner(tmp_path_factory: pytest.TempPathFactory) -> FaultRunner:
    chosen = tuple(s for s in SCENARIOS if s.name == "single")
    return FaultRunner(tmp_path_factory.mktemp("faults"), chosen)


@pytest.mark.many
@pytest.mark.parametrize(("kind", "seed"), CASES)
def test_fault_does_no_harm(runner: FaultRunner, kind: str, seed: int) -> None:
    """A fault could leave half a result, lose work, or prevent the command from resuming.

    Among the quick tests, `test_stopping` covers interrupts; `test_crash`, kills and full disks.
    """
    try:
        verdict = runner.judge(kind, seed)
    except SkippedError as error:
        pytest.skip(str(error))

    assert not verdict.violations, verdict


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole")
    recording = record(tmp_path_factory.mktemp("recording") / "table.mcap", 8)
    process(Job(recording, out / "table"))
    return out


@pytest.fixture
def out(whole: Path, tmp_path: Path) -> Path:
    shutil.copytree(whole, tmp_path / "out")
    return tmp_path / "out"


def test_undamaged_run_passes(out: Path, whole: Path) -> None:
    """Checks that always fail would soon be disabled."""
    assert not [*invariants.complete_outputs(TABLE, out)]
    assert not [*invariants.same_results(["table"], out, whole)]
    assert not [*invariants.nothing_hidden(out)]


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-5])


def _flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)


DAMAGE: tuple[tuple[str, Callable[[Path], None]], ...] = (
    ("annotated.mcap", _cut),
    ("annotated.mcap", _flip),
    ("review.rrd", _cut),
    ("run.json", _cut),
    ("tracks.csv", _cut),
    ("detections.parquet", _cut),
    ("frames.parquet", Path.unlink),
)


@pytest.mark.parametrize(("name", "damage"), DAMAGE)
def test_damaged_file_is_noticed(out: Path, name: str, damage: Callable[[Path], None]) -> None:
    """A check that cannot fail would let half a file pass."""
    damage(out / "table" / name)

    assert any(name in text for text in invariants.complete_outputs(TABLE, out))


def test_stray_files_and_torn_lines_are_noticed(out: Path) -> None:
    """A fault may leave half a manifest line, a file that is not a run, or a hidden folder."""
    (out / "manifest.jsonl").write_text('{"folder": "table"}\n{"fold')
    (out / "table.partial").write_text("")
    (out / ".table.partial").mkdir()

    found = " ".join(invariants.complete_outputs(TABLE, out))

    assert "last line is torn" in found
    assert "line 2 is torn" in found
    assert "stray table.partial" in found
    assert [*invariants.nothing_hidden(out)] == ["left over: .table.partial"]


def test_one_changed_category_is_noticed(out: Path, whole: Path) -> None:
    """Equal row counts are not equal tables."""
    path = out / "table" / "detections.parquet"
    table = pq.read_table(path)
    index = table.column_names.index("category")
    rows = pa.array(range(table.num_rows))
    changed = pc.if_else(pc.equal(rows, 0), pa.scalar("saucer"), table["category"].cast("string"))
    pq.write_table(table.set_column(index, "category", changed), path)

    assert any("detections" in text for text in invariants.same_results(["table"], out, whole))


def test_changed_track_is_noticed(out: Path, whole: Path) -> None:
    """The table that people edit is compared, too."""
    path = out / "table" / "tracks.csv"
    path.write_text(path.read_text().replace("\n", "\n9", 2))

    assert any("tracks.csv" in text for text in invariants.same_results(["table"], out, whole))


def test_lost_frames_are_noticed(out: Path) -> None:
    """Work that was reported long before the fault must be found again."""
    line = '{"event": "progress", "recording": "table.mcap", "phase": "perceive", "done": 9}\n'
    late, early = Ended(130, 9.0, [(8.0, line)], 9.0), Ended(130, 9.0, [(1.0, line)], 9.0)

    assert not [*invariants.nothing_lost(TABLE, late, out)]
    assert [*invariants.nothing_lost(TABLE, early, out)]


@pytest.mark.parametrize(
    ("ended", "message"),
    [
        (Ended(1, 1.0, [(0.5, "Error: full\n")]), "exit code 1"),
        (Ended(130, 1.0, [(0.5, "Traceback (most recent call last)\n")]), "Traceback"),
        (Ended(-11, 1.0), "exit code -11"),
        (Ended(130, 1.0, lingering=1), "outlive"),
        (Ended(-9, 1.0, hung=True), "hung"),
    ],
)
def test_bad_ends_are_noticed(ended: Ended, message: str) -> None:
    """A command that crashes, gives a wrong code or leaves processes behind must not pass."""
    assert any(message in text for text in invariants.ended_well("interrupt", ended))


def test_silent_and_repeated_errors_are_noticed() -> None:
    """An error must be reported exactly once."""
    silent, repeated = Ended(1, 1.0), Ended(1, 1.0, [(0.5, "Error: full\n")] * 2)

    assert "no error line" in [*invariants.ended_well("eio", silent)]
    assert any("twice" in text for text in invariants.ended_well("eio", repeated))
