"""Transfer labels from one run to another, to the same objects."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from shapecat.errors import OutputError
from shapecat.runs.folder import read_identity, read_run, write_run
from shapecat.runs.labels.corrections import relabel
from shapecat.runs.labels.meaning import find_misread, marked_as_new, merged_with, merging_with
from shapecat.runs.labels.same_objects import Group, Matches, match_in_place, match_in_time
from shapecat.runs.labels.track_table import TrackRow, TrackTable, read_track_table
from shapecat.runs.run_info import RunIdentity, RunInfo

__all__ = [
    "TABLE_ALONE",
    "Missed",
    "Transfer",
    "Transferred",
    "lost_labels",
    "match_labels",
    "transfer_labels",
]

IN_TIME, IN_PLACE = "frames in common", "places in other frames"
"""`Transfer.by` if tracks were matched by `match_in_time` or `match_in_place`."""
TABLE_ALONE = "places in the table alone"
"""`Transfer.by` if a table was given without its run, so that fixed frame and moved objects are
unknown."""


class Transferred(NamedTuple):
    """A transferred label; ``distance_m`` is the distance between the centres of the two tracks."""

    old_track: int
    track: int
    label: str
    distance_m: float


class Missed(NamedTuple):
    """A label that was not transferred, and the reason; ``old_track`` is 0 for unreadable lines."""

    old_track: int
    label: str
    reason: str


@dataclass(frozen=True)
class Transfer:
    """The outcome of a label transfer.

    ``source`` is the ``work`` id of the run with the labels, empty if unknown; ``by`` says, in
    words, how objects were matched.
    """

    source: str
    transferred: tuple[Transferred, ...]
    missed: tuple[Missed, ...]
    by: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for run.json."""
        return {
            "from": self.source,
            "by": self.by,
            "transferred": [item._asdict() for item in self.transferred],
            "not_transferred": [item._asdict() for item in self.missed],
        }


def lost_labels(source: Path, reason: str) -> Transfer:
    """Return the outcome of a transfer in which no label could be transferred.

    Parameters
    ----------
    source : the run folder with the labels.
    reason : why they could not be transferred, for the user.

    Raises
    ------
    OutputError : the tracks.csv of ``source`` is unreadable.
    """
    table = read_track_table(source / "tracks.csv")
    missed = [Missed(row.track, row.label, reason) for row in table.rows if row.label]
    return Transfer(table.run, (), tuple(missed or [Missed(0, "", reason)]))


def transfer_labels(source: Path, target: Path) -> Transfer:
    """Transfer the labels of another run to the same objects in a run.

    The labels are written to tracks.csv of ``target``, the outcome to its run.json. If a person
    gave a track of ``target`` a different label, that label is kept.

    Parameters
    ----------
    source : a run folder, or a tracks.csv.
    target : a run folder with tracks.

    Returns
    -------
    The transferred labels, and those that could not be transferred.

    Raises
    ------
    OutputError : the source or the target is unreadable; or objects must be matched by place, but
        fixed frames or positions are missing, or the fixed frames differ.
    """
    run = read_run(target)
    transfer = match_labels(source, target)
    transfer = _without(transfer, _labelled_otherwise(transfer, target, run))
    refused = relabel(target, _labels(transfer))
    if refused:  # perhaps as a typo, since that run's model does not know the category
        transfer = _with_new_categories(transfer, refused)
        refused = relabel(target, _labels(transfer))
    transfer = _without(transfer, refused)
    run["corrections"] = transfer.as_dict()
    write_run(target, run)
    return transfer


def _labelled_otherwise(transfer: Transfer, target: Path, run: RunInfo) -> dict[int, str]:
    """Return a message for each track to which a person gave a different label."""
    earlier = {
        (item["track"], item["label"]) for item in run.get("corrections", {}).get("transferred", ())
    }
    current = read_track_table(target / "tracks.csv").labels
    labels = {item: current.get(item.track, "") for item in transfer.transferred}
    return {
        item.track: f"track #{item.track} already has the label {label}"
        for item, label in labels.items()
        if label not in ("", item.label) and (item.track, label) not in earlier
    }


def _labels(transfer: Transfer) -> dict[int, str]:
    return {item.track: item.label for item in transfer.transferred}


def _with_new_categories(transfer: Transfer, tracks: Container[int]) -> Transfer:
    """Return a transfer in which the categories of some tracks are marked as new."""
    items = (
        item._replace(label=marked_as_new(item.label)) if item.track in tracks else item
        for item in transfer.transferred
    )
    return replace(transfer, transferred=tuple(items))


