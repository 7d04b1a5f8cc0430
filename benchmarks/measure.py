"""Measuring and printing: process CPU time on one thread, the best of several runs."""

import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np


def cpu_ms(work: Callable[[], Any], repeats: int = 5) -> float:
    """Return the least CPU time of ``work`` in milliseconds, after one warm-up run."""
    work()
    best = float("inf")
    for _ in range(repeats):
        begun = time.process_time_ns()
        work()
        best = min(best, (time.process_time_ns() - begun) * 1e-6)
    return best


def summary(values: Sequence[float]) -> dict[str, float]:
    """Return the median, 95th percentile and maximum of values."""
    return {
        "median": round(float(np.median(values)), 3),
        "p95": round(float(np.percentile(values, 95)), 3),
        "max": round(float(np.max(values)), 3),
    }


def markdown(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a Markdown table."""
    lines = [f"## {title}", "", f"| {' | '.join(columns)} |", f"|{'---|' * len(columns)}"]
    lines += [f"| {' | '.join(str(cell) for cell in row)} |" for row in rows]
    return "\n".join([*lines, ""])


def machine() -> str:
    """Return the processor and the Python version of this machine."""
    model = next(
        (
            line.split(":")[1].strip()
            for line in Path("/proc/cpuinfo").read_text("utf-8").splitlines()
            if line.startswith("model name")
        ),
        platform.processor(),
    )
    return f"{model}, Python {platform.python_version()}"
