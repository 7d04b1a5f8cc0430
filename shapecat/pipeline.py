"""Process a recording in four phases: perceive, revise, track, annotate.

The phases are connected only by the tables of the run folder, so each can be repeated alone.
Perceiving and revising are expensive and treat frames one by one; tracking is cheap and needs no
points; annotating, which writes the outputs, needs only the tables and the recording.
"""

import logging
import time
from collections.abc import Callable
from pathlib import Path

from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import OutputError, RecordingError
from shapecat.learning import load_model
from shapecat.recordings import Recording, choose_streams, open_recording
from shapecat.recordings.colour_streams import pair_colours
from shapecat.rehearsal import compile_all
from shapecat.runs.folder import (
    OUTPUT_OPTIONS,
    made_by_run,
    outputs_pending,
    read_run,
    recover,
    staged,
    sweep,
    write_run,
    writing_outputs,
)
from shapecat.runs.identity import ContentDigest, file_stats, same_content
from shapecat.runs.jobs import (
    Job,
    Summary,
    add_warnings,
    describe_differences,
    describe_run,
    differences,
    discard_if_changed,
    identify,
    require_model,
    require_other_folder,
    require_start_in_recording,
    require_unfinished,
    summarize,
    update_place,
)
from shapecat.runs.labels.corrections import adopt_labels, read_labels
from shapecat.runs.labels.replaced import (
    forget_old_labels,
    keep_labels,
    keep_last_labels,
    require_labels,
)
from shapecat.runs.labels.transfer import Transfer, transfer_labels
from shapecat.runs.perceive.doubts import explain_doubts
from shapecat.runs.perceive.phases import Work, perceive_all, revise
from shapecat.runs.perceive.resuming import has_work, require_resumable, resume, take_over_frames
from shapecat.runs.run_info import RunInfo
from shapecat.runs.tables.segments import discard_segments
from shapecat.system.files import holding, require_utf8
from shapecat.system.memory import release_memory
from shapecat.system.progress import Observer, ignore, observed

__all__ = ["annotate", "annotate_again", "process", "track"]

_log = logging.getLogger(__name__)


def process(job: Job, observe: Observer = ignore, *, cores: int = 1) -> Summary:
    """Process one recording into its run folder: perceive, revise, track, annotate.

    Unless the job overwrites it, a complete folder made from the same input, settings and model is
    kept, and gets the outputs that it lacks. A new folder gets its final name only when it is
    complete; an interrupted run resumes where it stopped. If a run replaces one that differs only
    in settings of tracking or outputs, it keeps the perceived frames.

    Parameters
    ----------
    observe : called with the phase, the number of frames done, and the total (None if unknown);
        while kernels are compiled, with the number compiled so far.
    cores : number of processes that perceive frames; the tables do not depend on it.

    Raises
    ------
    RecordingError, NoStreamError, ModelError, OutputError : the recording, its streams, the model
        or the run folder cannot be used; frames perceived so far are kept.
    Stopped : a signal asked the process to stop; frames in progress are finished and kept.
    """
    begun = time.perf_counter()
    require_utf8(job.source, RecordingError)
    require_utf8(job.folder)
    require_other_folder(job)
    with open_recording(job.source) as recording, ContentDigest(job.source) as content:
        categorizer = load_model(job.model)
        categorizer.require_descriptor(DESCRIPTOR_NAMES)
        require_model(job, categorizer)
        run = describe_run(job, categorizer)
        require_start_in_recording(job, recording)
        streams = choose_streams(recording, job.topics)
        topics = run["options"]["topics"] = [stream.topic for stream in streams]
        colours = pair_colours(recording, streams, job.color)
        _log.info("%s: %s, model %s", job.name, " ".join(topics), job.model or "default")
        recover(job.folder)
        if made_by_run(job.folder) is not None:
            if not job.overwrite:
                return _add_outputs(job, recording, run, content, observe)
            require_labels(job)
        require_resumable(job, run, content.result)
        with staged(
            job.folder,
            worth_keeping=has_work,
            finish=lambda: keep_last_labels(folder, run, job),
        ) as folder:
            require_unfinished(job)  # another process may have completed it before the lock
            run = resume(folder, run, job.source, content.result)
            if "perceive" not in run["seconds"]:
                run = take_over_frames(job.folder, folder, run, job.source, content.result)
            run["color"] = {topic: colour.topic for topic, colour in colours.items()}
            work = Work(recording, streams, colours, folder, run, job, categorizer, observe, cores)
            _run_phases(work, content, begun)
    return summarize(run)


