"""Warn if the clocks of sensors and transforms differ: their computers are not synchronized."""

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from shapecat.recordings.transforms.buffer import TransformBuffer
from shapecat.runs.tables.reading import numbers, read_by_topic

__all__ = ["explain_clocks", "explain_transform_clocks"]

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


def explain_transform_clocks(
    folder: Path, transforms: TransformBuffer, fixed_frame: str, frame_ids: Mapping[str, str]
) -> Iterator[str]:
    """Yield a warning for each sensor whose clock differs from that of its moving transforms.

    The delays of images and transforms are compared at the same log times, since a simulation may
    be slower than the recorder's clock. If several transforms move the sensor, the most similar
    delay counts: localization may stamp its transforms with a time in the future. Topics and
    transforms without stamps are not compared.

    Parameters
    ----------
    folder : folder with the table of frames.
    transforms : the transforms, after all frames were looked up.
    fixed_frame : the frame in which the sensors move.
    frame_ids : the coordinate frame of each topic's data.
    """
    times = ["stamp_ns", "log_time_ns"]
    logs = read_by_topic(
        folder, times, lambda frames: np.column_stack([numbers(frames[name]) for name in times])
    )
    for topic, (stamps, log_times) in ((topic, both.T) for topic, both in logs.items()):
        delays, frame_id = log_times - stamps, frame_ids[topic]
        clocks = transforms.delays_between(fixed_frame, frame_id)
        clocks = [clock for clock in clocks if not clock.all_zero]
        if not clocks or not delays.any():  # without stamps, log times replace them
            continue
        behind = [float(np.median(delays - clock.at(log_times))) * 1e-9 for clock in clocks]
        behind_s = min(behind, key=abs)
        if abs(behind_s) > _DIFFERENT_S:
            side = "behind" if behind_s > 0 else "ahead of"
            yield (
                f"the clock of {topic} is {abs(behind_s):.2f} s {side} that of the transforms, by "
                "their log times: poses of its sensor are wrong or unknown; synchronize the clocks "
                f"of the computers; --fixed-frame {frame_id} processes this recording without poses"
            )
