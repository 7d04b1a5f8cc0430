"""ROS 1 bags (format 2.0)."""

import bz2
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, ClassVar

import lz4.frame  # type: ignore[import-untyped]  # ships no types
from rosbags.rosbag1 import Reader, ReaderError

from shapecat.errors import RecordingError
from shapecat.recordings.decoding import LIBRARY_ERRORS
from shapecat.recordings.messages import Channel, Message, Topic, ros_type
from shapecat.recordings.recording import Recording

__all__ = ["BagRecording"]

_FREELY = 256 << 20
_RATIO = 1000


class BagRecording(Recording):
    """A ROS 1 bag; messages by the time they were recorded."""

    kind: ClassVar[str] = "ros1"

    def __init__(self, path: Path) -> None:
        """Open the bag and read its index.

        Raises
        ------
        RecordingError : it is not a bag, is damaged, or has no index.
        OSError : it cannot be read.
        """
        super().__init__(path)
        self._reader = Reader(path)
        try:
            self._reader.open()
        except (ReaderError, EOFError, *LIBRARY_ERRORS) as error:
            hint = "; `rosbag reindex` may repair it" if "index" in str(error) else ""
            msg = f"not a readable ROS 1 bag: {error}{hint}"
            raise RecordingError(msg) from error
        self._bound_chunks()
        self._channels = {c.id: _channel(c) for c in self._reader.connections}
        counts: dict[tuple[str, str, str], int] = {}
        for connection in self._reader.connections:
            channel = self._channels[connection.id]
            key = (channel.topic, channel.type, channel.encoding)
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(Topic(*key, counts[key]) for key in sorted(counts))
        if self._reader.message_count:
            self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1

    def close(self) -> None:
        """Close the bag."""
        self._reader.close()

    def channels(self) -> tuple[Channel, ...]:
        """Return every connection."""
        return tuple(self._channels.values())

    def messages(
        self,
        topics: Collection[str] | None = None,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[Message]:
        """Yield undecoded messages; see `Recording.messages`."""
        wanted = [c for c in self._reader.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        raw = self._reader.messages(wanted, start_ns, stop_ns)
        while True:
            try:
                connection, time, data = next(raw)
            except StopIteration:
                return
            except (ReaderError, OSError, EOFError, RuntimeError, *LIBRARY_ERRORS) as error:
                self.warn(f"damaged: nothing read after this: {error or type(error).__name__}")
                return
            yield Message(self._channels[connection.id], time, time, 0, data)

    def _bound_chunks(self) -> None:
        """Let no chunk decompress to more than it can honestly hold."""
        size = self.path.stat().st_size
        for position, chunk in self._reader.chunks.items():
            if chunk.datapos + chunk.datasize > size:
                self.close()
                msg = f"not a readable ROS 1 bag: the chunk at byte {position} is cut off"
                raise RecordingError(msg)
            method = _DECOMPRESS.get(chunk.decompressor)
            if method is not None:
                self._reader.chunks[position] = chunk._replace(decompressor=method)


def _channel(connection: Any) -> Channel:
    kind = ros_type(connection.msgtype)
    text = connection.msgdef.data.encode()
    latched = (("latching", "1"),) if connection.ext.latching else ()
    return Channel(connection.topic, kind, "ros1", connection.msgtype, "ros1msg", text, latched)


def _bounded(make: Callable[[], Any]) -> Callable[[bytes], bytes]:
    def decompress(data: bytes) -> bytes:
        limit = max(_FREELY, _RATIO * len(data))
        worker = make()
        plain = worker.decompress(data, max_length=limit)
        if not worker.eof:
            msg = f"chunk of {len(data)} bytes is cut off or holds more than {limit}"
            raise ReaderError(msg)
        return bytes(plain)

    return decompress


_DECOMPRESS: dict[Callable[[bytes], bytes], Callable[[bytes], bytes]] = {
    bz2.decompress: _bounded(bz2.BZ2Decompressor),
    lz4.frame.decompress: _bounded(lz4.frame.LZ4FrameDecompressor),
}
"""The library's unbounded method, and ours."""
