"""Rewrite a recording as MCAP, with its messages and the annotations in the order of log time."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from heapq import merge
from operator import attrgetter
from typing import BinaryIO

from mcap import records
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer

from shapecat.outputs.annotation.content import AnnotationChannel, EncodedMessage
from shapecat.outputs.annotation.ros1_conversion import convert_channel, raw_channel, wrap_raw
from shapecat.recordings import Channel, Message, Recording
from shapecat.recordings.containers.mcap_file import McapRecording
from shapecat.recordings.containers.mcap_records import ChunkError, parse
from shapecat.recordings.decoding.decoders import LIBRARY_ERRORS, schema_of

__all__ = ["rewrite"]

_Registered = tuple[int, Callable[[bytes | memoryview], memoryview] | None]
"""The id of a channel in the new file, and the converter of its messages, or None."""


def rewrite(
    recording: Recording,
    file: BinaryIO,
    channels: Sequence[AnnotationChannel],
    items: Iterable[EncodedMessage],
    metadata: Mapping[str, str],
) -> None:
    """Write the messages of a recording, its attachments and metadata, and the annotations.

    Messages of ROS 1 bags are converted to CDR, or wrapped by `wrap_raw` if that is impossible.

    Parameters
    ----------
    channels : the channels of the annotations.
    items : the annotations in the order of log time; each has the index of its channel in
        ``channels``.
    metadata : content of the metadata record ``shapecat``.
    """
    writer = Writer(file, compression=CompressionType.LZ4)
    parts = [part for part in recording.parts() if isinstance(part, McapRecording)]
    writer.start(parts[0].profile if parts else "ros2", "shapecat")
    target = _Target(writer, convert=recording.kind == "ros1")
    for channel in recording.channels():
        target.registered(channel)
    ids = [target.register(channel) for channel in channels]
    sequences: Counter[int] = Counter()
    streams: list[Iterable[Message | EncodedMessage]] = [recording.messages(), items]
    for item in merge(*streams, key=attrgetter("log_time_ns")):
        if isinstance(item, Message):
            target.write(item)
            continue
        position, time = item.channel, item.log_time_ns
        writer.add_message(ids[position], time, item.data, time, sequences[position])
        sequences[position] += 1
    for part in parts:
        _copy_extras(part, writer)
    writer.add_metadata("shapecat", dict(metadata))
    writer.finish()


class _Target:
    """Writes the original messages, and registers channels as they appear."""

    def __init__(self, writer: Writer, *, convert: bool) -> None:
        self.writer = writer
        self.convert = convert
        self.known: dict[Channel, _Registered] = {}
        self.schemas: dict[tuple[str, str, bytes], int] = {}
        self.raw: dict[str, int] = {}

    def write(self, message: Message) -> None:
        """Write a message, converted or wrapped if necessary."""
        channel = message.channel
        channel_id, convert = self.registered(channel)
        data: bytes | memoryview = message.data
        try:
            data = convert(data) if convert is not None else data
        except LIBRARY_ERRORS:
            channel_id, data = self._raw_id(channel), wrap_raw(channel, data)
        times = (message.log_time_ns, bytes(data), message.publish_time_ns)
        self.writer.add_message(channel_id, *times, message.sequence)

    def registered(self, channel: Channel) -> _Registered:
        """Return the id of a channel in the new file, and the converter of its messages or None.

        A new channel is registered first.
        """
        if channel not in self.known:
            self.known[channel] = self._register(channel)
        return self.known[channel]

    def register(self, channel: AnnotationChannel) -> int:
        """Register a channel and its schema; return the id of the channel."""
        key = (channel.schema_name, channel.schema_encoding, channel.schema)
        if key not in self.schemas:
            self.schemas[key] = self.writer.register_schema(*key) if channel.schema_name else 0
        about = channel.topic, channel.encoding, self.schemas[key], dict(channel.metadata)
        return int(self.writer.register_channel(*about))

    def _register(self, channel: Channel) -> _Registered:
        if not (self.convert and channel.encoding == "ros1"):
            about = channel.topic, channel.encoding, *schema_of(channel), channel.metadata
            return self.register(AnnotationChannel(*about)), None
        converted = convert_channel(channel)
        if converted is None:
            return self._raw_id(channel), lambda data: wrap_raw(channel, data)
        return self.register(converted[0]), converted[1]

    def _raw_id(self, channel: Channel) -> int:
        if channel.topic not in self.raw:
            self.raw[channel.topic] = self.register(raw_channel(channel.topic))
        return self.raw[channel.topic]


def _copy_extras(recording: McapRecording, writer: Writer) -> None:
    """Copy attachments and metadata to the writer; warn about damaged ones."""
    for record in recording.top_level():
        try:
            if record.opcode == Opcode.ATTACHMENT:
                file = parse(records.Attachment.read, recording.content(record))
                times = file.create_time, file.log_time
                writer.add_attachment(*times, file.name, file.media_type, file.data)
            elif record.opcode == Opcode.METADATA:
                entry = parse(records.Metadata.read, recording.content(record))
                writer.add_metadata(entry.name, entry.metadata)
        except ChunkError as error:
            recording.warn(f"skipped a record at byte {record.offset}: {error}")
