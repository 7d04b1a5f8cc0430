"""Plan a batch: find recordings, assign run folders, check the state of each."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal
from uuid import uuid4

from shapecat.batch.claims import claim_name
from shapecat.batch.finding import find_recordings
from shapecat.batch.finding_urls import stat_url
from shapecat.batch.manifest import Entry, Manifest, open_manifest
from shapecat.batch.naming import existing_names, name_folders
from shapecat.batch.sources import Source
from shapecat.batch.storage import Location, is_url
from shapecat.errors import ConfigError, OutputError
from shapecat.learning import load_model
from shapecat.runs.folder import OUTPUT_OPTIONS, read_run
from shapecat.runs.identity import file_stats
from shapecat.runs.jobs import Job, differences
from shapecat.runs.run_info import RunInfo, parse_run
from shapecat.system.files import partial_path

__all__ = ["Batch", "Status", "Task", "parse_shard", "plan_batch", "run_of", "shard_of"]

_NamedSource = tuple[str, Source]
"""The name of a run folder, and its recording."""

_THREADS = 16
"""Threads that check files: on a network disk each check is a round trip."""
_CHUNK = 256
"""Recordings that a thread checks at a time."""

Status = Literal["complete", "resume", "retry", "check", "new"]


@dataclass(frozen=True, slots=True)
class Task:
    """A recording of a batch and its status; small, since a batch may have millions.

    Attributes
    ----------
    template : a job with the options that all tasks share.
    out : folder or URL of the batch; ``name`` is the run folder in it.
    source : the recording, with its key and size unless they are unknown.
    status : ``complete`` according to manifest and run.json; ``resume`` if a run was interrupted;
        ``check`` if there is a run folder that may hold other results; ``retry`` if the last
        attempt failed; else ``new``.
    work : a key that changes with the options, settings and model.
    command : identifies a command that overwrites; empty for others.
    """

    template: Job
    out: str
    name: str
    source: Source
    status: Status
    work: str
    command: str = ""

    @property
    def job(self) -> Job:
        """The job that processes the recording."""
        at_url = is_url(self.out)
        return dataclasses.replace(
            self.template,
            source=Path(self.source.path),
            folder=Path(self.name) if at_url else Path(self.out, self.name),
            origin=self.source.url,
            target=f"{self.out.rstrip('/')}/{self.name}" if at_url else "",
            input_key=self.source.key,
            work_key=self.work,
        )

    def entry(self) -> Entry:
        """Return the first manifest entry of the task."""
        return Entry(
            folder=self.name,
            recording=self.source.recording,
            state="planned",
            input=self.source.key,
            work=self.work,
            command=self.command,
        )


def parse_shard(text: str) -> tuple[int, int]:
    """Return the index of a shard ``I/N``, from 0, and N; I may count from 0 or from 1.

    Raises
    ------
    ConfigError : the text is not of that form, N is 0, or I is larger than N.

    Examples
    --------
    >>> [parse_shard(f"{k}/3") for k in (0, 1, 2, 3)]
    [(0, 3), (1, 3), (2, 3), (0, 3)]
    """
    first, slash, last = text.partition("/")
    if not slash or not (first.isdecimal() and last.isdecimal() and int(last)):
        msg = f"--shard {text}: expected I/N, for example 2/4"
        raise ConfigError(msg)
    index, count = int(first), int(last)
    if index > count:
        msg = f"--shard {text}: expected I from 0 to {count - 1} or from 1 to {count}"
        raise ConfigError(msg)
    return index % count, count


def shard_of(named: Sequence[_NamedSource], index: int, count: int) -> list[_NamedSource]:
    """Return shard ``index``, from 0, of ``count`` disjoint shards that together cover the list.

    It is sorted by run folder.
    """
    return sorted(named, key=lambda pair: pair[0])[index::count]


@dataclass(frozen=True)
class Batch:
    """The tasks of a batch, the manifest, and the number of files that are not recordings.

    The manifest of a single recording is not written. ``notes`` are as in `SearchResult`.
    """

    tasks: list[Task]
    manifest: Manifest
    skipped: int
    notes: Sequence[str] = ()


@contextmanager
def plan_batch(
    job: Job, sources: Sequence[str], out: str, *, shard: str | None = None
) -> Iterator[Batch]:
    """Plan a task for each recording; keep the manifest open during the block.

    Of the recordings, only numbered files in a folder without metadata are opened: their times
    decide whether they are parts of one bag or separate recordings.

    Parameters
    ----------
    job : the options, settings and model for all recordings.
    sources : files, folders to search, and URLs.
    out : folder or URL in which each recording gets its run folder.
    shard : ``I/N`` to plan only a part of the recordings.

    Raises
    ------
    ConfigError : the shard is invalid, or a URL needs a library that is not installed.
    RecordingError : no recording was found, or a URL cannot be reached.
    ModelError : the model cannot be read.
    OutputError : the URL for the results cannot be reached, or shapecat did not make the manifest.
    """
    part = parse_shard(shard) if shard is not None else None
    found = find_recordings(sources)
    listing = Location(out, OutputError).names() if is_url(out) else _names_in(Path(out))
    stems, parents = [s.stem for s in found.sources], [s.parent for s in found.sources]
    several = len(stems) > 1
    with open_manifest(out, shard=shard) if several else Manifest() as manifest:
        known = existing_names(found.sources, out, listing, manifest.entries)
        named = list(zip(name_folders(stems, parents, known), found.sources, strict=True))
        if several or job.model is not None or is_url(out):
            job = dataclasses.replace(job, model_id=load_model(job.model).model_id)
        planner = _Planner(job, out, listing, manifest.entries)
        chosen = shard_of(named, *part) if part is not None else named
        yield Batch(planner.tasks(chosen), manifest, found.skipped, found.notes)


class _Planner:
    """Determines the status of each recording.

    ``listing`` are the names in the folder of results, ``entries`` the manifest's entries by name.
    """

    def __init__(self, job: Job, out: str, listing: set[str], entries: Mapping[str, Entry]) -> None:
        self._job, self._out, self._listing, self._entries = job, out, listing, entries
        self._work = _hash([job.settings.as_dict(), job.selection(), job.model_id])
        self._command = ""

    def tasks(self, named: Sequence[_NamedSource]) -> list[Task]:
        """Return the task of each recording."""
        if self._job.overwrite:
            self._command = _command(
                self._job, self._work, (self._entries.get(name) for name, _ in named)
            )
        chunks = [named[first : first + _CHUNK] for first in range(0, len(named), _CHUNK)]
        with ThreadPoolExecutor(_THREADS) as pool:
            tasks = pool.map(lambda chunk: [self._task(*each) for each in chunk], chunks)
            return list(chain.from_iterable(tasks))

    def _task(self, name: str, source: Source) -> Task:
        if not source.key:
            key, size = stat_url(source.url) if source.url else _input_key(Path(source.path))
            source = dataclasses.replace(source, key=key, bytes=size)
        task = Task(
            template=self._job,
            out=self._out,
            name=name,
            source=source,
            status="new",
            work=self._work,
            command=self._command,
        )
        return dataclasses.replace(task, status=self._status(task))

    def _status(self, task: Task) -> Status:
        entry, overwrite = self._entries.get(task.name), self._job.overwrite
        exists = task.name in self._listing
        if exists and task.source.key and entry is not None and entry.state == "complete":
            same = entry.same_command if overwrite else entry.same_work
            if same(task.entry()) and _is_wanted_run(task):
                return "complete"
        in_progress = {partial_path(Path(task.name)).name, claim_name(task.name)}
        if (overwrite or not exists) and not self._listing.isdisjoint(in_progress):
            return "resume"
        if exists and not overwrite:
            return "check"
        return "retry" if entry is not None and entry.state == "failed" else "new"


def _command(job: Job, work: str, entries: Iterable[Entry | None]) -> str:
    """Return the id of the overwriting command that this one resumes, or a new id.

    ``entries`` are the manifest entries of the recordings; None for one without an entry.
    """
    kind = "discard-labels" if job.discard_labels else "overwrite"
    unfinished = [
        entry
        for entry in entries
        if entry is not None
        and (entry.work, entry.command.partition(":")[0]) == (work, kind)
        and entry.state in {"planned", "running"}
    ]
    last = max(unfinished, key=lambda entry: entry.time, default=None)
    return f"{kind}:{uuid4().hex[:8]}" if last is None else last.command


def _names_in(folder: Path) -> set[str]:
    """Return the names in a folder; empty if it is missing or unreadable."""
    with suppress(OSError):
        return {path.name for path in folder.iterdir()}
    return set()


def _is_wanted_run(task: Task) -> bool:
    """Return whether a run listed as complete is the requested one, and has its outputs.

    A command for this recording alone, or with other shards, may have replaced the run, and an
    interrupted `annotate` leaves outputs missing.
    """
    job = task.job
    try:
        run = run_of(job)
    except OutputError:
        return False
    if job.target:
        return job.made(run)
    outputs = [name for option, name in OUTPUT_OPTIONS.items() if getattr(job, option)]
    wanted: dict[str, Any] = {
        "settings": job.settings.as_dict(),
        "options": job.selection(),
        "model": {"id": job.model_id},
    }
    differing = differences(run, wanted).keys() - {"topics", *OUTPUT_OPTIONS}
    chosen, requested = (
        [topic.strip("/") for topic in topics] for topics in (run["options"]["topics"], job.topics)
    )
    return (
        (job.origin or Path(run["input"]["path"]).exists())  # else the recording was moved
        and all(name in run["seconds"] and (job.folder / name).exists() for name in outputs)
        and not differing
        and requested in ([], chosen)
    )


def run_of(job: Job) -> RunInfo:
    """Return the content of run.json of a complete run.

    Raises
    ------
    OutputError : the file is missing or unreadable.
    """
    if not job.target:
        return read_run(job.folder)
    content = (Location(job.target, OutputError) / "run.json").read()
    return parse_run(content or b"", job.target)


def _input_key(source: Path) -> tuple[str, int]:
    """Return a key from the names, sizes and times of a recording's files, and their total bytes.

    The result is empty and 0 if a file cannot be read.
    """
    try:
        stats = file_stats(source)
    except OSError:
        return "", 0
    return _hash(stats), sum(size for _, size, *_ in stats)


def _hash(value: object) -> str:
    return hashlib.sha256(json.dumps(value).encode()).hexdigest()[:16]
