"""Decompress messages that rosbag2 compressed one by one (``--compression-mode message``)."""

import zstandard

from shapecat.recordings.messages import Channel
from shapecat.recordings.recording import Recording

__all__ = ["decompressed"]

_ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a compressed message; a CDR message begins with a zero byte."""
_LARGEST = 1 << 30
"""Largest size, in bytes, that a compressed message may claim for its data."""


def decompressed(
    recording: Recording, channel: Channel, data: bytes | memoryview
) -> bytes | memoryview | None:
    """Return a message's data, decompressed if necessary; None, with a warning, if that fails."""
    if data[: len(_ZSTD)] != _ZSTD or channel.encoding != "cdr":
        return data
    try:
        if zstandard.frame_content_size(data) > _LARGEST:
            recording.warn(f"{channel.topic}: skipped a message that claims more than 1 GiB")
            return None
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=_LARGEST)
    except (zstandard.ZstdError, MemoryError):
        recording.warn(f"{channel.topic}: skipped a damaged compressed message")
        return None
