"""Flip operators of the modules without kernels, one at a time, and run the tests that know them.

    python -m tests.mutations --only quick --minutes 4 --each 4

No file is touched: each mutant lives in a forked process alone, whose imports give it. A mutant is
killed if a test fails, or if the tests take far longer than without it. A module is judged by the
test files that `KNOWN_BY` names; they must pass without a mutant first.
"""

import argparse
import ast
import importlib.abc
import importlib.machinery
import importlib.util
import multiprocessing
import os
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import pytest

from tests.mutations.flips import Flip, flipped, flips_of

ROOT = Path(__file__).parents[2]
LIBRARIES = ("numba", "scipy.spatial.transform", "pyarrow.parquet", "rosbags.typesys",
             "mcap.reader", "mcap_ros2.decoder", "click.testing", "scipy.optimize")  # fmt: skip
"""Loaded once, before processes are forked."""
ROOMS = ("batch", "cameras", "colour", "executors", "outputs", "recordings", "runs", "system",
         "tracking")  # fmt: skip
KNOWN_BY: dict[str, Sequence[str]] = {
    "shapecat.runs": ("test_tables_turned", "test_tables", "test_done", "test_labels"),
    "shapecat.runs.folder": ("test_run_folder", "test_done"),
    "shapecat.runs.full_boxes": ("test_tables_turned", "test_completion"),
    "shapecat.runs.same_objects": ("test_label_transfer",),
    "shapecat.runs.perceiving": ("test_pipeline", "test_crash"),
    "shapecat.runs.second_look": ("test_second_look",),
    "shapecat.runs.segments": ("test_tables", "test_tables_turned"),
    "shapecat.outputs.exports": ("test_exports_worked", "test_exports_images"),
    "shapecat.outputs.report": ("test_report",),
    "shapecat.outputs.review": ("test_review",),
    "shapecat.outputs": ("test_annotations_turned", "test_annotated_mcap", "test_exports_worked"),
    "shapecat.recordings": ("test_recordings_frames", "test_cameras", "test_recordings"),
    "shapecat.recordings.transforms": ("test_transforms",),
    "shapecat.recordings.gravity": ("test_cameras", "test_gravity"),
    "shapecat.recordings.colour": ("test_recordings_colour",),
    "shapecat.recordings.foxglove": ("test_recordings_foxglove",),
    "shapecat.recordings.protobuf": ("test_recordings_foxglove",),
    "shapecat.tracking": ("test_tracking", "test_tables_turned"),
    "shapecat.tracking.full_boxes": ("test_completion", "test_tables_turned"),
    "shapecat.batch": ("test_done",),
    "shapecat.batch.remote": ("test_remote",),
    "shapecat.batch.runs": ("test_done", "test_batch"),
    "shapecat.executors": ("test_executors",),
    "shapecat.system": ("test_run_folder", "test_done"),
    "shapecat.colour": ("test_colour",),
    "shapecat.cameras": ("test_cameras", "test_colour"),
}
"""Test files by the beginning of a module's name; the longest that fits counts."""
SLOW = (
    "shapecat.batch.remote",
    "shapecat.batch.runs",
    "shapecat.executors",
    "shapecat.outputs.report",
    "shapecat.outputs.review",
    "shapecat.runs.perceiving",
    "shapecat.runs.second_look",
)
"""Judged by tests with a browser, a viewer or whole recordings: left out of samples."""
SLOWEST_S = 900.0


_QUICK = "quick"


class Mutant(NamedTuple):
    """A flip in a module."""

    module: str
    flip: Flip


def candidates() -> dict[str, Path]:
    """Return the modules without kernels, by name."""
    files = sorted(f for room in ROOMS for f in (ROOT / "shapecat" / room).rglob("*.py"))
    named = {".".join(f.relative_to(ROOT).with_suffix("").parts): f for f in files}
    return {
        name: file
        for name, file in named.items()
        if not name.endswith("__init__") and "@kernel" not in file.read_text("utf-8")
    }


