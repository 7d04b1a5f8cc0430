"""Interpret the label that a person gives a track.

A label is a category, a new category, ``delete``, or ``merge with N``.
"""

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from shapecat.runs.labels.track_table import TrackRow
from shapecat.types import CATEGORIES, UNKNOWN

__all__ = [
    "DELETE",
    "NAME_RULE",
    "TrackLabel",
    "find_misread",
    "is_category_name",
    "marked_as_new",
    "merged_with",
    "merging_with",
    "order_categories",
    "resolve_labels",
]

DELETE = "delete"
"""The label that deletes a track: the outputs leave it out."""

_MERGE = re.compile(r"merged? +(?:with|into) +#?(\d{1,9})(?:[.,]0*)?", re.IGNORECASE)
_INCOMPLETE_MERGE = re.compile(r"merge\D*(\d{1,9})", re.IGNORECASE)
_COMMAND = re.compile(r"(merged?( |\W*\d|$)|del(ete)?$|remove$)", re.IGNORECASE)
_NEW = re.compile(r"new +(.+)", re.IGNORECASE)
_RESERVED = ("none", "dontcare", "na", "nan", "null")
"""Names that mean "no object" in exported formats, or "no value" to readers of tables."""
_NAME = re.compile(r"[^\W\d_][\w .+&'()-]{0,58}[\w)]|[^\W\d_]")
NAME_RULE = (
    "a letter followed by letters, digits, spaces and - _ . + & ' ( ), at most 60 characters; the "
    "last is a letter, a digit, _ or )"
)
"""The rule for the name of a category, in words."""
_SHOWN = 80
"""Maximum number of characters of an invalid label in a message."""


class TrackLabel(NamedTuple):
    """The number, category and confidence with which a track is shown.

    A track that is merged with another one has all three from the other.
    """

    track: int
    category: str
    confidence: float


def merged_with(label: str) -> int | None:
    """Return the number of the track that a label merges with; None for any other label.

    Examples
    --------
    >>> merged_with("merge with 7"), merged_with("cup")
    (7, None)
    """
    merge = _MERGE.fullmatch(label)
    return int(merge[1]) if merge else None


def merging_with(track: int) -> str:
    """Return the label that merges another track with ``track``.

    Examples
    --------
    >>> merging_with(7)
    'merge with 7'
    """
    return f"merge with {track}"


def marked_as_new(label: str) -> str:
    """Mark the category in a label as new; return other labels, and marked ones, unchanged.

    Examples
    --------
    >>> marked_as_new("pan"), marked_as_new("new pan"), marked_as_new("delete")
    ('new pan', 'new pan', 'delete')
    """
    named = is_category_name(label) and not _NEW.fullmatch(label)
    return f"new {label}" if named else label


_Verdict = str | int | None
"""A category, the number of the track to merge with, or None to delete."""


def find_misread(
    rows: Sequence[TrackRow], categories: Iterable[str] = (), *, one_frame: bool = True
) -> dict[int, str]:
    """Return the problems of invalid labels by track number, see `resolve_labels`."""
    return resolve_labels(rows, categories, one_frame=one_frame)[1]


def resolve_labels(
    rows: Sequence[TrackRow], categories: Iterable[str], *, one_frame: bool
) -> tuple[dict[int, TrackLabel], dict[int, str]]:
    """Interpret the labels of all tracks.

    Parameters
    ----------
    rows : the lines of a tracks.csv.
    categories : known categories, besides those in the rows and those of the default model.
    one_frame : whether the topics share a fixed frame, so that tracks of different topics may be
        merged.

    Returns
    -------
    The final labels, and the problems of invalid labels, both by track number. A deleted track is
    in neither.
    """
    names = {n.lower(): n for n in (UNKNOWN, *CATEGORIES, *categories, *(r.category for r in rows))}
    verdicts: dict[int, _Verdict] = {}
    misread = {}
    for row in sorted(rows, key=lambda row: _NEW.fullmatch(row.label) is None):  # new names first
        try:
            verdicts[row.track] = _understand(row.label, names) if row.label else row.category
        except ValueError as error:
            misread[row.track] = str(error)
            verdicts[row.track] = row.category
    by_track = {row.track: row for row in rows}
    labels = {}
    for row in rows:
        try:
            target = by_track[_follow(row.track, verdicts)]
            if not (one_frame or _share_a_topic(target, row)):
                msg = f"track #{target.track} belongs to another topic, {target.topic}"
                if not target.topic:
                    msg = f"the table names no topic for track #{target.track}"
                raise ValueError(msg)  # noqa: TRY301  collected with those of the calls
        except ValueError as error:
            misread[row.track] = f"{row.label!r}: {error}"
            continue
        category = verdicts[target.track]
        if isinstance(category, str):
            confidence = 1.0 if target.label else target.confidence
            labels[row.track] = TrackLabel(target.track, category, confidence)
    return labels, misread


