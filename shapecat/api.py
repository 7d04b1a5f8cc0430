"""The Python interface: open a run or a recording, process a recording, perceive one image.

``import shapecat`` loads this module only when one of its names is used.
"""

import difflib
import os
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, Self

from numpy.typing import ArrayLike

from shapecat import pipeline
from shapecat.batch.finding import find_recordings
from shapecat.batch.storage import is_url
from shapecat.config import Settings, load_settings, with_settings
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import ConfigError, ModelError, RecordingError, explained, listed
from shapecat.learning import Categorizer, load_model
from shapecat.outputs.in_memory import frame_of, perceive_alone
from shapecat.outputs.opened_run import Run, RunFrame, Table
from shapecat.recordings import FrameRange, Recording, choose_streams, frames
from shapecat.recordings import open_recording as _open_recording
from shapecat.rehearsal import compile_all
from shapecat.runs.jobs import Job
from shapecat.system.progress import Observer, ignore
from shapecat.system.scripts import runs_again
from shapecat.types import Camera, Frame

__all__ = [
    "OpenRecording",
    "Run",
    "RunFrame",
    "Table",
    "open_recording",
    "open_run",
    "perceive",
    "process",
]


def open_run(folder: str | Path) -> Run:
    """Open the results of `shapecat process`.

    Raises
    ------
    ConfigError : the folder is a URL.
    OutputError : the folder is not a finished run.
    """
    return Run(_path(folder))


