"""Report the source of a run's up direction; warn if it, or a pose, may be wrong or unknown."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from shapecat.errors import listed
from shapecat.recordings.transforms.gravity import PoseFinder
from shapecat.runs.tables.placed_frames import count_poses
from shapecat.runs.tables.reading import keys_of, read_together

__all__ = ["explain_up", "report_up"]

_DISAGREE_DEG = 10
"""A larger median angle between the given up directions and the planes causes a warning."""


def report_up(poses: PoseFinder, folder: Path) -> dict[str, Any]:
    """Return the source of the up direction and its agreement with the planes, for run.json.

    Parameters
    ----------
    folder : folder with the tables of frames, planes and detections.
    """
    uses = poses.given
    report: dict[str, Any] = {"source": max(uses, key=lambda name: uses[name], default="planes")}
    if poses.dropped:
        report["dropped"] = dict(poses.dropped)
    if len(uses) > 1:
        report["frames"] = dict(uses)
    if set(uses) - {"planes"}:
        angles, bare = _angles_to_planes(folder)
        typical = round(float(np.median(angles)), 1) if angles else None
        report |= {"planes_differ_deg": typical, "frames_without_plane": bare}
    return report


def explain_up(poses: PoseFinder, folder: Path, report: Mapping[str, Any]) -> Iterator[str]:
    """Yield warnings about transforms, unknown poses, and planes that disagree with up.

    The problems of transforms are failed look-ups, gaps, and contradictions at equal stamps.

    Parameters
    ----------
    folder : folder with the table of frames.
    report : the result of `report_up`.
    """
    if poses.failed:
        yield f"failed transform look-ups: {poses.failed}, the first: {poses.first_failure}"
    if poses.longest_gap is not None:
        gap = poses.longest_gap
        yield (
            f"frames without pose ({poses.in_gaps}×): gaps of up to {gap.gap_s:.2f} s in the "
            f"transforms of {gap.frame_id}, which moves meanwhile"
        )
    if contradicted := poses.transforms.known.contradicted:
        frames = listed(contradicted)
        yield (
            f"transforms: a clock was set back, and those of {frames} have the stamps of different "
            "earlier ones: poses may be those of another time; split the recording where its "
            "stamps go backwards"
        )
    yield from _missing_poses(folder, poses)
    differ_deg = report.get("planes_differ_deg")
    if differ_deg is not None and differ_deg > _DISAGREE_DEG:
        yield (
            f"up and the detected planes differ by {differ_deg} degrees; try another --up "
            "(tf, imu, or X,Y,Z)"
        )


def _missing_poses(folder: Path, poses: PoseFinder) -> Iterator[str]:
    """Yield a warning for each topic with frames whose pose in the fixed frame is unknown.

    Without a fixed frame, all topics get a warning if any transform moves, since their sensors may
    move with it.
    """
    fixed_frame = poses.fixed_frame
    if fixed_frame is None and poses.transforms.known.moves:
        for topic in count_poses(folder):
            yield (
                f"{topic}: no transforms lead from the frame of its sensor to a fixed frame: its "
                "tracks are in the frame of the sensor, which may move"
            )
    if fixed_frame is None or not (poses.failed or poses.in_gaps):
        return
    for topic, (with_pose, count) in count_poses(folder).items():
        loss = ", whose objects are not tracked"
        if 2 * with_pose <= count:
            loss = ": its tracks are in the frame of the sensor"
        if with_pose < count:
            frames = f"{count - with_pose} of {count} frames"
            yield f"{topic}: the pose of its sensor in {fixed_frame} is unknown in {frames}{loss}"


def _angles_to_planes(folder: Path) -> tuple[list[float], int]:
    """Compare the given up directions with the planes.

    Returns
    -------
    The angle between the two in each frame with a plane, degrees; and the number of frames that
    have a given up direction, but neither planes nor objects.
    """
    angles, bare = [], 0
    rows = ["topic", "frame"]
    columns = {"frames": [*rows, "up", "up_given"], "planes": rows, "detections": rows}
    for frames, *plane_tables in read_together(folder, columns):
        planes, objects = (set(keys_of(table)) for table in plane_tables)
        for row in frames.to_pylist():
            key = (row["topic"], row["frame"])
            if row["up_given"] is None:
                continue
            if key in planes:
                cosine = np.clip(np.dot(row["up"], row["up_given"]), -1, 1)
                angles.append(float(np.degrees(np.arccos(cosine))))
            bare += key not in planes and key not in objects
    return angles, bare
