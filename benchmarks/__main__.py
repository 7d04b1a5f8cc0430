"""Measure the stages, print Markdown tables and write ``build/benchmarks.json``."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"  # one thread; set before the libraries read it

from collections.abc import Callable  # noqa: E402  the environment comes first
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

from benchmarks import ablation, detection, stages  # noqa: E402
from benchmarks.measure import machine, save  # noqa: E402


def main() -> None:
    """Run all benchmarks."""
    print("# Benchmarks\n\n" + ", ".join(machine().values()) + "\n")
    results = {}
    works: dict[str, Callable[[], tuple[str, dict[str, Any]]]] = {
        "detection": lambda: detection.run(15),
        "ablation": lambda: ablation.run(30),
        "stages": lambda: stages.run(8),
    }
    for name, work in works.items():
        table, figures = work()
        print(table)
        results[name] = figures
    save(Path("build/benchmarks.json"), results)


main()
