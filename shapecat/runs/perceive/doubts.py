"""Warn about problems that may lead to missing tracks, wrong categories or displaced masks.

These are missing planes, wrong poses, different clocks, colour images far in time from their depth
images, and surface settings that differ from those of training.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from shapecat.config import SurfaceSettings
from shapecat.recordings import Recording
from shapecat.runs.perceive.clocks import explain_clocks
from shapecat.runs.perceive.colour_offsets import explain_colour_offsets
from shapecat.runs.perceive.misplacement import explain_misplacement
from shapecat.runs.perceive.missing_planes import explain_missing_planes
from shapecat.runs.perceive.pose_jumps import explain_jumps
from shapecat.runs.run_info import RunInfo

__all__ = ["explain_doubts"]


def explain_doubts(recording: Recording, folder: Path, run: RunInfo) -> Iterator[str]:
    """Yield a warning for each problem that may spoil tracks, categories or masks.

    Parameters
    ----------
    folder : folder with the tables of the perceived frames.
    """
    yield from _explain_surfaces(run["settings"]["surface"])
    yield from explain_missing_planes(recording, folder, run)
    if run["color"]:
        yield from explain_colour_offsets(folder)
    fixed_frame = run["fixed_frame"]
    if fixed_frame is not None:
        yield from explain_jumps(folder, fixed_frame)
        yield from explain_misplacement(folder, fixed_frame)
        yield from explain_clocks(folder)


def _explain_surfaces(settings: Mapping[str, Any]) -> Iterator[str]:
    """Yield a warning if surface settings differ from the defaults, which all models assume."""
    changed = [
        f"surface.{name}"
        for name, value in asdict(SurfaceSettings()).items()
        if settings[name] != value
    ]
    if changed:
        yield (
            f"changed {', '.join(changed)}: every model is trained with the defaults, so "
            "categories may be wrong, and more objects unknown"
        )
