"""Labelled objects of a frame, from any source."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

from shapecat.arrays import F4, U4, Bool
from shapecat.runs.tables import Key
from shapecat.types import Box

__all__ = ["Item", "Labelling", "Reference"]


@dataclass(frozen=True)
class Item:
    """An object in a frame.

    Attributes
    ----------
    track : its identity over time; None where it has none.
    pixels : (n,) indices into the frame; None where only boxes are known.
    box : in the sensor frame.
    decidable : its category can be told from what is seen of it.
    view_category, posterior : what the single view says, of a run.
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

    ``known`` (n,) tells the pixels with a label, all where it is None; ``shape`` is that of the
    image, height and width.
    """

    items: tuple[Item, ...]
    known: Bool | None = None
    shape: tuple[int, int] | None = None


class Reference(ABC):
    """A reference for comparisons; frames are requested in recording order."""

    kind: str
    """In words: truth of every pixel, COCO labels, KITTI labels, another run."""
    frames: int
    """How many frames it has."""
    tracked: bool = False
    """Whether identities are the same over all frames."""

    @abstractmethod
    def at(self, key: Key, stamp_ns: int) -> Labelling | None:
        """Return the objects of a frame; None if it has no such frame."""

    @abstractmethod
    def describe_frames(self) -> str:
        """Return which frames it has, in few words."""
