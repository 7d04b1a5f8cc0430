"""One case: a scenario, a fault drawn from a seed, checks, the same command again, checks."""

import random
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tests.faults import injection, invariants
from tests.faults.injection import COUNTERS, Ended, Running
from tests.faults.scenarios import SCENARIOS, Scenario, record_all

_FIRST_S = 900.0
"""Limit for an undisturbed run: the first one of an installation compiles kernels."""


class SkippedError(Exception):
    """A fault that cannot be injected on this machine."""


@dataclass(frozen=True)
class Verdict:
    """A case: violated invariants, and exit code and stderr of the disturbed command.

    ``fault_s`` is the time of the fault, seconds after the start, if it was set in advance.
    """

    kind: str
    seed: int
    scenario: str
    violations: tuple[str, ...]
    code: int
    fault_s: float | None
    stderr: str


@dataclass(frozen=True)
class _Reference:
    case: Path
    seconds: float
    calls: tuple[int, ...]


class FaultRunner:
    """Keeps the recordings and one undisturbed run of each scenario."""

    def __init__(self, store: Path, scenarios: tuple[Scenario, ...] = SCENARIOS) -> None:
        """Simulate the recordings and run the scenarios undisturbed; the first is `single`."""
        self.store, self.scenarios = store, scenarios
        store.mkdir(parents=True, exist_ok=True)
        record_all(store, {name for s in scenarios for name in s.recordings} | {"other.mcap"})
        self.shim = injection.build_shim(store)
        first = {s.name: self._undisturbed(s) for s in scenarios[:1]}
        with ThreadPoolExecutor(2) as pool:
            others = [*pool.map(self._undisturbed, scenarios[1:])]
        self.references = first | {s.name: r for s, r in zip(scenarios[1:], others, strict=True)}

    def _undisturbed(self, scenario: Scenario) -> _Reference:
        case = self.store / "reference" / scenario.name.replace(" ", "_")
        scenario.prepare(self.store, case)
        shim = self.shim and injection.shimmed(self.shim, "count", 0, case)
        ended = Running(scenario.command(case), shim or {}).end(limit_s=_FIRST_S)
        if ended.code:
            msg = f"{scenario.name} fails undisturbed: {ended.text}"
            raise RuntimeError(msg)
        counts = case.with_name(f"{case.name}.counts")
        raw = counts.read_bytes() if shim else bytes(24)
        calls = tuple(int.from_bytes(raw[i : i + 8], "little") for i in (0, 8, 16))
        return _Reference(case, ended.seconds, calls)

    def draw(self, kind: str, rng: random.Random) -> Scenario:
        """Choose a scenario in which a fault of this kind can happen; else raise `SkippedError`."""
        fitting = [s for s in self.scenarios if _fits(kind, s)]
        if not fitting:
            msg = f"no scenario for {kind}"
            raise SkippedError(msg)
        return rng.choice(fitting)

    def judge(self, kind: str, seed: int) -> Verdict:
        """Run a case, check it, run the command again, check that; may raise `SkippedError`."""
        rng = random.Random(f"{kind} {seed}")  # noqa: S311  draws moments, no secrets
        scenario = self.draw(kind, rng)
        case = self.store / "cases" / f"{kind}-{seed}-{time.monotonic_ns()}"
        try:
            scenario.prepare(self.store, case)
            ended = self._disturbed(kind, rng, scenario, case)
            violations = [*self._after_fault(kind, scenario, ended, case)]
            self._restore(kind, scenario, case)
            violations += self._again(kind, scenario, ended, case)
        finally:
            injection.unmount(case / "out")
            shutil.rmtree(case, ignore_errors=True)
        return Verdict(
            kind, seed, scenario.name, tuple(violations), ended.code, ended.fault_s, ended.text
        )

    def _disturbed(self, kind: str, rng: random.Random, scenario: Scenario, case: Path) -> Ended:
        reference, command = self.references[scenario.name], scenario.command(case)
        if kind in COUNTERS:
            if self.shim is None:
                msg = "no C compiler"
                raise SkippedError(msg)
            nth = rng.randint(1, max(1, reference.calls[COUNTERS[kind]]))
            return Running(command, injection.shimmed(self.shim, kind, nth, case)).end()
        if kind == "tmpfs":
            if not injection.mount(case / "out", rng.randint(1, 20)):
                msg = "mounting is not permitted"
                raise SkippedError(msg)
            return Running(command).end()
        if kind == "replace":
            path = case / "in" / scenario.recordings[0]
            other = self.store / "other.mcap"
            return injection.replace_input(rng, command, reference.seconds, path, other)
        return injection.disturb(kind, rng, command, reference.seconds)

    def _after_fault(self, kind: str, scenario: Scenario, ended: Ended, case: Path) -> list[str]:
        violations = [*invariants.ended_well(kind, ended)]
        violations += invariants.complete_outputs(scenario, case / "out")
        if kind != "replace":
            violations += invariants.nothing_lost(scenario, ended, case / "out")
        if scenario.verb == "export":
            reference = self.references[scenario.name].case / "crops"
            done = ended.code == 0
            violations += invariants.same_files(case / "crops", reference, all_there=done)
        if ended.code == 0 and kind != "replace":
            violations += self._compared(scenario, case)
        return violations

    def _compared(self, scenario: Scenario, case: Path) -> list[str]:
        reference = self.references[scenario.name].case
        violations = [*invariants.same_results(scenario.runs, case / "out", reference / "out")]
        if scenario.verb == "export":
            violations += invariants.same_files(case / "crops", reference / "crops", all_there=True)
        return violations

    def _restore(self, kind: str, scenario: Scenario, case: Path) -> None:
        if kind == "tmpfs":
            injection.enlarge(case / "out")
        if kind == "replace":
            name = scenario.recordings[0]
            (case / "in" / name).unlink(missing_ok=True)
            (case / "in" / name).hardlink_to(self.store / name)

    def _again(self, kind: str, scenario: Scenario, ended: Ended, case: Path) -> list[str]:
        """Run the command again and return what is wrong; overwrite results of a replaced input."""
        options = ("--overwrite",) if kind == "replace" and ended.code == 0 else ()
        again = Running(scenario.command(case, *options)).end()
        violations = [f"exit code {again.code}: {again.text[-300:]}"] if again.code else []
        violations += invariants.complete_outputs(scenario, case / "out")
        violations += invariants.nothing_hidden(case)
        violations += self._compared(scenario, case)
        return [f"again: {text}" for text in violations]


def _fits(kind: str, scenario: Scenario) -> bool:
    if kind == "worker":
        return scenario.jobs > 1
    if kind == "replace":
        return scenario.name == "single"
    return kind != "tmpfs" or scenario.verb == "process"
