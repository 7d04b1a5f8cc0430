"""Fast ROS messages: what a track always says is encoded once, then its numbers are filled in.

The library that knows the encodings takes 30 us for an object; in the messages of a track only
the time and the place change from frame to frame. Frames that show the same tracks share all but
these bytes.
"""

import struct
from collections.abc import Sequence
from functools import lru_cache
from itertools import chain, count
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import F8
from shapecat.outputs.annotation import Annotation, text_position
from shapecat.outputs.ros_annotations import ArrayMessage, RosMessages
from shapecat.types import ShownBox, ShownBoxes, ShownFrame

__all__ = ["StencilEncoder"]

_TIME = struct.Struct("<iI")
_COUNT = struct.Struct("<I")
_BOX = struct.Struct("<56s24s24s")
_CDR_HEADER = 4
_PLANS = 1024
"""Plans kept: some 10 kB each, for as many sets of tracks seen together."""

Values = tuple[bytes, ...]
"""What changes, encoded: the lifetime, the time; for each box its pose, its size, its text."""
_OF_FRAME, _OF_BOX = 2, 3

Labels = tuple[tuple[int, str, float], ...]


class _Stencil(NamedTuple):
    """Encoded bytes in pieces, and the numbers of the values that go in between."""

    pieces: tuple[bytes, ...]
    holes: tuple[int, ...]
    length: int


class _Plan:
    """How to join values and what never changes."""

    def __init__(self, pieces: Sequence[bytes], holes: Sequence[int], values: int) -> None:
        """Plan a value between any two pieces; so many values will be given."""
        between = chain.from_iterable(zip(count(values), holes))
        # An empty piece more, as a single one would be picked bare.
        self._pieces = (*pieces, b"")
        self._pick = itemgetter(*between, values + len(pieces) - 1, values + len(pieces))

    def fill(self, values: Values) -> bytes:
        """Join the values with the pieces."""
        return b"".join(self._pick(values + self._pieces))


class StencilEncoder:
    """Encodes one kind of message exactly as `RosMessages` does."""

    def __init__(self, ros: RosMessages, message: ArrayMessage) -> None:
        """Begin without a stencil."""
        self._ros = ros
        self._message = message
        self._head = lru_cache(_PLANS)(self._cut_head)
        self._element = lru_cache(None)(self._cut_element)
        self._plan = lru_cache(_PLANS)(self._make_plan)

    def __call__(self, annotations: Sequence[Annotation]) -> list[bytes]:
        """Encode frames."""
        values = _box_values([annotation.frame.objects for annotation in annotations])
        result, at = [], 0
        for annotation in annotations:
            stop = at + _OF_BOX * len(annotation.frame.objects)
            result.append(self._encode(annotation, values[at:stop]))
            at = stop
        return result

    def _encode(self, annotation: Annotation, of_boxes: Values) -> bytes:
        if annotation.gone and self._message.gone == "inside":  # seldom
            return self._whole(annotation)
        frame = annotation.frame
        gone = annotation.gone if self._message.gone else ()
        plan = self._plan(frame.objects.labels, frame.frame_id, gone)
        return plan.fill(_frame_values(annotation) + of_boxes)

    def _make_plan(self, labels: Labels, frame_id: str, gone: tuple[int, ...]) -> _Plan:
        """Put the stencils of a frame together."""
        makers = range(len(self._message.elements))
        head = self._head(frame_id, gone)
        pieces, holes = [*head.pieces], [*head.holes]
        pieces[-1] += _COUNT.pack(len(labels) * len(makers))
        length = head.length + _COUNT.size
        for k, label in enumerate(labels):
            for maker in makers:
                padding, shift = (0, 0) if self._ros.ros1 else _align(length)
                element = self._element(maker, label, frame_id, shift)
                pieces[-1] += bytes(padding) + element.pieces[0]
                pieces += element.pieces[1:]
                holes += (h + _OF_BOX * k if h >= _OF_FRAME else h for h in element.holes)
                length += padding + element.length
        return _Plan(pieces, holes, _OF_FRAME + _OF_BOX * len(labels))

    def _whole(self, annotation: Annotation) -> bytes:
        return self._ros.serialize(self._message.whole(annotation), self._message.name)

    def _cut_head(self, frame_id: str, gone: tuple[int, ...]) -> _Stencil:
        """Make the stencil of a message up to the number of its elements."""
        sample = _sample(frame_id, gone)
        return _stencil(self._whole(sample)[: -_COUNT.size], _frame_values(sample))

    def _cut_element(
        self, maker: int, label: tuple[int, str, float], frame_id: str, shift: int
    ) -> _Stencil:
        """Make the stencil of an element of a track."""
        sample, box = _sample(frame_id), ShownBox(*label, *_SAMPLE)
        element = self._message.elements[maker](sample, box)
        encode = self._ros.shifted if shift else self._ros.serialize
        data = encode(element, self._message.element)
        start = 0 if self._ros.ros1 else _CDR_HEADER
        return _stencil(data[start:], _SAMPLE_VALUES)


def _align(length: int) -> tuple[int, int]:
    """Return the padding to 4 bytes, as every element begins with an integer, and the shift.

    The shift is the offset modulo 8 after it.
    """
    at = length - _CDR_HEADER
    return -at % 4, (at + -at % 4) % 8


# Their bytes are not UTF-8, so that no text is taken for them.
_SAMPLE: Any = (
    (-1.1e-300, -1.2e-300, -1.3e-300),
    (-1.4e-300, -1.5e-300, -1.6e-300),
    (-0.7,) * 4,
)
_STAMP_NS = 0x7FFEFDFC * 10**9 + 0x1FFEFDFC
_LIFETIME_NS = 0x7EFEFDFC * 10**9 + 0x1EFEFDFC


def _sample(frame_id: str, gone: tuple[int, ...] = ()) -> Annotation:
    frame = ShownFrame("", 0, _STAMP_NS, 0, frame_id, ShownBoxes.of([]), ())
    return Annotation(frame, _LIFETIME_NS, gone)


def _frame_values(annotation: Annotation) -> Values:
    seconds, nanoseconds = divmod(annotation.frame.stamp_ns, 10**9)
    return (
        _TIME.pack(*divmod(annotation.lifetime_ns, 10**9)),
        _TIME.pack(min(seconds, 2**31 - 1), nanoseconds),
    )


def _box_values(frames: Sequence[ShownBoxes]) -> Values:
    """Return the values of all boxes of some frames, one box after another."""
    places: F8 = np.concatenate([boxes.places for boxes in frames])
    center, size, orientation = places[:, :3], places[:, 3:6], places[:, 6:]
    above = np.column_stack(text_position(center.T, size.T, orientation.T))
    rows = np.hstack([center, orientation, size, above]).astype("<f8")
    return tuple(chain.from_iterable(_BOX.iter_unpack(rows.tobytes())))


_SAMPLE_VALUES = _frame_values(_sample("")) + _box_values(
    [ShownBoxes.of([ShownBox(0, "", 0.0, *_SAMPLE)])]
)


def _stencil(data: bytes, values: Values) -> _Stencil:
    """Find the values of a sample in what it was encoded to."""
    found = []
    for which, value in enumerate(values):
        at = data.find(value)
        while at >= 0:
            found.append((at, at + len(value), which))
            at = data.find(value, at + len(value))
    found.sort()
    starts, stops = [*(start for start, _, _ in found), len(data)], (stop for _, stop, _ in found)
    pieces = (data[a:b] for a, b in zip([0, *stops], starts, strict=True))
    return _Stencil(tuple(pieces), tuple(which for *_, which in found), len(data))
