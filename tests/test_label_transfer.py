"""Tests of labels of another run: refused by number, and transferred by place and time."""

import csv
import json
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from click.testing import Result

from shapecat.errors import OutputError
from shapecat.runs.folder import read_run, staged, write_run
from shapecat.runs.identity import new_id
from shapecat.runs.jobs import Job
from shapecat.runs.labelled_tracks import LabelledTracks
from shapecat.runs.labels.corrections import adopt_labels, read_labels
from shapecat.runs.labels.replaced import keep_labels
from shapecat.runs.labels.same_objects import Match, _by_majority, _mutual_nearest
from shapecat.runs.labels.track_table import read_track_table
from shapecat.runs.labels.transfer import TABLE_ALONE, match_labels, transfer_labels
from shapecat.runs.tables.schemas import DETECTIONS, FRAMES, TRACKS
from shapecat.runs.tables.writing import write_table
from tests.mcap_files import read_ros
from tests.run_info import run_info
from tests.scenes import record
from tests.track_tables import lines

Run = Callable[..., Result]
Path3 = Sequence[Sequence[float] | None]
"""Where an object is in each frame (x, y, z), metres; None where it is not seen."""
FRAMES_EACH = 10
CUP, CAN, BOWL = (0.11, -0.42, 0.83), (0.34, -0.15, 0.79), (-0.27, 0.08, 0.86)


def test_only_mutually_nearest_objects_are_paired() -> None:
    """Of two cups near the old place, only the nearer is paired, and only within the limit."""
    one = np.array([[0.00, 0.5, 0.3], [0.05, 0.5, 0.3], [0.9, 0.1, 0.2]])
    other = np.array([[0.92, 0.1, 0.2], [0.04, 0.5, 0.3]])
    limit = np.array([[0.1, 0.1], [0.1, 0.1], [0.019, 0.1]])

    pairs = [(k, j, round(dist, 6)) for k, j, dist in _mutual_nearest(one, other, limit)]
    wider = [(k, j, round(dist, 6)) for k, j, dist in _mutual_nearest(one, other, limit + 0.002)]

    assert pairs == [(1, 1, 0.01)]
    assert wider == [(1, 1, 0.01), (2, 0, 0.02)]


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        (7, 2, {1: [Match(9, 0.03)]}),  # of ten frames: the second has too small a share
        (7, 3, {}),  # a rival
        (5, 2, {}),  # no majority
    ],
)
def test_track_is_matched_by_majority_unless_another_competes(
    first: int, second: int, expected: dict[int, list[Match]]
) -> None:
    """A track that switches between two objects must not get the label of one."""
    votes = {(1, 9): first, (2, 9): second}
    distances = {(1, 9): 0.03 * first, (2, 9): 0.05 * second}
    found = _by_majority(votes, distances, Counter({9: 10}), lambda track: track)

    assert found.found == expected
    assert set(found.reasons) == (set() if expected else {1, 2} if second == 3 else {1})


def static(place: Sequence[float], *, frames: range = range(FRAMES_EACH)) -> Path3:
    return [place if k in frames else None for k in range(FRAMES_EACH)]


