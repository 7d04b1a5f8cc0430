"""Many recordings: plan their run folders, process each, and let none stop the others."""

import dataclasses
import logging
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from shapecat.errors import ShapecatError
from shapecat.jobs import Job, Summary
from shapecat.pipeline import Observer, process

__all__ = ["Outcome", "exit_code", "plan_folders", "process_many", "with_same"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """What became of one job: a summary, or a message and the exit code it stands for."""

    job: Job
    summary: Summary | None = None
    message: str = ""
    code: int = 0


def plan_folders(sources: Sequence[Path], out: Path) -> list[Path]:
    """Return a run folder for each recording: its name without suffix, below ``out``.

    Recordings of the same name are told apart by their parent folders, then by number.

    Examples
    --------
    >>> sources = [Path("a/x.mcap"), Path("b/x.mcap"), Path("y.bag")]
    >>> [str(folder) for folder in plan_folders(sources, Path("o"))]
    ['o/a_x', 'o/b_x', 'o/y']
    """
    names = [_stem(source) for source in sources]
    unique = [
        name if names.count(name) == 1 else f"{source.resolve().parent.name}_{name}"
        for name, source in zip(names, sources, strict=True)
    ]
    numbered = [
        name if name not in unique[:k] else f"{name}_{k + 1}" for k, name in enumerate(unique)
    ]
    return [out / name for name in numbered]


def _stem(source: Path) -> str:
    return source.resolve().name if source.is_dir() else source.stem


def process_many(
    jobs: Sequence[Job], *, workers: int, observe: Observer | None = None
) -> Iterator[Outcome]:
    """Process the jobs and yield what became of each, as they end.

    Parameters
    ----------
    workers : processes; with one, or one job, everything happens in this process and ``observe``
        hears of the progress.
    """
    workers = min(workers, len(jobs))
    if workers <= 1:
        for job in jobs:
            yield _attempt(job, observe)
        return
    # Spawned, not forked: the threads of numeric and Rerun libraries do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        running = {pool.submit(_attempt, job): job for job in jobs}
        try:
            for future in as_completed(running):
                error = future.exception()
                yield (
                    Outcome(running[future], message=str(error), code=1)
                    if error
                    else (future.result())
                )
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _attempt(job: Job, observe: Observer | None = None) -> Outcome:
    """Process one job; a known error is an outcome, an unknown one too, but logged in full."""
    try:
        return Outcome(job, process(job, observe) if observe else process(job))
    except ShapecatError as error:
        return Outcome(job, message=str(error), code=error.exit_code)
    except Exception as error:  # noqa: BLE001  one bad recording must not stop the others
        _log.exception("%s: this is a bug in shapecat", job.source)
        return Outcome(job, message=f"{job.source}: {type(error).__name__}: {error}", code=1)


def exit_code(outcomes: Sequence[Outcome]) -> int:
    """Return 0 if all are complete, 1 if some; if none is, what kept them: 3 before 4 before 1."""
    codes = {outcome.code for outcome in outcomes}
    if codes <= {0}:
        return 0
    if 0 in codes:
        return 1
    return next((code for code in (3, 4, 2) if code in codes), 1)


def with_same(job: Job, sources: Sequence[Path], out: Path) -> list[Job]:
    """Return a job like ``job`` for each recording."""
    folders = plan_folders(sources, out)
    return [
        dataclasses.replace(job, source=source, folder=folder)
        for source, folder in zip(sources, folders, strict=True)
    ]
