"""Tests of the tables of a moving, rotated sensor; all numbers differ, so swaps are noticed."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from shapecat.completion import DIRECTIONS
from shapecat.config import TrackingSettings
from shapecat.geometry import box_corners
from shapecat.outputs.report.tracks import read_timelines
from shapecat.runs.labelled_frames import _join, read_labelled_frames
from shapecat.runs.labelled_tracks import LabelledTracks, read_annotation_frames
from shapecat.runs.labels.corrections import read_labels
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.runs.tables.placed_frames import streams_with_poses
from shapecat.runs.tables.segments import GROUP_FRAMES
from shapecat.runs.tracks import _line, _read_streams, track_run
from shapecat.tracking.records import Track
from shapecat.types import (
    Box,
    Candidate,
    Detection,
    FullBox,
    NeuralGas,
    Perception,
    Plane,
    Pose,
    Scene,
)
from tests.track_tables import lines, rows

CATEGORIES = ("cup", "can", "bowl")
SECOND = 10**9
EPOCH = 1_700_000_000 * SECOND
FRAMES = 6
ROTATIONS = Rotation.from_euler(
    "xyz", [[0.4 + 0.02 * k, -0.7, 1.9 + 0.05 * k] for k in range(FRAMES)]
)
POSITIONS = np.array([[1.3 + 0.01 * k, -2.1, 0.6 + 0.02 * k] for k in range(FRAMES)])
CENTERS = np.array([[3.1, 4.2, 0.7], [3.5, 4.9, 0.8], [2.6, 4.4, 0.9]])
"""Centres of three objects at rest, in the fixed frame, metres."""
UP = np.array([0.0, 0.0, 1.0])
AXES = Rotation.from_euler("z", 0.6)
POSTERIORS = np.array(
    [
        [[0.7, 0.2, 0.1], [0.6, 0.3, 0.1], [0.5, 0.1, 0.4]],
        [[0.2, 0.7, 0.1], [0.1, 0.8, 0.1], [0.3, 0.6, 0.1]],
    ]
)
"""Posteriors of each object, in even and in odd frames."""
PARTIAL = [False, True, False, False, True, False]
"""Frames in which the image border cuts the first object."""
NOVELTIES = np.array([[0.9 if cut else 0.4, 0.3, 1.2] for cut in PARTIAL])
"""By frame and object; a cut view has a higher novelty."""
SIZE = np.array([0.06, 0.11, 0.19])
FULL_CENTERS = CENTERS + np.array([0.01, 0.02, 0.03])
FULL_AXES = Rotation.from_euler("z", 0.9)
FULL_SIZE = np.array([0.07, 0.13, 0.22])
FULL_STD = np.array([0.004, 0.006, 0.009])
AROUND = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
EXTENTS = np.stack([np.cos(AROUND), np.sin(AROUND)], axis=1)
FULL_OUTLINE = abs(EXTENTS) @ (0.035, 0.065) + EXTENTS @ (0.011, 0.004)
"""A rectangle of 0.07 m by 0.13 m with its middle at (0.011, 0.004) in the box."""
FUSED_CENTERS = FULL_CENTERS + FULL_AXES.apply([0.011, 0.004, 0.0])
"""Centres of the boxes around the outlines `FULL_OUTLINE`."""
NEURONS = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]])
OUTLINE = np.array([[0.1, 0.2, 1.3], [1.4, 0.5, 1.6], [1.7, 1.8, 1.9], [0.2, 1.1, 1.2]])


def detection_of(frame: int, item: int) -> Detection:
    """Return the detection of an object in a frame, in sensor coordinates."""
    inverse = ROTATIONS[frame].inv()
    center = inverse.apply(CENTERS[item] - POSITIONS[frame])
    orientation = (inverse * AXES).as_quat()
    candidate = Candidate(
        indices=np.arange(10 * item, 10 * item + 5 + item),
        box=Box(center, SIZE, orientation),
        plane=item % 2,
        on_candidate=item - 1 if item else None,
        support_m=0.04 * item,
        touches_border=item == 0 and PARTIAL[frame],
        occluded=False,
    )
    gas = NeuralGas(NEURONS + item, np.array([[0, 2], [1, 2]]))
    full_center = inverse.apply(FULL_CENTERS[item] - POSITIONS[frame])
    turn = (inverse * FULL_AXES).as_quat()
    full = FullBox(full_center, FULL_SIZE, turn, FULL_STD, FULL_OUTLINE)
    posterior, novelty = POSTERIORS[frame % 2, item], float(NOVELTIES[frame, item])
    seconds = 0.001 * (1 + frame + 10 * item)
    return Detection(candidate, gas, np.arange(4.0), posterior, novelty, seconds, full)


def stamp(frame: int) -> int:
    return EPOCH + frame * SECOND // 10


def frame_of(
    k: int,
    objects: Iterable[Detection],
    *,
    topic: str = "/depth",
    index: int | None = None,
    stamp_ns: int | None = None,
    posed: bool = True,
    origin: Any = 0.0,
    frame_id: str = "cam",
    offset: Pose | None = None,
) -> tuple[Perception, FrameRow]:
    """Return a frame that the sensor takes at its k-th position; its number is k by default.

    ``origin`` is added to the position; ``offset`` is the pose of the sensor in ``frame_id``.
    """
    up = ROTATIONS[k].inv().apply(UP)
    planes = (Plane(up, -0.5, OUTLINE, 0.7, 0.0), Plane(up, -0.2, OUTLINE + 1, 0.4, 0.3))
    index, stamp_ns = k if index is None else index, stamp(k) if stamp_ns is None else stamp_ns
    pose = Pose(ROTATIONS[k].as_matrix(), POSITIONS[k] + origin) if posed else None
    found, seconds = tuple(objects), {"detect": 0.01 + 0.001 * k, "surface": 0.05}
    perception = Perception(topic, index, stamp_ns, frame_id, Scene(up, planes, ()), found, seconds)
    return perception, FrameRow(stamp_ns + 5, pose, up, frame_from_sensor=offset)


def all_of(k: int) -> list[Detection]:
    return [detection_of(k, item) for item in range(3)]


def write_frames(
    folder: Path, frames: Iterable[tuple[Perception, FrameRow]], *, work: str = ""
) -> Path:
    """Write the tables of some frames, and track their detections."""
    with PerceptionTables(folder, categories=CATEGORIES, model_id="m") as tables:
        for perception, row in frames:
            tables.write([perception], [row])
    track_run(folder, TrackingSettings(), CATEGORIES, work=work)
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the tables of three objects seen by a moving, rotated sensor."""
    folder = tmp_path_factory.mktemp("turned")
    return write_frames(folder, (frame_of(k, all_of(k)) for k in range(FRAMES)), work="w0123")


