"""Name the run folders of a batch, so that each recording keeps its own."""

import json
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from types import MappingProxyType

from shapecat.batch.manifest import Entry, entries_at
from shapecat.batch.sources import Source
from shapecat.batch.storage import Location, is_url
from shapecat.errors import ShapecatError
from shapecat.runs.folder import read_identity
from shapecat.system.files import partial_path

__all__ = ["existing_names", "name_folders"]

_NUMBER = re.compile(r"_\d+$")
_PARTIAL = re.compile(re.escape(partial_path(Path("*")).name).replace(r"\*", "(.+)"))
"""Pattern of the folders of interrupted runs; its group is the name of the run."""


def name_folders(
    names: Sequence[str], parents: Sequence[str], existing: Mapping[int, str] = MappingProxyType({})
) -> list[str]:
    """Return a unique run folder name for each recording: its file name without suffix.

    If several recordings have the same name, the name of the parent folder is put in front of it;
    if the resulting name is taken, a number is added.

    Parameters
    ----------
    names : names of the recordings, without suffix.
    parents : names of the folders that hold the recordings.
    existing : maps the index of a recording to the name that its run folder already has.

    Examples
    --------
    >>> name_folders(["x", "x", "y"], ["a", "b", ""])
    ['a_x', 'b_x', 'y']
    >>> name_folders(["x", "x", "y"], ["a", "b", ""], {0: "x"})
    ['x', 'b_x', 'y']
    """
    counts = Counter(names)
    taken = set(existing.values())
    folders = []
    for k, (name, parent) in enumerate(zip(names, parents, strict=True)):
        if k in existing:
            folders.append(existing[k])
            continue
        unique = name if counts[name] == 1 else f"{parent}_{name}"
        numbered = (f"{unique}_{number}" for number in count(k + 1))
        free = next(folder for folder in chain([unique], numbered) if folder not in taken)
        taken.add(free)
        folders.append(free)
    return folders


def existing_names(
    sources: Sequence[Source], out: str, listing: set[str], noted: Mapping[str, Entry]
) -> dict[int, str]:
    """Return the names of the run folders that recordings already have, by index in ``sources``.

    Without them, a recording that is added to a batch later, or processed alone, would get the
    folder of another one, or rename it. Recordings are left out whose name is in ``out`` and unique
    among ``sources``: their folder has that name.

    Parameters
    ----------
    out : folder or URL of the batch.
    listing : the names in ``out``.
    noted : entries of the manifest, by run folder. At a URL, those of all shards are read instead.

    Raises
    ------
    OutputError : the storage at a URL cannot be read.
    """
    counts = Counter(source.stem for source in sources)
    ambiguous = {
        source.url or os.path.realpath(source.path): k
        for k, source in enumerate(sources)
        if counts[source.stem] > 1 or source.stem not in listing
    }
    some = [sources[k] for k in ambiguous.values()]
    possible = {name for s in some for name in (s.stem, f"{s.parent}_{s.stem}")}
    partial = {match[1] for match in map(_PARTIAL.fullmatch, listing) if match}
    names = {*listing, *partial, *noted}
    folders = sorted(n for n in names if n in possible or _NUMBER.sub("", n) in possible)
    entries = entries_at(out) if folders and is_url(out) else noted
    recording_of = _recording_at_url if is_url(out) else _recording_in
    existing: dict[int, str] = {}
    for folder in folders:
        k = ambiguous.get(recording_of(out, folder, entries.get(folder)))
        if k is not None:
            existing.setdefault(k, folder)
    return existing


def _recording_in(out: str, name: str, entry: Entry | None) -> str:
    """Return the path or URL of the recording of a run, complete or begun; empty if unknown."""
    for folder in (Path(out, name), partial_path(Path(out, name))):
        with suppress(ShapecatError):
            return read_identity(folder)["input"]["path"]
    recording = entry.recording if entry is not None else ""
    return recording if is_url(recording) or not recording else os.path.realpath(recording)


def _recording_at_url(out: str, name: str, entry: Entry | None) -> str:
    """Return the path or URL of the recording of a run at a URL; empty if unknown."""
    recording = entry.recording if entry is not None else ""
    if is_url(recording):
        return recording
    if Path(recording).is_absolute():  # other paths depend on the current folder
        return os.path.realpath(recording)
    with suppress(ShapecatError, ValueError, LookupError, TypeError, RecursionError):
        content = (Location(out) / name / "run.json").read() or b"{}"
        return str(json.loads(content)["input"]["path"])
    return ""
