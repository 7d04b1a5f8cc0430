"""Tests of the wheel in an environment with only the runtime dependencies."""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import distribution, requires
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def run(*command: object, **options: object) -> subprocess.CompletedProcess[str]:
    done = subprocess.run(  # type: ignore[call-overload]  # the options are passed through
        list(map(str, command)), capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the wheel from a copy of the needed folders."""
    out = tmp_path_factory.mktemp("wheel")
    source = out / "source"
    source.mkdir()
    for name in ("shapecat", "cli", "schemas", "pyproject.toml", "README.md", "LICENSE"):
        run("cp", "-r", ROOT / name, source)
    code = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    run(sys.executable, "-c", code, out, cwd=source)  # as pip does, without a network
    return next(out.glob("*.whl"))


def runtime_distributions() -> set[str]:
    """Return the names of the distributions that shapecat needs, directly or not."""
    found: set[str] = set()
    queue = ["shapecat"]
    while queue:
        name = re.sub(r"[-_.]+", "-", queue.pop()).lower()
        if name in found:
            continue
        found.add(name)
        try:
            needed = requires(name) or []
        except ImportError:
            continue
        # Users need not install the extras.
        queue += [re.split(r"[\s;<>=!~\[(]", n)[0] for n in needed if "extra ==" not in n]
    return found


@pytest.fixture(scope="module")
def bare(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make an environment with the wheel and only the runtime dependencies."""
    env = tmp_path_factory.mktemp("bare") / "env"
    run(sys.executable, "-m", "venv", "--without-pip", env)
    site = next(env.glob("lib/python3*/site-packages"))
    for name in runtime_distributions() - {"shapecat"}:
        try:
            files = distribution(name).files or []
        except ImportError:
            continue
        for top in {Path(f).parts[0] for f in files if not str(f).startswith("..")}:
            target = Path(str(distribution(name).locate_file(top)))
            if target.exists() and not (site / top).exists():
                (site / top).symlink_to(target)
    pip = Path(str(distribution("pip").locate_file("pip")))  # as `pip --python` does, once
    options = ("-q", "--no-deps", "--no-compile", "--disable-pip-version-check")
    run(env / "bin" / "python", pip, "install", *options, wheel)
    _copy_compiled_kernels(site / "shapecat")
    return env


def _copy_compiled_kernels(package: Path) -> None:
    """Copy the kernels compiled here: compiling them again takes minutes."""
    for kept in (ROOT / "shapecat").rglob("__pycache__/kernels-*"):
        here = kept.parent.parent
        stage = package / here.relative_to(ROOT / "shapecat")
        target = stage / "__pycache__" / kept.name
        shutil.copytree(kept, target)
        for sources in (here, *here.rglob("*/")):
            if (target / _numba_name(sources)).exists():
                name = _numba_name(stage / sources.relative_to(here))
                (target / _numba_name(sources)).rename(target / name)


def _numba_name(sources: Path) -> str:
    """Return numba's name for the cache folder of a folder of sources."""
    return (
        f"{sources.name}_{hashlib.sha1(str(sources).encode(), usedforsecurity=False).hexdigest()}"
    )


def test_wheel_installs_one_top_level_package(wheel: Path) -> None:
    """Folders cli and schemas must not shadow other packages."""
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()

    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"shapecat"}
    assert "shapecat/cli/main.py" in names
    assert "shapecat/models/default.npz" in names
    assert "shapecat/py.typed" in names
    assert any(name.startswith("shapecat/schemas/") and name.endswith(".msg") for name in names)


JOB = """
import sys
from importlib.util import find_spec
from shapecat.__main__ import run

assert find_spec("pytest") is None
for words in ("simulate s.mcap --frames 2", "process s.mcap --out out --jobs 1"):
    sys.argv = ["shapecat", *words.split()]
    try:
        run()
    except SystemExit as end:
        assert not end.code, words
"""
"""Two commands in one process, since loading libraries takes longer than either."""


@pytest.mark.many
def test_wheel_simulates_and_processes_a_recording(bare: Path, tmp_path: Path) -> None:
    """An import of a development dependency would fail only for users."""
    environment = {**os.environ, "PYTHONPATH": "", "PYTHONDONTWRITEBYTECODE": "1"}
    options = {"cwd": tmp_path, "env": environment}
    version = run(bare / "bin" / "shapecat", "--version", **options).stdout
    run(bare / "bin" / "python", "-c", JOB, **options)

    assert "shapecat" in version

    names = {path.name for path in (tmp_path / "out" / "s").iterdir()}
    assert {"run.json", "tracks.csv", "annotated.mcap", "review.rrd"} <= names


def test_lock_file_covers_every_dependency() -> None:
    """`make setup` installs only what the lock file lists."""
    locked = set(
        re.findall(r"^([a-z0-9-]+)==", (ROOT / "requirements.lock").read_text(), re.MULTILINE)
    )
    declared = [n for n in requires("shapecat") or [] if "extra ==" not in n]
    needed = {re.split(r"[\s;<>=!~\[(]", n)[0].lower() for n in declared}

    assert needed <= locked


def test_only_versions_of_arrow_that_work_are_allowed() -> None:
    """Up to version 25, Arrow converts types with pandas; `process`, which blocks it, failed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (least,) = (n for n in project["dependencies"] if n.startswith("pyarrow>="))
    assert int(least.removeprefix("pyarrow>=").partition(".")[0]) >= 26
