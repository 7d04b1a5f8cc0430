"""Interface of all readers."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar, Self

from shapecat.recordings.messages import (
    Channel,
    Message,
    Needed,
    Selection,
    Stamp,
    Topic,
    Topics,
)

__all__ = ["Recording"]

_MOST_WARNINGS = 100


class Recording(ABC):
    """An open log. Use it as a context manager, or `close` it.

    Attributes
    ----------
    path : the file or folder.
    topics : what was recorded, by name; a topic with two types appears twice.
    start_ns, end_ns : log times of the first and last message; 0 when there is none.
    warnings : what was odd about the recording, for the user.
    """

    kind: ClassVar[str]
    """``mcap``, ``ros1`` or ``ros2``."""

    def __init__(self, path: Path) -> None:
        """Prepare the attributes; subclasses fill them."""
        self.path = path
        self.topics: tuple[Topic, ...] = ()
        self.start_ns = 0
        self.end_ns = 0
        self.warnings: list[str] = []
        self._channels: dict[int, Channel] = {}
        self._decoders: dict[tuple[str, str, bytes], Callable[[bytes | memoryview], Any]] = {}

    def channels(self) -> tuple[Channel, ...]:
        """Return every channel, also those without messages."""
        return tuple(self._channels.values())

    def parts(self) -> list["Recording"]:
        """Return the recordings that it consists of: one per file, or itself alone."""
        return [self]

    def messages(
        self,
        topics: Topics = None,
        start_ns: Stamp = None,
        stop_ns: Stamp = None,
        needed: Needed = None,
    ) -> Iterator[Message]:
        """Yield undecoded messages in constant memory.

        Parameters
        ----------
        topics : names to read; all by default.
        start_ns, stop_ns : log times of the first message and of the first one left out.
        needed : an indexed file may give other messages without their data, unread.

        Yields
        ------
        Messages by log time; in the order of the file where it has no index. A part that cannot
        be read is left out and noted in ``warnings``.
        """
        return self._read(Selection(topics, start_ns, stop_ns, needed))

    @abstractmethod
    def _read(self, selection: Selection) -> Iterator[Message]:
        """Yield the messages that are selected."""

    @abstractmethod
    def close(self) -> None:
        """Release the file."""

    def decode(self, message: Message) -> Any:
        """Return a message as an object with the fields of its type as attributes.

        The type is read from the definition that the recording itself holds.

        Raises
        ------
        MessageError : the message, or the definition of its type, cannot be understood.
        """
        from shapecat.recordings.decoding import decode  # noqa: PLC0415  # loads rosbags

        return decode(message, self._decoders)

    def warn(self, text: str) -> None:
        """Add to ``warnings``, once; a badly damaged recording has no end of them."""
        if text not in self.warnings and len(self.warnings) <= _MOST_WARNINGS:
            enough = len(self.warnings) == _MOST_WARNINGS
            self.warnings.append("and more of this kind" if enough else text)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
