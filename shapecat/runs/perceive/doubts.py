"""Find what may cost a run its tracks: missing planes, wrong poses, clocks that differ."""

from collections.abc import Iterator
from pathlib import Path

from shapecat.recordings import Recording
from shapecat.runs.perceive.clocks import explain_clocks
from shapecat.runs.perceive.misplacement import explain_misplacement
from shapecat.runs.perceive.missing_planes import explain_missing_planes
from shapecat.runs.perceive.pose_jumps import explain_jumps
from shapecat.runs.run_info import RunInfo

__all__ = ["explain_doubts"]


def explain_doubts(recording: Recording, folder: Path, run: RunInfo) -> Iterator[str]:
    """Yield a warning for each thing that may cost the run tracks.

    Parameters
    ----------
    folder : with the tables of the perceived frames.
    """
    yield from explain_missing_planes(recording, folder, run)
    fixed_frame = run["fixed_frame"]
    if fixed_frame is not None:
        yield from explain_jumps(folder, fixed_frame)
        yield from explain_misplacement(folder, fixed_frame)
        yield from explain_clocks(folder)