def test_sensor_pose_is_written_row_major(run: Path) -> None:
    """A transposed rotation is also valid; only unequal numbers reveal it."""
    for row in rows(run, "frames"):
        k = row["frame"]
        assert_allclose(np.reshape(row["fixed_rotation"], (3, 3)), ROTATIONS[k].as_matrix())
        assert_allclose(row["fixed_translation"], POSITIONS[k])
        assert_allclose(row["up_given"], ROTATIONS[k].inv().apply(UP), atol=1e-6)
        assert (row["stamp_ns"], row["log_time_ns"]) == (stamp(k), stamp(k) + 5)
        assert row["stages"] == ["detect", "surface"]
        assert_allclose(row["seconds"], [0.01 + 0.001 * k, 0.05], rtol=1e-6)


def test_centres_are_in_sensor_and_fixed_frame(run: Path) -> None:
    for row in rows(run, "detections"):
        k, item = row["frame"], row["detection"]
        own = ROTATIONS[k].inv().apply(CENTERS[item] - POSITIONS[k])
        assert_allclose(row["center"], own, atol=1e-5)
        assert_allclose(row["center_fixed"], CENTERS[item], atol=1e-5)
        support = (-0.5, -0.2)[item % 2] + 0.04 * item
        assert_allclose(row["height_m"], ROTATIONS[k].inv().apply(UP) @ own - support, atol=1e-5)
        flags = (row["touches_border"], row["occluded"])
        assert flags == (item == 0 and PARTIAL[k], False)
        best = "can" if k % 2 else "cup"
        assert row["category"] == (best, best, "unknown")[item]


