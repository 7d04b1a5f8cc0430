"""Read frames from robot recordings: containers, clouds, depth images, transforms."""

from shapecat.recordings.containers.opening import open_recording
from shapecat.recordings.frames import FrameRange, frames
from shapecat.recordings.messages import Channel, Message, MessageError, Topic
from shapecat.recordings.recording import Recording
from shapecat.recordings.streams import Stream, choose_streams, depth_streams
from shapecat.recordings.transforms.buffer import TransformBuffer, fixed_frame
from shapecat.recordings.transforms.reading import read_transforms

__all__ = [
    "Channel",
    "FrameRange",
    "Message",
    "MessageError",
    "Recording",
    "Stream",
    "Topic",
    "TransformBuffer",
    "choose_streams",
    "depth_streams",
    "fixed_frame",
    "frames",
    "open_recording",
    "read_transforms",
]
