"""The annotated recording: all original messages, and the labelled objects.

A complete MCAP file is copied byte for byte and extended. Any other recording, and a file in which
the run has found damage, is rewritten as MCAP. Annotations use the encoding of the recording.
"""

import json
from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from heapq import merge
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO, TypeVar

from shapecat.outputs.annotation.channels import annotation_encoders
from shapecat.outputs.annotation.content import (
    Annotation,
    AnnotationChannel,
    EncodedMessage,
    Encoders,
)
from shapecat.outputs.annotation.encoders import ENCODINGS
from shapecat.outputs.annotation.image_annotations import ImageFrame, image_encoders_for
from shapecat.outputs.annotation.mcap_append import Appender, copy_bytes
from shapecat.recordings import Recording
from shapecat.recordings.containers.mcap_file import McapRecording
from shapecat.recordings.containers.mcap_summary import Summary
from shapecat.system.files import replacing
from shapecat.types import AnnotationFrame

__all__ = ["write_annotated"]

_LIFETIME = 1.5
"""Lifetime of boxes in viewers, as a multiple of the frame period."""
_BUFFER = 4 << 20
"""Size of the write buffer, bytes; large, since each write waits for the thread that copies."""
_PERIOD_NS = 1_000_000_000
"""Frame period assumed for a stream with a single frame."""
_LONGEST_NS = 3600 * 10**9
"""Limit of the frame period: a clock that is set during a recording may jump by decades."""
_AHEAD = 64
"""Number of following frames that are searched for the next frame of a topic."""
_F = TypeVar("_F", Annotation, ImageFrame)


