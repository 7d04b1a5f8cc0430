"""Find a usable calibration of a camera, since some drivers publish zeros at first."""

from contextlib import suppress
from typing import Any

from shapecat.recordings.messages import MALFORMED
from shapecat.recordings.pinhole import has_intrinsics
from shapecat.recordings.recording import Recording
from shapecat.recordings.streams import first_messages

__all__ = ["first_calibration"]

_SEARCHED = 300
"""Number of messages to search: ten seconds at 30 Hz."""


def first_calibration(recording: Recording, topic: str) -> Any:
    """Return the first decoded CameraInfo of a topic that has intrinsics.

    If none of the first few hundred has, return the first one; None if none can be decoded.
    """
    first = None
    for info in first_messages(recording, topic, most=_SEARCHED):
        with suppress(*MALFORMED):
            if has_intrinsics(info):
                return info
            first = info if first is None else first
    return first
