"""Read a file that consists of chunks: by time if it is indexed, otherwise in file order."""

from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from heapq import heappop, heappush
from pathlib import Path
from typing import Any, NamedTuple

from shapecat.recordings.containers.message_compression import decompressed
from shapecat.recordings.messages import Message, Selection, Topic, detached, sum_topics
from shapecat.recordings.recording import Recording

__all__ = ["Chunk", "ChunkedRecording", "RawMessage", "in_time_order"]

_PENDING = 512 << 20
"""Maximum bytes of messages held back; with more, no further chunk is read ahead."""


class RawMessage(NamedTuple):
    """A message record; ``data`` is a view into its chunk, times are nanoseconds."""

    channel_id: int
    sequence: int
    log_time: int
    publish_time: int
    data: memoryview


class Chunk(NamedTuple):
    """Position, times and channels of a chunk, from the index.

    Attributes
    ----------
    start, end : log times of its first and last message, nanoseconds.
    position : offset in the file, bytes.
    channel_ids : the channels of its messages; empty if the index does not list them.
    entry : the index entry of the chunk, whose type depends on the format.
    """

    start: int
    end: int
    position: int
    channel_ids: Collection[int]
    entry: Any

    def overlaps(self, channel_ids: set[int], selection: Selection) -> bool:
        """Return whether the chunk may hold messages of these channels in the selected period."""
        return (
            (selection.start_ns is None or self.end >= selection.start_ns)
            and (selection.stop_ns is None or self.start < selection.stop_ns)
            and (not self.channel_ids or not channel_ids.isdisjoint(self.channel_ids))
        )


class ChunkedRecording(Recording):
    """A recording in one file that consists of chunks.

    Each format has its own type of records, which is ``Any`` here.
    """

    def __init__(self, path: Path) -> None:
        """Open the file and read its index; without a usable index, scan the file.

        Raises
        ------
        RecordingError : the file is not of this format.
        OSError : the file cannot be read.
        """
        super().__init__(path)
        self._chunks: list[Chunk] = []
        self._counts: Counter[int] = Counter()
        self.indexed = False  # while the index is read
        self._file = path.open("rb")
        try:
            self._size = self._file.seek(0, 2)
            self.indexed = self._read_index()
            if not self.indexed:
                self._scan()
            elif self._chunks:
                self.start_ns = min(chunk.start for chunk in self._chunks)
                self.end_ns = max(chunk.end for chunk in self._chunks)
        except BaseException:
            self._file.close()
            raise
        self.topics = sum_topics(
            Topic(channel.topic, channel.type, channel.encoding, self._counts[number])
            for number, channel in self._channels.items()
        )

    def _release(self) -> None:
        self._file.close()

    @abstractmethod
    def _read_index(self) -> bool:
        """Store channels, counts and chunks from the index; return False if it is not usable."""

    @abstractmethod
    def _record_at(self, position: int) -> Any:
        """Return the record at a byte offset; None if it is damaged or truncated."""

    @abstractmethod
    def _records(self) -> Iterator[Any]:
        """Yield the records in file order; a truncated last one is cut to its readable part."""

    @abstractmethod
    def _expand(self, record: Any) -> Iterator[RawMessage]:
        """Yield the messages of a record; store its channels if the file has no index."""

    @abstractmethod
    def _read_chunk(
        self, chunk: Chunk, channel_ids: set[int], selection: Selection
    ) -> Iterator[RawMessage]:
        """Yield at least the selected messages of these channels in an indexed chunk."""

    def _forget_channels(self) -> None:
        self._channels = {}

    def _agrees(self) -> bool:
        """Return whether the channels in the index are equal to those in the chunks."""
        indexed, warnings = self._channels, list(self.warnings)
        self._forget_channels()
        unseen = set(indexed)
        for chunk in sorted(self._chunks, key=lambda chunk: chunk.position):
            if not unseen.isdisjoint(chunk.channel_ids):
                unseen.difference_update(chunk.channel_ids)
                for _ in self._expand(self._record_at(chunk.position)):
                    pass  # this stores the channels
        found, self._channels = self._channels, indexed
        self.warnings = warnings  # damage is reported when the chunk is read
        return all(indexed.get(number) == channel for number, channel in found.items())

    def _scan(self) -> Any:
        """Read the whole file to find its channels, counts and times.

        Returns the last record; None if there is none.
        """
        self._forget_channels()
        self._counts.clear()
        record = None
        for record in self._records():
            for message in self._expand(record):
                if not self._counts:
                    self.start_ns = self.end_ns = message.log_time
                self.start_ns = min(self.start_ns, message.log_time)
                self.end_ns = max(self.end_ns, message.log_time)
                self._counts[message.channel_id] += 1
        return record

    def _read(self, selection: Selection) -> Iterator[Message]:
        channel_ids = {n for n, c in self._channels.items() if selection.has_topic(c.topic)}
        for raw in self._raw_messages(channel_ids, selection):
            channel = self._channels[raw.channel_id]
            if raw.channel_id not in channel_ids or not selection.has_time(raw.log_time):
                continue
            unneeded = selection.needed and not selection.needed(channel.topic, raw.log_time)
            data = b"" if unneeded else decompressed(self, channel, raw.data)
            if data is None and selection.needed:
                data = b""  # it keeps its place, as unneeded messages do
            if data is not None:
                times = raw.log_time, raw.publish_time
                yield Message(channel, *times, raw.sequence, detached(data))

    def _raw_messages(self, channel_ids: set[int], selection: Selection) -> Iterator[RawMessage]:
        if not self.indexed:
            for record in self._records():
                yield from self._expand(record)
            return
        chunks = [chunk for chunk in self._chunks if chunk.overlaps(channel_ids, selection)]
        yield from in_time_order(
            chunks,
            lambda chunk: (
                message
                for message in self._read_chunk(chunk, channel_ids, selection)
                if message.channel_id in channel_ids
            ),
        )


def in_time_order(
    chunks: Iterable[Chunk], read: Callable[[Chunk], Iterator[RawMessage]]
) -> Iterator[RawMessage]:
    """Yield the messages of all chunks by time, in file order if times are equal.

    While more than 512 MiB of messages are held back, no further chunk is read; messages of
    overlapping chunks may then come out of order.

    Parameters
    ----------
    read : yields the messages of a chunk; called when the chunk is due.
    """
    waiting = sorted(chunks, key=lambda chunk: (chunk.start, chunk.position), reverse=True)
    heap: list[tuple[int, int, int, RawMessage]] = []
    pending = 0
    while waiting or heap:
        due = waiting and (not heap or waiting[-1].start <= heap[0][0])
        if due and (not heap or pending < _PENDING):
            chunk = waiting.pop()
            for number, message in enumerate(read(chunk)):
                heappush(heap, (message.log_time, chunk.position, number, message))
                pending += len(message.data)
            continue
        *_, message = heappop(heap)
        pending -= len(message.data)
        yield message