def write_annotated(
    recording: Recording,
    path: Path,
    frames: Iterable[AnnotationFrame],
    *,
    run: Mapping[str, object],
    markers: bool = False,
    images: Iterable[ImageFrame] = (),
    image_topics: Sequence[str] = (),
) -> None:
    """Write a copy of a recording with annotation channels.

    Each frame, with or without objects, gets a message on ``/shapecat/scene`` and, for ROS, on
    ``/shapecat/detections``. Messages have the stamp, frame id and log time of the frame. The
    file gets its name when it is complete.

    Parameters
    ----------
    path : the file to write.
    frames : the boxes to show in each frame, in the order of the recording.
    run : the content of run.json. The metadata record ``shapecat`` holds it as JSON, under the key
        ``run.json``.
    markers : whether to write ``/shapecat/markers`` for RViz, if the encoding is a ROS encoding.
    images : the boxes to show on the colour images, in the order of the recording. They are
        written to ``/shapecat/image_annotations`` and, for ROS, ``/shapecat/detections_2d``, with
        the stamp, frame id and log time of the image.
    image_topics : the topics of these images. If there are several, each has channels of its own:
        ``/shapecat/image_annotations/TOPIC``.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    metadata = {"run.json": json.dumps(run)}
    with replacing(path) as hidden, hidden.open("wb", buffering=_BUFFER) as file:
        damaged = bool(run.get("damaged"))  # other readers stop at a damaged chunk
        if isinstance(recording, McapRecording) and recording.indexed and not damaged:
            with _copying(recording, hidden, file):
                channels, items = _encoded(recording, frames, images, image_topics, markers=markers)
                _append(recording.summary, file, channels, items, metadata)
        else:
            from shapecat.outputs.annotation.mcap_rewrite import rewrite  # noqa: PLC0415  loads YAML for ROS 1

            channels, items = _encoded(recording, frames, images, image_topics, markers=markers)
            rewrite(recording, file, channels, items, metadata)


@contextmanager
def _copying(recording: McapRecording, path: Path, file: BinaryIO) -> Iterator[None]:
    """Copy the data section of a recording to ``path`` while the block writes annotations.

    ``file`` is the open file at ``path``; it is truncated after the annotations.
    """
    length = recording.summary.data_end
    with ThreadPoolExecutor(1) as pool:  # the copy does not hold the interpreter lock
        copying = pool.submit(copy_bytes, recording.path, path, length)
        yield
        copying.result()
    file.truncate()


def _encoded(
    recording: Recording,
    frames: Iterable[AnnotationFrame],
    images: Iterable[ImageFrame],
    image_topics: Sequence[str],
    *,
    markers: bool,
) -> tuple[list[AnnotationChannel], Iterator[EncodedMessage]]:
    """Return the annotation channels, and their encoded messages in the order of log time."""
    annotations = _annotations(frames)
    first = next(annotations, None)
    encoding = _encoding(recording, first)
    kinds = annotation_encoders(encoding, markers=markers)
    channels = [channel for channel, _ in kinds]
    all_annotations = chain([first] if first else [], annotations)
    items = chain.from_iterable(_messages(one, kinds, 0) for one in all_annotations)
    drawn, starts = image_encoders_for(encoding, image_topics), dict[str, int]()
    for topic, encoders in drawn.items():
        starts[topic] = len(channels)
        channels += [channel for channel, _ in encoders]
    more = chain.from_iterable(
        _messages(image, drawn[image.topic], starts[image.topic]) for image in images
    )
    return channels, merge(items, more, key=attrgetter("log_time_ns"))


def _messages(frame: _F, encoders: Encoders[_F], first: int) -> Iterator[EncodedMessage]:
    """Encode a frame for each channel; ``first`` is the index of the first of these channels."""
    for number, (_, encode) in enumerate(encoders, start=first):
        yield EncodedMessage(number, frame.log_time_ns, encode(frame))


def _append(
    summary: Summary,
    file: BinaryIO,
    channels: Iterable[AnnotationChannel],
    items: Iterable[EncodedMessage],
    metadata: Mapping[str, str],
) -> None:
    """Write annotations and metadata after the original data section, and then a new summary."""
    file.seek(summary.data_end)
    compression = summary.chunks[0].compression if summary.chunks else "zstd"
    with Appender(file, summary, compression) as appender:
        numbers = [appender.add_channel(channel) for channel in channels]
        sequences: Counter[int] = Counter()
        for number, log_time, data in items:
            appender.add_message(numbers[number], log_time, sequences[number], data)
            sequences[number] += 1
        appender.add_metadata("shapecat", metadata)
        appender.finish()


def _annotations(frames: Iterable[AnnotationFrame]) -> Iterator[Annotation]:
    """Add to each frame the lifetime of its boxes, and the tracks whose boxes it removes.

    The lifetime follows from the time to the next frame. A box of an earlier frame is removed if no
    sensor sees its track any more.
    """
    visible: dict[str, set[int]] = {}
    for frame, period in _with_periods(frames):
        current = {box.track for box in frame.objects}
        gone = (visible.get(frame.topic, set()) | set(frame.ended)) - current
        visible[frame.topic] = current
        gone -= set().union(*visible.values())  # unless another sensor still sees it
        lifetime = round(_LIFETIME * min(period, _LONGEST_NS))
        yield Annotation(frame, lifetime, tuple(sorted(gone)))


def _with_periods(frames: Iterable[AnnotationFrame]) -> Iterator[tuple[AnnotationFrame, int]]:
    """Yield each frame with the time to the next frame of its topic, ns.

    If none of the next `_AHEAD` frames is of the same topic, the time since the topic's previous
    frame takes its place, or `_PERIOD_NS` if there is no previous frame.
    """
    source = iter(frames)
    following = deque(islice(source, _AHEAD))
    last: dict[str, AnnotationFrame] = {}
    while following:
        frame = following.popleft()
        following.extend(islice(source, 1))
        after = next((other for other in following if other.topic == frame.topic), None)
        before = last.get(frame.topic)
        last[frame.topic] = frame
        if after is not None:
            yield frame, _period(frame, after)
        else:
            yield frame, _PERIOD_NS if before is None else _period(before, frame)


def _period(frame: AnnotationFrame, following: AnnotationFrame) -> int:
    """Return the time between two frames, ns: by stamp or by log time, whichever is longer."""
    by_stamp = following.stamp_ns - frame.stamp_ns
    return max(1, by_stamp, following.log_time_ns - frame.log_time_ns)


def _encoding(recording: Recording, first: Annotation | None) -> str:
    """Return the encoding for annotations: that of the first frame's topic, or the most common.

    Only `ENCODINGS` count; JSON is the default. For a ROS 1 bag, which is converted to ROS 2, the
    encoding is CDR.
    """
    if recording.kind == "ros1":
        return "cdr"
    topics = [topic for topic in recording.topics if topic.encoding in ENCODINGS]
    encodings = [topic.encoding for topic in topics if first and topic.name == first.frame.topic]
    common = Counter(topic.encoding for topic in topics).most_common(1)
    return encodings[0] if encodings else common[0][0] if common else "json"
