"""Tests that the recordings in the folder fixtures give their expected tables."""

import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from numpy.typing import NDArray
from PIL import Image

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
def test_fixture_gives_expected_tables(name: str, tmp_path: Path) -> None:
    """A change of results must be noticed and intended."""
    tables = processed_tables(FIXTURES / name, tmp_path / "run")

    wrong = [
        f"{table}: {difference}"
        for table, rows in tables.items()
        for difference in differences(rows, read_table(expected_path(name, table)))
    ]
    assert wrong == [], f"{name} gives other tables; {RENEW}"


def test_no_result_depends_on_freed_memory(tmp_path: Path) -> None:
    """A kernel frees an array after its last use, even if a record taken from it is read later.

    Most allocators leave freed memory as it was, so that nobody notices; this one overwrites it.
    """
    code = (
        "from pathlib import Path; from tests.fixtures import *; "
        f"tables = processed_tables(FIXTURES / 'clutter', Path({str(tmp_path / 'run')!r})); "
        "print([*differences(tables['detections'], "
        "read_table(expected_path('clutter', 'detections')))])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONMALLOC": "debug"},
        cwd=Path(__file__).parents[1],
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stdout == "[]\n"


def test_comparison_ignores_rounding_differences() -> None:
    """A comparison that is too tolerant would let everything pass."""
    wanted = [{"category": "cup", "points": "512", "x": "0.4000", "on": ""}]

    assert not list(differences([wanted[0] | {"x": "0.4010"}], wanted))
    for wrong in ({"category": "can"}, {"points": "513"}, {"x": "0.4100"}, {"x": ""}, {"on": "0"}):
        assert len(list(differences([wanted[0] | wrong], wanted))) == 1, wrong
    assert list(differences([], wanted)) == ["0 rows, expected 1"]
    assert list(differences([{"category": "cup"}], wanted))


def test_fixtures_are_small_and_complete() -> None:
    """Cloning must stay quick, and no table may remain of a deleted recording."""
    files = [path for path in FIXTURES.rglob("*") if path.is_file()]
    tables = {expected_path(n, t) for n in SCENES for t in ("tracks", "detections", "planes")}

    assert sum(path.stat().st_size for path in files) < LARGEST
    assert set(EXPECTED.iterdir()) == tables


@pytest.mark.many
def test_fixtures_can_be_reproduced(tmp_path: Path) -> None:
    """A recording that cannot be reproduced cannot be repaired.

    All bytes are equal except those of colour images, whose pixels processors round differently.
    """
    make_recordings(tmp_path)

    made = {path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_file()}
    kept = {path.relative_to(FIXTURES) for path in FIXTURES.rglob("*") if path.is_file()}
    assert made == {path for path in kept if path.suffix != ".md" and path.parts[0] != "expected"}
    changed = [p for p in made if (tmp_path / p).read_bytes() != (FIXTURES / p).read_bytes()]
    coloured = [Path(name) for name, scene in SCENES.items() if scene.color]
    assert [p for p in changed if p not in coloured] == [], RENEW
    for name in coloured:
        new, old = (list(read_messages(folder / name)) for folder in (tmp_path, FIXTURES))
        assert [m[:2] for m in new] == [m[:2] for m in old], RENEW
        for (topic, _, data), (_, _, before) in zip(new, old, strict=True):
            if topic.endswith("/compressed"):
                difference = np.abs(decoded_jpeg(data) - decoded_jpeg(before))
                assert difference.mean() < 1, f"{topic}: {RENEW}"
                assert difference.max() < 30, f"{topic}: {RENEW}"
            else:
                assert data == before, f"{topic}: {RENEW}"


def read_messages(path: Path) -> Iterator[tuple[str, int, bytes]]:
    """Yield topic, log time and data of each message."""
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            yield channel.topic, message.log_time, bytes(message.data)


def decoded_jpeg(data: bytes) -> NDArray[np.int64]:
    """Return the pixels of the JPEG file in a message."""
    with Image.open(io.BytesIO(data[data.index(b"\xff\xd8\xff") :])) as image:
        return np.asarray(image).astype(np.int64)
