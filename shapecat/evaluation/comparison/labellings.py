"""Labelled objects of a frame, from any source."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from shapecat.arrays import F4, U4, Bool
from shapecat.errors import RecordingError
from shapecat.recordings.messages import MALFORMED
from shapecat.runs.tables.reading import Key
from shapecat.types import Box

__all__ = [
    "UNREADABLE",
    "LabelledItem",
    "Labelling",
    "Place",
    "Reference",
    "finite_box",
    "numbering_notes",
]

UNREADABLE = (*MALFORMED, OSError, RecursionError)
"""Errors of reading a text file, and of using values from it that have wrong types or ranges."""
_Frame = TypeVar("_Frame")
Place = tuple[str | None, int, int | None]
"""How a reference names a frame: its topic (None for any); its timestamp (ns), or its number if
there is no timestamp; and its number in addition to a timestamp (None if unknown)."""


@dataclass(frozen=True)
class LabelledItem:
    """An object in a frame.

    Attributes
    ----------
    track : number of its track; None if it has none.
    pixels : (n,) flat indices into the frame; None if there is no mask.
    box : 3D box in the sensor frame; None if there is none.
    decidable : whether its category is unambiguous in this frame.
    confidence : confidence of the final label; only in runs.
    view_category, posterior : category and posterior (c,) from this frame alone; only in runs.
    """

    track: int | None
    category: str
    pixels: U4 | None = None
    box: Box | None = None
    decidable: bool = True
    confidence: float = 1.0
    view_category: str = ""
    posterior: F4 | None = None


def finite_box(center: ArrayLike, size: ArrayLike, orientation: ArrayLike) -> Box:
    """Return the `Box` that a file describes.

    Raises
    ------
    ValueError : a shape is wrong, or a value is not finite.
    """
    values = [np.asarray(value, np.float32) for value in (center, size, orientation)]
    if not all(np.isfinite(value).all() for value in values):
        msg = "a box has values that are not finite"
        raise ValueError(msg)
    return Box(*values)


@dataclass(frozen=True)
class Labelling:
    """The objects of a frame.

    Attributes
    ----------
    known : (n,) which pixels of the frame have a label; None if all have.
    shape : height and width of the image; None if unknown.
    ignored : (n,) which pixels show objects that count neither as missed nor as false; None if
        there are none.
    """

    items: tuple[LabelledItem, ...]
    known: Bool | None = None
    shape: tuple[int, int] | None = None
    ignored: Bool | None = None


class Reference(ABC, Generic[_Frame]):
    """A reference for comparisons; frames are requested in recording order.

    Parameters
    ----------
    path : path of the reference, for messages.
    frames : places and entries of the frames, each a `Place` and what `labelling` takes.

    Raises
    ------
    RecordingError : two entries describe the same frame.
    """

    kind: str
    """Kind of the reference, in words."""
    unit = "frames"
    """Plural noun for the timestamps or numbers that identify frames, for messages."""
    tracked: bool = False
    """Whether objects have identities over time."""
    numbered: bool = False
    """Whether frames are named by their numbers alone."""

    def __init__(self, path: Path, frames: Iterable[tuple[Place, _Frame]]) -> None:
        entries = list(frames)
        self.path = path
        self.frames = len(entries)
        """Number of frames."""
        self._index = self._indexed(entries)

    def _indexed(self, entries: list[tuple[Place, _Frame]]) -> dict[Place, _Frame]:
        """Return the entries by place; raise `RecordingError` if two have the same place.

        A frame is found by its timestamp alone, unless other frames of its topic have the same one:
        then its number is needed, too.
        """
        index: dict[Place, _Frame] = {}
        for place, entry in entries:
            if place in index:
                topic, stamp, number = place
                name = stamp if number is None else number
                msg = f"{self.path}: frame {name} of {topic or 'any topic'} is labelled twice"
                raise RecordingError(msg)
            index[place] = entry
        counts = Counter((topic, stamp) for topic, stamp, _ in index)
        unique = {place: entry for place, entry in index.items() if counts[place[:2]] == 1}
        return index | {(topic, stamp, None): entry for (topic, stamp, _), entry in unique.items()}

    def at(self, key: Key, stamp_ns: int, *, repeated: bool = False) -> Labelling | None:
        """Return the objects of a frame; None if the reference lacks this frame.

        ``key`` is the topic and the number of the frame, ``stamp_ns`` its timestamp; ``repeated``
        is whether other frames of its topic have the same timestamp.

        Raises
        ------
        RecordingError, OutputError : the labels of the frame are damaged.
        """
        number = key[1]
        numbers = [(stamp_ns, number), (stamp_ns, None), (number, None)]
        if repeated:
            numbers.remove((stamp_ns, None))
        places = ((topic, *pair) for pair in numbers for topic in (key[0], None))
        found = next((place for place in places if place in self._index), None)
        return None if found is None else self.labelling(self._index[found])

    @abstractmethod
    def labelling(self, entry: _Frame) -> Labelling:
        """Return the objects of a frame; errors are as for `at`."""

    def describe_frames(self) -> str:
        """Describe the range of frames, and their topics if they are known, in a few words."""
        numbers = [number for _, number, _ in self._index]
        topics = ", ".join(sorted({str(topic) for topic, *_ in self._index if topic is not None}))
        where = f" of {topics}" if topics else ""
        return (
            f"{self.unit} {min(numbers)} to {max(numbers)}{where}" if numbers else f"no {self.unit}"
        )


def numbering_notes(other: Reference[Any], start_s: float | None) -> list[str]:
    """Return a list with a note if frames may be numbered differently in run and reference.

    ``start_s`` is the start of the run in its recording, None for the beginning.
    """
    if not (other.numbered and start_s):
        return []
    note = (
        f"Frames are matched by number, which the run counts from --start {start_s:g}. If the "
        "labels count from the start of the recording, they are matched with the wrong frames: use "
        "labels with timestamps."
    )
    return [note]
