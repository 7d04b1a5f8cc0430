"""Plan a batch: find recordings, assign run folders, check the state of each."""

import dataclasses
import hashlib
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from shapecat.batch.finding import find_recordings
from shapecat.batch.manifest import Entry, Manifest
from shapecat.batch.remote import look_at, output_place
from shapecat.errors import ConfigError, OutputError
from shapecat.learning import load_model
from shapecat.runs.folder import read_run
from shapecat.runs.jobs import Job
from shapecat.system.files import partial_path

__all__ = [
    "Batch",
    "Shard",
    "Task",
    "plan_batch",
    "plan_folders",
]

_LOOKS_AT_ONCE = 16
"""Threads that look at files: on a network disk each look is a round trip."""

Status = Literal["complete", "resume", "retry", "check", "new"]


@dataclass(frozen=True)
class Task:
    """A recording of a batch, and its status.

    ``status`` is ``complete`` where the manifest vouches for it, ``resume`` where a killed run
    goes on, ``retry`` where the last try failed, ``check`` where there are results of unknown
    origin, else ``new``.
    """

    job: Job
    status: Status
    bytes: int
    input: str
    work: str

    def entry(self) -> Entry:
        """Return the first manifest entry of the task."""
        return Entry(
            folder=self.job.folder.name,
            recording=self.job.name,
            state="planned",
            input=self.input,
            work=self.work,
        )


@dataclass(frozen=True)
class Shard:
    """Part ``index`` of ``count``. Counting may start at 0 or at 1."""

    index: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Read ``I/N``.

        Raises
        ------
        ConfigError : it is not of that form, or I is larger than N.
        """
        first, slash, last = text.partition("/")
        if not slash or not (first.isdecimal() and last.isdecimal()):
            msg = f"--shard {text}: expected I/N, for example 2/4"
            raise ConfigError(msg)
        index, count = int(first), int(last)
        if count < 1 or index > count:
            msg = f"--shard {text}: expected I from 0 to {count - 1} or from 1 to {count}"
            raise ConfigError(msg)
        return cls(index % count, count)

    def of(self, jobs: Sequence[Job]) -> list[Job]:
        """Return the jobs of this shard; the shards of a list are disjoint and cover it.

        Examples
        --------
        >>> [Shard.parse(f"{k}/3").index for k in (0, 1, 2, 3)]
        [0, 1, 2, 0]
        """
        ordered = sorted(jobs, key=lambda job: job.folder.name)
        return ordered[self.index :: self.count]


@dataclass(frozen=True)
class Batch:
    """The tasks of a batch, its manifest if it has several recordings, and the skipped files."""

    tasks: list[Task]
    manifest: Manifest | None
    left_out: int


def plan_folders(names: Sequence[str], parents: Sequence[str], out: Path) -> list[Path]:
    """Return a run folder below ``out`` for each recording, by its name without suffix.

    Recordings of the same name are told apart by their parent folders, then by number.

    Examples
    --------
    >>> [str(folder) for folder in plan_folders(["x", "x", "y"], ["a", "b", ""], Path("o"))]
    ['o/a_x', 'o/b_x', 'o/y']
    """
    counts = Counter(names)
    unique = [
        name if counts[name] == 1 else f"{parent}_{name}"
        for name, parent in zip(names, parents, strict=True)
    ]
    taken: set[str] = set()
    folders = []
    for k, name in enumerate(unique):
        free = name if name not in taken else f"{name}_{k + 1}"
        taken.add(free)
        folders.append(out / free)
    return folders


@contextmanager
def plan_batch(
    job: Job, sources: Sequence[str], out: str, *, shard: str | None = None
) -> Iterator[Batch]:
    """Plan a job like ``job`` for each recording, without opening any.

    Parameters
    ----------
    sources : files, folders to search, and URLs.
    out : folder, or URL, below which each recording gets its run folder.
    shard : ``I/N`` for a part of them.

    Raises
    ------
    ConfigError : the shard makes no sense, or a URL needs a library that is not installed.
    RecordingError : a folder or URL holds no recording.
    """
    part = Shard.parse(shard) if shard is not None else None
    found = find_recordings(sources)
    folders = plan_folders(
        [source.stem for source in found.kept], [source.parent for source in found.kept], Path(out)
    )
    with output_place(out, part_of=shard) as place:
        jobs = [
            dataclasses.replace(
                job,
                source=Path(source.path),
                folder=place.folder(folder.name),
                origin=source.url,
                target=place.target(folder.name),
            )
            for source, folder in zip(found.kept, folders, strict=True)
        ]
        manifest = Manifest(place.manifest) if len(jobs) > 1 else None
        model_id = load_model(job.model).model_id if manifest is not None else ""
        chosen = part.of(jobs) if part is not None else jobs
        with ThreadPoolExecutor(_LOOKS_AT_ONCE) as pool:
            tasks = list(pool.map(lambda job: _task(job, manifest, model_id), chosen))
        yield Batch(tasks, manifest, found.left_out)


def _task(job: Job, manifest: Manifest | None, model_id: str) -> Task:
    entry = manifest.entries.get(job.folder.name) if manifest is not None else None
    key, size = look_at(job.origin) if job.origin else _input_key(job.source)
    work = _work_key(job, model_id)
    status: Status = "new"
    there = _exists(job)
    if partial_path(job.folder).exists() and (job.overwrite or not there):
        status = "resume"
    elif there and not job.overwrite:
        same = entry is not None and (entry.input, entry.work) == (key, work)
        done = same and entry is not None and entry.state == "complete" and _whole(job)
        status = "complete" if done else "check"
    elif entry is not None and entry.state == "failed":
        status = "retry"
    return Task(job, status, size, key, work)


def _exists(job: Job) -> bool:
    return look_at(f"{job.target}/run.json")[1] > 0 if job.target else job.folder.exists()


def _whole(job: Job) -> bool:
    """Return whether a run has all its outputs; an interrupted correction leaves it incomplete."""
    if job.target:
        return True  # uploaded as a whole
    outputs = [
        name for name, made in (("annotated.mcap", job.mcap), ("review.rrd", job.rrd)) if made
    ]
    try:
        run = read_run(job.folder)
    except OutputError:
        return False
    return all(name in run["seconds"] and (job.folder / name).exists() for name in outputs)


def _input_key(source: Path) -> tuple[str, int]:
    """Return a key of the files of a recording, and their size, without reading them."""
    try:
        files = sorted(source.iterdir()) if source.is_dir() else [source]
        stats = [(file.name, file.stat()) for file in files]
    except OSError:
        return "", 0
    known = [(name, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for name, stat in stats]
    return _hash(known), sum(size for _, size, *_ in known)


def _work_key(job: Job, model_id: str) -> str:
    """Return a key of settings, options and model."""
    return _hash([job.settings.as_dict(), job.selection(), model_id])


def _hash(value: object) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16]
