"""Invariants after a fault. Each check yields the violations as text."""

import json
import re
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from mcap.exceptions import McapError
from mcap.records import Footer
from mcap.stream_reader import StreamReader

from tests.faults.injection import Ended
from tests.faults.scenarios import Scenario
from tests.track_tables import untimed_table

TABLES = ("frames", "detections", "planes", "tracks")
FILES = ("run.json", *(f"{name}.parquet" for name in TABLES), "tracks.csv")
OUTPUTS = ("annotated.mcap", "review.rrd")
RECENT_S = 3.0
"""Work of this many seconds before the fault may be lost."""
CODES = {
    "interrupt": {0, 130},
    "double": {0, 130},
    "terminate": {0, 143},
    "kill": {0, -9},
    "worker": {0, 1},
    "replace": {0, 1, 3, 4},
    "tmpfs": {0, 1},
    "enospc": {0, 1},
    "eio": {0, 1},
    "eioread": {0, 1, 3},
    "erofs": {0, 1},
    "short": {0},
    "clock": {0},
}
"""Accepted exit codes by kind of fault."""
_CRASH = re.compile(
    r"Traceback|SystemError|Segmentation fault|Fatal Python error|resource_tracker|core dumped"
    r"|Bus error|this is a bug|Exception ignored"
)


def ended_well(kind: str, ended: Ended) -> Iterator[str]:
    """Check the exit code and the messages."""
    if ended.hung:
        yield "hung"
    elif ended.code not in CODES[kind]:
        yield f"exit code {ended.code}, expected one of {sorted(CODES[kind])}"
    if found := _CRASH.search(ended.text):
        yield f"stderr says {found[0]!r}"
    if ended.lingering:
        yield f"{ended.lingering} processes outlive the command"
    lines = [line for line in ended.text.splitlines() if line.startswith("Error: ")]
    lines += [str(event["message"]) for _, event in ended.events() if event.get("message")]
    if 0 < ended.code < 5 and not lines:
        yield "no error line"
    for line in sorted({line for line in lines if lines.count(line) > 1}):
        yield f"printed twice: {line}"


def complete_outputs(scenario: Scenario, out: Path) -> Iterator[str]:
    """Check that everything under a final name is complete."""
    for item in sorted(out.iterdir()) if out.is_dir() else []:
        if item.name.startswith("."):
            continue
        if item.name == "manifest.jsonl":
            yield from complete_lines(item)
        elif item.name not in scenario.runs or not item.is_dir():
            yield f"stray {item.name}"
        else:
            yield from complete_run(item)


def complete_run(run: Path) -> Iterator[str]:
    """Check that a run folder holds every file, each of them complete."""
    for name in (*FILES, *OUTPUTS):
        if not (run / name).is_file():
            yield f"{run.name}: no {name}"
    for path in sorted(run.iterdir()):
        if path.name.endswith(".partial") and not path.name.startswith("."):
            yield f"{run.name}: stray {path.name}"
        elif not path.name.startswith("."):
            yield from (f"{run.name}: {text}" for text in complete_file(path))


def complete_file(path: Path) -> Iterator[str]:
    """Check one file by its kind."""
    try:
        if path.suffix == ".json":
            json.loads(path.read_text("utf-8"))
        elif path.suffix == ".parquet":
            pq.read_table(path)
        elif path.suffix == ".mcap":
            _read_mcap(path)
        elif path.suffix == ".rrd":
            _read_rrd_footer(path)
        elif path.suffix == ".csv" and not path.read_bytes().endswith(b"\n"):
            yield f"{path.name}: last line is cut"
    except Exception as error:  # noqa: BLE001  damage shows as any error, also of a decompressor
        yield f"{path.name}: {type(error).__name__}: {error}"


def _read_mcap(path: Path) -> None:
    with path.open("rb") as file:
        last = None
        for record in StreamReader(file, validate_crcs=True).records:
            last = record
        if not isinstance(last, Footer):
            msg = "no footer"
            raise McapError(msg)


def _read_rrd_footer(path: Path) -> None:
    """Check the last 32 bytes: start and size of the footer, and a magic number."""
    content = path.read_bytes()
    begin, size = struct.unpack("<QQ", content[-32:-16])
    if (
        content[:4] != b"RRF2"
        or content[-12:-4] != b"RRF2FOOT"
        or begin + size + 32 != len(content)
    ):
        msg = "no footer"
        raise ValueError(msg)