def tests_of(module: str) -> list[str]:
    """Return the test files that judge a module, the quickest first."""
    fitting = max((name for name in KNOWN_BY if module.startswith(name)), key=len)
    return [str(ROOT / "tests" / f"{name}.py") for name in KNOWN_BY[fitting]]


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives one module another code."""

    def __init__(self, name: str, file: Path, code: CodeType) -> None:
        self.name, self.file, self.code = name, file, code

    def find_spec(
        self, name: str, _path: object, _target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Know that module alone."""
        if name != self.name:
            return None
        return importlib.util.spec_from_file_location(name, self.file, loader=self)

    def create_module(self, _spec: object) -> None:
        """Leave it to Python."""

    def exec_module(self, module: Any) -> None:
        """Run the other code."""
        exec(self.code, module.__dict__)  # noqa: S102  our own code but for an operator


def attempt(mutant: Mutant | None, file: Path, tests: Sequence[str], seconds: float) -> str:
    """Run tests in a forked process; return ``passed``, ``failed`` or ``late``."""
    context = multiprocessing.get_context("fork")
    process = context.Process(target=_run, args=(mutant, file, list(tests)))
    process.start()
    process.join(seconds)
    if process.is_alive():
        process.kill()
        process.join()
        return "late"
    return "passed" if process.exitcode == 0 else "failed"


def _run(mutant: Mutant | None, file: Path, tests: list[str]) -> None:
    os.setpgrp()
    if mutant is not None:
        tree = flipped(file.read_text("utf-8"), mutant.flip)
        code = compile(ast.fix_missing_locations(tree), str(file), "exec")
        sys.meta_path.insert(0, _Mutated(mutant.module, file, code))
    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not many",
               "-W", "ignore::pytest.PytestAssertRewriteWarning"]  # fmt: skip
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        ended = int(pytest.main([*options, *tests]))
    os._exit(0 if ended in {0, 5} else 1)


def sampled(seed: int, only: str) -> Iterator[tuple[str, Path, list[Mutant]]]:
    """Yield modules in an order that the seed chooses, each with its mutants in such an order."""
    rng = random.Random(seed)  # noqa: S311  no secret
    modules = [(name, file) for name, file in candidates().items() if only in name]
    if only == _QUICK:
        modules = [item for item in candidates().items() if not item[0].startswith(SLOW)]
    rng.shuffle(modules)
    for name, file in modules:
        mutants = [Mutant(name, flip) for flip in flips_of(file.read_text("utf-8"))]
        rng.shuffle(mutants)
        if mutants:
            yield name, file, mutants


def main() -> int:
    """Print each mutant that survives, and the share that was killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after so long")
    parser.add_argument("--each", type=int, default=10**6, help="mutants of a module, at most")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="part of the names of modules, or quick")
    parser.add_argument("--least", type=float, default=0.8, help="share that has to be killed")
    options = parser.parse_args()
    for name in LIBRARIES:
        importlib.import_module(name)
    until = time.monotonic() + 60 * options.minutes
    counts: Counter[str] = Counter()
    for name, file, mutants in sampled(options.seed, options.only):
        if time.monotonic() > until:
            break
        tests = tests_of(name)
        begun = time.monotonic()
        if attempt(None, file, tests, SLOWEST_S) != "passed":
            print(f"{name}: left out, its tests do not pass without a mutant in {SLOWEST_S:g} s")
            continue
        allowed = 20 + 4 * (time.monotonic() - begun)
        for mutant in mutants[: options.each]:
            if time.monotonic() > until:
                break
            ended = attempt(mutant, file, tests, allowed)
            counts[ended] += 1
            if ended == "passed":
                where = file.relative_to(ROOT)
                print(f"survived: {where}:{mutant.flip.line}: {mutant.flip.what}", flush=True)
    total = counts.total()
    killed = total - counts["passed"]
    share = killed / total if total else 1.0
    print(f"{killed} of {total} mutants killed, {share:.0%} (seed {options.seed})")
    return int(share < options.least)


if __name__ == "__main__":
    sys.exit(main())
