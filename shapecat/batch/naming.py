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

from shapecat.batch.finding import Source
from shapecat.batch.manifest import Entry, entries_at
from shapecat.batch.storage import Location, is_url
from shapecat.errors import ShapecatError
from shapecat.runs.folder import read_run

__all__ = ["known_names", "name_folders"]

_NUMBER = re.compile(r"_\d+$")


def name_folders(
    names: Sequence[str], parents: Sequence[str], known: Mapping[int, str] = MappingProxyType({})
) -> list[str]:
    """Return a unique run folder name for each recording: its own name without suffix.

    Recordings with the same name get the name of their parent folder in front, then a number.

    Parameters
    ----------
    known : the names that some recordings, by index, already have.

    Examples
    --------
    >>> name_folders(["x", "x", "y"], ["a", "b", ""])
    ['a_x', 'b_x', 'y']
    >>> name_folders(["x", "x", "y"], ["a", "b", ""], {0: "x"})
    ['x', 'b_x', 'y']
    """
    counts = Counter(names)
    taken = set(known.values())
    folders = []
    for k, (name, parent) in enumerate(zip(names, parents, strict=True)):
        if k in known:
            folders.append(known[k])
            continue
        unique = name if counts[name] == 1 else f"{parent}_{name}"
        numbered = (f"{unique}_{number}" for number in count(k + 1))
        free = next(folder for folder in chain([unique], numbered) if folder not in taken)
        taken.add(free)
        folders.append(free)
    return folders


def known_names(sources: Sequence[Source], out: str, there: set[str]) -> dict[int, str]:
    """Return the names of the run folders that recordings, by index, already have in ``out``.

    A recording that comes to a batch later, or is processed alone, must not rename a run. Those
    whose own name no other recording shares, and is in ``out``, are left out.

    Parameters
    ----------
    there : the names in ``out``.
    """
    counts = Counter(source.stem for source in sources)
    unsure = {
        source.url or os.path.realpath(source.path): k
        for k, source in enumerate(sources)
        if counts[source.stem] > 1 or source.stem not in there
    }
    named = [sources[k] for k in unsure.values()]
    own = {name for source in named for name in (source.stem, f"{source.parent}_{source.stem}")}
    found = sorted(name for name in there if name in own or _NUMBER.sub("", name) in own)
    entries = entries_at(out) if found and is_url(out) else {}
    known: dict[int, str] = {}
    for name in found:
        k = unsure.get(_recording_of(out, name, entries.get(name)))
        if k is not None:
            known.setdefault(k, name)
    return known


def _recording_of(out: str, name: str, entry: Entry | None) -> str:
    """Return the path or URL of the recording of a run; empty if there is no readable run."""
    noted = entry.recording if entry is not None else ""
    if is_url(noted):
        return noted
    if Path(noted).is_absolute():  # other paths depend on the current folder
        return os.path.realpath(noted)
    with suppress(ShapecatError, ValueError, LookupError, TypeError):
        if not is_url(out):
            return read_run(Path(out, name))["input"]["path"]
        content = (Location(out) / name / "run.json").read() or b"{}"
        return str(json.loads(content)["input"]["path"])
    return ""
