"""Tests of the warnings about causes of lost tracks and wrong categories."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import Result

from shapecat.config import Settings
from shapecat.runs.perceive import doubts
from tests.run_info import run_info
from tests.scenes import record


@pytest.mark.parametrize("fixed_frame", ["map", None])
@pytest.mark.parametrize("color", [{}, {"/depth": "/color"}])
def test_every_doubt_is_looked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, fixed_frame: str | None, color: dict[str, str]
) -> None:
    """Without a fixed frame, there are no poses to doubt, and sensors are tracked separately."""
    of_poses = ["explain_jumps", "explain_misplacement", "explain_clocks"]
    of_colour = ["explain_colour_offsets"]
    for name in ("explain_missing_planes", *of_colour, *of_poses):
        monkeypatch.setattr(doubts, name, lambda *_, name=name: iter([name]))
    run = run_info(fixed_frame=fixed_frame, color=color, settings=Settings().as_dict())
    recording: Any = None
    found = list(doubts.explain_doubts(recording, tmp_path, run))

    of_run = (of_colour if color else []) + (of_poses if fixed_frame else [])
    assert found == ["explain_missing_planes", *of_run]


def test_changed_surfaces_are_reported_once(
    shapecat: Callable[..., Result], tmp_path: Path
) -> None:
    """Models are trained with default surfaces: with others, categories are wrong."""
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
