"""Benchmark detection, its ablation, and the stages; print Markdown tables."""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"  # one thread; set before the libraries read it

from benchmarks import ablation, detection, stages  # noqa: E402  the environment comes first
from benchmarks.measure import machine  # noqa: E402


def main() -> None:
    """Run the benchmarks."""
    print(f"# Benchmarks\n\n{machine()}\n")
    print(detection.run(15))
    print(ablation.run(30))
    print(stages.run(8))


main()
