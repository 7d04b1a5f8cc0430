"""The story: a recording becomes detections, detections become tracks, tracks become annotations.

Three phases, joined only by the tables of the run folder. Perceive is the expensive one and knows
nothing of time; track is cheap and knows nothing of points; annotate knows nothing of perception.
Each can be run again alone.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa

from shapecat.depth_fusion import RecentFrames
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import NoStreamError, OutputError
from shapecat.executors.order import Processes, read_ahead
from shapecat.jit import CompileClock, compile_clock
from shapecat.learning import Categorizer, load_model
from shapecat.outputs.rereading import with_clouds
from shapecat.perception import Perceiver, View
from shapecat.recordings import Recording, choose_streams, frames, open_recording
from shapecat.recordings.gravity import Upright
from shapecat.runs.corrections import TrackLabel, adopt_labels, read_labels
from shapecat.runs.folder import read_run, staged, sweep, write_run
from shapecat.runs.jobs import Job, Summary, describe_run, resume, same_work, summarize
from shapecat.runs.labels import read_labelled_frames
from shapecat.runs.shown import read_shown_frames
from shapecat.runs.tables import (
    FrameRow,
    PerceptionTables,
    count_rows,
    discard_segments,
    read_row_groups,
    release_memory,
)
from shapecat.runs.tracks import track_run
from shapecat.types import Frame, LabelledFrame, ShownFrame

__all__ = ["Observer", "annotate", "annotate_again", "perceive_all", "process", "track"]

_Shown = TypeVar("_Shown", LabelledFrame, ShownFrame)
Observer = Callable[[str, int, int | None], None]
"""Called with the name of the phase, the frames done, and how many there are, if known."""

_AHEAD = 4
"""Frames read while one is written."""
_MANY = 100
"""With so many frames other processes are started before anything is read."""


def _ignore(_phase: str, _done: int, _total: int | None) -> None:
    """Observe nothing."""


def process(job: Job, observe: Observer = _ignore, *, cores: int = 1) -> Summary:
    """Process one recording into its run folder: perceive, track, annotate.

    A complete folder made from the same input, settings and model is left as it is. Nothing
    appears under the final name before all of it is complete; a run that was killed goes on
    where it stopped.

    Parameters
    ----------
    cores : frames are perceived in so many processes. The tables do not depend on it.

    Raises
    ------
    RecordingError, NoStreamError, ModelError, OutputError : with nothing left behind.
    """
    begun = time.perf_counter()
    with open_recording(job.source) as recording, _compile_clock(observe, cores) as compiled:
        categorizer = load_model(job.model)
        categorizer.require_descriptor(DESCRIPTOR_NAMES)
        run = describe_run(job, categorizer)
        run["options"]["topics"] = [s.topic for s in choose_streams(recording, job.topics)]
        if job.folder.exists() and not job.overwrite:
            return _finished(job, recording, run, observe)
        with staged(job.folder) as folder:
            run = resume(folder, run)
            earlier = sum(run["seconds"].values())
            _once(
                "perceive",
                folder,
                run,
                lambda: perceive_all(
                    recording, folder, run, job, categorizer, observe, cores=cores
                ),
            )
            discard_segments(folder)
            _once("track", folder, run, lambda: track(folder, run, job))
            annotate(folder, recording, run, observe, cores=cores)
            run["seconds"]["compile"] = compiled.seconds
            run["seconds"]["total"] = earlier + time.perf_counter() - begun
            write_run(folder, run)
    return summarize(job, run)


def _once(phase: str, folder: Path, run: dict[str, Any], work: Callable[[], None]) -> None:
    """Do a phase unless it is done, and note in run.json that it is, and how long it took."""
    if phase in run["seconds"]:
        return
    begun = time.perf_counter()
    work()
    release_memory()
    run["seconds"][phase] = time.perf_counter() - begun
    write_run(folder, run)


@contextmanager
def _compile_clock(observe: Observer, cores: int) -> Iterator[CompileClock]:
    """Measure compilation, which happens once per installation, and let the user know of it.

    With several cores another process takes a share of it.
    """
    with ExitStack() as stack:

        def begin() -> None:
            observe("compile", 0, None)
            if cores > 1:
                from shapecat.rehearsal import compile_ahead  # noqa: PLC0415  once per installation

                stack.enter_context(compile_ahead())

        yield stack.enter_context(compile_clock(begin))


def _finished(
    job: Job, recording: Recording, planned: dict[str, Any], observe: Observer
) -> Summary:
    """Return what a complete folder holds, after removing or finishing what a kill left of it."""
    run = read_run(job.folder)
    if not same_work(run, planned):
        msg = (
            f"{job.folder}: holds the results of another input, model or settings; "
            "choose another --out, or --overwrite it"
        )
        raise OutputError(msg)
    sweep(job.folder)
    annotate(job.folder, recording, run, observe)
    return summarize(job, run, fresh=False)


def perceive_all(
    recording: Recording,
    folder: Path,
    run: dict[str, Any],
    job: Job,
    categorizer: Categorizer,
    observe: Observer = _ignore,
    *,
    cores: int = 1,
) -> None:
    """Write frames, detections and planes, frame by frame in flat memory."""
    skipped: Counter[str] = Counter()
    source, total = _select(recording, run["options"], skipped)
    recent = RecentFrames(job.settings.detection.fuse_frames)
    count = 0
    with (
        Processes(Perceiver(categorizer, job.settings, job.model), cores) as processes,
        PerceptionTables(
            folder, categories=categorizer.categories, model_id=categorizer.model_id
        ) as tables,
    ):
        if (total or 0) - tables.done >= _MANY:
            processes.start()
        upright = Upright.of(recording, up=job.up, fixed_frame=job.fixed_frame)

        def view(frame: Frame) -> tuple[FrameRow, View]:
            up, pose = upright.up(frame), upright.fixed_from_sensor(frame)
            row = FrameRow(frame.log_time_ns, pose, up)
            return row, View(frame, up, recent.before(frame, pose))

        views = map(view, source)
        for count, _ in enumerate(islice(views, tables.done), start=1):
            observe("perceive", count, total)
        for row, perception in processes.in_order(views):
            count += 1
            tables.write(perception, row)
            observe("perceive", count, total)
    if not count:
        reasons = ", ".join(f"{n} {reason}" for reason, n in skipped.items()) or "none in range"
        msg = f"{job.source}: no usable frame on {', '.join(run['options']['topics'])} ({reasons})"
        raise NoStreamError(msg)
    found = count_rows(folder, "detections")
    run["counts"] = {"frames": count, "skipped": dict(skipped), "detections": found}
    if tables.done:
        run["counts"]["resumed"] = tables.done
    run["fixed_frame"], run["up"] = upright.fixed_frame, upright.report(_perceived(folder))
    run["warnings"] = [*recording.warnings, *upright.warnings, *recent.warnings()]


def _perceived(folder: Path) -> Iterator[tuple[pa.Table, pa.Table]]:
    """Yield what the tables say of up, frames beside planes."""
    frames = read_row_groups(folder / "frames.parquet", ["topic", "frame", "up", "up_given"])
    return zip(frames, read_row_groups(folder / "planes.parquet", ["topic", "frame"]), strict=True)


def track(folder: Path, run: dict[str, Any], job: Job) -> None:
    """Follow the detections over time and fuse their posteriors: tracks.parquet, tracks.csv."""
    run["counts"]["tracks"] = track_run(folder, job.settings.tracking, run["model"]["categories"])


def annotate(
    folder: Path,
    recording: Recording,
    run: dict[str, Any],
    observe: Observer = _ignore,
    *,
    cores: int = 1,
) -> None:
    """Write annotated.mcap and review.rrd from the tables, tracks.csv and the recording.

    With several cores a thread reads while another writes.
    """
    settings, total = run["settings"]["outputs"], run["counts"]["frames"]

    def labels() -> dict[int, TrackLabel]:
        return read_labels(folder / "tracks.csv", run["model"]["categories"])

    def write_mcap() -> None:
        from shapecat.outputs.annotated_mcap import write_annotated  # noqa: PLC0415  on first use

        shown = read_shown_frames(folder, labels())
        write_annotated(
            recording,
            folder / "annotated.mcap",
            _observed(shown, "annotate", total, observe),
            run=run,
            markers=settings["markers"],
        )

    def write_rrd() -> None:
        from shapecat.outputs.review import write_review  # noqa: PLC0415  loads Rerun on first use

        labelled = read_labelled_frames(folder, labels())
        pairs = with_clouds(_observed(labelled, "review", total, observe), recording, run)
        write_review(
            folder / "review.rrd",
            read_ahead(pairs, count=_AHEAD) if cores > 1 else pairs,
            name=recording.path.name,
            run=run,
            categories=run["model"]["categories"],
            cloud_points=settings["cloud_points"],
            fixed_frame=run["fixed_frame"],
        )

    if run["options"]["mcap"]:
        _once("annotated.mcap", folder, run, write_mcap)
    if run["options"]["rrd"]:
        _once("review.rrd", folder, run, write_rrd)


def annotate_again(folder: Path, labels: Path | None, observe: Observer = _ignore) -> None:
    """Write the outputs of a finished run again, with the labels a person has corrected.

    Raises
    ------
    OutputError : the folder is not a finished run, or the table of labels does not fit it.
    RecordingError : the recording is no longer there.
    """
    run = read_run(folder)
    source = Path(run["input"]["path"])
    adopt_labels(labels or folder / "tracks.csv", folder)
    for output in ("annotated.mcap", "review.rrd"):
        run["seconds"].pop(output, None)
    write_run(folder, run)  # after a kill, the next run writes what is missing
    with open_recording(source) as recording:
        annotate(folder, recording, run, observe)
    write_run(folder, run)


def _select(
    recording: Recording, options: dict[str, Any], skipped: Counter[str]
) -> tuple[Iterator[Frame], int | None]:
    """Return the frames that the options select, and about how many there are."""
    streams = choose_streams(recording, options["topics"])
    chosen = {name: options[name] for name in ("start_s", "end_s", "every")}
    whole = options["start_s"] is None and options["end_s"] is None
    counts = [stream.count for stream in streams]
    total = sum(-(-(n or 0) // options["every"]) for n in counts) if whole else 0
    return frames(recording, streams, skipped=skipped, **chosen), total or None


def _observed(
    items: Iterator[_Shown], phase: str, total: int, observe: Observer
) -> Iterator[_Shown]:
    for done, item in enumerate(items, start=1):
        yield item
        observe(phase, done, total)
