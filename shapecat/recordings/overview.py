"""What a recording holds, in plain values: for people and programs that look before they work."""

from pathlib import Path
from typing import Any

from shapecat.files import input_size
from shapecat.recordings.opening import open_recording
from shapecat.recordings.streams import cloud_streams

__all__ = ["describe_recording"]


def describe_recording(path: Path) -> dict[str, Any]:
    """Return path, kind, size, times, topics with their use, and warnings of one recording.

    Raises
    ------
    RecordingError : it cannot be read.
    """
    with open_recording(path) as recording:
        streams = {stream.topic: stream for stream in cloud_streams(recording)}
        infos = {stream.info_topic for stream in streams.values()}
        start, end = recording.start_ns, recording.end_ns
        return {
            "path": str(path),
            "kind": recording.kind,
            "bytes": input_size(path),
            "start_ns": start,
            "seconds": 0.0 if start is None or end is None else (end - start) * 1e-9,
            "topics": [
                {
                    "name": topic.name,
                    "type": topic.type,
                    "encoding": topic.encoding,
                    "count": topic.count,
                    "use": f"{streams[topic.name].kind} stream"
                    if topic.name in streams
                    else "camera"
                    if topic.name in infos
                    else "",
                }
                for topic in recording.topics
            ],
            "warnings": list(recording.warnings),
        }