def make_run(
    folder: Path,
    objects: Mapping[int, Path3],
    *,
    work: str = "",
    digest: str = "xxh3-128:one",
    fixed_frame: str | None = "map",
    size: float | tuple[float, float, float] = 0.08,
    first_size: tuple[float, float, float] | None = None,
    labels: Mapping[int, str] | None = None,
    frames_per_stamp: int = 1,
    tracks_of_other_camera: Collection[int] = (),
) -> Path:
    """Write the tables of a run whose tracks are at the given positions.

    All detections have ``size``, m, except the first one if ``first_size`` is given.
    ``frames_per_stamp`` is the number of successive frames with the same stamp. Another camera,
    with the same stamps and frame numbers, sees the ``tracks_of_other_camera``.
    """
    folder.mkdir(parents=True)
    work = work or f"w{folder.name}"
    source = {"path": f"/recordings/{folder.name}.mcap", "digest": digest, "files": []}
    model = {"categories": ["cup", "can", "bowl"]}
    run = run_info(id=new_id(), work=work, input=source, fixed_frame=fixed_frame, model=model)
    write_run(folder, run)
    rows = [
        (track, frame, place)
        for track, path in objects.items()
        for frame, place in enumerate(path)
        if place is not None
    ]
    stamps = [1_000 + 33 * (frame // frames_per_stamp) for _, frame, _ in rows]
    counts: dict[tuple[str, int], int] = {}
    topics = ["/right" if track in tracks_of_other_camera else "/depth" for track, _, _ in rows]
    detections = []
    for key in zip(topics, (frame for _, frame, _ in rows), strict=True):
        detections.append(counts.get(key, 0))
        counts[key] = detections[-1] + 1
    columns: dict[str, Any] = {
        "track": [track for track, _, _ in rows],
        "topic": topics,
        "frame": [frame for _, frame, _ in rows],
        "stamp_ns": stamps,
        "detection": pa.array(detections, pa.int32()),
        "center_fixed": [list(place) for _, _, place in rows],
        "posterior": [[1.0, 0.0, 0.0]] * len(rows),
    }
    full = {name: [None] * len(rows) for name in TRACKS.names if "_full" in name}
    write_table(folder / "tracks.parquet", full | columns, TRACKS)
    order = sorted(range(len(rows)), key=lambda k: (rows[k][1], topics[k], detections[k]))
    found = {name: [columns[name][k] for k in order] for name in ("topic", "frame", "stamp_ns")}
    empty = {field.name: [None] * len(rows) for field in DETECTIONS}
    sides = size if isinstance(size, tuple) else (size, size, 1.3 * size)
    sizes = [list(first_size or sides), *[list(sides)] * (len(rows) - 1)]
    found = {**empty, **found, "size": sizes[: len(rows)]}
    write_table(folder / "detections.parquet", found, DETECTIONS)
    write_table(folder / "frames.parquet", {f.name: [] for f in FRAMES}, FRAMES)
    write_csv(folder / "tracks.original.csv", objects, work, {})
    write_csv(folder / "tracks.csv", objects, work, labels or {})
    return folder


def write_csv(
    path: Path, objects: Mapping[int, Path3], work: str, labels: Mapping[int, str]
) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("track", "category", "confidence", "label", "x", "y", "z", "topic", "run"))
        for track, places in objects.items():
            x, y, z = np.median([place for place in places if place is not None], axis=0)
            row = (track, "cup", 0.9, labels.get(track, ""), x, y, z, "/depth", work)
            writer.writerow(row)


def labels_of(folder: Path) -> dict[int, str]:
    return read_track_table(folder / "tracks.csv").labels


def shifted(place: Sequence[float], x: float = 0, y: float = 0, z: float = 0) -> list[float]:
    return [place[0] + x, place[1] + y, place[2] + z]


# ---- the run that a table belongs to


def test_table_of_another_run_is_refused(tmp_path: Path) -> None:
    """Equal track numbers of two runs mean different objects."""
    mine = make_run(tmp_path / "mine", {1: static(CUP)})
    theirs = make_run(tmp_path / "theirs", {1: static(CAN)}, labels={1: "bowl"})
    with pytest.raises(OutputError) as refused:
        adopt_labels(theirs / "tracks.csv", mine)

    for words in ("wmine", "wtheirs", "/recordings/theirs.mcap", str(mine), "--by-place"):
        assert words in str(refused.value)
    assert labels_of(mine) == {1: ""}


def test_table_copied_from_another_run_is_refused(tmp_path: Path) -> None:
    mine = make_run(tmp_path / "mine", {1: static(CUP)})
    write_csv(mine / "tracks.csv", {1: static(CAN)}, "wtheirs", {1: "bowl"})

    with pytest.raises(OutputError, match="wtheirs"):
        adopt_labels(mine / "tracks.csv", mine)
    with pytest.raises(OutputError, match="wtheirs"):
        read_labels(mine / "tracks.csv")


def test_mixed_tables_are_refused(tmp_path: Path) -> None:
    mine = make_run(tmp_path / "mine", {1: static(CUP), 2: static(CAN)})
    text = (mine / "tracks.csv").read_text().splitlines()
    text[-1] = text[-1].replace("wmine", "wtheirs")
    (tmp_path / "mixed.csv").write_text("\n".join(text))

    with pytest.raises(OutputError, match="several runs"):
        adopt_labels(tmp_path / "mixed.csv", mine)


def test_table_without_run_column_is_checked_by_positions(tmp_path: Path) -> None:
    """If a user deletes the column, positions decide; a table without positions is accepted."""
    mine = make_run(tmp_path / "mine", {1: static(CUP)})
    theirs = make_run(tmp_path / "theirs", {1: static(shifted(CUP, y=0.01))})
    for run, label in ((mine, "bowl"), (theirs, "can")):
        lines = [line.rpartition(",")[0] for line in (run / "tracks.csv").read_text().splitlines()]
        (tmp_path / f"{run.name}.csv").write_text(
            "\n".join(lines).replace("0.9,,", f"0.9,{label},")
        )
    (tmp_path / "hand.csv").write_text("track,category,confidence,label\n1,cup,0,delete\n")

    adopt_labels(tmp_path / "mine.csv", mine)
    assert labels_of(mine) == {1: "bowl"}
    with pytest.raises(OutputError, match="at other positions"):
        adopt_labels(tmp_path / "theirs.csv", mine)
    assert labels_of(mine) == {1: "bowl"}
    adopt_labels(tmp_path / "hand.csv", mine)
    assert labels_of(mine) == {1: "delete"}


def test_run_column_survives_spreadsheet(tmp_path: Path) -> None:
    """Spreadsheets write semicolons, a byte order mark and decimal commas, and move columns."""
    mine = make_run(tmp_path / "mine", {1: static(CUP)}, work="w12e4567890123456")
    text = "\ufeffrun;label;confidence;category;track\nw12e4567890123456;bowl;0,9;cup;1,0\n"
    (tmp_path / "saved.csv").write_text(text, "utf-8")

    adopt_labels(tmp_path / "saved.csv", mine)

    assert labels_of(mine) == {1: "bowl"}


# ---- one recording, processed again


def test_labels_are_transferred_to_tracks_at_same_positions(tmp_path: Path) -> None:
    """Numbers differ, positions differ by 2 cm, and no coordinates may be swapped."""
    labels = {1: "mug", 2: "delete", 3: "merge with 1"}
    objects = {1: static(CUP), 2: static(CAN), 3: static(BOWL)}
    source = make_run(tmp_path / "source", objects, labels=labels)
    moved = {
        7: static(shifted(BOWL, z=0.02)),
        8: static(shifted(CUP, x=0.02)),
        9: static(shifted(CAN, y=-0.02)),
    }
    target = make_run(tmp_path / "target", moved)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {7: "merge with 8", 8: "mug", 9: "delete"}
    assert not transfer.missed
    assert {item.distance_m for item in transfer.transferred} == {0.02}
    listed = read_run(target)["corrections"]
    assert listed["from"] == "wsource"
    assert {item["track"] for item in listed["transferred"]} == {7, 8, 9}


def test_runs_in_different_fixed_frames_are_not_compared(tmp_path: Path) -> None:
    """The position of a cup in one fixed frame may be that of a bowl in another."""
    source = make_run(
        tmp_path / "source", {1: static(CUP), 2: static(CAN)}, labels={1: "mug"}, fixed_frame="odom"
    )
    target = make_run(tmp_path / "target", {1: static(CAN), 2: static(CUP)})

    with pytest.raises(OutputError, match="fixed frames differ"):
        transfer_labels(source, target)
    assert set(labels_of(target).values()) == {""}


def test_objects_that_swap_places_are_distinguished_by_time(tmp_path: Path) -> None:
    """Two objects swap places halfway: only time, not their median positions, tells them apart."""
    half = FRAMES_EACH // 2
    first = [CUP] * half + [CAN] * half
    second = [CAN] * half + [CUP] * half
    source = make_run(tmp_path / "source", {1: first, 2: second}, labels={1: "mug", 2: "tin"})
    target = make_run(tmp_path / "target", {5: second, 6: first})

    transfer_labels(source, target)

    assert labels_of(target) == {5: "tin", 6: "mug"}


@pytest.mark.parametrize(
    ("size", "other", "matched"),
    [(0.1, 0.1, False), (0.1, 0.21, True), (0.21, 0.1, True)],
)
def test_large_objects_are_matched_over_larger_distances_at_once(
    tmp_path: Path, size: float, other: float, *, matched: bool
) -> None:
    """Other settings may find another part of a box.

    So the centres may be half as far apart as the two detections are wide on average.
    """
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"}, size=size)
    target = make_run(tmp_path / "target", {5: static(shifted(CUP, y=0.07))}, size=other)

    transfer_labels(source, target)

    assert labels_of(target) == {5: "mug" if matched else ""}


def test_skipped_frames_do_not_count_against_a_match(tmp_path: Path) -> None:
    """The source has half of the frames: no label would have a majority of all frames."""
    every_2nd = range(0, FRAMES_EACH, 2)
    source = make_run(tmp_path / "source", {1: static(CUP, frames=every_2nd)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: static(CUP)})

    transfer_labels(source, target)

    assert labels_of(target) == {5: "mug"}


def test_frames_with_equal_stamps_are_told_apart(tmp_path: Path) -> None:
    """If each message is recorded twice, no label would have a majority of the frames."""
    objects = {1: static(CUP), 2: static(CAN)}
    source = make_run(tmp_path / "source", objects, labels={1: "mug", 2: "tin"}, frames_per_stamp=2)
    target = make_run(tmp_path / "target", objects, frames_per_stamp=2)

    transfer_labels(source, target)

    assert labels_of(target) == {1: "mug", 2: "tin"}


def test_tracks_of_two_cameras_are_told_apart(tmp_path: Path) -> None:
    """Frames of two cameras may have equal numbers and stamps: objects of one would be lost."""
    objects = {1: static(CUP), 2: static(CAN), 3: static(shifted(CUP, x=0.4))}
    labels = {1: "mug", 2: "tin", 3: "bowl"}
    source = make_run(tmp_path / "source", objects, labels=labels, tracks_of_other_camera={2})
    target = make_run(tmp_path / "target", objects, tracks_of_other_camera={2})

    transfer_labels(source, target)

    assert labels_of(target) == labels


@pytest.mark.parametrize("kept", [slice(0), slice(0, None, 2)])
def test_detections_of_another_run_are_refused(tmp_path: Path, kept: slice) -> None:
    """A missing frame raised a KeyError, and a missing detection an IndexError."""
    objects = {1: static((0, 0, 1)), 2: static((1, 0, 1))}
    source = make_run(tmp_path / "a", objects, labels={1: "bowl"})
    target = make_run(tmp_path / "b", objects)
    path = target / "detections.parquet"
    rows = pq.read_table(path).to_pylist()[kept]
    write_table(path, {name: [row[name] for row in rows] for name in DETECTIONS.names}, DETECTIONS)

    with pytest.raises(OutputError, match="tables are inconsistent"):
        match_labels(source, target)


def test_run_without_objects_misses_each_label(tmp_path: Path) -> None:
    """An error about fixed frames, which one recording does not need, would hide the reason."""
    labels = {1: "mug", 2: "merge with 1"}
    objects = {1: static(CUP), 2: static(CAN)}
    source = make_run(tmp_path / "source", objects, labels=labels, fixed_frame=None)
    target = make_run(tmp_path / "target", {}, fixed_frame=None)

    transfer = transfer_labels(source, target)

    assert not transfer.transferred
    assert {(item.old_track, item.label): item.reason for item in transfer.missed} == {
        (1, "mug"): "nothing was found there",
        (2, "merge with 1"): "track #1, which it is merged with: nothing was found there",
    }
    listed = read_run(target)["corrections"]
    assert (listed["by"], listed["transferred"]) == ("frames in common", [])
    assert len(listed["not_transferred"]) == 2


def test_both_parts_of_split_track_are_labelled(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"})
    parts = {4: static(CUP, frames=range(4)), 5: static(CUP, frames=range(4, 10))}
    target = make_run(tmp_path / "target", parts)

    transfer_labels(source, target)

    assert labels_of(target) == {4: "mug", 5: "mug"}


def test_conflicting_labels_are_reported_not_applied(tmp_path: Path) -> None:
    objects = {1: static(CUP, frames=range(5)), 2: static(CUP, frames=range(5, 10))}
    source = make_run(tmp_path / "source", objects, labels={1: "mug", 2: "tin"})
    target = make_run(tmp_path / "target", {9: static(CUP)})

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {9: ""}
    assert {item.old_track for item in transfer.missed} == {1, 2}
    assert all("9" in item.reason for item in transfer.missed)


@pytest.mark.parametrize("digest", ["xxh3-128:one", "xxh3-128:two"])
def test_merged_tracks_may_be_one_track_in_target(tmp_path: Path, digest: str) -> None:
    """If each were matched alone, the two merged tracks would compete for one track.

    The target is of the same recording, or of another one.
    """
    objects = {1: static(CUP, frames=range(7)), 2: static(CUP, frames=range(7, 10))}
    labels = {1: "mug", 2: "merge with 1"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    target = make_run(tmp_path / "target", {9: static(CUP, frames=range(8))}, digest=digest)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {9: "mug"}
    assert not [item for item in transfer.missed if item.old_track == 1]


def test_missing_objects_are_reported(tmp_path: Path) -> None:
    """Merges with a missing object must be reported as well."""
    objects = {1: static(CUP), 2: static(CAN), 3: static(BOWL)}
    labels = {1: "mug", 2: "tin", 3: "merge with 2"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    target = make_run(tmp_path / "target", {1: static(BOWL), 2: static(CUP)})

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {1: "", 2: "mug"}
    assert {item.old_track: item.reason for item in transfer.missed} == {
        2: "nothing was found there",
        3: "track #2, which it is merged with: nothing was found there",
    }


def test_neighbour_does_not_get_label_of_missing_object(tmp_path: Path) -> None:
    """The labelled object is missing in the target, and its neighbour is the nearest track."""
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"}, size=0.05)
    beside = {5: static(shifted(CUP, y=0.08))}
    target = make_run(tmp_path / "target", beside, size=0.05)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {5: ""}
    assert [item.old_track for item in transfer.missed] == [1]


@pytest.mark.parametrize("part_first", [False, True])
def test_merged_track_may_be_split_in_target(tmp_path: Path, part_first: bool) -> None:
    """Otherwise the parts would be two objects again. The order of lines must not matter."""
    whole = [None if 5 <= k < 8 else CUP for k in range(FRAMES_EACH)]
    part = static(shifted(CUP, y=0.01), frames=range(5, 8))
    objects = {2: part, 1: whole} if part_first else {1: whole, 2: part}
    labels = {1: "mug", 2: "merge with 1"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    parts = {9: static(CUP, frames=range(5)), 10: static(CUP, frames=range(5, 10))}
    target = make_run(tmp_path / "target", parts)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {9: "mug", 10: "merge with 9"}
    assert not transfer.missed


@pytest.mark.parametrize("numbers", [(8, 9), (9, 8)])
def test_parts_stay_merged_if_whole_is_seen_at_both(tmp_path: Path, numbers: Any) -> None:
    """If the target misses the object in a frame, the track of a part of it is nearest there.

    The label would be copied to both tracks, which would be two objects again.
    """
    later, part = range(1, FRAMES_EACH), shifted(CUP, z=0.075)
    objects = {1: static(CUP), 2: static(part, frames=later)}
    labels = {1: "mug", 2: "merge with 1"}
    source = make_run(tmp_path / "source", objects, labels=labels, size=0.1)
    both = [shifted(CUP, z=0.03), *static(part)[1:]]
    target = make_run(
        tmp_path / "target", {numbers[0]: static(CUP, frames=later), numbers[1]: both}, size=0.1
    )

    transfer_labels(source, target)

    assert sorted(labels_of(target).values()) == ["merge with 8", "mug"]


def test_chain_of_merges_is_transferred(tmp_path: Path) -> None:
    """Merges into each other would form a loop, and all labels would be lost."""
    third = range(3), range(3, 6), range(6, 10)
    objects = {k: static(CUP, frames=frames) for k, frames in enumerate(third, start=1)}
    labels = {1: "merge with 2", 2: "merge with 3"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    parts = {k + 10: static(CUP, frames=frames) for k, frames in enumerate(third)}
    target = make_run(tmp_path / "target", parts)

    transfer_labels(source, target)

    assert labels_of(target) == {10: "merge with 12", 11: "merge with 12", 12: ""}


# ---- existing labels, and labels that cannot be read


def test_existing_label_in_target_is_kept(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: static(CUP)}, labels={5: "teapot"})

    (missed,) = transfer_labels(source, target).missed

    assert missed.reason == "track #5 already has the label teapot"
    assert labels_of(target) == {5: "teapot"}


def test_transferred_label_can_be_replaced(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: static(CUP)})
    transfer_labels(source, target)
    write_csv(source / "tracks.csv", {1: static(CUP)}, "wsource", {1: "teapot"})

    assert not transfer_labels(source, target).missed
    assert labels_of(target) == {5: "teapot"}


def test_second_transfer_keeps_corrected_label(tmp_path: Path) -> None:
    """Only labels that the first transfer wrote may be replaced."""
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: static(CUP)})
    transfer_labels(source, target)
    write_csv(target / "tracks.csv", {5: static(CUP)}, "wtarget", {5: "teapot"})

    (missed,) = transfer_labels(source, target).missed

    assert missed.reason == "track #5 already has the label teapot"
    assert labels_of(target) == {5: "teapot"}


def test_conflicting_label_does_not_block_the_others(tmp_path: Path) -> None:
    """A user merged #6 of the target with #5, which the source says to delete."""
    labels = {1: "delete", 3: "mug"}
    source = make_run(tmp_path / "source", {1: static(CUP), 3: static(BOWL)}, labels=labels)
    objects = {5: static(CUP), 6: static(CAN), 7: static(BOWL)}
    target = make_run(tmp_path / "target", objects, labels={6: "merge with 5"})

    (missed,) = transfer_labels(source, target).missed

    assert (missed.old_track, "track #5 is deleted" in missed.reason) == (1, True)
    assert labels_of(target) == {5: "", 6: "merge with 5", 7: "mug"}


def test_misspelt_label_does_not_block_the_others(tmp_path: Path) -> None:
    labels = {1: "mug", 2: "bowll"}
    source = make_run(tmp_path / "source", {1: static(CUP), 2: static(CAN)}, labels=labels)
    target = make_run(tmp_path / "target", {5: static(CUP), 6: static(CAN)})

    (missed,) = transfer_labels(source, target).missed

    assert (missed.old_track, "did you mean bowl" in missed.reason) == (2, True)
    assert labels_of(target) == {5: "mug", 6: ""}


def test_category_unknown_to_target_is_transferred_as_new(tmp_path: Path) -> None:
    """In a run with a model that has not learned *pan*, all pans would lose their label."""
    source = make_run(
        tmp_path / "source", {1: static(CUP), 2: static(CAN)}, labels={1: "pan", 2: "mug"}
    )
    run = read_run(source)
    run["model"]["categories"] += ["pan"]
    write_run(source, run)
    target = make_run(tmp_path / "target", {5: static(CUP), 6: static(CAN)})

    for _ in range(2):
        assert not transfer_labels(source, target).missed
        assert labels_of(target) == {5: "new pan", 6: "mug"}
    assert read_labels(target / "tracks.csv", ["can"])[5].category == "pan"


@pytest.mark.parametrize(
    ("found", "broken", "told"),
    [
        ("\n2,", "\nx,", "line 3: expected a track number"),
        ("wsource\r\n2,", "wb\r\n2,", "several runs"),
    ],
)
def test_damaged_lines_are_not_silently_skipped(
    tmp_path: Path, found: str, broken: str, told: str
) -> None:
    labels = {1: "mug", 2: "tin"}
    source = make_run(tmp_path / "source", {1: static(CUP), 2: static(CAN)}, labels=labels)
    table = (source / "tracks.csv").read_bytes().decode()
    assert found in table
    (source / "tracks.csv").write_bytes(table.replace(found, broken).encode())
    target = make_run(tmp_path / "target", {5: static(CUP), 6: static(CAN)})

    with pytest.raises(OutputError, match=told):
        transfer_labels(source, target)
    assert labels_of(target) == {5: "", 6: ""}


def test_runs_without_common_frames_are_matched_by_place(tmp_path: Path) -> None:
    """With another --start and --every, all labels were lost, though every object was found."""
    odd = [CUP if k % 2 else None for k in range(FRAMES_EACH)]
    source = make_run(tmp_path / "source", {1: odd}, labels={1: "mug"})
    even = [None if k % 2 else shifted(CUP, z=0.01) for k in range(FRAMES_EACH)]
    target = make_run(tmp_path / "target", {5: even, 6: static(CAN, frames=range(1))})

    assert not transfer_labels(source, target).missed
    assert labels_of(target) == {5: "mug", 6: ""}


# ---- a second recording of the same place


def second(folder: Path, objects: Mapping[int, Path3], **options: Any) -> Path:
    return make_run(folder, objects, digest="xxh3-128:two", **options)


def test_static_objects_are_found_in_another_recording(tmp_path: Path) -> None:
    """Equal stamps are a coincidence, and must not matter."""
    objects = {1: static(CUP), 2: static(CAN)}
    source = make_run(tmp_path / "source", objects, labels={1: "mug", 2: "delete"})
    moved = {1: static(shifted(CAN, z=0.02)), 2: static(shifted(CUP, y=0.03))}
    target = second(tmp_path / "target", moved)

    transfer_labels(source, target)

    assert labels_of(target) == {1: "delete", 2: "mug"}


def test_moved_object_is_reported_not_labelled(tmp_path: Path) -> None:
    path = [shifted(CUP, x=0.05 * k) for k in range(FRAMES_EACH)]
    source = make_run(tmp_path / "source", {1: path}, labels={1: "mug"})
    target = second(tmp_path / "target", {1: static(shifted(CUP, x=0.22))})

    (missed,) = transfer_labels(source, target).missed

    assert "moved" in missed.reason
    assert labels_of(target) == {1: ""}


@pytest.mark.parametrize(
    ("size", "moved"),
    [(0.08, True), (0.31, False), ((0.31, 0.08, 0.1), False), ((0.08, 0.31, 0.1), False)],
)
def test_positions_of_large_objects_may_scatter_more(
    tmp_path: Path, size: float | tuple[float, float, float], *, moved: bool
) -> None:
    """From another side, the centre of the visible part of a box is elsewhere."""
    path = [shifted(CUP, x=0.025 * k) for k in range(FRAMES_EACH)]  # half of it within 6 cm
    source = make_run(tmp_path / "source", {1: path}, labels={1: "mug"}, size=size)
    target = second(tmp_path / "target", {1: static(shifted(CUP, x=0.11))}, size=size)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {1: "" if moved else "mug"}
    assert ["moved" in one.reason for one in transfer.missed] == [True] * moved


def test_two_candidates_are_reported_not_labelled(tmp_path: Path) -> None:
    """Of two objects about equally near the old place, the wrong one could get the label."""
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"})
    around = {1: static(shifted(CUP, x=0.03)), 2: static(shifted(CUP, x=-0.035))}
    target = second(tmp_path / "target", around)

    (missed,) = transfer_labels(source, target).missed

    assert "both there" in missed.reason
    assert labels_of(target) == {1: "", 2: ""}


def test_identical_cups_that_swap_are_not_labelled(tmp_path: Path) -> None:
    """In the second recording, each cup is nearly where the other was."""
    labels = {1: "mug", 2: "tin"}
    beside = shifted(CUP, y=0.06)
    source = make_run(tmp_path / "source", {1: static(CUP), 2: static(beside)}, labels=labels)
    swapped = {1: static(shifted(CUP, y=0.025)), 2: static(shifted(CUP, y=0.035))}
    target = second(tmp_path / "target", swapped)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {1: "", 2: ""}
    assert {item.old_track for item in transfer.missed} == {1, 2}


@pytest.mark.parametrize(("apart", "found"), [(0.045, False), (0.08, True)])
def test_object_between_two_old_places_is_not_labelled(
    tmp_path: Path, apart: float, *, found: bool
) -> None:
    """The object may be either of the old ones: a difference of 5 mm in distance is chance."""
    places = {1: static(CUP), 2: static(shifted(CUP, y=apart))}
    source = make_run(tmp_path / "source", places, labels={1: "mug", 2: "tin"})
    target = second(tmp_path / "target", {1: static(shifted(CUP, y=0.02))})

    transfer_labels(source, target)

    assert labels_of(target) == {1: "mug" if found else ""}


def test_object_of_another_size_does_not_match(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"})
    target = second(tmp_path / "target", {1: static(CUP)}, size=0.2)

    (missed,) = transfer_labels(source, target).missed

    assert "a different size" in missed.reason


def test_size_of_an_object_is_not_that_of_one_view(tmp_path: Path) -> None:
    """In the first view, an object may be joined with its neighbour."""
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"})
    target = second(tmp_path / "target", {1: static(CUP)}, first_size=(0.4, 0.1, 0.1))

    transfer_labels(source, target)

    assert labels_of(target) == {1: "mug"}


@pytest.mark.parametrize("frame", [None, "odom"])
def test_positions_in_other_frames_are_not_compared(tmp_path: Path, frame: str | None) -> None:
    source = make_run(tmp_path / "source", {1: static(CUP)}, labels={1: "mug"}, fixed_frame=frame)
    target = second(tmp_path / "target", {1: static(CUP)})

    with pytest.raises(OutputError, match="fixed frame"):
        match_labels(source, target)


@pytest.mark.parametrize("place", ["downloads", "other"])
def test_table_alone_is_matched_by_positions(tmp_path: Path, place: str) -> None:
    """Such a table may lie beside the tables of another run, whose tracks are other objects."""
    (tmp_path / "downloads").mkdir()
    make_run(tmp_path / "other", {4: static(CAN), 5: static(CUP)})
    table = tmp_path / place / "table.csv"
    write_csv(table, {4: static(CUP), 5: static(CAN)}, "wfar", {4: "mug"})
    target = second(tmp_path / "target", {1: static(CAN), 2: static(shifted(CUP, z=0.01))})

    transfer = transfer_labels(table, target)

    assert labels_of(target) == {1: "", 2: "mug"}
    assert transfer.by == TABLE_ALONE


@pytest.mark.parametrize(("size", "label"), [(0.08, ""), (0.31, "mug")])
def test_large_objects_are_matched_over_larger_distances_to_table_alone(
    tmp_path: Path, size: float, label: str
) -> None:
    """The table has no sizes, but the run has them."""
    table = tmp_path / "table.csv"
    write_csv(table, {4: static(CUP)}, "wfar", {4: "mug"})
    target = second(tmp_path / "target", {2: static(shifted(CUP, x=0.09))}, size=size)

    transfer_labels(table, target)

    assert labels_of(target) == {2: label}


def test_table_alone_may_have_categories_of_target(tmp_path: Path) -> None:
    """*pan* is one letter from *can*, but the model of the run has learned it."""
    table = tmp_path / "table.csv"
    write_csv(table, {4: static(CUP)}, "wfar", {4: "pan"})
    target = second(tmp_path / "target", {2: static(CUP)})
    run = read_run(target)
    run["model"]["categories"] += ["pan"]
    write_run(target, run)

    assert not transfer_labels(table, target).missed
    assert labels_of(target) == {2: "pan"}


def test_labels_without_match_survive_later_runs(tmp_path: Path) -> None:
    """After trying other settings and returning to the old ones, the labels were in no file."""
    folder, job = tmp_path / "lab", Job(tmp_path / "lab.mcap", tmp_path / "lab")
    for label in ("teapot", "vase", ""):
        with staged(folder) as new:
            run = run_info(id=new_id())
            if folder.exists():  # without the tables of the new run, no label finds its object
                keep_labels(new, run, job)
            text = f"track,category,confidence,label\n1,can,0.5,{label}\n"
            (new / "tracks.csv").write_text(text)
            write_run(new, run)

    kept = {label for table in folder.glob("tracks.*csv") for label in labels_in(table)}
    assert kept == {"teapot", "vase"}


def test_labels_of_another_recording_wait_until_they_are_asked_for(tmp_path: Path) -> None:
    """Another recording may have the same name: a bowl could be deleted where a cup was."""
    old = make_run(tmp_path / "lab", {4: static(CUP)}, labels={4: "delete"})
    new = second(tmp_path / "new", {1: static(CUP)})
    run = read_run(new)

    keep_labels(new, run, Job(tmp_path / "lab.mcap", old))

    assert labels_of(new) == {1: ""}
    (missed,) = run["corrections"]["not_transferred"]
    assert "annotate --by-place --labels tracks.previous.csv" in missed["reason"]
    assert [labels_in(table) for table in old.glob("tracks.previous-*.csv")] == [{"delete"}]
    assert not transfer_labels(new / "tracks.previous.csv", new).missed
    assert labels_of(new) == {1: "delete"}


def test_unreadable_tables_of_another_version_cost_no_labels(tmp_path: Path) -> None:
    """The message asked to process the recording again, which had just been done."""
    old = make_run(tmp_path / "lab", {4: static(CUP)}, labels={4: "mug"})
    tracks = pq.read_table(old / "tracks.parquet")
    single = tracks["center_fixed"].cast(pa.list_(pa.float32()))
    k = tracks.column_names.index("center_fixed")
    pq.write_table(tracks.set_column(k, "center_fixed", single), old / "tracks.parquet")
    with pytest.raises(OutputError, match="again with --overwrite, which keeps labels"):
        LabelledTracks.read(old, {})
    new = make_run(tmp_path / "new", {1: static(CUP)})
    run = read_run(new)

    keep_labels(new, run, Job(tmp_path / "lab.mcap", old))

    (missed,) = run["corrections"]["not_transferred"]
    assert "column center_fixed holds list" in missed["reason"]
    assert "again" not in missed["reason"]
    assert labels_in(new / "tracks.previous.csv") == {"mug"}


@pytest.mark.parametrize("fixed_frame", ["map", None])
def test_labels_of_another_version_are_transferred(tmp_path: Path, fixed_frame: str | None) -> None:
    """The folder of a run of another version could not be replaced, nor its labels transferred."""
    objects = {4: static(CUP), 5: static(BOWL)}
    old = make_run(tmp_path / "lab", objects, labels={4: "mug"}, fixed_frame=fixed_frame)
    description = json.loads((old / "run.json").read_text())
    del description["options"]["color"]
    (old / "run.json").write_text(json.dumps(description))
    objects = {1: static(BOWL), 2: static(CUP)}
    with pytest.raises(OutputError, match=r"options\.color is .* another version .* --overwrite"):
        read_run(old)
    with staged(old) as hidden:
        new = make_run(hidden / "new", objects, fixed_frame=fixed_frame)
        run = read_run(new)
        keep_labels(new, run, Job(tmp_path / "lab.mcap", old))
        labels = labels_of(new)

    assert labels == {1: "", 2: "mug"}
    assert run["corrections"]["by"] == "frames in common"
    assert not run["corrections"]["not_transferred"]
    assert [path.name for path in old.iterdir()] == ["new"]


@pytest.mark.parametrize(("there", "copies"), [([CUP, BOWL], []), ([CUP], [{"mug", "vase"}])])
def test_table_is_kept_for_good_if_any_label_is_lost(
    tmp_path: Path, there: list[Any], copies: list[set[str]]
) -> None:
    """The next run replaces tracks.previous.csv, and transfers only the labels that were found."""
    objects = {4: static(CUP), 5: static(BOWL)}
    old = make_run(tmp_path / "lab", objects, labels={4: "mug", 5: "vase"})
    new = make_run(tmp_path / "new", {k: static(place) for k, place in enumerate(there, start=1)})
    run = read_run(new)
    keep_labels(new, run, Job(tmp_path / "lab.mcap", old))

    assert list(labels_of(new).values()) == ["mug", "vase"][: len(there)]
    assert labels_in(new / "tracks.previous.csv") == {"mug", "vase"}
    assert [labels_in(table) for table in old.glob("tracks.previous-*.csv")] == copies


@pytest.mark.parametrize(
    ("found", "broken", "lost"),
    [("\n4,cup,0.9,", "\nx,cup,0.9,", (0, "")), ("mug", "Größe", (4, "Größe"))],
)
def test_table_with_labels_on_invalid_lines_is_kept(
    tmp_path: Path, found: str, broken: str, lost: tuple[int, str]
) -> None:
    """Such a table counted as one without labels, so that the new run replaced it silently."""
    old = make_run(tmp_path / "lab", {4: static(CUP)}, labels={4: "mug"})
    table = (old / "tracks.csv").read_bytes().decode().replace(found, broken).encode("cp1252")
    (old / "tracks.csv").write_bytes(table)
    new = make_run(tmp_path / "new", {1: static(CUP)})
    run = read_run(new)
    keep_labels(new, run, Job(tmp_path / "lab.mcap", old))

    (copy,) = old.glob("tracks.previous-*.csv")
    assert copy.read_bytes() == (new / "tracks.previous.csv").read_bytes() == table
    (missed,) = run["corrections"]["not_transferred"]
    assert (missed["old_track"], missed["label"]) == lost
    assert "tracks.csv: line 2: " in missed["reason"]


# ---- the real command


@pytest.fixture(scope="module")
def processed(shapecat: Run, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Process a recording; return it and its run folder."""
    folder = tmp_path_factory.mktemp("corrected")
    recording = record(folder / "lab.mcap", 12)
    shapecat("process", recording, "--out", folder / "out", "--no-rrd", "--jobs", 1)
    return recording, folder / "out" / "lab"


def label_first(run: Path, label: str) -> dict[str, str]:
    rows = lines(run)
    rows[0]["label"] = label
    with (run / "tracks.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return rows[0]


def place_of(row: Mapping[str, str]) -> list[float]:
    return [float(row[name]) for name in "xyz"]


def annotated_classes(run: Path) -> set[str]:
    """Return the classes in annotated.mcap."""
    found = read_ros(run / "annotated.mcap", "/shapecat/detections")
    return {item.results[0].hypothesis.class_id for _, one in found for item in one.detections}


def test_overwriting_keeps_corrections_unless_discarded(
    shapecat: Run, processed: tuple[Path, Path]
) -> None:
    recording, run = processed
    before = label_first(run, "teapot")
    again = ("process", recording, "--out", run.parent, "--no-rrd", "--jobs", 1, "--overwrite")
    done = shapecat(*again, "--every", 2)

    assert done.exit_code == 0
    assert "lab.mcap: transferred 1 of 1 corrected labels" in done.stderr
    (row,) = [row for row in lines(run) if row["label"]]
    assert row["label"] == "teapot"
    assert np.allclose(place_of(row), place_of(before), atol=0.02)
    assert read_run(run)["corrections"]["transferred"][0]["label"] == "teapot"
    assert labels_in(run / "tracks.previous.csv") == {"teapot"}
    assert "teapot" in annotated_classes(run)

    done = shapecat(*again, "--discard-labels")

    assert "transferred" not in done.stderr
    assert labels_in(run / "tracks.csv") == set()
    assert "teapot" not in annotated_classes(run)


def test_discarding_labels_requires_overwriting(shapecat: Run, tmp_path: Path) -> None:
    done = shapecat("process", tmp_path / "lab.mcap", "--out", tmp_path, "--discard-labels")

    assert done.exit_code == 2
    assert "--discard-labels needs --overwrite" in done.stderr


def labels_in(table: Path) -> set[str]:
    return {row.label for row in read_track_table(table).rows if row.label}


def test_labels_without_match_are_reported_and_kept(
    shapecat: Run, processed: tuple[Path, Path]
) -> None:
    """In the new run, all objects are beyond the range of the sensor."""
    recording, run = processed
    label_first(run, "teapot")
    done = shapecat(
        *("process", recording, "--out", run.parent, "--no-rrd", "--jobs", 1, "--overwrite"),
        *("--set", "detection.max_range_m=0.2"),
    )

    assert done.exit_code == 0, done.stderr
    assert "transferred 0 of 1 corrected labels" in done.stderr
    assert "teapot: nothing was found there" in done.stderr
    assert labels_in(run / "tracks.previous.csv") == {"teapot"}


def test_by_place_transfers_labels_of_another_run(
    shapecat: Run, processed: tuple[Path, Path], tmp_path: Path
) -> None:
    recording, _ = processed
    for name in ("one", "two"):
        shapecat("process", recording, "--out", tmp_path / name, "--no-rrd", "--jobs", 1,
                 *(("--every", 2) if name == "two" else ()))  # fmt: skip
    one, two = (tmp_path / name / "lab" for name in ("one", "two"))
    label_first(one, "teapot")

    refused = shapecat("annotate", two, "--labels", one / "tracks.csv")
    assert (refused.exit_code, refused.stderr.count("\n")) == (1, 1)
    assert labels_in(two / "tracks.csv") == set()

    done = shapecat("annotate", two, "--labels", one / "tracks.csv", "--by-place")
    assert done.exit_code == 0, done.stderr
    assert "1 of 1 labels transferred" in done.stdout
    assert "teapot" in annotated_classes(two)
    # Without this list, corrected labels could not be transferred once more.
    assert [item["label"] for item in read_run(two)["corrections"]["transferred"]] == ["teapot"]


def test_transfer_to_table_without_the_matched_track_names_it(tmp_path: Path) -> None:
    """A line that a spreadsheet lost must not end in a traceback, with all outputs outdated."""
    table = tmp_path / "table.csv"
    write_csv(table, {4: static(CUP)}, "wfar", {4: "mug"})
    target = second(tmp_path / "target", {2: static(CUP)})
    own = target / "tracks.csv"
    own.write_text(own.read_text().splitlines()[0] + "\n")

    with pytest.raises(OutputError, match="missing tracks: #2; restore the lines"):
        transfer_labels(table, target)


@pytest.mark.parametrize("confidence", ["", "nan", "inf", "-0.1", "1.01", "495"])
def test_table_alone_with_confidence_outside_0_to_1_is_refused(
    tmp_path: Path, confidence: str
) -> None:
    """A spreadsheet that turned 0.495 into 495 has changed the positions as well."""
    table = tmp_path / "table.csv"
    write_csv(table, {4: static(CUP)}, "wfar", {4: "mug"})
    table.write_text(table.read_text().replace(",0.9,", f",{confidence},"))
    target = second(tmp_path / "target", {2: static(CUP)})

    with pytest.raises(OutputError, match=f"a confidence from 0 to 1, got .*'{confidence}'"):
        transfer_labels(table, target)


@pytest.mark.parametrize(("found", "place"), [("x,y,z", "u,v,w"), ("0.34,", ",")])
def test_table_alone_without_positions_is_refused(tmp_path: Path, found: str, place: str) -> None:
    """Without a position, its labels could go to any object."""
    table = tmp_path / "table.csv"
    write_csv(table, {4: static(CUP), 5: static(CAN)}, "wfar", {4: "mug"})
    text = table.read_text()
    assert found in text
    table.write_text(text.replace(found, place))
    target = second(tmp_path / "target", {1: static(CAN), 2: static(CUP)})

    line, track = (2, 4) if place == "u,v,w" else (3, 5)
    with pytest.raises(OutputError, match=f"line {line}: no position x, y, z of track #{track}"):
        transfer_labels(table, target)
    assert labels_of(target) == {1: "", 2: ""}


def test_table_with_misspelt_labels_only_reports_each(tmp_path: Path) -> None:
    """Misspelt labels would be lost without a word."""
    source = make_run(tmp_path / "source", {1: static(CUP), 2: static(CAN)}, labels={2: "cupp"})
    target = make_run(tmp_path / "target", {5: static(CUP), 6: static(CAN)})

    transfer = transfer_labels(source, target)

    assert not transfer.transferred
    assert [(one.old_track, one.label) for one in transfer.missed] == [(2, "cupp")]
    assert "cup" in transfer.missed[0].reason
    assert labels_of(target) == {5: "", 6: ""}


def test_object_between_two_old_ones_is_that_of_neither(tmp_path: Path) -> None:
    """Whatever the order of the tracks, the object must not get the label of the first."""
    places = {1: static(CUP), 2: static(shifted(CUP, x=0.03))}
    for order in ((1, 2), (2, 1)):
        name = f"source{order[0]}"
        labels = {1: "mug", 2: "tin"}
        source = make_run(tmp_path / name, {k: places[k] for k in order}, labels=labels)
        between = {7: static(shifted(CUP, x=0.014))}
        target = second(tmp_path / f"target{order[0]}", between)

        transfer = transfer_labels(source, target)

        assert labels_of(target) == {7: ""}
        assert {one.old_track: one.reason for one in transfer.missed} == {
            1: "track #7 could also be track #2",
            2: "track #7 could also be track #1",
        }
