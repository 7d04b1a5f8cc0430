"""Process odd recordings and print the outcome of each: ``python -m tests.odd [FOLDER]...``."""

import json
import sys
import tempfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from click.testing import CliRunner

from tests.odd_recordings import CASES

COLLECTION = Path(__file__).parents[2] / "shared" / "data" / "odd"
CODES = {0, 3, 4}


class Verdict(NamedTuple):
    """The outcome of one recording."""

    code: int
    frames: int
    skipped: int
    message: str


def examine(path: Path, out: Path, *options: str) -> Verdict:
    """Process a recording as a user would; raise unknown errors, which are bugs."""
    arguments = ["process", str(path), "--out", str(out), "--no-rrd", *options]
    command: Any = import_module("shapecat.cli.main").main
    result = CliRunner().invoke(command, arguments)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    if result.exit_code:
        return Verdict(result.exit_code, 0, 0, result.stderr.strip().removeprefix("Error: "))
    (folder,) = out.iterdir()
    run = json.loads((folder / "run.json").read_text())
    skipped = sum(run["counts"]["skipped"].values())
    return Verdict(0, run["counts"]["frames"], skipped, "; ".join(run["warnings"]))


def recordings(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders, and the folders that are one recording."""
    for path in sorted(folder.iterdir()):
        parts = (
            [p for p in path.iterdir() if p.suffix in {".db3", ".zstd"}] if path.is_dir() else []
        )
        if path.is_dir() and not parts and path.name != "split_without_metadata":
            yield from recordings(path)
        else:
            yield path


def main(folders: list[Path]) -> int:
    """Print the table; return 1 if an exit code is not one of the documented ones."""
    wrong = 0
    for name, verdict in _verdicts(folders):
        wrong += verdict.code not in CODES
        line = f"{name:40.40} {verdict.code:4} {verdict.frames:6} {verdict.skipped:7}"
        sys.stdout.write(f"{line}  {verdict.message[:150]}\n")
    return int(wrong > 0)


def _verdicts(folders: list[Path]) -> Iterator[tuple[str, Verdict]]:
    sys.stdout.write(f"{'file':40} code frames skipped  message\n")
    with tempfile.TemporaryDirectory() as scratch:
        for number, (name, case) in enumerate(CASES.items()):
            case_folder = Path(scratch, str(number))
            case_folder.mkdir()
            yield name, examine(case.write(case_folder), case_folder / "out")
        for folder in folders:
            for number, path in enumerate(recordings(folder)):
                out = Path(scratch, f"{folder.name}-{number}")
                yield str(path.relative_to(folder)), examine(path, out)


if __name__ == "__main__":
    sys.exit(main([Path(a) for a in sys.argv[1:]] or [COLLECTION] * COLLECTION.exists()))
