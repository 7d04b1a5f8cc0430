"""Disturb the command at random and print the outcomes: ``python -m tests.faults --count 50``."""

import argparse
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path

from tests.faults.cases import FaultRunner, SkippedError, Verdict
from tests.faults.injection import KINDS
from tests.faults.scenarios import SCENARIOS

GROUPS = {"disk": ("enospc", "tmpfs", "erofs"), "io": ("eio", "eioread", "short"), "all": KINDS}


def main(words: list[str] | None = None) -> int:
    """Run the cases; return 1 if an invariant failed, or no case was judged."""
    options = _parse(words)
    scenarios = tuple(s for s in SCENARIOS if options.jobs in {None, s.jobs} or s.name == "single")
    with tempfile.TemporaryDirectory(prefix="shapecat-faults-") as store:
        until = time.monotonic() + 60 * options.minutes
        runner = FaultRunner(Path(store), scenarios)
        print(f"undisturbed runs done, {len(scenarios)} scenarios", flush=True)
        with ThreadPoolExecutor(options.at_once) as pool:
            judged = pool.map(lambda case: _judge(runner, case, until), _cases(options))
            verdicts = [*judged]
    return _print(verdicts)


def _parse(words: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m tests.faults", description=__doc__)
    parser.add_argument("--count", type=int, default=50, help="number of cases")
    parser.add_argument("--seed", type=int, default=0, help="the seed of the first case")
    parser.add_argument("--kind", choices=[*KINDS, *GROUPS], default="all")
    parser.add_argument(
        "--jobs", type=int, choices=[1, 2], help="only scenarios with this number of jobs"
    )
    parser.add_argument("--at-once", type=int, default=2, help="number of cases at the same time")
    parser.add_argument(
        "--minutes", type=float, default=15.0, help="begin no case after this number of minutes"
    )
    parser.add_argument("--only", type=int, metavar="SEED", help="one case of --kind")
    return parser.parse_args(words)


def _cases(options: argparse.Namespace) -> Iterator[tuple[str, int]]:
    kinds = GROUPS.get(options.kind, (options.kind,))
    if options.only is not None:
        return iter([(kind, options.only) for kind in kinds])
    seeds = range(options.seed, options.seed + options.count)
    return islice(((kind, seed) for seed in seeds for kind in kinds), options.count)


def _judge(runner: FaultRunner, case: tuple[str, int], until: float) -> Verdict | str:
    """Judge a case; return the reason if it is skipped."""
    if time.monotonic() > until:
        return "no time left"
    try:
        verdict = runner.judge(*case)
    except SkippedError as error:
        return f"{case[0]}: {error}"
    if verdict.violations:
        print(_describe(verdict), flush=True)
    return verdict


def _describe(verdict: Verdict) -> str:
    moment = "" if verdict.fault_s is None else f" at {verdict.fault_s:.2f} s"
    head = f"{verdict.kind} --only {verdict.seed} ({verdict.scenario}){moment}: exit {verdict.code}"
    lines = [line for line in verdict.stderr.splitlines() if not line.startswith('{"event": "prog')]
    return "\n    ".join([head, *verdict.violations, "stderr:", *lines[-6:]])


def _print(results: list[Verdict | str]) -> int:
    verdicts = [result for result in results if isinstance(result, Verdict)]
    tries = Counter(verdict.kind for verdict in verdicts)
    failed: dict[str, list[int]] = defaultdict(list)
    for verdict in verdicts:
        if verdict.violations:
            failed[verdict.kind].append(verdict.seed)
    print(f"\n{'kind':<12}{'tries':>6}{'held':>6}  failed seeds")
    for kind, count in tries.items():
        seeds = " ".join(map(str, failed[kind]))
        print(f"{kind:<12}{count:>6}{count - len(failed[kind]):>6}  {seeds}")
    for reason, count in Counter(r for r in results if isinstance(r, str)).items():
        print(f"skipped {count}: {reason}")
    return int(any(failed.values()) or not verdicts)


if __name__ == "__main__":
    sys.exit(main())
