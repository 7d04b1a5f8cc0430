"""Rewrite a recording as MCAP, with the annotations among its messages by time."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
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
"""The number of a channel in the written file, and the conversion of its messages."""


def rewrite(
    recording: Recording,
    file: BinaryIO,
    channels: Sequence[AnnotationChannel],
    items: Iterable[EncodedMessage],
    metadata: Mapping[str, str],
) -> None:
    """Write the messages of a recording, its attachments and metadata, and the annotations.

    Messages of ROS 1 bags are converted to CDR, or wrapped by `wrap_raw` if that is impossible.
    """
    writer = Writer(file, compression=CompressionType.LZ4)
    parts = [part for part in recording.parts() if isinstance(part, McapRecording)]
    writer.start(parts[0].profile if parts else "ros2", "shapecat")
    source = _Source(writer, convert=recording.kind == "ros1")
    for channel in recording.channels():
        source.number(channel)
    numbers = [_register(writer, channel) for channel in channels]
    sequences: Counter[int] = Counter()
    streams: list[Iterable[Message | EncodedMessage]] = [recording.messages(), items]
    for item in merge(*streams, key=attrgetter("log_time_ns")):
        if isinstance(item, Message):
            source.write(item)
            continue
        position, time = item.channel, item.log_time_ns
        writer.add_message(numbers[position], time, item.data, time, sequences[position])
        sequences[position] += 1
    for part in parts:
        _copy_extras(part, writer)
    writer.add_metadata("shapecat", dict(metadata))
    writer.finish()


class _Source:
    """Writes the original messages, and registers their channels as they appear."""

    def __init__(self, writer: Writer, *, convert: bool) -> None:
        self.writer = writer
        self.convert = convert
        self.known: dict[Channel, _Registered] = {}
        self.schemas: dict[tuple[str, str, bytes], int] = {}
        self.raw: dict[str, int] = {}

    def write(self, message: Message) -> None:
        """Write a message, converted or wrapped if necessary."""
        channel = message.channel
        number, convert = self.number(channel)
        data: bytes | memoryview = message.data
        try:
            data = convert(data) if convert is not None else data
        except LIBRARY_ERRORS:
            number, data = self._raw_number(channel), wrap_raw(channel, data)
        times = (message.log_time_ns, bytes(data), message.publish_time_ns)
        self.writer.add_message(number, *times, message.sequence)

    def number(self, channel: Channel) -> _Registered:
        """Return the number of a channel, and the function that converts its messages, or None."""
        if channel not in self.known:
            self.known[channel] = self._register(channel)
        return self.known[channel]

    def _register(self, channel: Channel) -> _Registered:
        if not (self.convert and channel.encoding == "ros1"):
            described = AnnotationChannel(
                channel.topic, channel.encoding, *schema_of(channel), channel.metadata
            )
            return _register(self.writer, described, self.schemas), None
        converted = convert_channel(channel)
        if converted is None:
            return self._raw_number(channel), lambda data: wrap_raw(channel, data)
        return _register(self.writer, converted[0], self.schemas), converted[1]

    def _raw_number(self, channel: Channel) -> int:
        if channel.topic not in self.raw:
            described = raw_channel(channel.topic)
            self.raw[channel.topic] = _register(self.writer, described, self.schemas)
        return self.raw[channel.topic]


def _register(
    writer: Writer,
    channel: AnnotationChannel,
    schemas: dict[tuple[str, str, bytes], int] | None = None,
) -> int:
    key = (channel.schema_name, channel.schema_encoding, channel.schema)
    schemas = {} if schemas is None else schemas
    if key not in schemas:
        schemas[key] = writer.register_schema(*key) if channel.schema_name else 0
    metadata = dict(channel.metadata)
    return int(writer.register_channel(channel.topic, channel.encoding, schemas[key], metadata))


def _copy_extras(recording: McapRecording, writer: Writer) -> None:
    """Copy attachments and metadata to the writer."""
    for item in _extras(recording):
        if isinstance(item, records.Attachment):
            writer.add_attachment(
                item.create_time, item.log_time, item.name, item.media_type, item.data
            )
        else:
            writer.add_metadata(item.name, item.metadata)


def _extras(recording: McapRecording) -> Iterator[records.Attachment | records.Metadata]:
    readers = {
        Opcode.ATTACHMENT: records.Attachment.read,
        Opcode.METADATA: records.Metadata.read,
    }
    for record in recording.top_level():
        read = readers.get(record.opcode)
        if read is not None:
            try:
                yield parse(read, recording.content(record))
            except ChunkError as error:
                recording.warn(f"skipped a record at byte {record.offset}: {error}")
