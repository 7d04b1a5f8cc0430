"""Labels carried from one run to another: to the objects that are where, and when, they were."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from shapecat.runs.corrections import merged_with, merging_with, relabel
from shapecat.runs.folder import read_run, write_run
from shapecat.runs.same_objects import Group, Matches, match_in_place, match_in_time
from shapecat.runs.track_table import TrackRow, TrackTable, read_track_table

__all__ = ["Missed", "Transfer", "Transferred", "lost_labels", "match_labels", "transfer_labels"]


class Transferred(NamedTuple):
    """A label that has found its object; ``distance_m`` between the centres in the two runs."""

    old_track: int
    track: int
    label: str
    distance_m: float


class Missed(NamedTuple):
    """A label that has not, and why."""

    old_track: int
    label: str
    reason: str


@dataclass(frozen=True)
class Transfer:
    """What became of the labels of another table; ``source`` names its run's work, if known."""

    source: str
    transferred: tuple[Transferred, ...]
    missed: tuple[Missed, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for run.json."""
        return {
            "from": self.source,
            "transferred": [item._asdict() for item in self.transferred],
            "not_transferred": [item._asdict() for item in self.missed],
        }


def lost_labels(source: Path, reason: str) -> Transfer:
    """Return what is to be said of a table none of whose labels can be carried over."""
    table = read_track_table(source / "tracks.csv")
    missed = (Missed(row.track, row.label, reason) for row in table.rows if row.label)
    return Transfer(table.run, (), tuple(missed))


def transfer_labels(source: Path, target: Path) -> Transfer:
    """Give the tracks of a run the labels that the same objects have in another table.

    The labels go into tracks.csv of ``target``, what became of them into its run.json.

    Parameters
    ----------
    source : a run folder, or a tracks.csv.
    target : a run folder with tracks.

    Raises
    ------
    OutputError : one of them cannot be read, or they have no frame of reference in common.
    """
    transfer = match_labels(source, target)
    relabel(target, {item.track: item.label for item in transfer.transferred})
    run = read_run(target)
    run["corrections"] = transfer.as_dict()
    write_run(target, run)
    return transfer


def match_labels(source: Path, target: Path) -> Transfer:
    """Find for each label of a table the track of a run that is the same object.

    Raises
    ------
    OutputError : as `transfer_labels`.
    """
    path = source / "tracks.csv" if source.is_dir() else source
    table = read_track_table(path)
    labelled = [row for row in table.rows if row.label]
    folder = path.parent if _is_in_its_run(path, table) else None
    if not labelled:
        return Transfer(table.run, (), ())
    group = _groups(labelled)
    if folder is not None and _same_recording(read_run(folder), read_run(target)):
        matches = match_in_time(folder, target, group)
    else:
        matches = match_in_place(table.rows, folder, target, group)
    return _translate(table.run, labelled, matches)


def _is_in_its_run(path: Path, table: TrackTable) -> bool:
    """Return whether the tables beside a tracks.csv are those it came from."""
    folder = path.parent
    if not (folder / "run.json").exists() or not (folder / "tracks.parquet").exists():
        return False
    if not table.run:
        return path.name == "tracks.csv"
    return bool(table.run == read_run(folder).get("work"))


def _groups(labelled: Sequence[TrackRow]) -> Group:
    """Return which tracks a person has merged."""
    partners = {row.track: merged_with(row.label) for row in labelled}

    def root(track: int) -> int:
        seen = {track}
        while (partner := partners.get(track)) is not None and partner not in seen:
            seen.add(partner)
            track = partner
        return track

    return root


def _same_recording(a: Mapping[str, Any], b: Mapping[str, Any]) -> bool:
    digests = [run["input"].get("digest") for run in (a, b)]
    return bool(digests[0]) and digests[0] == digests[1] and a["fixed_frame"] == b["fixed_frame"]


def _translate(work: str, labelled: Sequence[TrackRow], matches: Matches) -> Transfer:
    """Give labels to the tracks of the target; what a merge refers to is translated as well."""
    given: dict[int, Transferred] = {}
    missed = []
    for row in labelled:
        if row.track not in matches.found and merged_with(row.label) in matches.found:
            continue  # the part is not found on its own, the whole is
        label, reason = _label_there(row, matches)
        for match in matches.found.get(row.track, ()) if not reason else ():
            other = given.get(match.track)
            if label and label == merging_with(match.track):
                continue  # the target has made one track of the two
            if other is not None and other.label != label:
                reason = f"track {match.track} is also track {other.old_track}, a {other.label}"
                continue
            given[match.track] = Transferred(row.track, match.track, label, match.distance_m)
        if reason:
            missed.append(Missed(row.track, row.label, reason))
    return Transfer(work, tuple(given.values()), tuple(missed))


def _label_there(row: TrackRow, matches: Matches) -> tuple[str, str]:
    """Return the label a row's object has in the target, or why it has none."""
    if row.track not in matches.found:
        return "", matches.reasons.get(row.track, "nothing was found there")
    partner = merged_with(row.label)
    if partner is None:
        return row.label, ""
    there = matches.found.get(partner)
    if not there:
        reason = matches.reasons.get(partner, "nothing was found there")
        return "", f"track {partner}, which it is merged with: {reason}"
    return merging_with(there[0].track), ""
