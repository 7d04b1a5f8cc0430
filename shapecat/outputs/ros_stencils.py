"""Fast ROS messages: what a track always says is encoded once, then its numbers are filled in.

The library that knows the encodings takes 30 us for an object; in the messages of a track only
the time and the place change from frame to frame. Frames that show the same tracks share all but
these bytes.
"""

import struct
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from shapecat.arrays import I4, U1
from shapecat.outputs.annotation import Annotation, text_position
from shapecat.outputs.ros_annotations import ArrayMessage, RosMessages
from shapecat.types import ShownBox, ShownBoxes, ShownFrame

__all__ = ["StencilEncoder"]

_COUNT = struct.Struct("<I")
_CDR_HEADER = 4
_PLANS = 64
"""Plans kept: some 10 kB each, for as many sets of tracks seen together lately."""

_FRAME_BYTES, _BOX_BYTES = 16, 104
_PARTS = (
    slice(0, 8),  # the lifetime
    slice(8, 16),  # the time
    slice(16, 72),  # the pose of a box
    slice(72, 96),  # its size
    slice(96, 120),  # the place of its text
)
"""Where values that change are among the bytes of a frame, those of its first box included."""

Labels = tuple[tuple[int, str, float], ...]


class _Stencil(NamedTuple):
    """Encoded bytes, and which of them change: their place, and where the values are taken from."""

    data: bytes
    holes: tuple[tuple[int, slice], ...]


class StencilEncoder:
    """Encodes one kind of message exactly as `RosMessages` does."""

    def __init__(self, ros: RosMessages, message: ArrayMessage) -> None:
        """Begin without a stencil."""
        self._ros = ros
        self._message = message
        self._element = lru_cache(None)(self._cut_element)
        self._plan = lru_cache(_PLANS)(self._make_plan)

    def __call__(self, annotations: Sequence[Annotation]) -> list[bytes]:
        """Encode frames; those that show the same tracks together."""
        result = [b""] * len(annotations)
        alike: dict[tuple[Labels, str, tuple[int, ...]], list[int]] = {}
        for k, annotation in enumerate(annotations):
            if annotation.gone and self._message.gone == "inside":  # seldom
                result[k] = self._whole(annotation)
                continue
            gone = annotation.gone if self._message.gone else ()
            key = (annotation.frame.objects.labels, annotation.frame.frame_id, gone)
            alike.setdefault(key, []).append(k)
        values = _values(annotations)
        for key, members in alike.items():
            rows = _fill(self._plan(*key), values.of(members, len(key[0])))
            for k, row in zip(members, rows, strict=True):
                result[k] = row.tobytes()
        return result

    def _make_plan(self, labels: Labels, frame_id: str, gone: tuple[int, ...]) -> _Stencil:
        """Put the stencils of a frame together: values of the frame, then box by box."""
        makers = range(len(self._message.elements))
        head = _sample(frame_id, gone)
        data, holes = _stencil(self._whole(head)[: -_COUNT.size])
        data += _COUNT.pack(len(labels) * len(makers))
        for k, label in enumerate(labels):
            for maker in makers:
                padding, shift = (0, 0) if self._ros.ros1 else _align(len(data))
                data += bytes(padding)
                element = self._element(maker, label, frame_id, shift)
                holes += tuple((len(data) + at, _of_box(k, part)) for at, part in element.holes)
                data += element.data
        return _Stencil(data, holes)

    def _whole(self, annotation: Annotation) -> bytes:
        return self._ros.serialize(self._message.whole(annotation), self._message.name)

    def _cut_element(
        self, maker: int, label: tuple[int, str, float], frame_id: str, shift: int
    ) -> _Stencil:
        """Make the stencil of an element of a track."""
        box = ShownBox(*label, *_SAMPLE)
        sample = _sample(frame_id, boxes=[box])
        element = self._message.elements[maker](sample, box)
        encode = self._ros.shifted if shift else self._ros.serialize
        data = encode(element, self._message.element)
        start = 0 if self._ros.ros1 else _CDR_HEADER
        return _stencil(data[start:])


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


def _sample(
    frame_id: str, gone: tuple[int, ...] = (), boxes: Sequence[ShownBox] = ()
) -> Annotation:
    frame = ShownFrame("", 0, _STAMP_NS, 0, frame_id, ShownBoxes.of(boxes), ())
    return Annotation(frame, _LIFETIME_NS, gone)


class _Values(NamedTuple):
    """What changes: (frames, 16) bytes of frames, (boxes, 104) of boxes, and each frame's first."""

    frames: U1
    boxes: U1
    firsts: I4

    def of(self, members: Sequence[int], count: int) -> U1:
        """Return (members, bytes) the values of frames with so many boxes."""
        rows = self.firsts[members][:, None] + np.arange(count)
        boxes = self.boxes[rows].reshape(len(members), count * _BOX_BYTES)
        return np.hstack([self.frames[members], boxes])


def _values(annotations: Sequence[Annotation]) -> _Values:
    """Gather what changes: for all frames together, as each operation costs more than a frame."""
    times = np.array([(a.lifetime_ns, a.frame.stamp_ns) for a in annotations], np.int64)
    seconds, nanoseconds = np.divmod(times, 10**9)
    whole = np.stack([np.minimum(seconds, 2**31 - 1), nanoseconds], axis=2).astype("<u4")
    places = np.concatenate([a.frame.objects.places for a in annotations])
    center, size, orientation = places[:, :3], places[:, 3:6], places[:, 6:]
    above = np.column_stack(text_position(center.T, size.T, orientation.T))
    boxes = np.hstack([center, orientation, size, above]).astype("<f8")
    counts = [len(a.frame.objects.places) for a in annotations]
    return _Values(
        whole.view(np.uint8).reshape(-1, _FRAME_BYTES),
        boxes.view(np.uint8).reshape(-1, _BOX_BYTES),
        np.cumsum([0, *counts[:-1]]),
    )


@lru_cache(1)
def _sample_parts() -> tuple[bytes, ...]:
    """Return the values of a sample as they stand in what it is encoded to."""
    frame, box, _ = _values([_sample("", boxes=[ShownBox(0, "", 0.0, *_SAMPLE)])])
    whole = np.concatenate([frame[0], box[0]])
    return tuple(whole[part].tobytes() for part in _PARTS)


def _of_box(number: int, part: slice) -> slice:
    """Return where values of the first box, or of the frame, are for another box."""
    if part.start < _FRAME_BYTES:
        return part
    shift = number * _BOX_BYTES
    return slice(part.start + shift, part.stop + shift)


def _fill(plan: _Stencil, values: U1) -> U1:
    """Return (frames, bytes) the messages with their values."""
    rows: U1 = np.tile(np.frombuffer(plan.data, np.uint8), (len(values), 1))
    for at, part in plan.holes:
        rows[:, at : at + part.stop - part.start] = values[:, part]
    return rows


def _stencil(data: bytes) -> _Stencil:
    """Find the values of a sample in what it was encoded to."""
    holes = []
    for part, value in zip(_PARTS, _sample_parts(), strict=True):
        at = data.find(value)
        while at >= 0:
            holes.append((at, part))
            at = data.find(value, at + len(value))
    return _Stencil(data, tuple(holes))
