"""Labelled objects of a frame, from any source."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

from shapecat.arrays import F4, U4, Bool
from shapecat.runs.tables import Key
from shapecat.types import Box

__all__ = ["LabelledItem", "Labelling", "Reference", "find_frame"]

_Frame = TypeVar("_Frame")


@dataclass(frozen=True)
class LabelledItem:
    """An object in a frame.

    Attributes
    ----------
    track : number of its track; None if it has none.
    pixels : (n,) flat indices into the frame; None if there is no mask.
    box : 3D box in the sensor frame; None if there is none.
    decidable : whether its category is unambiguous in this view.
    confidence : confidence of the final label; only in runs.
    view_category, posterior : category and posterior (c,) of the single view; only in runs.
    """

    track: int | None
    category: str
    pixels: U4 | None = None
    box: Box | None = None
    decidable: bool = True
    confidence: float = 1.0
    view_category: str = ""
    posterior: F4 | None = None


@dataclass(frozen=True)
class Labelling:
    """The objects of a frame.

    Attributes
    ----------
    known : (n,) which pixels of the frame have a label; None if all have.
    shape : height and width of the image; None if unknown.
    ignored : (n,) which pixels show objects that need not be found, nor are false if they are;
        None if there are none.
    """

    items: tuple[LabelledItem, ...]
    known: Bool | None = None
    shape: tuple[int, int] | None = None
    ignored: Bool | None = None


class Reference(ABC):
    """A reference for comparisons; frames are requested in recording order."""

    kind: str
    """Kind of the reference, in words."""
    frames: int
    """Number of frames."""
    tracked: bool = False
    """Whether objects have identities over time."""

    @abstractmethod
    def at(self, key: Key, stamp_ns: int) -> Labelling | None:
        """Return the objects of a frame; None if the reference lacks this frame.

        ``key`` is the topic and the number of the frame, ``stamp_ns`` its timestamp.
        """

    @abstractmethod
    def describe_frames(self) -> str:
        """Describe the range of frames in a few words."""


def find_frame(
    frames: Mapping[tuple[str | None, int], _Frame], key: Key, stamp_ns: int
) -> _Frame | None:
    """Return the entry of a frame; None if there is none.

    Parameters
    ----------
    frames : entries by topic, None for any topic, and by timestamp (ns) or frame number.
    """
    places = ((topic, number) for number in (stamp_ns, key[1]) for topic in (key[0], None))
    return next((frames[place] for place in places if place in frames), None)