class OpenRecording:
    """An open recording, from which frames are read; a context manager that closes it.

    Threads may share it; each process has to open the recording itself.
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._process, self._reading = os.getpid(), Lock()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files of the recording."""
        self.recording.close()

    @property
    def topics(self) -> tuple[str, ...]:
        """The names of all topics, each once."""
        return tuple(dict.fromkeys(channel.topic for channel in self.recording.channels()))

    def frames(
        self,
        topics: str | Iterable[str] = (),
        *,
        start_s: float | None = None,
        end_s: float | None = None,
        every: int = 1,
    ) -> Iterator[Frame]:
        """Yield the frames of depth sensors; the options are as for `process`.

        Frames are in the order of the recording, except that a depth image may wait for its
        calibration. Unreadable frames are skipped.

        Raises
        ------
        ConfigError : ``start_s``, ``end_s`` or ``every`` is invalid.
        NoStreamError : a topic is missing or not usable, or none is given and none can be chosen.
        RecordingError : the recording is closed, perhaps while its frames are read, or was opened
            by a process from which this one was forked.
        """
        frame_range = FrameRange(start_s, end_s, every)
        chosen = (topics,) if isinstance(topics, str) else tuple(topics)
        with self._alone():
            streams = choose_streams(self.recording, chosen)
        return self._one_by_one(frames(self.recording, streams, frame_range))

    def _one_by_one(self, read: Iterator[Frame]) -> Iterator[Frame]:
        while True:
            with self._alone():
                frame = next(read, None)
            if frame is None:
                return
            yield frame

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Let one thread read at a time; refuse other processes.

        All threads, and processes forked from this one, share the position in the file. Messages
        read elsewhere in the file would count as damaged, and be skipped.
        """
        if os.getpid() != self._process:
            msg = f"{self.recording.path}: is open in another process; open it in each process"
            raise RecordingError(msg)
        with self._reading:
            yield


def open_recording(path: str | Path) -> OpenRecording:
    """Open an MCAP file, a ROS 1 bag or a ROS 2 bag.

    Raises
    ------
    ConfigError : the path is a URL.
    RecordingError : the path is not a readable recording, or is a folder of several recordings.
    """
    return OpenRecording(_open_recording(_one_recording(_path(path))))


def process(
    recording: str | Path,
    out: str | Path,
    *,
    topics: str | Iterable[str] = (),
    up: str | Iterable[float] = "auto",
    fixed_frame: str | None = None,
    start_s: float | None = None,
    end_s: float | None = None,
    every: int = 1,
    model: str | Path | None = None,
    config: str | Path | None = None,
    mcap: bool = True,
    rrd: bool = True,
    color: str | None = None,
    overwrite: bool = False,
    discard_labels: bool = False,
    cores: int = 1,
    observe: Observer | None = None,
    **settings: Any,
) -> Run:
    """Process one recording as `shapecat process` does, and open the results.

    The results are written to ``out/NAME``, where NAME is the name of the recording without its
    suffix. Without ``overwrite``, complete results of the same input, settings and model are opened
    instead of being computed again.

    Parameters
    ----------
    topics : one topic of depth images or clouds, or several; needed if there are several cameras.
    up : up direction: ``tf`` from transforms, ``imu`` from an accelerometer, or three numbers in
        the sensor frame; ``auto`` uses transforms, else an accelerometer, else the planes.
    fixed_frame : frame in which objects stand still, such as ``map``; None to choose one.
    start_s, end_s : limits, seconds after the start of the recording, ``end_s`` exclusive; None for
        no limit.
    every : process every n-th frame.
    model : path of a model file; None for the model that comes with shapecat.
    config : path of a TOML file with settings.
    overwrite : whether to replace earlier results; corrected labels are transferred.
    discard_labels : with ``overwrite``, whether to drop corrected labels.
    color : topic of the colour images for all depth topics; None to choose one for each, empty to
        use none.
    mcap, rrd : whether to write annotated.mcap and review.rrd.
    cores : number of processes that perceive frames. If there are several, a script must have
        ``if __name__ == "__main__":``.
    observe : called with the phase, the number of frames done, and the total (None if unknown);
        while kernels are compiled, with the number compiled so far.
    settings : for example ``seed=3`` or ``detection={"max_range_m": 1.5}``; see docs/reference.md.

    Raises
    ------
    ConfigError : an option or setting does not exist, has an invalid value or would have no effect,
        or several processes are requested and the script lacks the ``__main__`` line.
    RecordingError : the recording cannot be read, or is a folder of several recordings.
    NoStreamError, ModelError, OutputError : as for the command, which prints them.
    """
    _require_known(settings, process.__annotations__)
    frame_range = FrameRange(start_s, end_s, every)
    if cores < 1 or cores % 1:
        msg = f"cores must be an integer of at least 1, got {cores}"
        raise ConfigError(msg)
    if discard_labels and not overwrite:
        msg = "discard_labels needs overwrite: without it, labels stay with their results"
        raise ConfigError(msg)
    if cores > 1 and runs_again():
        msg = f'cores={cores} starts processes: a script needs `if __name__ == "__main__":`'
        raise ConfigError(msg)
    source = _one_recording(_path(recording))
    job = Job(
        source=source,
        folder=_path(out) / (source.resolve().name if source.is_dir() else source.stem),
        settings=with_settings(load_settings(None if config is None else _path(config)), settings),
        topics=(topics,) if isinstance(topics, str) else tuple(topics),
        up=up if isinstance(up, str) else ",".join(str(float(part)) for part in up),
        fixed_frame=fixed_frame,
        frame_range=frame_range,
        model=None if model is None else _path(model),
        mcap=mcap,
        rrd=rrd,
        color=color,
        overwrite=overwrite,
        discard_labels=discard_labels,
    )
    pipeline.process(job, observe or ignore, cores=int(cores))
    return Run(job.folder)


def perceive(
    reading: ArrayLike | Frame,
    intrinsics: ArrayLike | Camera | None = None,
    *,
    up: ArrayLike | None = None,
    model: str | Path | None = None,
    config: str | Path | None = None,
    **settings: Any,
) -> RunFrame:
    """Find and categorize the objects of one depth image, point cloud or frame.

    Nothing is tracked and nothing is written; the result depends only on the arguments. The first
    call after an installation compiles kernels for about a minute.

    Parameters
    ----------
    reading : a depth image (h, w) along the optical axis, floats in metres or integers in
        millimetres; or points (n, 3) or (h, w, 3) in the sensor frame, metres; or a frame of a
        recording, which needs no intrinsics. Depth that is zero, negative or not finite, points
        that are not finite, and values that NumPy masks count as missing.
    intrinsics : fx, fy, cx, cy of the depth image, pixels, or its camera matrix (3, 3), or the
        `Camera` of a frame.
    up : (3,) up direction in the sensor frame; None to estimate it from planes.
    model, config, settings : as for `process`.

    Returns
    -------
    A frame like the frames of a run. The track of each object is its number in the frame, from 1;
    posterior and confidence come from this view alone. If ``labelled.planes`` is empty,
    ``labelled.up`` is not an estimate, but ``up`` or, without it, the default (0, -1, 0).

    Raises
    ------
    ConfigError : an argument has the wrong shape or value, or a setting does not exist.
    ModelError : the model cannot be read, or was trained on a different descriptor.
    """
    _require_known(settings, perceive.__annotations__)
    chosen = with_settings(load_settings(None if config is None else _path(config)), settings)
    categorizer = load_model(None) if model is None else _model_at(_path(model))
    categorizer.require_descriptor(DESCRIPTOR_NAMES)
    frame = frame_of(reading, intrinsics)
    compile_all()
    return perceive_alone(frame, up=up, categorizer=categorizer, settings=chosen)


def _model_at(path: Path) -> Categorizer:
    """Read a model, or return the one read last if it is from the same, unchanged file."""
    with explained(f"{path}: cannot read the model", ModelError):
        file = path.stat()
    return _unchanged_model(path.resolve(), file.st_size, file.st_mtime_ns)


@lru_cache(maxsize=1)
def _unchanged_model(path: Path, _size: int, _mtime_ns: int) -> Categorizer:
    return load_model(path)


def _require_known(settings: Collection[str], options: Collection[str]) -> None:
    """Reject a keyword that is neither an option nor a setting."""
    options = set(options) - {"return", "settings"}
    known = sorted({*options, *Settings.__annotations__})
    for name in settings:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"; did you mean {near[0]}?" if near else f"; known: {', '.join(known)}"
            msg = f"unknown option or setting {name}{hint}"
            raise ConfigError(msg)


def _path(given: str | Path) -> Path:
    """Return a path; ``~`` is the home folder. Refuse a URL, which would become a local path."""
    if is_url(os.fspath(given)):
        msg = f"{given} is a URL; from Python, shapecat reads and writes local paths only"
        raise ConfigError(msg)
    return Path(os.path.expanduser(given))  # noqa: PTH111  Path fails without a home


def _one_recording(path: Path) -> Path:
    """Return a path; refuse a folder of recordings, whose files would be read as parts of one."""
    if path.is_dir():
        found = [source.path for source in find_recordings([str(path)]).sources]
        if len(found) > 1:
            names = listed([str(Path(name).relative_to(path)) for name in found])
            msg = f"{path}: a folder of {len(found)} recordings; name one of them: {names}"
            raise RecordingError(msg)
    return path
