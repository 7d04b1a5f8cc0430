"""Run the expensive phases: perceive all frames, then revise some with a better up direction."""

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from shapecat.cameras.colour import ColourView
from shapecat.depth_fusion import RecentFrames
from shapecat.errors import NoStreamError
from shapecat.executors.ordered_pool import OrderedPool
from shapecat.learning import Categorizer
from shapecat.perception import Perceiver, PerceptionInput
from shapecat.recordings import Recording, Stream
from shapecat.recordings.colour_frames import frames_with_colour
from shapecat.recordings.colour_motion import view_at_its_time
from shapecat.recordings.colour_streams import ColourStream
from shapecat.recordings.transforms.gravity import PoseFinder
from shapecat.rehearsal import rehearse
from shapecat.runs.jobs import Job
from shapecat.runs.perceive.clocks import explain_transform_clocks
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.runs.perceive.second_look import Revision, frames_to_revise
from shapecat.runs.perceive.up_check import Oriented, UpCheck
from shapecat.runs.perceive.up_report import explain_up, report_up
from shapecat.runs.run_info import RunInfo
from shapecat.runs.selection import count_frames
from shapecat.runs.tables.reading import Key, count_rows, read_row_groups
from shapecat.runs.tables.segments import read_segments
from shapecat.system import stopping
from shapecat.system.progress import Observer, ignore
from shapecat.types import Frame

__all__ = ["Work", "perceive_all", "revise"]

_MANY = 100
"""With at least this many frames, the other processes are started before any frame is read."""

_Item = tuple[FrameRow, PerceptionInput]
"""The values of a frame's row that its `Perception` lacks, and the frame to perceive."""


class Work(NamedTuple):
    """A job with its open recording and streams, the folder of its tables, and its run.json.

    ``colours`` holds the colour stream of each depth topic that has one; ``cores`` is the number of
    processes that perceive frames.
    """

    recording: Recording
    streams: tuple[Stream, ...]
    colours: dict[str, ColourStream]
    folder: Path
    run: RunInfo
    job: Job
    categorizer: Categorizer
    observe: Observer = ignore
    cores: int = 1


def perceive_all(work: Work) -> None:
    """Perceive every frame in constant memory; write frames, detections, planes and masks.

    The counts, the fixed frame, the up direction and the warnings are stored in ``work.run``.

    Raises
    ------
    NoStreamError : no frame could be read.
    """
    recording, folder, run, job = work.recording, work.folder, work.run, work.job
    skipped: Counter[str] = Counter()
    recent = RecentFrames(job.settings.detection.fuse_frames)
    total = count_frames(work.streams, run["options"])
    with _perceiving(work, "perceive", total) as perceive:
        poses = _pose_finder(work, job.fixed_frame)

        def view(oriented: Oriented) -> _Item:
            frame, colour, (_, _, pose) = oriented
            up = poses.accept(frame.topic, oriented[2])
            row = FrameRow(frame.log_time_ns, pose, up, frame_from_sensor=frame.frame_from_sensor)
            return row, PerceptionInput(frame, up, recent.before(frame, pose), pose, colour)

        count, resumed = perceive(map(view, _oriented(work, poses, skipped)))
    if not count:
        reasons = ", ".join(f"{n} {reason}" for reason, n in skipped.items()) or "none in range"
        msg = f"{job.source}: no usable frame on {', '.join(run['options']['topics'])} ({reasons})"
        raise NoStreamError(msg)
    detections = count_rows(folder, "detections")
    run["counts"] = {"frames": count, "skipped": dict(skipped), "detections": detections}
    if run["color"]:
        run["counts"]["color"] = count_rows(folder, "masks")
    if resumed:
        run["counts"]["resumed"] = resumed
    run["fixed_frame"], run["up"] = poses.fixed_frame, report_up(poses, folder)
    lost = [f"skipped frames ({n}×): {reason}" for reason, n in skipped.most_common(3)]
    of_poses = [*poses.warnings, *_explain_poses(work, poses)]
    run["warnings"] = [*lost, *recording.warnings, *of_poses, *recent.warnings()]
    if recording.damaged:
        run["damaged"] = True


def _explain_poses(work: Work, poses: PoseFinder) -> Iterator[str]:
    """Yield a warning for each problem with the up directions and poses of the perceived frames."""
    yield from explain_up(poses, work.folder, work.run["up"])
    if poses.fixed_frame is not None:
        frame_ids = {stream.topic: stream.frame_id for stream in work.streams}
        yield from explain_transform_clocks(
            work.folder, poses.transforms.known, poses.fixed_frame, frame_ids
        )


