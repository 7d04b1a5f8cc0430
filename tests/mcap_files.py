"""Write and read MCAP files."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.summary import Summary
from mcap.writer import Writer
from mcap_ros2.decoder import DecoderFactory


@contextmanager
def mcap_writer(
    path: Path, profile: str = "ros2", *, finish: bool = True, **options: Any
) -> Iterator[Writer]:
    """Provide the writer of a file, which has no summary and no end unless ``finish``."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile, "test")
        yield writer
        if finish:
            writer.finish()
        else:
            writer.flush()


def read_ros(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Return log time and decoded message of each message of a ROS 2 topic."""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return [(m.log_time, d) for *_, m, d in reader.iter_decoded_messages(topics=[topic])]


def summary_of(path: Path) -> Summary:
    """Return the summary of a file."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return summary
