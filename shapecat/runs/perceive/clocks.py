"""Warn if the clocks of two sensors differ, since their computers are not synchronized."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from shapecat.runs.tables.reading import numbers, read_by_topic

__all__ = ["explain_clocks"]

_DIFFERENT_S = 0.3
"""Smallest difference of two clocks that causes a warning. Drivers' delays differ by less."""


def explain_clocks(folder: Path) -> Iterator[str]:
    """Yield a warning if the sensors of a run have different clocks.

    The log times of all images are from one clock, that of the recorder. If the clocks of the
    sensors agree, all images have about the same delay from stamp to log time. A difference matters
    only to sensors that are tracked together.

    Parameters
    ----------
    folder : folder with the table of frames.
    """
    delays = read_by_topic(
        folder,
        ["stamp_ns", "log_time_ns"],
        lambda frames: numbers(frames["log_time_ns"]) - numbers(frames["stamp_ns"]),
    )
    delays_s = {topic: float(np.median(delay)) * 1e-9 for topic, delay in delays.items()}
    first, last = min(delays_s, key=delays_s.__getitem__), max(delays_s, key=delays_s.__getitem__)
    ahead_s = delays_s[last] - delays_s[first]
    if ahead_s > _DIFFERENT_S:
        yield (
            f"the clock of {first} is {ahead_s:.2f} s ahead of that of {last}, by their log times: "
            "poses of a moving sensor are wrong, and a moving object gets two tracks; synchronize "
            "the clocks of the computers"
        )
