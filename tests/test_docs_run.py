"""The commands of the pages work as printed, in order, in an empty folder."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

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

_STARTS_CLUSTERS = {"howto-cluster.md"}
"""Starting Dask and Ray from the shell takes a minute; `test_executors` runs on both."""


def script(page: str) -> str:
    """Return what a reader would type: the shell blocks, without installing packages."""
    text = (DOCS / page).read_text("utf-8")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line for line in "".join(blocks).splitlines() if not line.startswith("pip ")]
    return "\n".join(["set -eu", "trap 'kill $(jobs -p) 2>/dev/null || true' EXIT", *lines])


def run_script(text: str, folder: Path) -> None:
    """Run what a reader would type in a folder, with the installed command."""
    programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-c", text],
        cwd=folder,
        env={**os.environ, "PATH": programs},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [pytest.param(p, marks=pytest.mark.many if p in _STARTS_CLUSTERS else ()) for p in PAGES],
)
def test_page_works_as_printed(page: str, tmp_path: Path) -> None:
    run_script(script(page), tmp_path)

    assert [name for name in PAGES[page] if not (tmp_path / name).exists()] == []
