"""The recordings of the folder fixtures give the tables that are expected of them."""

from pathlib import Path

import pytest

from tests.fixtures import (
    EXPECTED,
    FIXTURES,
    RECORDINGS,
    SCENES,
    differences,
    expected_path,
    make_recordings,
    processed_tables,
    read_table,
)

LARGEST = 3_000_000
RENEW = "if that is meant, renew them with `make fixtures`"


@pytest.mark.parametrize("name", RECORDINGS)
def test_fixture_gives_the_expected_tables(name: str, tmp_path: Path) -> None:
    """A change of results must be noticed, and be meant."""
    tables = processed_tables(FIXTURES / name, tmp_path / "run")

    wrong = [
        f"{table}: {difference}"
        for table, rows in tables.items()
        for difference in differences(rows, read_table(expected_path(name, table)))
    ]
    assert wrong == [], f"{name} gives other tables; {RENEW}"


def test_differences_are_told_except_in_last_digits() -> None:
    """A comparison that forgives too much would let everything pass."""
    wanted = [{"category": "cup", "points": "512", "x": "0.4000", "on": ""}]

    assert not list(differences([wanted[0] | {"x": "0.4010"}], wanted))
    for wrong in ({"category": "can"}, {"points": "513"}, {"x": "0.4100"}, {"x": ""}, {"on": "0"}):
        assert len(list(differences([wanted[0] | wrong], wanted))) == 1, wrong
    assert list(differences([], wanted)) == ["0 rows, expected 1"]
    assert list(differences([{"category": "cup"}], wanted))


def test_fixtures_are_small_and_all_there() -> None:
    """A clone must stay quick, and no table be left over from a recording that is gone."""
    files = [path for path in FIXTURES.rglob("*") if path.is_file()]
    tables = {expected_path(n, t) for n in SCENES for t in ("tracks", "detections", "planes")}

    assert sum(path.stat().st_size for path in files) < LARGEST
    assert set(EXPECTED.iterdir()) == tables


@pytest.mark.many
def test_fixtures_made_again_are_the_same_bytes(tmp_path: Path) -> None:
    """A recording that cannot be made again cannot be mended either."""
    make_recordings(tmp_path)

    made = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    kept = {path.relative_to(FIXTURES) for path in FIXTURES.rglob("*") if path.is_file()}
    assert made == {path for path in kept if path.suffix != ".md" and path.parts[0] != "expected"}
    changed = [p for p in made if (tmp_path / p).read_bytes() != (FIXTURES / p).read_bytes()]
    assert changed == [], f"the simulator makes other recordings; {RENEW}"
