"""The door from Python: open a run, open a recording, process one.

``import shapecat`` loads nothing of this until a name is used.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Self

from shapecat import pipeline
from shapecat.config import load_settings, with_settings
from shapecat.errors import ConfigError
from shapecat.outputs.opened_run import Run, RunFrame, Table
from shapecat.recordings import Recording, choose_streams, frames
from shapecat.recordings import open_recording as _open_recording
from shapecat.runs.jobs import Job
from shapecat.system.scripts import runs_again
from shapecat.types import Frame

__all__ = ["OpenRecording", "Run", "RunFrame", "Table", "open_recording", "open_run", "process"]

Observer = Callable[[str, int, int | None], None]


def _ignore(_phase: str, _done: int, _total: int | None) -> None:
    """Observe nothing."""


def open_run(folder: str | Path) -> Run:
    """Open the results of `shapecat process`.

    Raises
    ------
    OutputError : the folder is no finished run.
    """
    return Run(Path(folder))


class OpenRecording:
    """An open recording; a context manager that yields frames."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close its files."""
        self.recording.close()

    @property
    def topics(self) -> tuple[str, ...]:
        """All topics."""
        return tuple(channel.topic for channel in self.recording.channels())

    def frames(
        self,
        topics: Sequence[str] = (),
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        every: int = 1,
    ) -> Iterator[Frame]:
        """Yield the readings of depth sensors, by log time; options as those of `process`.

        Raises
        ------
        NoStreamError : there is no such stream, or none that can be read.
        """
        streams = choose_streams(self.recording, topics)
        return frames(
            self.recording,
            streams,
            start_s=start_s,
            end_s=end_s,
            every=every,
            skipped=Counter(),
        )


def open_recording(path: str | Path) -> OpenRecording:
    """Open an MCAP file, a ROS 1 bag or a ROS 2 bag.

    Raises
    ------
    RecordingError : it is none, or damaged from the start.
    """
    return OpenRecording(_open_recording(Path(path)))


def process(
    recording: str | Path,
    out: str | Path,
    *,
    topics: Sequence[str] = (),
    up: str = "auto",
    fixed_frame: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    every: int = 1,
    model: str | Path | None = None,
    config: str | Path | None = None,
    mcap: bool = True,
    rrd: bool = True,
    overwrite: bool = False,
    cores: int = 1,
    observe: Observer | None = None,
    **settings: Any,
) -> Run:
    """Process one recording into the folder ``out/NAME``, as `shapecat process` does.

    A complete folder made from the same input and settings is opened as it is.

    Parameters
    ----------
    topics, up, fixed_frame, start_s, end_s, every, model, config, overwrite : the options of the
        command of the same names.
    mcap, rrd : write annotated.mcap and review.rrd.
    cores : processes that perceive. With several, a script needs ``if __name__ == "__main__":``.
    observe : told the phase, the frames done, and how many there are, if known.
    settings : ``seed=3``, ``detection={"max_range_m": 1.5}``; names as in the reference.

    Raises
    ------
    ConfigError : a setting that does not exist, or does not fit; or a script without that line asks
        for several cores.
    RecordingError, NoStreamError, ModelError, OutputError : as the command, which prints them.
    """
    if cores > 1 and runs_again():
        msg = f'cores={cores} starts processes: a script needs `if __name__ == "__main__":`'
        raise ConfigError(msg)
    source = Path(recording)
    job = Job(
        source=source,
        folder=Path(out) / (source.resolve().name if source.is_dir() else source.stem),
        settings=with_settings(load_settings(None if config is None else Path(config)), settings),
        topics=tuple(topics),
        up=up,
        fixed_frame=fixed_frame,
        start_s=start_s,
        end_s=end_s,
        every=every,
        model=None if model is None else Path(model),
        mcap=mcap,
        rrd=rrd,
        overwrite=overwrite,
    )
    pipeline.process(job, observe or _ignore, cores=cores)
    return Run(job.folder)