def _share_a_topic(a: TrackRow, b: TrackRow) -> bool:
    return a.topic == b.topic or bool(set(a.topic.split()) & set(b.topic.split()))


def _follow(track: int, verdicts: Mapping[int, _Verdict]) -> int:
    """Return the track at the end of a chain of merges; ``verdicts`` are by track.

    Raises
    ------
    ValueError : a track in the chain is missing or deleted, or the chain is a loop.
    """
    chain = [track]
    while isinstance(target := verdicts[chain[-1]], int):
        if target not in verdicts:
            msg = f"there is no track #{target}"
            raise ValueError(msg)
        if target in chain:
            msg = f"forms a loop: {' -> '.join(f'#{k}' for k in [*chain, target])}"
            raise ValueError(msg)
        chain.append(target)
        if verdicts[target] is None:
            msg = f"track #{target} is deleted"
            raise ValueError(msg)
    return chain[-1]


def _understand(label: str, names: dict[str, str]) -> _Verdict:
    """Interpret a label.

    ``names`` maps lower-case names to the known categories; a new category is added in place.

    Raises
    ------
    ValueError : the label is malformed, or likely a misspelt known name.
    """
    label = unicodedata.normalize("NFC", label)
    if label.lower() in names:
        return names[label.lower()]
    if label.lower() == DELETE:
        return None
    merge = merged_with(label)
    if merge is not None:
        return merge
    new = _NEW.fullmatch(label)
    name = new[1] if new else label
    if not is_category_name(name):
        if intended := _INCOMPLETE_MERGE.fullmatch(label):
            msg = f"{label!r}: did you mean {merging_with(int(intended[1]))}?"
            raise ValueError(msg)
        hint = "" if _NAME.fullmatch(_without_marks(name)) else f"; a category is {NAME_RULE}"
        shown = label if len(label) <= _SHOWN else f"{label[:_SHOWN]}…"
        msg = f"{shown!r} is not a category, `{DELETE}` or `merge with N`{hint}"
        raise ValueError(msg)
    number = re.search(r"\d{1,9}$", name)
    commands = (DELETE, *([merging_with(int(number[0]))] if number else ()))
    plain = unicodedata.normalize("NFKC", name).lower()  # full-width letters look like the others
    nearest = None if new else _nearest(plain, [*names, *commands])
    if nearest:
        suggestion = names.get(nearest, nearest)
        msg = f"{label!r}: did you mean {suggestion}? For a new category write `new {name}`"
        raise ValueError(msg)
    return names.setdefault(name.lower(), name)


def is_category_name(name: str) -> bool:
    """Return whether a text can name a category.

    It follows `NAME_RULE`, and is neither a command, such as ``delete``, nor a reserved name.

    Examples
    --------
    >>> is_category_name("tea pot"), is_category_name("merge with 3"), is_category_name("none")
    (True, False, False)
    """
    allowed = _NAME.fullmatch(_without_marks(name)) and not _COMMAND.match(name)
    return bool(allowed) and name.lower() not in _RESERVED


def order_categories(names: Iterable[str]) -> tuple[str, ...]:
    """Return the distinct ``names`` except `UNKNOWN`, in a fixed order.

    The categories of the default model come first, in its order; other names follow in
    alphabetical order.
    """
    distinct = {str(name) for name in names} - {UNKNOWN}
    return (*(name for name in CATEGORIES if name in distinct), *sorted(distinct - set(CATEGORIES)))


def _without_marks(text: str) -> str:
    """Return a text without the accents and vowel signs that are separate characters."""
    return "".join(c for c in text if not unicodedata.category(c).startswith("M"))


def _nearest(name: str, names: Sequence[str]) -> str | None:
    """Return the name in ``names`` with the smallest edit distance from ``name``.

    None if the distance is more than 2, or more than 1 if either name is short.
    """
    distances = [(_slips(name, candidate), candidate) for candidate in names]
    slips, candidate = min(distances)
    return candidate if slips <= (1 if min(len(name), len(candidate)) < 5 else 2) else None


def _slips(a: str, b: str) -> int:
    """Return the edit distance: letters added, dropped, changed or swapped (Damerau 1964)."""
    before, last = list[int](), list(range(len(b) + 1))
    for i, x in enumerate(a, start=1):
        row = [i]
        for j, y in enumerate(b, start=1):
            row.append(min(last[j] + 1, row[j - 1] + 1, last[j - 1] + (x != y)))
            if i > 1 and j > 1 and x == b[j - 2] and a[i - 2] == y:
                row[j] = min(row[j], before[j - 2] + 1)
        before, last = last, row
    return last[-1]
