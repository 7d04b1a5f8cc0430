"""Find the topics with transforms, which several robots may publish in their own namespaces."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from shapecat.recordings.decoding.foxglove import ros_counterpart
from shapecat.recordings.messages import MALFORMED
from shapecat.recordings.recording import Recording
from shapecat.recordings.streams import first_messages

__all__ = ["TF_TYPES", "TransformTopics", "is_latched", "transform_topics"]

TF_TYPES = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


class TransformTopics(NamedTuple):
    """The topics with static transforms, and those with transforms that may change."""

    static: set[str]
    moving: set[str]


def transform_topics(recording: Recording, sensor_topics: Sequence[str] = ()) -> TransformTopics:
    """Return the topics of a recording that hold transforms.

    If frames of the same name are on ``/r1/tf`` and ``/r2/tf``, the topic in the namespace of
    ``sensor_topics`` is used, and the other robot's is left out, with a warning. ``/tf`` is always
    used.
    """
    topics = {t.name for t in recording.topics if ros_counterpart(t.type) in TF_TYPES}
    spaces = {topic: topic.strip("/").rpartition("/")[0] for topic in sorted(topics)}
    spaces = {topic: space for topic, space in spaces.items() if space}
    if len(set(spaces.values())) > 1:
        topics -= _of_other_robots(recording, spaces, sensor_topics)
    static = {name for name in topics if name.endswith("tf_static")}
    return TransformTopics(static, topics - static)


def is_latched(kind: str) -> bool:
    """Return whether the last transform of a message type stays valid, as Foxglove's do."""
    return ros_counterpart(kind) in TF_TYPES and kind not in TF_TYPES


def _of_other_robots(
    recording: Recording, spaces: Mapping[str, str], sensor_topics: Sequence[str]
) -> set[str]:
    """Return the topics of other robots, and add warnings; ``spaces`` maps topics to namespaces."""
    around = {
        max(
            (s for s in spaces.values() if name.strip("/").startswith(f"{s}/")), key=len, default=""
        )
        for name in sensor_topics
    }
    left: set[str] = set()
    owner: dict[str, str] = {}  # the topic of each frame
    for topic in sorted(spaces, key=lambda topic: spaces[topic] not in around):
        frames = _frames(recording, topic)
        rivals = [owner[f] for f in frames if f in owner and spaces[owner[f]] != spaces[topic]]
        nearer = [other for other in rivals if spaces[other] in around]
        if nearer and spaces[topic] not in around:
            recording.warn(
                f"transforms on {topic} are ignored: {nearer[0]}, in the namespace of the depth "
                "topic, has frames of the same name"
            )
            left.add(topic)
            continue
        if rivals:
            recording.warn(
                f"transforms on {rivals[0]} and {topic} have frames of the same name, and those of "
                "one robot are used for the other: process one at a time, with --topic"
            )
        owner |= {frame: topic for frame in frames if frame not in owner}
    return left


def _frames(recording: Recording, topic: str) -> list[str]:
    """Return the child frames in the first transforms on a topic, sorted."""
    frames: set[str] = set()
    with suppress(*MALFORMED):
        for message in first_messages(recording, topic):
            frames |= {one.child_frame_id.strip().lstrip("/") for one in message.transforms}
    return sorted(frames)