def test_plane_columns_have_right_values(run: Path) -> None:
    found = rows(run, "planes")

    assert len(found) == 2 * FRAMES
    for row in found:
        k, number = row["frame"], row["plane"]
        assert (row["topic"], row["stamp_ns"]) == ("/depth", stamp(k))
        assert_allclose(row["normal"], ROTATIONS[k].inv().apply(UP), atol=1e-6)
        assert_allclose(row["offset"], (-0.5, -0.2)[number], rtol=1e-6)
        assert_allclose(row["height_m"], (0.0, 0.3)[number], atol=1e-7)
        assert_allclose(row["area_m2"], (0.7, 0.4)[number], rtol=1e-6)
        assert_allclose(np.reshape(row["outline"], (-1, 3)), OUTLINE + number, rtol=1e-6)


def test_detection_columns_have_right_values(run: Path) -> None:
    """Neurons are x y z triples, and edges are pairs."""
    for row in rows(run, "detections"):
        item = row["detection"]
        assert_allclose(np.reshape(row["neurons"], (-1, 3)), NEURONS + item, rtol=1e-6)
        assert row["edges"] == [0, 2, 1, 2]
        assert row["descriptor"] == [0, 1, 2, 3]
        assert row["indices"] == list(range(10 * item, 10 * item + 5 + item))
        assert (row["points"], row["frame_id"], row["plane"]) == (5 + item, "cam", item % 2)
        assert (row["on_detection"], row["reused_from"]) == (item - 1 if item else None, None)
        assert_allclose(row["size"], SIZE, rtol=1e-6)
        k, inverse = row["frame"], ROTATIONS[row["frame"]].inv()
        center = inverse.apply(FULL_CENTERS[item] - POSITIONS[k])
        assert_allclose(row["center_full"], center, atol=1e-6)
        assert_allclose(row["size_full"], FULL_SIZE, rtol=1e-6)
        turn = Rotation.from_quat(row["orientation_full"])
        assert_allclose(turn.as_matrix(), (inverse * FULL_AXES).as_matrix(), atol=1e-6)
        turn = Rotation.from_quat(row["orientation"])
        assert_allclose(turn.as_matrix(), (inverse * AXES).as_matrix(), atol=1e-6)
        assert_allclose(row["size_full_std"], FULL_STD, rtol=1e-6)
        assert_allclose(row["outline_full"], FULL_OUTLINE, rtol=1e-6)
        assert row["seconds"] == pytest.approx(0.001 * (1 + k + 10 * item))
        assert_allclose(row["novelty"], NOVELTIES[row["frame"], item], rtol=1e-6)
        best = int(np.argmax(POSTERIORS[row["frame"] % 2, item]))
        assert row["confidence"] == pytest.approx(POSTERIORS[row["frame"] % 2, item, best])


def test_tracker_reads_boxes_in_fixed_frame(run: Path) -> None:
    """With the inverse pose, boxes at rest would rotate."""
    (found,) = _read_streams(run, len(CATEGORIES), {"/depth"})

    assert found.frames.tolist() == list(range(FRAMES))
    assert found.numbers.tolist() == list(range(3 * FRAMES))
    for k in range(FRAMES):
        of_frame = found.of_frame(k)
        assert_allclose(found.centers[of_frame], CENTERS, atol=1e-5)
        axes = np.tile(AXES.as_matrix(), (3, 1, 1))
        assert_allclose(found.axes(of_frame), axes, atol=1e-5)
        assert found.partial[of_frame].tolist() == [PARTIAL[k], False, False]
        assert_allclose(found.posteriors[of_frame], POSTERIORS[k % 2], atol=1e-6)
        assert_allclose(found.novelties[of_frame], NOVELTIES[k], rtol=1e-6)


