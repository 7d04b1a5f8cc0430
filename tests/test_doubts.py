"""Tests of the warning about surfaces made with other settings than those of training."""

import json
from collections.abc import Callable
from pathlib import Path

from click.testing import Result

from tests.scenes import record


def test_changed_surfaces_are_reported_once(
    shapecat: Callable[..., Result], tmp_path: Path
) -> None:
    """A model knows no others: categories were wrong, and nothing said why."""
    path = record(tmp_path / "lab.mcap", 2)
    wanted = (
        "changed surface.neurons, surface.smooth_radius_m: every model is trained with the "
        "defaults, so categories may be wrong, and more objects unknown"
    )
    plain = ("process", path, "--no-mcap", "--no-rrd", "--set", "tracking.min_hits=2")
    changed = ("--set", "surface.neurons=60", "--set", "surface.smooth_radius_m=0.015")
    default = shapecat(*plain, "--set", "surface.neurons=80", "--out", tmp_path / "default")
    other = shapecat(*plain, *changed, "--out", tmp_path / "other")

    assert "every model" not in default.stderr
    assert " ".join(other.stderr.split()).count(wanted) == 1
    for name, warnings in (("default", []), ("other", [wanted])):
        run = json.loads((tmp_path / name / "lab" / "run.json").read_text())
        assert run["warnings"] == warnings