def _run_phases(work: Work, content: ContentDigest, begun: float) -> None:
    """Run the phases that are not done; ``begun`` is when the work began, on `perf_counter`."""
    folder, run, job, observe = work.folder, work.run, work.job, work.observe
    compiling_s = compile_all(observe, cores=work.cores, colour=bool(work.colours))
    content.start()
    # There is a total if the run was killed after the last phase.
    earlier_s = run["seconds"].pop("total", None) or sum(run["seconds"].values())
    _run_once("perceive", folder, run, lambda: perceive_all(work))
    _run_once("revise", folder, run, lambda: _revise_and_warn(work))
    discard_if_changed(folder, run, job.source)  # or a resumed run could mix two recordings
    identify(run, content)
    write_run(folder, run)
    discard_segments(folder)
    _run_once("track", folder, run, lambda: track(folder, run, job))
    for _ in range(2):  # labels may be given while the outputs are written
        forget_old_labels(folder, run, job)
        _run_once("labels", folder, run, lambda: keep_labels(folder, run, job))
        annotate(folder, work.recording, run, observe)
    discard_if_changed(folder, run, job.source)
    run["seconds"]["compile"] = compiling_s
    run["seconds"]["total"] = earlier_s + time.perf_counter() - begun
    write_run(folder, run)


def _revise_and_warn(work: Work) -> None:
    """Perceive again the frames that disagree with the rest; warn about doubtful results."""
    revise(work)
    work.run["warnings"] += explain_doubts(work.recording, work.folder, work.run)


def _run_once(phase: str, folder: Path, run: RunInfo, work: Callable[[], object]) -> None:
    """Do the work of a phase unless it is done, and write its duration to run.json."""
    if phase in run["seconds"]:
        _log.info("%s: %s is already done", folder, phase)
        return
    _log.info("%s: %s starts", folder, phase)
    begun = time.perf_counter()
    work()
    release_memory()
    run["seconds"][phase] = time.perf_counter() - begun
    _log.info("%s: %s took %.2f s", folder, phase, run["seconds"][phase])
    write_run(folder, run)


def _add_outputs(
    job: Job, recording: Recording, planned: RunInfo, content: ContentDigest, observe: Observer
) -> Summary:
    """Write the outputs that ``planned`` requests and a complete run lacks; summarize this run.

    Nothing is written if the results are at a URL. The options in ``planned`` change in place.

    Raises
    ------
    OutputError : the folder holds the results of another input, model or settings.
    """
    run = read_run(job.folder)
    for option, output in OUTPUT_OPTIONS.items():
        if job.target:  # without its tables, nothing can be added
            planned["options"][option] |= run["options"][option]
            continue
        exists = (job.folder / output).exists()
        planned["options"][option] |= exists
        run["options"][option] = planned["options"][option]
        if not exists:
            run["seconds"].pop(output, None)
    differing = differences(run, planned)
    if not same_content(run["input"], job.source, content.result):
        differing["input"] = f"{run['input']['path']} with other content in the old run"
    if differing:
        other = describe_differences(differing)
        msg = f"{job.folder}: has results of {other}; choose another --out, or --overwrite it"
        raise OutputError(msg)
    if not job.target:
        with writing_outputs(job.folder):
            sweep(job.folder)
            if update_place(run, planned["input"]):
                write_run(job.folder, run)
            annotate(job.folder, recording, run, observe)
    return summarize(run, processed=False)


def track(folder: Path, run: RunInfo, job: Job) -> None:
    """Track the detections, write tracks.parquet and tracks.csv, and count the tracks in ``run``.

    Raises
    ------
    OutputError : a table is unreadable, or cannot be written.
    """
    from shapecat.runs.tracks import track_run  # noqa: PLC0415  loads SciPy on first use

    run["counts"]["tracks"] = track_run(
        folder, job.settings.tracking, run["model"]["categories"], work=run["work"]
    )


