"""A finished run, and the recording it was made from."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from shapecat.errors import OutputError, RecordingError
from shapecat.recordings import Recording, choose_streams, frames, open_recording
from shapecat.runs.corrections import read_labels
from shapecat.runs.folder import read_run
from shapecat.runs.identity import content_digest, same_content
from shapecat.runs.label_meaning import TrackLabel
from shapecat.runs.labels import read_labelled_frames
from shapecat.runs.run_info import RunInfo, window_of
from shapecat.types import Frame, LabelledFrame

__all__ = [
    "FinishedRun",
    "clouds_again",
    "find_runs",
    "open_source",
    "read_finished",
]


@dataclass(frozen=True)
class FinishedRun:
    """A run folder: run.json, and what each of its tracks is shown as."""

    folder: Path
    run: RunInfo
    labels: Mapping[int, TrackLabel]

    @property
    def name(self) -> str:
        """The name of the recording."""
        return self.folder.resolve().name

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories of the model, followed by those that a person has added."""
        known = tuple(self.run["model"]["categories"])
        added = {label.category for label in self.labels.values()} - {*known, "unknown"}
        return (*known, *sorted(added))

    def frames(self) -> Iterator[LabelledFrame]:
        """Read the labelled frames."""
        return read_labelled_frames(self.folder, self.labels)

    def frames_with_full_boxes(self) -> Iterator[LabelledFrame]:
        """Read the labelled frames with full boxes where they are known."""
        for frame in self.frames():
            objects = (replace(item, box=item.full or item.box) for item in frame.objects)
            yield replace(frame, objects=tuple(objects))


def read_finished(folder: Path) -> FinishedRun:
    """Read run.json and the labels of a run folder.

    Raises
    ------
    OutputError : it is not a finished run, or its tracks.csv cannot be understood.
    """
    run = read_run(folder)
    return FinishedRun(folder, run, read_labels(folder / "tracks.csv", run["model"]["categories"]))


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Return the runs among folders and in them, sorted by name, each once.

    Raises
    ------
    OutputError : a folder holds none.
    """
    runs = [run for folder in folders for run in _runs_in(folder)]
    return list({run.resolve(): run for run in runs}.values())


def _runs_in(folder: Path) -> list[Path]:
    if (folder / "run.json").is_file():
        return [folder]
    runs = sorted(path.parent for path in folder.glob("*/run.json"))
    runs = [run for run in runs if not run.name.startswith(".")]
    if not runs:
        msg = f"{folder}: no run.json there or one level below; expected results of a process"
        raise OutputError(msg)
    return runs


@contextmanager
def open_source(run: RunInfo, moved_to: Path | None = None) -> Iterator[Recording]:
    """Open the recording that a run was made from.

    Parameters
    ----------
    moved_to : where it is now; where it was processed by default.

    Raises
    ------
    RecordingError : it is not there.
    OutputError : it is another one than it was.
    """
    path = moved_to or Path(run["input"]["path"])
    if moved_to is None and not path.exists():
        msg = f"{path}: the recording is not there any more; say where it is: --recording PATH"
        raise RecordingError(msg)
    with open_recording(path) as recording:
        if not same_content(run["input"], path, lambda: content_digest(path)):
            hint = "is another recording" if moved_to else "has changed since it was processed"
            msg = f"{path}: {hint}; process it again"
            raise OutputError(msg)
        yield recording


def clouds_again(recording: Recording, run: RunInfo) -> Iterator[Frame]:
    """Read the frames of a run again."""
    options = run["options"]
    streams = choose_streams(recording, options["topics"])
    return frames(recording, streams, skipped=Counter(), **window_of(options))
