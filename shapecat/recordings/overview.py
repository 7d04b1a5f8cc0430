"""Contents of a recording as plain values, for `shapecat info`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from shapecat.errors import RecordingError, explained
from shapecat.recordings.colour_streams import pair_colours
from shapecat.recordings.containers.opening import open_recording
from shapecat.recordings.files import input_size
from shapecat.recordings.recording import Recording
from shapecat.recordings.streams import Stream, depth_streams

__all__ = ["describe_recording"]


def describe_recording(path: Path) -> dict[str, Any]:
    """Return a recording's path, kind, size, times, topics with their use, and warnings.

    The keys are ``path``, ``kind``, ``bytes``, ``start_ns`` (log time), ``seconds``, ``warnings``
    and ``topics``. Each topic has ``name``, ``type``, ``encoding``, ``count`` and ``use``,
    which is empty for a topic that shapecat does not use.

    Raises
    ------
    RecordingError : the recording cannot be read.
    """
    unreadable = explained(f"{path}: cannot be read", RecordingError)
    with unreadable, open_recording(path) as recording:
        streams = {stream.topic: stream for stream in depth_streams(recording)}
        uses = _uses(recording, streams)
        for stream in streams.values():
            if stream.doubt:
                recording.warn(stream.doubt)
        start, end = recording.start_ns, recording.end_ns
        return {
            "path": str(path),
            "kind": recording.kind,
            "bytes": input_size(path),
            "start_ns": start,
            "seconds": (end - start) * 1e-9,
            "topics": [
                {
                    "name": topic.name,
                    "type": topic.type,
                    "encoding": topic.encoding,
                    "count": topic.count,
                    "use": uses.get(topic.name, ""),
                }
                for topic in recording.topics
            ],
            "warnings": list(recording.warnings),
        }


def _uses(recording: Recording, streams: Mapping[str, Stream]) -> dict[str, str]:
    """Return the purpose of each topic that shapecat uses, in words."""
    uses = {stream.info_topic: "CameraInfo" for stream in streams.values() if stream.info_topic}
    colours = pair_colours(recording, list(streams.values()))
    for topic, stream in streams.items():
        uses[topic] = f"{stream.kind} stream{'' if stream.usable else ' without CameraInfo'}"
        colour = colours.get(topic)
        if colour is None:
            continue
        if colour.kind == "cloud":
            uses[topic] += " with colours"
            continue
        use = uses.get(colour.topic, "")
        uses[colour.topic] = f"{use}, {topic}" if use else f"colour of {topic}"
        if colour.info_topic:
            uses.setdefault(colour.info_topic, "CameraInfo")
    return uses
