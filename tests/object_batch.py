"""A batch in object storage, on Dask workers without a shared disk, with workers that die.

    python -m tests.object_batch --count 2000        by hand; some minutes

The storage refuses a fraction of the requests. One worker is killed when a third of the recordings
are done, the scheduler and all workers when two thirds are; both are restarted, as a cluster
administrator would do. `Report` holds the outcome.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.object_storage import object_storage, requests
from tests.processes import DaskCluster, free_address
from tests.scenes import record

IN, OUT = "s3://lab/in", "s3://lab/out"
FRAMES = 3


@dataclass(frozen=True)
class Report:
    """The outcome of a batch.

    ``states`` and ``tries`` count recordings by state and by number of tries, ``made`` how often
    each recording became a run; ``left`` names the objects in the bucket that belong to neither
    runs nor manifest; ``refused`` counts refused requests.
    """

    code: int
    errors: str
    seconds: float
    states: Counter[str]
    tries: Counter[int]
    made: Counter[str]
    left: list[str]
    refused: int


def fill(count: int, folder: Path) -> None:
    """Upload a number of recordings to the bucket, copies of five different ones."""
    import fsspec  # noqa: PLC0415  an extra

    system = fsspec.filesystem("s3")
    kinds = [record(folder / f"{k}.mcap", FRAMES + k).read_bytes() for k in range(5)]
    for first in range(0, count, 100):
        some = range(first, min(count, first + 100))
        system.pipe({f"{IN}/run_{k:04}.mcap".removeprefix("s3://"): kinds[k % 5] for k in some})


def run(count: int, folder: Path, *, refused: float) -> Report:
    """Process a number of recordings; kill a worker, then the scheduler and all workers.

    ``refused`` is the fraction of requests that the storage refuses.
    """
    with object_storage(folder / "log", refused=refused) as log:
        fill(count, folder)
        address = free_address()
        cluster = DaskCluster(address, folder / "dask")
        command = [sys.executable, "-m", "shapecat", "process", f"{IN}/", "--out", OUT, "--no-rrd"]
        command += ["--executor", "dask", "--scheduler", address, "--progress", "plain"]
        begun = time.monotonic()
        errors = folder / "errors"
        with errors.open("wb") as file:
            process = subprocess.Popen(command, stderr=file, stdout=subprocess.DEVNULL)
        try:
            wait_until(lambda: len(set(made(log))) >= count // 3, process)
            cluster.kill_a_worker()
            wait_until(lambda: len(set(made(log))) >= 2 * count // 3, process)
            cluster.kill()
            cluster = DaskCluster(address, folder / "dask")
            process.wait(timeout=300 + 5 * count)
        finally:
            process.kill()
            cluster.kill()
        seconds = time.monotonic() - begun
        return _report(process.returncode, errors.read_text("utf-8"), seconds, log)


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> None:
    """Wait for a condition, or for a process to end."""
    while not condition() and process.poll() is None:
        time.sleep(0.5)


def made(log: Path) -> list[str]:
    """Return the names of the recordings that became runs, in order, with repetitions."""
    return [path.split("/")[-2] for path in requests(log, "PUT", "/run.json")]


def _report(code: int, errors: str, seconds: float, log: Path) -> Report:
    import fsspec  # noqa: PLC0415  an extra

    system: Any = fsspec.filesystem("s3", use_listings_cache=False)
    bucket = OUT.removeprefix("s3://")
    lines = system.cat_file(f"{bucket}/manifest.jsonl").splitlines()
    entries = [json.loads(line) for line in lines]
    places = {path.removeprefix(f"{bucket}/").split("/")[0] for path in system.find(bucket)}
    runs = {entry["folder"] for entry in entries}
    unfinished = [upload["Key"] for upload in system.list_multipart_uploads("lab")]
    return Report(
        code=code,
        errors=errors,
        seconds=seconds,
        states=Counter(entry["state"] for entry in entries),
        tries=Counter(entry["tries"] for entry in entries),
        made=Counter(made(log)),
        left=sorted(places - runs - {"manifest.jsonl", ".manifest"}) + unfinished,
        refused=sum(line.endswith(" 503") for line in log.read_text("utf-8").splitlines()),
    )


if __name__ == "__main__":
    import click

    @click.command()
    @click.option("--count", default=2000)
    @click.option("--refused", default=0.05, help="Share of requests that the storage refuses.")
    def main(count: int, refused: float) -> None:
        """Run the batch and print its outcome."""
        with tempfile.TemporaryDirectory() as folder:
            report = run(count, Path(folder), refused=refused)
        repeated = [name for name, times in report.made.items() if times != 1]
        click.echo(
            f"exit code {report.code}, {report.seconds:.0f} s, {dict(report.states)}, tries"
            f" {dict(report.tries)}, {len(report.made)} made, {len(repeated)} not once, left:"
            f" {report.left}, {report.refused} requests refused\n{report.errors[-1000:]}"
        )

    main()
