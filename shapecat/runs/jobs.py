"""Describe jobs (a recording and how to process it) and runs (their results, in run.json)."""

import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

from shapecat import __version__
from shapecat.config import Settings
from shapecat.errors import ModelError, NoStreamError, OutputError, RecordingError
from shapecat.learning import Categorizer
from shapecat.recordings import Recording
from shapecat.recordings.files import input_size
from shapecat.recordings.frames import ALL_FRAMES, FrameRange
from shapecat.runs.folder import clear, made_by_run
from shapecat.runs.identity import (
    ContentDigest,
    file_stats,
    new_id,
    unchanged,
    work_id,
)
from shapecat.runs.run_info import InputInfo, Options, OriginInfo, RunInfo, SettingsInfo

__all__ = [
    "Job",
    "Summary",
    "add_warnings",
    "describe_differences",
    "describe_run",
    "differences",
    "discard_if_changed",
    "identify",
    "require_model",
    "require_other_folder",
    "require_start_in_recording",
    "require_unfinished",
    "summarize",
    "update_place",
]

_LIBRARIES = ("numpy", "numba", "mcap", "rosbags", "rerun-sdk", "pyarrow")


@dataclass(frozen=True)
class Job:
    """One recording to process, and how.

    Attributes
    ----------
    source : path of the recording; unused while it is still at the URL ``origin``.
    folder : where the results are written, ``OUT/NAME``.
    topics : depth topics; empty to choose one.
    up : ``auto``, ``tf``, ``imu``, or a vector ``X,Y,Z`` in the sensor frame.
    fixed_frame : name of the fixed frame; None to choose one.
    frame_range : the frames to process.
    model : path of the model file; None for the default model.
    model_id : id that the model must have; empty for any.
    color : topic of the colour images; None to choose one, empty for none.
    mcap, rrd : whether to write annotated.mcap and review.rrd.
    overwrite : whether to replace earlier results.
    discard_labels : whether to discard the labels of the replaced results.
    origin : URL from which ``source`` is downloaded; empty if none.
    target : URL to which the results are uploaded; empty if none.
    input_key : changes with the content of the recording; empty if unknown.
    work_key : changes with the options, settings and model; empty if unknown.
    """

    source: Path
    folder: Path
    settings: Settings = field(default_factory=Settings)
    topics: tuple[str, ...] = ()
    up: str = "auto"
    fixed_frame: str | None = None
    frame_range: FrameRange = ALL_FRAMES
    model: Path | None = None
    model_id: str = ""
    color: str | None = None
    mcap: bool = True
    rrd: bool = True
    overwrite: bool = False
    discard_labels: bool = False
    origin: str = ""
    target: str = ""
    input_key: str = ""
    work_key: str = ""

    @property
    def name(self) -> str:
        """The path or URL of the recording."""
        return self.origin or str(self.source)

    @property
    def place(self) -> str:
        """The folder or URL of the results."""
        return self.target or str(self.folder)

    @property
    def keys(self) -> OriginInfo:
        """``input_key`` and ``work_key``, as stored in a run.json at a URL."""
        return {"input": self.input_key, "work": self.work_key}

    def made(self, run: RunInfo) -> bool:
        """Return whether a run at a URL has the keys of this job; False if the job has none."""
        return bool(self.input_key and self.work_key) and run.get("origin") == self.keys

    def selection(self) -> Options:
        """Return the options that affect the results, as stored in run.json."""
        return {
            "topics": list(self.topics),
            "up": self.up,
            "fixed_frame": self.fixed_frame,
            "start_s": self.frame_range.start_s,
            "end_s": self.frame_range.end_s,
            "every": self.frame_range.every,
            "color": self.color,
            "mcap": self.mcap,
            "rrd": self.rrd,
        }


@dataclass(frozen=True)
class Summary:
    """The outcome of a finished job, for messages and the manifest of a batch.

    Attributes
    ----------
    counts : entry ``counts`` of run.json.
    seconds : total duration of the run.
    processed : False if the run was complete before.
    corrections : outcome of transferring labels from the replaced run; None if there were none.
    """

    counts: Mapping[str, Any]
    seconds: float
    warnings: tuple[str, ...]
    processed: bool = True
    corrections: Mapping[str, Any] | None = None


def describe_run(job: Job, categorizer: Categorizer) -> RunInfo:
    """Return the run.json of a new run; `identify` sets its digest and ``work`` id later."""
    return {
        "id": new_id(),
        "work": "",
        "input": {
            "path": job.origin or str(job.source.resolve()),
            "bytes": input_size(job.source),
            "digest": "",
            "files": file_stats(job.source),
        },
        "versions": {
            "shapecat": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in _LIBRARIES},
        },
        "settings": cast("SettingsInfo", job.settings.as_dict()),
        "options": job.selection(),
        "model": {"id": categorizer.model_id, "categories": list(categorizer.categories)},
        "fixed_frame": None,
        "up": {},
        "counts": {"frames": 0, "skipped": {}, "detections": 0},
        "seconds": {},
        "warnings": [],
        "color": {},
    }