def _without(transfer: Transfer, reasons: Mapping[int, str]) -> Transfer:
    """Return a transfer in which the labels of some tracks count as missed, for these reasons."""
    remaining = tuple(item for item in transfer.transferred if item.track not in reasons)
    missed = (
        Missed(item.old_track, item.label, reasons[item.track])
        for item in transfer.transferred
        if item.track in reasons
    )
    return replace(transfer, transferred=remaining, missed=(*transfer.missed, *missed))


def match_labels(source: Path, target: Path) -> Transfer:
    """Match the labelled tracks of a table with tracks of a run that are the same objects.

    The result is as for `transfer_labels`, but nothing is written.

    Raises
    ------
    OutputError : as for `transfer_labels`.
    """
    path = source / "tracks.csv" if source.is_dir() else source
    table = read_track_table(path)
    folder = path.parent if _is_in_its_run(path, table) else None
    _require_complete(path, table, alone=folder is None)
    categories = read_identity(folder or target)["model"]["categories"]
    misread = find_misread(table.rows, categories)
    labelled = [row for row in table.rows if row.label and row.track not in misread]
    wrong = tuple(
        Missed(r.track, r.label, misread[r.track]) for r in table.rows if r.track in misread
    )
    if not labelled:
        return Transfer(table.run, (), wrong)
    group = _groups(labelled)
    by, matches = IN_TIME, None
    if folder is not None and _same_recording(read_identity(folder), read_run(target)):
        matches = match_in_time(folder, target, group)
    if matches is None:
        by = TABLE_ALONE if folder is None else IN_PLACE
        matches = match_in_place(table.rows, folder, target, group)
    transferred, missed = _translate(labelled, group, matches)
    return Transfer(table.run, transferred, (*wrong, *missed), by)


def _require_complete(path: Path, table: TrackTable, *, alone: bool) -> None:
    """Check that a table has only valid lines, all from one run.

    If the table is ``alone``, without the other tables of its run, its positions are used. Then a
    wrong confidence is an error, since a spreadsheet may have spoilt the positions, too.

    Raises
    ------
    OutputError : a line is invalid, or the table holds tracks of several runs.
    """
    if problems := [*table.problems, *(table.wrong_numbers if alone else ())]:
        msg = f"{path}: {problems[0]}"
        raise OutputError(msg)
    if len(table.runs) > 1:
        msg = (
            f"{path}: holds tracks of several runs ({', '.join(table.runs)}); give one run's table"
        )
        raise OutputError(msg)


def _is_in_its_run(path: Path, table: TrackTable) -> bool:
    """Return whether the other tables in the folder of a tracks.csv are from the same run."""
    folder = path.parent
    if not (folder / "run.json").exists() or not (folder / "tracks.parquet").exists():
        return False
    if not table.run:
        return path.name == "tracks.csv"
    return table.run == read_identity(folder)["work"]


def _groups(labelled: Sequence[TrackRow]) -> Group:
    """Return a function that maps a track to the end of its chain of merges, perhaps itself."""
    partners = {row.track: merged_with(row.label) for row in labelled}

    def root(track: int) -> int:
        group = {track}
        while (partner := partners.get(track)) is not None and partner not in group:
            group.add(partner)
            track = partner
        return track

    return root


def _same_recording(a: RunIdentity, b: RunIdentity) -> bool:
    digest = a["input"]["digest"]
    same = bool(digest) and digest == b["input"]["digest"]
    return same and a["fixed_frame"] == b["fixed_frame"]


def _translate(
    labelled: Sequence[TrackRow], group: Group, matches: Matches
) -> tuple[tuple[Transferred, ...], tuple[Missed, ...]]:
    """Return the labels for tracks of the target, and the labels that match no track.

    A *whole* is a track with which others, its parts, were merged. Its label is copied to its
    matches. If it has parts, its other matches and theirs are merged with its first match.
    """
    transferred: dict[int, Transferred] = {}
    missed = []
    for row in sorted(labelled, key=lambda row: group(row.track) != row.track):
        whole = group(row.track)
        direct = matches.found.get(row.track, ())
        if whole not in matches.found:
            missed.append(Missed(row.track, row.label, _why(row.track, whole, matches)))
        elif whole == row.track:
            transferred |= {
                m.track: Transferred(row.track, m.track, row.label, m.distance_m) for m in direct
            }
        else:
            first, *others = matches.found[whole]
            for match in (*others, *direct):  # a part may have no match of its own
                if match.track != first.track:
                    label = merging_with(first.track)
                    item = Transferred(row.track, match.track, label, match.distance_m)
                    transferred[match.track] = item
    return tuple(transferred.values()), tuple(missed)


def _why(track: int, whole: int, matches: Matches) -> str:
    """Return the reason why a track has no match, for the user.

    It is the reason of ``whole``, the track at the end of its chain of merges.
    """
    reason = matches.reasons.get(whole, "nothing was found there")
    return reason if track == whole else f"track #{whole}, which it is merged with: {reason}"
