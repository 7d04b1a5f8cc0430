"""The tests of a module in a forked process, with or without a mutant of that module."""

import ast
import importlib.abc
import importlib.machinery
import importlib.util
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import pytest
from coverage import Coverage

from tests.mutations.flips import Flip, flipped

__all__ = ["ROOT", "Mutant", "Reached", "attempt", "reach"]

ROOT = Path(__file__).parents[2]
SLOWEST_S = 900.0
"""Maximum duration of a test file without a mutant."""

_FORK = multiprocessing.get_context("fork")


class Mutant(NamedTuple):
    """A flip in a module."""

    module: str
    file: Path
    flip: Flip


class Reached(NamedTuple):
    """The tests of a file that reach each line, by path and line, and the seconds all of them took.

    An empty name stands for what runs before the first test, when modules are imported.
    """

    tests: Mapping[str, Mapping[int, Sequence[str]]]
    seconds: float

    def by(self, mutant: Mutant) -> Sequence[str]:
        """Return the tests that reach a mutant."""
        return self.tests.get(str(mutant.file), {}).get(mutant.flip.line, ())


def reach(test: Path) -> Reached | None:
    """Run a test file; return what its tests reach, or None if one fails."""
    answer, question = _FORK.Pipe(duplex=False)
    begun = time.monotonic()
    process = _FORK.Process(target=_trace, args=(test, question))
    process.start()
    question.close()
    try:
        tests = answer.recv() if answer.poll(SLOWEST_S) else {}
    except EOFError:
        tests = {}
    passed = _exit_code(process, seconds=60.0) == 0
    return Reached(tests, time.monotonic() - begun) if passed else None


def attempt(mutant: Mutant, tests: Sequence[Path], first: Sequence[str], seconds: float) -> str:
    """Run test files with a mutant, beginning with ``first``; return ``survived`` or its killer.

    ``failed``: a test failed; ``broken``: a test file could not be imported; ``late``: the tests
    took longer than ``seconds``.
    """
    process = _FORK.Process(target=_judge, args=(mutant, tests, set(first)))
    process.start()
    return {0: "survived", 1: "failed", None: "late"}.get(_exit_code(process, seconds), "broken")


def _exit_code(process: BaseProcess, seconds: float) -> int | None:
    """Return the exit code of a process, None if it had to be killed."""
    process.join(seconds)
    late = process.is_alive()
    if late:
        os.killpg(process.pid or 0, signal.SIGKILL)
    process.join()
    return None if late else process.exitcode


def _trace(test: Path, answer: Connection) -> None:
    os.setpgrp()
    source = [str(ROOT / "shapecat"), str(ROOT / "cli")]
    coverage = Coverage(data_file=None, config_file=False, source=source)
    with coverage.collect():
        ended = _tested([test], _Contexts(coverage))
    data = coverage.get_data()
    answer.send({file: data.contexts_by_lineno(file) for file in data.measured_files()})
    answer.close()
    os._exit(ended)


def _judge(mutant: Mutant, tests: Sequence[Path], first: set[str]) -> None:
    os.setpgrp()
    tree = flipped(mutant.file.read_text("utf-8"), mutant.flip)
    code = compile(ast.fix_missing_locations(tree), str(mutant.file), "exec")
    finder = _Mutated(mutant.module, mutant.file, code)
    sys.meta_path.insert(0, finder)
    os._exit(_tested(tests, _Order(first), finder))


def _tested(tests: Sequence[Path], *plugins: object) -> int:
    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-m", "not many",
               "-W", "ignore::pytest.PytestAssertRewriteWarning"]  # fmt: skip
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        return int(pytest.main([*options, *map(str, tests)], plugins=plugins))


class _Contexts:
    """Tells the tracer which test is running."""

    def __init__(self, coverage: Coverage) -> None:
        self.coverage = coverage

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.coverage.switch_context(nodeid)


class _Order:
    """Runs some tests first."""

    def __init__(self, first: set[str]) -> None:
        self.first = first

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: item.nodeid not in self.first)


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Replaces the code of one module."""

    def __init__(self, name: str, file: Path, code: CodeType) -> None:
        self.name, self.file, self.code = name, file, code

    def pytest_sessionstart(self) -> None:
        """Come before pytest's import hook, which would load the modules that have doctests."""
        sys.meta_path.insert(0, self)

    def find_spec(
        self, name: str, _path: object, _target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Find only the mutated module."""
        if name != self.name:
            return None
        return importlib.util.spec_from_file_location(name, self.file, loader=self)

    def create_module(self, _spec: object) -> None:
        """Use the default."""

    def exec_module(self, module: Any) -> None:
        """Run the mutated code."""
        exec(self.code, module.__dict__)  # noqa: S102  our own code but for an operator
