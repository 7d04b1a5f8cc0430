"""The interface of all readers of recordings."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, Self

from shapecat.errors import RecordingError, explained
from shapecat.recordings.messages import (
    Channel,
    Message,
    Needed,
    Selection,
    TimeLimit,
    Topic,
    Topics,
)

__all__ = ["Recording"]

_MOST_WARNINGS = 100


class Recording(ABC):
    """An open recording. Use it as a context manager, or `close` it.

    Attributes
    ----------
    path : the file or folder.
    topics : sorted by name; a topic with two types appears twice.
    start_ns, end_ns : log times of the first and last message; 0 if there is none.
    closed : whether the recording was closed; then no messages can be read.
    indexed : whether messages can be found by topic and time, without reading the whole file.
    damaged : whether a damaged chunk or message index was found so far; set for MCAP files only.
    warnings : problems found in the recording, for the user.
    frame_ids : frame ids found so far, by topic: a cache for the search for streams.
    """

    kind: ClassVar[str]
    """``mcap``, ``ros1`` or ``ros2``."""

    def __init__(self, path: Path) -> None:
        """Set empty attributes; subclasses fill them."""
        self.path = path
        self.topics: tuple[Topic, ...] = ()
        self.start_ns = 0
        self.end_ns = 0
        self.closed = False
        self.indexed = True
        self.damaged = False
        self.warnings: list[str] = []
        self.frame_ids: dict[str, str] = {}
        self._channels: dict[int, Channel] = {}
        self._decoders: dict[tuple[str, str, bytes], Callable[[bytes | memoryview], Any]] = {}

    def channels(self) -> tuple[Channel, ...]:
        """Return all channels, including those without messages."""
        return tuple(self._channels.values())

    def parts(self) -> list["Recording"]:
        """Return one recording for each file; for a single file, that is this recording."""
        return [self]

    def messages(
        self,
        topics: Topics = None,
        start_ns: TimeLimit = None,
        stop_ns: TimeLimit = None,
        needed: Needed = None,
    ) -> Iterator[Message]:
        """Yield undecoded messages in constant memory.

        Parameters
        ----------
        topics : names to read; all by default.
        start_ns, stop_ns : messages with ``start_ns <= log time < stop_ns`` are read.
        needed : returns whether the data of a message is needed. Messages that are not needed may
            be yielded without data. If ``needed`` is given, damaged messages, too, are yielded
            without data, so that frame numbers do not depend on which messages are needed.

        Yields
        ------
        Messages by log time, or in file order if the file has no index. Damaged parts are skipped
        and added to ``warnings``.

        Raises
        ------
        RecordingError : the file cannot be read, or the recording is closed before or while its
            messages are read.
        """
        self._require_open()
        with explained(f"{self.path}: cannot be read", RecordingError):
            for message in self._read(Selection(topics, start_ns, stop_ns, needed)):
                yield message
                self._require_open()  # some libraries would end here as if there were no more

    def _require_open(self) -> None:
        if self.closed:
            msg = f"{self.path}: is closed; read its frames before you close it"
            raise RecordingError(msg)

    @abstractmethod
    def _read(self, selection: Selection) -> Iterator[Message]:
        """Yield the selected messages."""

    def close(self) -> None:
        """Release the files; messages cannot be read any more."""
        self.closed = True
        self._release()

    @abstractmethod
    def _release(self) -> None:
        """Close the files, and remove temporary copies."""

    def decode(self, message: Message) -> Any:
        """Return a message as an object with the fields of its type as attributes.

        The definition of the type is read from the recording itself. Foxglove messages get the
        fields of the corresponding ROS messages.

        Raises
        ------
        MessageError : the message, or the definition of its type, is malformed or unsupported.
        """
        from shapecat.recordings.decoding.decoders import decode  # noqa: PLC0415  # loads rosbags

        return decode(message, self._decoders)

    def warn(self, text: str) -> None:
        """Add a warning unless it is a duplicate; after 100, only note that there are more."""
        if text not in self.warnings and len(self.warnings) <= _MOST_WARNINGS:
            enough = len(self.warnings) == _MOST_WARNINGS
            self.warnings.append("and more warnings" if enough else text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
