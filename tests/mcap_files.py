"""Write and read MCAP files."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.summary import Summary
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys.store import Typestore


@contextmanager
def mcap_writer(
    path: Path, profile: str = "ros2", *, finish: bool = True, **options: Any
) -> Iterator[Writer]:
    """Provide the writer of a file, which has no summary and no end unless ``finish``."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile, "test")
        yield writer
        if finish:
            writer.finish()
        else:
            writer.flush()


class McapChannels:
    """Writes serialized ROS messages to an MCAP file, with a channel for each topic and type."""

    def __init__(self, writer: Writer, types: Typestore, version: int = 2) -> None:
        self._writer, self._types, self._version = writer, types, version
        self._channels: dict[tuple[str, str], int] = {}

    def declare(self, topic: str, kind: str) -> int:
        """Return the channel, after registering it if it is new."""
        if (topic, kind) not in self._channels:
            text = self._types.generate_msgdef(kind, ros_version=self._version)[0].encode()
            name, encodings = kind, ("ros2msg", "cdr")
            if self._version == 1:
                name, encodings = kind.replace("/msg/", "/"), ("ros1msg", "ros1")
            schema = self._writer.register_schema(name, encodings[0], text)
            channel = self._writer.register_channel(topic, encodings[1], schema)
            self._channels[topic, kind] = channel
        return self._channels[topic, kind]

    def write(self, topic: str, kind: str, time: int, data: bytes) -> None:
        """Write a message of type ``kind``; ``time``, ns, is its log time and its publish time."""
        self._writer.add_message(self.declare(topic, kind), time, data, time)


def read_ros(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Return log time and decoded message of each message of a ROS 2 topic."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(m.log_time, d) for *_, m, d in reader.iter_decoded_messages(topics=[topic])]


def summary_of(path: Path) -> Summary:
    """Return the summary of a file."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return summary