def differences(run: RunInfo, planned: Mapping[str, Any]) -> dict[str, str]:
    """Return the settings, options and model in which two runs differ, with both values.

    Parameters
    ----------
    planned : the run.json of the planned run, or just its settings, options and model.

    Returns
    -------
    Both values as text, by name; settings have names such as ``detection.max_range_m``.
    """
    entries, planned_entries = (_entries(each) for each in (run, planned))
    return {
        name: f"{_words(entries.get(name))} in the old run, "
        f"{_words(planned_entries.get(name))} requested"
        for name in dict.fromkeys((*entries, *planned_entries))
        if entries.get(name) != planned_entries.get(name)
    }


def describe_differences(differing: Mapping[str, str]) -> str:
    """Describe the `differences` of two runs, and perhaps of their inputs, for an error message."""
    listed = "; ".join(f"{name}: {text}" for name, text in differing.items())
    return f"another input, model or settings ({listed})"


def _entries(run: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings, options and model of a run, by name."""
    tree: dict[str, Any] = {**run["settings"], **run["options"], "model": run["model"]["id"]}
    entries: dict[str, Any] = {}
    for name, value in tree.items():
        parts = value.items() if isinstance(value, dict) else ()
        entries |= {f"{name}.{part}": each for part, each in parts} or {name: value}
    return entries


def _words(value: Any) -> str:
    """Return the value of an entry as text."""
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return "default" if value is None else text or "none"


def add_warnings(run: RunInfo, warnings: Iterable[str]) -> None:
    """Add warnings to a run, each once, in place."""
    run["warnings"] = list(dict.fromkeys([*run["warnings"], *warnings]))


def identify(run: RunInfo, content: ContentDigest) -> None:
    """Set the ``work`` id of a run, and the digest of its input if it has none, in place.

    Raises
    ------
    RecordingError : the recording cannot be read.
    """
    run["input"]["digest"] = run["input"]["digest"] or content.result()
    run["work"] = work_id(run)


def update_place(run: RunInfo, found: InputInfo) -> bool:
    """Correct the path of a run's recording, in place, if it was moved; return whether it was.

    ``found`` describes the recording at its new path.
    """
    moved = not Path(run["input"]["path"]).exists() and run["input"]["path"] != found["path"]
    if moved:
        run["input"] |= {"path": found["path"], "files": found["files"]}
    return moved


def require_start_in_recording(job: Job, recording: Recording) -> None:
    """Check that the selected range begins within the recording.

    Raises
    ------
    NoStreamError : the range begins after the end of the recording.
    """
    seconds = (recording.end_ns - recording.start_ns) * 1e-9
    start_s = job.frame_range.start_s
    if recording.end_ns and start_s is not None and start_s > seconds:
        msg = f"{job.source}: --start {start_s:g} is after the end at {seconds:.1f} s"
        raise NoStreamError(msg)


def require_other_folder(job: Job) -> None:
    """Check that the results will not replace the recording.

    Raises
    ------
    OutputError : the run folder is the recording itself, such as a ROS 2 bag in ``--out``.
    """
    with suppress(OSError):  # one of them is missing, or reported when it is opened
        if job.folder.samefile(job.source):
            msg = (
                f"{job.folder}: the results would replace the recording itself; choose another "
                "--out"
            )
            raise OutputError(msg)


def require_unfinished(job: Job) -> None:
    """Check that there is no complete run, unless the job overwrites it.

    Raises
    ------
    OutputError : another process has completed the run folder.
    """
    if not job.overwrite and made_by_run(job.folder) is not None:
        msg = f"{job.folder}: another process has just completed it; run the same command again"
        raise OutputError(msg)


def require_model(job: Job, categorizer: Categorizer) -> None:
    """Check that the model is still the one with which the command began.

    Raises
    ------
    ModelError : it is another one: the file was replaced, or differs on this machine.
    """
    if job.model_id not in ("", categorizer.model_id):
        name = job.model or "the default model"
        ids = f"{categorizer.model_id} instead of {job.model_id}"
        msg = (
            f"{name}: is not the model with which the command began ({ids}); give all machines one "
            "model, and run the command again"
        )
        raise ModelError(msg)


def discard_if_changed(folder: Path, run: RunInfo, source: Path) -> None:
    """Remove the results if the recording has changed since it was read.

    Raises
    ------
    RecordingError : the recording has changed.
    """
    if not unchanged(run["input"]["files"], source):
        clear(folder)
        msg = f"{source}: changed while it was processed; run the same command again"
        raise RecordingError(msg)


def summarize(run: RunInfo, *, processed: bool = True) -> Summary:
    """Return the summary of a run.

    Parameters
    ----------
    processed : False if the run was complete before; then ``corrections`` is None.
    """
    return Summary(
        counts=run["counts"],
        seconds=run["seconds"].get("total", 0.0),
        warnings=tuple(run["warnings"]),
        processed=processed,
        corrections=run.get("corrections") if processed else None,
    )
