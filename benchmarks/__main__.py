"""Measure the stages, print Markdown tables, write ``build/benchmarks.json``."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"  # before the libraries read it: everything is measured on one thread

from pathlib import Path  # noqa: E402  the environment comes first

from benchmarks import detection, stages  # noqa: E402
from benchmarks.measure import machine, save  # noqa: E402


def main() -> None:
    """Run all benchmarks."""
    print("# Benchmarks\n\n" + ", ".join(machine().values()) + "\n")
    results = {}
    for name, (table, figures) in (("detection", detection.run(15)), ("stages", stages.run(8))):
        print(table)
        results[name] = figures
    save(Path("build/benchmarks.json"), results)


main()