def test_tracker_reads_interleaved_topics_as_their_streams(tmp_path: Path) -> None:
    """A detection read into the frame of another topic, or row group, would be misplaced."""
    count = 2 * GROUP_FRAMES + 5
    wanted: dict[str, list[tuple[int, int, list[float]]]] = {"": [], "/own": []}
    written, row = [], 0
    for k in range(count):
        topic, at = ("/own", "/a", "/b")[k % 3], k % FRAMES
        found = all_of(at)[: k % 4]
        posed = topic != "/own" and k != 7
        for item, one in enumerate(found):
            if topic == "/own":
                center = one.candidate.box.center.tolist()
                wanted["/own"].append((EPOCH + k, row + item, center))
            elif posed:
                wanted[""].append((EPOCH + k, row + item, CENTERS[item].tolist()))
        row += len(found)
        written.append(
            frame_of(at, found, topic=topic, index=k // 3, stamp_ns=EPOCH + k, posed=posed)
        )
    write_frames(tmp_path, written)
    placed = streams_with_poses(tmp_path)
    own, shared = _read_streams(tmp_path, len(CATEGORIES), placed)

    assert placed == {"/a", "/b"}
    assert (own.names, shared.names) == (("/own",), ("/a", "/b"))
    for table, name in ((own, "/own"), (shared, "")):
        frames = [k for k in range(count) if (k % 3 == 0) == bool(name)]
        assert table.stamps_ns.tolist() == [EPOCH + k for k in frames]
        assert table.frames.tolist() == [k // 3 for k in frames]
        stamps, row_numbers, centers = zip(*wanted[name], strict=True)
        assert table.stamps_ns[table.rows].tolist() == list(stamps)
        assert table.numbers.tolist() == list(row_numbers)
        assert_allclose(table.centers, centers, atol=1e-5)


def test_tracker_reads_which_views_are_reused(tmp_path: Path) -> None:
    """A view reused in a static scene would count as many views; frame numbers may have gaps."""
    seen = [replace(detection_of(k, 1), reused_from=(None, 2, 2, None)[k]) for k in range(4)]
    frames = (frame_of(k, [one], index=3 * k + 2, posed=False) for k, one in enumerate(seen))
    write_frames(tmp_path, frames)

    (table,) = _read_streams(tmp_path, len(CATEGORIES), set())

    assert table.described.tolist() == [2, 2, 2, 11]


@pytest.mark.parametrize("flag", ["touches_border", "occluded"])
def test_view_with_either_flag_counts_as_partial(tmp_path: Path, flag: str) -> None:
    """Otherwise a view of a half-hidden object would weigh four times as much as it should."""
    frames = []
    for k in range(FRAMES):
        one = detection_of(k, 1)
        flags: dict[str, Any] = {flag: k == 5}
        frames.append(frame_of(k, [replace(one, candidate=replace(one.candidate, **flags))]))
    write_frames(tmp_path, frames)

    views = POSTERIORS[np.arange(FRAMES) % 2, 1]
    fused = np.exp(np.average(np.log(views), axis=0, weights=[1, 1, 1, 1, 1, 0.25]))
    assert_allclose(rows(tmp_path, "tracks")[-1]["posterior"], fused / fused.sum(), atol=1e-6)


def test_track_boxes_match_object_poses(run: Path) -> None:
    """The fused box encloses the outlines; half of the variance is common to all six views."""
    tracks = rows(run, "tracks")
    # The standard deviation of a visible length is 6 mm, that of the height is given.
    std = np.array([0.006, 0.006, FULL_STD[2]]) * math.sqrt(1 / 2 + 1 / 12)

    assert len(tracks) == 3 * FRAMES
    for row in tracks:
        k, item = row["frame"], row["detection"]
        inverse = ROTATIONS[k].inv()
        assert_allclose(row["center_fixed"], CENTERS[item], atol=1e-5)
        center = inverse.apply(FUSED_CENTERS[item] - POSITIONS[k])
        assert_allclose(row["center_full"], center, atol=1e-5)
        turn = Rotation.from_quat(row["orientation_full"])
        assert_allclose(turn.as_matrix(), (inverse * FULL_AXES).as_matrix(), atol=1e-5)
        assert_allclose(row["size_full"], FULL_SIZE, atol=1e-5)
        assert_allclose(row["size_full_std"], std, atol=1e-6)


def test_positions_far_from_origin_are_exact(tmp_path: Path) -> None:
    """Fixed frames of outdoor robots have coordinates of millions of metres (UTM)."""
    origin = np.array([500_000.25, 5_400_000.125, 310.5])
    frames = (frame_of(k, all_of(k), origin=origin) for k in range(FRAMES))
    folder = write_frames(tmp_path, frames)

    for table in ("detections", "tracks"):
        found = rows(folder, table)
        assert len(found) == 3 * FRAMES
        for row in found:
            assert_allclose(row["center_fixed"] - origin, CENTERS[row["detection"]], atol=1e-5)
    places = [[float(line[axis]) for axis in "xyz"] for line in lines(folder)]
    order = np.argsort([place[0] for place in places])
    assert_allclose(np.array(places)[order] - origin, CENTERS[[2, 0, 1]], atol=6e-4)


def test_equal_frame_numbers_of_two_sensors_are_not_confused(tmp_path: Path) -> None:
    """Each box is shown in the frame of the sensor that saw it."""
    topics = ["/right" if k % 2 else "/left" for k in range(FRAMES)]
    write_frames(
        tmp_path,
        (frame_of(k, all_of(k), topic=topic, index=k // 2) for k, topic in enumerate(topics)),
    )

    tracks = rows(tmp_path, "tracks")
    assert len(tracks) == 3 * FRAMES
    for row in tracks:
        k, item = 2 * row["frame"] + (row["topic"] == "/right"), row["detection"]
        assert row["stamp_ns"] == stamp(k)
        assert_allclose(row["center_fixed"], CENTERS[item], atol=1e-5)
        own = ROTATIONS[k].inv().apply(FUSED_CENTERS[item] - POSITIONS[k])
        assert_allclose(row["center_full"], own, atol=1e-5)


@pytest.mark.parametrize("flag", ["touches_border", "occluded"])
def test_cut_views_have_less_weight_for_full_box(tmp_path: Path, flag: str) -> None:
    """Four cut views weigh as much as one of the two whole views."""
    cut = (True, False, True, True, False, True)
    heights = [0.11 if one else 0.21 for one in cut]
    frames = []
    for k in range(FRAMES):
        found = all_of(k)
        first, whole = found[1].candidate, found[1].full
        flags: dict[str, Any] = {flag: cut[k]}
        assert whole is not None
        found[1] = replace(
            found[1],
            candidate=replace(first, **flags),
            full=replace(whole, size=np.array([*whole.size[:2], heights[k]])),
        )
        frames.append(frame_of(k, found))
    write_frames(tmp_path, frames)

    for row in rows(tmp_path, "tracks"):
        height = 0.21 if row["detection"] == 1 else FULL_SIZE[2]
        assert row["size_full"][2] == pytest.approx(height, abs=1e-5)


@pytest.mark.parametrize("posed", [3, 4])
def test_pose_missing_in_half_of_frames_is_not_used(tmp_path: Path, posed: int) -> None:
    """Detections without a pose would be lost, which is accepted only if there are few."""
    own = np.array([0.31, -0.12, 0.94])
    one = detection_of(0, 1)
    box = replace(one.candidate.box, center=own)
    one = replace(one, candidate=replace(one.candidate, box=box))
    frames = (
        frame_of(0, [one], index=k, stamp_ns=stamp(k), posed=k < posed) for k in range(FRAMES)
    )
    write_frames(tmp_path, frames)

    place, count = (ROTATIONS[0].apply(own) + POSITIONS[0], 4) if posed == 4 else (own, FRAMES)
    tracks = [row for row in rows(tmp_path, "tracks") if row["detection"] is not None]
    assert [row["frame"] for row in tracks] == list(range(count))
    assert_allclose([row["center_fixed"] for row in tracks], [place] * count, atol=1e-5)
    assert [row["frames"] for row in lines(tmp_path)] == [str(count)]
    placed = streams_with_poses(tmp_path)
    turn = (ROTATIONS[0] if placed else Rotation.identity()) * ROTATIONS[0].inv() * AXES
    for table in _read_streams(tmp_path, len(CATEGORIES), placed):
        axes = table.axes(slice(None))
        assert_allclose(axes, np.tile(turn.as_matrix(), (len(axes), 1, 1)), atol=1e-5)


def test_causal_posteriors_use_current_and_earlier_views(run: Path) -> None:
    """Row k is the geometric mean of views 0 to k, with a quarter weight for partial views."""
    for item in range(3):
        weights = np.where(PARTIAL, 0.25, 1.0) if item == 0 else np.ones(FRAMES)
        views = np.log([POSTERIORS[k % 2, item] for k in range(FRAMES)])
        summed = np.cumsum(views * weights[:, None], axis=0) / np.cumsum(weights)[:, None]
        wanted = np.exp(summed) / np.exp(summed).sum(axis=1, keepdims=True)
        causal = [row["posterior"] for row in rows(run, "tracks") if row["detection"] == item]
        assert_allclose(causal, wanted, atol=1e-6)


def test_tracks_csv_starts_with_unknown_and_uncertain_tracks(run: Path) -> None:
    """Users read from the top."""
    table = lines(run)

    assert table[0]["category"] == "unknown"
    assert "unknown" not in [row["category"] for row in table][1:]
    confidences = [float(row["confidence"]) for row in table[1:]]
    assert confidences == sorted(confidences)
    assert confidences[0] < confidences[1]
    assert table[0]["guess"] != "unknown"


def test_tracks_csv_has_positions_and_times(run: Path) -> None:
    """No reader would notice swapped columns."""
    by_place = {round(float(row["x"]), 1): row for row in lines(run)}

    assert sorted(by_place) == [2.6, 3.1, 3.5]
    for item, center in enumerate(CENTERS):
        row = by_place[round(center[0], 1)]
        place = [float(row[axis]) for axis in "xyz"]
        assert_allclose(place, center, atol=1e-3)
        assert (row["first_s"], row["last_s"], row["frames"]) == ("0.000", "0.500", "6")
        assert (row["topic"], row["run"], row["label"]) == ("/depth", "w0123", "")
        weights = np.where(PARTIAL, 0.25, 1.0) if item == 0 else np.ones(FRAMES)
        limit = 1 + 0.08 * (1 - 1 / weights.sum())  # more lenient with more views
        fused = np.average(NOVELTIES[:, item], weights=weights) / limit
        assert float(row["novelty"]) == pytest.approx(fused, abs=0.006)


@pytest.mark.parametrize("merged", [False, True])
def test_labelled_frames_and_annotations_have_same_boxes(run: Path, *, merged: bool) -> None:
    """Two code paths read the tables; the up direction differs in every frame."""
    labels = read_labels(run / "tracks.csv", CATEGORIES)
    if merged:
        labels[3] = labels[1]
    shown = list(read_annotation_frames(run, LabelledTracks.read(run, labels)))
    labelled = list(read_labelled_frames(run, labels))

    assert [frame.index for frame in shown] == [frame.index for frame in labelled]
    for one, other in zip(shown, labelled, strict=True):
        assert one.stamp_ns == other.stamp_ns == stamp(one.index)
        assert other.fixed_from_sensor is not None
        assert_allclose(other.fixed_from_sensor.rotation, ROTATIONS[one.index].as_matrix())
        assert len(one.objects) == 3 - merged
        for item, same in zip(one.objects, other.objects, strict=True):
            assert (item.track, item.category) == (same.track, same.category)
            assert same.full is not None
            assert_allclose(item.center, same.full.center, atol=1e-6)
            assert_allclose(item.size, same.full.size, atol=1e-6)
            assert_allclose(item.orientation, same.full.orientation, atol=1e-6)


def test_annotation_of_unknown_whole_is_the_visible_part(tmp_path: Path) -> None:
    """One such object must not cost the other objects of the frame their whole boxes."""
    frames = []
    for k in range(FRAMES):
        first, vague, last = all_of(k)
        frames.append(frame_of(k, [first, replace(vague, full=None), last]))
    folder = write_frames(tmp_path, frames)
    labels = read_labels(folder / "tracks.csv", CATEGORIES)

    for frame in read_annotation_frames(folder, LabelledTracks.read(folder, labels)):
        sizes = sorted(one.size for one in frame.objects)
        assert_allclose(sizes, [SIZE, FULL_SIZE, FULL_SIZE], atol=1e-6)


def test_times_count_from_earliest_stamp_not_first_message(tmp_path: Path) -> None:
    """Beside a camera whose frames arrive late, a track would begin before the recording."""
    one, delays = [detection_of(0, 1)], {"/soon": SECOND // 20, "/late": 0}
    frames = (
        frame_of(k, one, topic=topic, stamp_ns=stamp(k) + delay, posed=False)
        for k in range(FRAMES)
        for topic, delay in delays.items()
    )
    write_frames(tmp_path, frames)

    table, timelines = lines(tmp_path), read_timelines(tmp_path)
    begins = {row["topic"]: (row["first_s"], row["last_s"]) for row in table}
    assert begins == {"/late": ("0.000", "0.500"), "/soon": ("0.050", "0.550")}
    for row in table:
        shown = timelines[int(row["track"])].seconds
        assert_allclose(shown[[0, -1]], [float(row["first_s"]), float(row["last_s"])], atol=1e-3)


def test_confidence_and_guess_use_all_views(run: Path) -> None:
    """The last causal posterior of a track decides, not its first view."""
    last = {row["track"]: row["posterior"] for row in rows(run, "tracks")}

    for row in lines(run):
        posterior = last[int(row["track"])]
        assert float(row["confidence"]) == pytest.approx(max(posterior), abs=6e-4)
        assert row["guess"] == CATEGORIES[int(np.argmax(posterior))]
        assert row["category"] in {row["guess"], "unknown"}


ROBOT = Pose(Rotation.from_euler("xyz", [-1.8, 0.3, 0.7]).as_matrix(), np.array([0.2, -0.4, 1.1]))


def test_merged_box_is_upright_in_named_frame(tmp_path: Path) -> None:
    """A cloud in the frame of the robot is drawn there; up is known in the sensor frame."""
    write_frames(
        tmp_path,
        (frame_of(k, all_of(k), frame_id="base", offset=ROBOT) for k in range(FRAMES)),
    )
    labels = read_labels(tmp_path / "tracks.csv", CATEGORIES)
    labels[3] = labels[1]

    tracks = LabelledTracks.read(tmp_path, labels)
    for frame in read_annotation_frames(tmp_path, tracks, visible=True):
        (merged,) = (box for box in frame.objects if box.track == 1)
        axes = Rotation.from_quat(merged.orientation).as_matrix()
        up = ROBOT.rotation @ ROTATIONS[frame.index].inv().apply(UP)
        assert_allclose(axes[:, 2], up, atol=1e-5)
        centers = ROTATIONS[frame.index].inv().apply(CENTERS - POSITIONS[frame.index])
        apart = centers @ ROBOT.rotation.T + ROBOT.translation - merged.center
        inside = (np.abs(apart @ axes) < np.array(merged.size) / 2).all(axis=1)
        assert inside.sum() >= 2
        assert merged.size[2] < SIZE[2] + 0.21  # their heights differ by 0.2 at most


def test_only_boxes_of_named_frames_are_transformed(tmp_path: Path) -> None:
    """A robot may publish clouds in its base frame beside images in that of a camera."""
    sensors = (("/cloud", "base", ROBOT), ("/depth", "optical", None))
    written = (
        frame_of(k, [detection_of(k, 0)], topic=topic, frame_id=frame_id, offset=offset)
        for k in range(FRAMES)
        for topic, frame_id, offset in sensors
    )
    write_frames(tmp_path, written)
    tracks = LabelledTracks.read(tmp_path, read_labels(tmp_path / "tracks.csv", CATEGORIES))

    for visible in (True, False):
        frames = list(read_annotation_frames(tmp_path, tracks, visible=visible))
        assert len(frames) == 2 * FRAMES
        for named, plain in zip(frames[::2], frames[1::2], strict=True):
            (moved,), (box,) = named.objects, plain.objects
            assert (named.frame_id, plain.frame_id) == ("base", "optical")
            assert_allclose(
                moved.center, ROBOT.rotation @ box.center + ROBOT.translation, atol=1e-6
            )
            axes = (Rotation.from_quat(each.orientation).as_matrix() for each in (moved, box))
            assert_allclose(next(axes), ROBOT.rotation @ next(axes), atol=1e-6)


def test_parts_of_merged_track_become_one_object(run: Path) -> None:
    """One part may rest on the other: the lower support counts."""
    frame = next(read_labelled_frames(run, read_labels(run / "tracks.csv", CATEGORIES)))
    up = frame.up
    assert up is not None
    low, high = sorted(frame.objects, key=lambda part: float(up @ part.box.center))[::2]
    parts = [replace(high, height_m=0.03), replace(low, height_m=0.07)]
    bottoms = [float(up @ part.box.center) - part.height_m for part in parts]
    whole = _join(parts, up.tolist())

    assert bottoms[1] < bottoms[0] - 0.1
    assert float(up @ whole.box.center) - whole.height_m == pytest.approx(bottoms[1])
    above = replace(high, height_m=math.nan)  # no plane was found below it
    for some in ([above, parts[1]], [parts[1], above]):
        assert _join(some, up.tolist()).height_m == pytest.approx(whole.height_m)
    hidden, cut = replace(parts[0], occluded=True), replace(parts[1], touches_border=True)
    for some in ([hidden, cut], [cut, hidden]):  # a partial part makes the object partial
        joined = _join(some, up.tolist())
        assert (joined.occluded, joined.touches_border) == (True, True)
    assert not np.allclose(high.posterior, low.posterior)
    assert_allclose(whole.posterior, (high.posterior + low.posterior) / 2)
    assert not np.allclose(high.causal, low.causal)
    assert_allclose(whole.causal, (high.causal + low.causal) / 2)
    vague = replace(parts[0], full=None)  # only its visible part is known
    for some in ([vague, parts[1]], [parts[1], vague]):
        box = _join(some, up.tolist()).full
        assert box is not None
        corners = np.concatenate([box_corners(part.full or part.box) for part in some])
        local = (corners - box.center) @ Rotation.from_quat(box.orientation).as_matrix()
        assert_allclose(np.abs(local).max(axis=0), box.size / 2, atol=1e-5)
    assert _join([vague, replace(parts[1], full=None)], up.tolist()).full is None
    assert whole.detections == (*high.detections, *low.detections)
    assert len(set(whole.detections)) == 2


def test_track_position_is_median() -> None:
    """A single outlier must not move the position that the user sees."""
    centers = np.array([[0.3, 1.1, 0.7], [0.31, 1.12, 0.72], [0.32, 1.13, 0.73], [1.5, 2.6, 0.1]])
    track = Track(
        id=3,
        topics=("/depth",) * 4,
        hits=3,
        frames=np.arange(4),
        stamps_ns=np.arange(4) * SECOND,
        detections=np.array([0, 0, -1, 0]),  # it coasts
        centers=centers,
        causal=np.full((4, 3), 1 / 3),
        posterior=np.array([0.2, 0.7, 0.1]),
        confidence=0.7,
        novelty=0.4,
    )

    line = _line(track, CATEGORIES, 0, "")

    assert_allclose([line[name] for name in "xyz"], [0.315, 1.125, 0.71])
    assert (line["track"], line["category"], line["frames"]) == (3, "can", 3)
    assert (line["first_s"], line["last_s"]) == (0, 3)
    late = replace(track, stamps_ns=np.array([1, 0, 3, 2]) * SECOND)  # frames arrived out of order
    line = _line(late, CATEGORIES, 0, "")
    assert (line["first_s"], line["last_s"]) == (0, 3)