def annotate(folder: Path, recording: Recording, run: RunInfo, observe: Observer = ignore) -> None:
    """Write review.rrd and annotated.mcap, as far as requested and not yet written.

    ``run`` gets their durations, and the warnings of the recording.

    Raises
    ------
    OutputError : a file cannot be written, or tracks.csv is invalid.
    """
    if run["options"]["mcap"] and any(t.name.startswith("/shapecat/") for t in recording.topics):
        recording.warn(
            "annotated.mcap has the annotations of an earlier run besides those of this one"
        )
    if run["options"]["rrd"]:
        _run_once("review.rrd", folder, run, lambda: _write_review(folder, recording, run, observe))
    add_warnings(run, recording.warnings)
    if run["options"]["mcap"]:
        _run_once(
            "annotated.mcap", folder, run, lambda: _write_mcap(folder, recording, run, observe)
        )


def _write_review(folder: Path, recording: Recording, run: RunInfo, observe: Observer) -> None:
    from shapecat.outputs.review.scenes import with_clouds  # noqa: PLC0415  on first use
    from shapecat.outputs.review.writing import write_review  # noqa: PLC0415  loads Rerun
    from shapecat.runs.labelled_frames import read_labelled_frames  # noqa: PLC0415  on first use
    from shapecat.runs.tables.placed_frames import streams_with_poses  # noqa: PLC0415  the same

    labels = read_labels(folder / "tracks.csv", run["model"]["categories"])
    labelled = read_labelled_frames(folder, labels)
    labelled = observed(labelled, "review", run["counts"]["frames"], observe)
    frames = with_clouds(labelled, recording, run, streams_with_poses(folder))
    write_review(folder / "review.rrd", frames, name=recording.path.name, run=run, labels=labels)


def _write_mcap(folder: Path, recording: Recording, run: RunInfo, observe: Observer) -> None:
    from shapecat.outputs.annotation.annotated_mcap import write_annotated  # noqa: PLC0415  on first use
    from shapecat.outputs.annotation.image_annotations import read_image_frames  # noqa: PLC0415  the same
    from shapecat.runs.labelled_tracks import (  # noqa: PLC0415  the same
        LabelledTracks,
        read_annotation_frames,
    )

    settings = run["settings"]["outputs"]
    labels = read_labels(folder / "tracks.csv", run["model"]["categories"])
    tracks = LabelledTracks.read(folder, labels)
    topics = list(dict.fromkeys(run["color"].values()))
    boxes = run.get("boxes", settings["boxes"])
    frames = read_annotation_frames(folder, tracks, visible=boxes == "visible")
    write_annotated(
        recording,
        folder / "annotated.mcap",
        observed(frames, "annotate", run["counts"]["frames"], observe),
        run=run,
        markers=settings["markers"],
        images=read_image_frames(folder, tracks) if topics else (),
        image_topics=topics,
    )
    add_warnings(run, recording.warnings)  # a recording that is rewritten is read as a whole


def annotate_again(
    folder: Path,
    labels: Path | None,
    observe: Observer = ignore,
    *,
    by_place: bool = False,
    boxes: str | None = None,
    recording: Path | None = None,
) -> Transfer | None:
    """Write the outputs of a finished run again, with labels that a person corrected.

    Parameters
    ----------
    labels : the corrected table; by default the run's own tracks.csv.
    by_place : whether ``labels`` is the table or folder of another run, whose labels are
        transferred to the objects at the same places.
    boxes : ``full`` or ``visible``; by default, the kind of boxes is not changed.
    recording : path of the recording; by default, the path at which it was processed.

    Returns
    -------
    The outcome of the transfer by place; None if there was none.

    Raises
    ------
    OutputError : the folder is not a finished run, the table does not fit it, another process is
        writing the outputs, or the content of the recording has changed since it was processed.
    RecordingError : the recording is missing or unreadable.
    """
    from shapecat.runs.finished import open_source  # noqa: PLC0415  on first use

    with open_source(read_run(folder), recording) as source, writing_outputs(folder):
        with outputs_pending(folder):
            transfer = _apply_labels(labels, folder, by_place=by_place)
        run = read_run(folder)
        run["input"] |= {"path": str(source.path.resolve()), "files": file_stats(source.path)}
        run |= {"boxes": boxes} if boxes else {}
        write_run(folder, run)
        annotate(folder, source, run, observe)
        write_run(folder, run)
    return transfer


def _apply_labels(labels: Path | None, folder: Path, *, by_place: bool) -> Transfer | None:
    """Apply a table of labels to a run; return the outcome of a transfer by place, else None."""
    if by_place and labels is not None:
        with holding(folder):
            return transfer_labels(labels, folder)
    adopt_labels(labels or folder / "tracks.csv", folder)
    return None