def revise(work: Work) -> None:
    """Perceive again frames that have no plane or disagree with the rest; rewrite the tables.

    An up direction that the user gave is never revised. A frame keeps its first result if it shows
    neither a plane nor an object with the new up direction. The counts in ``work.run`` are updated.
    """
    folder, run = work.folder, work.run
    chosen = frames_to_revise(read_segments(folder)) if run["up"]["source"] != "option" else {}
    if not chosen:
        return
    with _perceiving(work, "revise", len(chosen), again=True) as perceive:
        perceive(islice(_views_again(work, chosen), len(chosen)))
    run["counts"]["detections"] = count_rows(folder, "detections")
    revised = read_row_groups(folder / "frames.parquet", ["revised"])
    run["counts"]["revised"] = sum(sum(group["revised"].to_pylist()) for group in revised)


def _views_again(work: Work, chosen: dict[Key, Revision]) -> Iterator[_Item]:
    """Yield the chosen frames with their revised up directions."""
    poses = _pose_finder(work, work.run["fixed_frame"])
    recent = RecentFrames(work.job.settings.detection.fuse_frames)
    for frame, colour, (_, _, pose) in _oriented(work, poses, Counter()):
        earlier = recent.before(frame, pose)
        revision = chosen.get((frame.topic, frame.index))
        if revision is not None:
            offset = frame.frame_from_sensor
            row = FrameRow(frame.log_time_ns, pose, revision.up_given, frame_from_sensor=offset)
            yield row, PerceptionInput(frame, revision.up, earlier, pose, colour)


@contextmanager
def _perceiving(
    work: Work, phase: str, total: int | None, *, again: bool = False
) -> Iterator[Callable[[Iterator[_Item]], tuple[int, int]]]:
    """Let the block perceive frames in several processes; then join the tables.

    Parameters
    ----------
    phase : name of the phase, for progress.
    total : number of frames; None if unknown.
    again : whether the frames are perceived a second time (`revise`).

    Yields
    ------
    A function that skips the frames that an interrupted run has written, perceives the others, and
    writes their results. It returns the number of all frames, and the number written before.
    """
    job, categorizer = work.job, work.categorizer
    perceiver = Perceiver(categorizer, job.settings, job.model)
    with (
        OrderedPool(perceiver, work.cores, rehearse) as pool,
        PerceptionTables(
            work.folder,
            categories=categorizer.categories,
            model_id=categorizer.model_id,
            colour=bool(work.run["color"]),
            again=again,
        ) as tables,
    ):
        if (total or 0) - tables.done >= _MANY:
            pool.start()

        def perceive(views: Iterator[_Item]) -> tuple[int, int]:
            """Perceive the frames not written yet; count all frames and those written before."""
            count = 0
            for count, _ in enumerate(islice(views, tables.done), start=1):
                stopping.check()
                if not again:  # the frames of a second look are few
                    work.observe(phase, count, total)
            for rows, perceptions in pool.in_order(_blocks(views, job.settings.reuse_frames)):
                tables.write(perceptions, rows)
                for _ in rows:
                    count += 1
                    work.observe(phase, count, total)
            stopping.check()
            return count, tables.done

        yield perceive


def _blocks(
    views: Iterator[_Item], size: int
) -> Iterator[tuple[tuple[FrameRow, ...], tuple[PerceptionInput, ...]]]:
    """Yield blocks of ``size`` frames, until asked to stop; the last one may be shorter.

    A resumed run has the same blocks, since segments hold whole blocks.
    """
    while not stopping.asked() and (block := tuple(islice(views, size))):
        rows, perceptions = zip(*block, strict=True)
        yield rows, perceptions


def _pose_finder(work: Work, fixed_frame: str | None) -> PoseFinder:
    streams = work.streams
    return PoseFinder.of(work.recording, up=work.job.up, fixed_frame=fixed_frame, streams=streams)


def _oriented(work: Work, poses: PoseFinder, skipped: Counter[str]) -> Iterator[Oriented]:
    """Yield the frames of a run with their orientations, once the up directions are decided.

    ``skipped`` counts the unreadable frames by reason.
    """
    source = (_placed(poses, *reading) for reading in _read_frames(work, skipped))
    for frame, colour, orientation in UpCheck(poses, work.job.settings).before(source):
        yield frame, colour, poses.corrected(frame.topic, orientation)


def _placed(poses: PoseFinder, frame: Frame, colour: ColourView | None) -> Oriented:
    """Look up the orientation of a frame, and the pose of its colour camera."""
    orientation = poses.orient(frame)
    pose = poses.corrected(frame.topic, orientation).fixed_from_sensor
    view = view_at_its_time(colour, frame, pose, poses.fixed_frame, lambda: poses.transforms)
    return frame, view, orientation


def _read_frames(work: Work, skipped: Counter[str]) -> Iterator[tuple[Frame, ColourView | None]]:
    """Yield the frames of a run, each with its colour image (without pixels) or None.

    ``skipped`` counts the unreadable frames by reason.
    """
    for frame, colour in frames_with_colour(
        work.recording, work.streams, work.colours, work.job.frame_range, skipped=skipped
    ):
        # Masks need no pixels, and frames are sent to other processes.
        yield frame, colour and replace(colour, image=replace(colour.image, data=b""))
