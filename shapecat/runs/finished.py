"""Read a finished run, and open the recording from which it was made."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from shapecat.errors import OutputError, RecordingError, ShapecatError
from shapecat.recordings import Recording, open_recording
from shapecat.runs.folder import read_run, require_work
from shapecat.runs.identity import content_digest, same_content
from shapecat.runs.labelled_frames import read_labelled_frames
from shapecat.runs.labels.corrections import read_labelled_table
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.labels.track_table import TrackTable
from shapecat.runs.run_info import RunInfo
from shapecat.system.files import require_utf8
from shapecat.types import UNKNOWN, LabelledFrame

__all__ = ["FinishedRun", "find_runs", "find_usable", "open_source", "read_finished"]


@dataclass(frozen=True)
class FinishedRun:
    """A run folder, with the content of run.json and tracks.csv, and the final label of each track.

    ``common`` holds the categories of all runs that are exported together, so that categories have
    the same order in each run; it is empty except in exports.
    """

    folder: Path
    info: RunInfo
    table: TrackTable
    labels: Mapping[int, TrackLabel]
    common: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The name of the run folder."""
        return self.folder.resolve().name

    @property
    def categories(self) -> tuple[str, ...]:
        """The categories in ``common``, then those of the model, then those that a person added."""
        of_model = dict.fromkeys((*self.common, *self.info["model"]["categories"]))
        added = {label.category for label in self.labels.values()} - {*of_model, UNKNOWN}
        return (*of_model, *sorted(added))

    def frames(self) -> Iterator[LabelledFrame]:
        """Read the labelled frames.

        Raises
        ------
        OutputError : a table is unreadable, or the run has been replaced since it was opened.
        """
        require_work(self.folder, self.info["work"])  # else labels go to tracks of another run
        yield from read_labelled_frames(self.folder, self.labels)

    def frames_with_full_boxes(self) -> Iterator[LabelledFrame]:
        """Read the labelled frames; their boxes are full boxes where these are known.

        ``height_m`` stays the height of the visible box.
        """
        for frame in self.frames():
            objects = (replace(item, box=item.full or item.box) for item in frame.objects)
            yield replace(frame, objects=tuple(objects))


def read_finished(folder: Path) -> FinishedRun:
    """Read run.json and tracks.csv of a run folder.

    Raises
    ------
    OutputError : the folder is not a finished run, or its tracks.csv is invalid.
    """
    info = read_run(folder)
    table, labels = read_labelled_table(folder / "tracks.csv", info["model"]["categories"])
    return FinishedRun(folder, info, table, labels)


def find_runs(folders: Sequence[Path]) -> list[Path]:
    """Return the run folders among ``folders`` and directly below them, each once.

    The runs below a folder are sorted by name. Files beside folders in the list are ignored, since
    the pattern ``results/*`` matches the manifest of a batch, too.

    Raises
    ------
    OutputError : a folder is not a run and holds none.
    """
    chosen = [folder for folder in folders if not folder.is_file()] or folders
    runs = [run for folder in chosen for run in _runs_in(folder)]
    return list({run.resolve(): run for run in runs}.values())


def _runs_in(folder: Path) -> list[Path]:
    if (folder / "run.json").is_file():
        return [folder]
    runs = sorted(path.parent for path in folder.glob("*/run.json"))
    runs = [run for run in runs if not run.name.startswith(".")]
    if not runs:
        msg = f"{folder}: no run.json there or one level below; expected runs of `process`"
        raise OutputError(msg)
    return runs


def find_usable(folders: Iterable[Path]) -> tuple[list[FinishedRun], list[ShapecatError]]:
    """Read the runs whose labels are valid and whose recordings are unchanged.

    Returns
    -------
    The usable runs, and the error of each other run.
    """
    usable, errors = [], []
    for folder in folders:
        advice = f"store its new path with `shapecat annotate {folder} --recording PATH`"
        try:
            finished = read_finished(folder)
            with open_source(finished.info, advice=advice):
                usable.append(finished)
        except ShapecatError as error:
            errors.append(error)
    return usable, errors


@contextmanager
def open_source(
    run: RunInfo, moved_to: Path | None = None, *, advice: str = "give --recording PATH"
) -> Iterator[Recording]:
    """Open the recording from which a run was made.

    Parameters
    ----------
    moved_to : path of the recording; None for the path at which it was processed.
    advice : what the error message suggests if the recording is missing or at a URL.

    Raises
    ------
    RecordingError : the recording is missing or unreadable, or its path is not valid UTF-8.
    OutputError : it is another recording, or its content has changed since it was processed.
    """
    path = moved_to or Path(run["input"]["path"])
    if moved_to is None and not path.exists():
        named = run["input"]["path"]  # a path would lose a slash of a URL
        state = "is at a URL; download it and" if "://" in named else "is missing; if it was moved,"
        msg = f"{named}: the recording {state} {advice}"
        raise RecordingError(msg)
    require_utf8(path, RecordingError)
    with open_recording(path) as recording:
        if not same_content(run["input"], path, lambda: content_digest(path)):
            msg = f"{path}: has changed since it was processed; process it again"
            if moved_to is not None:
                origin = run["input"]["path"]
                msg = f"{path}: another recording, not that of the run ({origin}), or changed since"
            raise OutputError(msg)
        yield recording