def complete_lines(manifest: Path) -> Iterator[str]:
    """Check that no line of a manifest is truncated."""
    content = manifest.read_bytes()
    if content and not content.endswith(b"\n"):
        yield "manifest: last line is torn"
    for number, line in enumerate(content.splitlines(), start=1):
        try:
            json.loads(line)
        except ValueError:
            yield f"manifest: line {number} is torn"


def nothing_lost(scenario: Scenario, ended: Ended, out: Path) -> Iterator[str]:
    """Check that frames reported `RECENT_S` before the fault, or else the end, are still there."""
    last = ended.fault_s if ended.fault_s is not None else ended.seconds
    for name, count in reported(ended, last - RECENT_S).items():
        run = name.rpartition("/")[2].partition(".")[0]
        if run in scenario.runs and (found := kept_frames(out, run)) < count:
            yield f"{run}: {found} frames kept of {count} done {RECENT_S:g} s before"


def reported(ended: Ended, until: float) -> dict[str, int]:
    """Return the number of frames of each recording that were perceived before a given time."""
    done: dict[str, int] = {}
    for moment, event in ended.events():
        if event.get("event") == "progress" and event.get("phase") == "perceive":
            count = event["done"]
            if moment <= until and isinstance(count, int):
                done[str(event["recording"])] = count
    return done


def kept_frames(out: Path, run: str) -> int:
    """Return the number of frames in a run folder, or in the hidden one of an unfinished run."""
    for folder in (out / run, out / f".{run}.partial"):
        if (folder / "frames.parquet").is_file():
            try:
                return int(pq.read_metadata(folder / "frames.parquet").num_rows)
            except (pa.ArrowException, OSError):
                pass  # not joined yet: count the segments
    hidden = out / f".{run}.partial" / "segments"
    return sum(_rows(path) for path in hidden.glob("[0-9]*/frames.arrow"))


def _rows(path: Path) -> int:
    with pa.OSFile(str(path)) as file:
        try:
            return int(pa.ipc.open_file(file).read_all().num_rows)
        except pa.ArrowInvalid:
            file.seek(0)
            return int(pa.ipc.open_stream(file).read_all().num_rows)


def nothing_hidden(out: Path) -> Iterator[str]:
    """Check that a completed command leaves no hidden partial results."""
    for path in sorted(out.rglob(".*")):
        if path.name.endswith((".partial", ".old")):
            yield f"left over: {path.relative_to(out)}"


def same_results(runs: Iterable[str], out: Path, reference: Path) -> Iterator[str]:
    """Check that the tables are those of an undisturbed run, row by row."""
    for run in runs:
        try:
            for name in TABLES:
                expected = untimed_table(reference / run, name)
                if not untimed_table(out / run, name).equals(expected):
                    yield f"{run}: {name}.parquet differs from an undisturbed run"
            if tracks(out / run) != tracks(reference / run):
                yield f"{run}: tracks.csv differs from an undisturbed run"
        except (OSError, pa.ArrowException) as error:
            yield f"{run}: {type(error).__name__}: {error}"


def tracks(run: Path) -> list[list[str]]:
    """Read tracks.csv without the id of the run."""
    text = (run / "tracks.csv").read_text("utf-8")
    rows = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    left_out = [i for i, name in enumerate(rows[0]) if name in {"run", "run_id"}] if rows else []
    return [[cell for i, cell in enumerate(row) if i not in left_out] for row in rows]


def same_files(folder: Path, reference: Path, *, all_there: bool) -> Iterator[str]:
    """Check that files are equal to those after an undisturbed command.

    With ``all_there``, no file may be missing or stray.
    """
    found, expected = files(folder), files(reference)
    for name in sorted(found.keys() & expected.keys()):
        if found[name] != expected[name]:
            yield f"{name} differs from an undisturbed run"
    if all_there and found.keys() != expected.keys():
        yield f"{len(found.keys() ^ expected.keys())} files missing or stray"


def files(folder: Path) -> dict[str, bytes]:
    """Read the files of a folder that are not hidden."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(p.startswith(".") for p in path.relative_to(folder).parts)
    }
