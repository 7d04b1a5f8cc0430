"""Tests that the documented commands work, in order, in an empty folder."""

import os
import re
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result

DOCS = Path(__file__).parents[1] / "docs"
PAGES = {
    "tutorial.md": {"results/kitchen/report.html", "crops", "results/manifest.jsonl"},
    "howto-labelling.md": {
        "results/lab/report.html",
        "mine.npz",
        "page.html",
        "again/lab/annotated.mcap",
        "kitti/lab/label_2",
        "coco/images/train",
        "yolo/data.yaml",
    },
    "howto-bag.md": {"results/robot/tracks.csv", "far/robot/run.json"},
    "howto-cluster.md": {
        "results/monday/run.json",
        "results/tuesday/run.json",
        "shards/monday/run.json",  # the first of four
        "dask/monday/run.json",
        "dask/tuesday/run.json",
        "ray/monday/run.json",
        "ray/tuesday/run.json",
        "stored/monday/run.json",
    },
}

_ENDS_JOBS = "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT"


def commands(page: str) -> list[str]:
    """Return the lines that a reader would type: the shell blocks, without installing packages."""
    text = (DOCS / page).read_text("utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    return [line for line in "".join(blocks).splitlines() if not line.startswith("pip ")]


def run_in_shell(lines: list[str], folder: Path) -> None:
    """Run lines in one shell in a folder, with the installed command."""
    programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euc", "\n".join([_ENDS_JOBS, *lines])],
        cwd=folder,
        env={**os.environ, "PATH": programs},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def run_here(line: str, shapecat: Callable[..., Result]) -> None:
    """Run a line in this process, where libraries load once, or in a shell if it needs one.

    Recordings are processed in this process too: `test_batch` and `test_executors` start others.
    """
    line = re.sub(r"--jobs \d+", "--jobs 1", line)
    if not line.startswith("shapecat ") or set(line) & set("$|<>&;*?\\"):
        run_in_shell([line], Path())
        return
    done = shapecat(*shlex.split(line)[1:])
    assert done.exit_code == 0, f"{line}\n{done.output}"


@pytest.mark.many  # `test_docs` checks that their commands and options exist
@pytest.mark.slow
@pytest.mark.parametrize("page", ["howto-bag.md", "tutorial.md", "howto-labelling.md"])
def test_documented_commands_work(
    page: str,
    shapecat: Callable[..., Result],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Learning takes a few steps only: the accuracy of the model does not matter here."""
    monkeypatch.setattr("shapecat.learning.incremental._STEPS", 2)
    monkeypatch.setattr("shapecat.learning.incremental._FEW_STEPS", 1)
    monkeypatch.chdir(tmp_path)
    for line in commands(page):
        run_here(line, shapecat)

    assert [name for name in PAGES[page] if not (tmp_path / name).exists()] == []


@pytest.mark.many
@pytest.mark.parametrize("page", ["tutorial.md", "howto-cluster.md"])
def test_documented_commands_work_in_a_shell(page: str, tmp_path: Path) -> None:
    """Starting processes, Dask and Ray takes a minute."""
    with socket.socket() as probe:  # the page's port may be taken
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    run_in_shell([line.replace("8786", str(port)) for line in commands(page)], tmp_path)

    assert [name for name in PAGES[page] if not (tmp_path / name).exists()] == []
