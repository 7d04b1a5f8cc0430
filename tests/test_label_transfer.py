"""Labels of another run: refused by number, transferred by place and time, never guessed."""

import csv
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from click.testing import Result
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from shapecat.errors import OutputError
from shapecat.runs.corrections import adopt_labels, read_labels
from shapecat.runs.folder import read_run, write_run
from shapecat.runs.identity import new_id
from shapecat.runs.label_transfer import TABLE_ALONE, match_labels, transfer_labels
from shapecat.runs.same_objects import Match, _by_majority, _mutual_nearest
from shapecat.runs.tables import DETECTIONS, FRAMES, TRACKS, write_table
from shapecat.runs.track_table import read_track_table
from tests.run_info import run_info
from tests.scenes import record

Run = Callable[..., Result]
Path3 = Sequence[Sequence[float] | None]
"""Where an object is in each frame; None where it is not seen."""
FRAMES_EACH = 10
CUP, CAN, BOWL = (0.11, -0.42, 0.83), (0.34, -0.15, 0.79), (-0.27, 0.08, 0.86)


def test_only_what_is_nearest_to_each_other_is_a_pair() -> None:
    """Of two cups beside the place of one, a label goes to the nearer; to none out of reach."""
    one = np.array([[0.00, 0.5, 0.3], [0.05, 0.5, 0.3], [0.9, 0.1, 0.2]])
    other = np.array([[0.92, 0.1, 0.2], [0.04, 0.5, 0.3]])
    reach = np.array([[0.1, 0.1], [0.1, 0.1], [0.019, 0.1]])

    pairs = [(k, j, round(apart, 6)) for k, j, apart in _mutual_nearest(one, other, reach)]
    wider = [(k, j, round(apart, 6)) for k, j, apart in _mutual_nearest(one, other, reach + 0.002)]

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
def test_a_track_is_the_object_it_is_nearest_to_unless_another_has_a_claim(
    first: int, second: int, expected: dict[int, list[Match]]
) -> None:
    """It would get the label of one of two objects between which it changes."""
    votes = {(1, 9): first, (2, 9): second}
    apart = {(1, 9): 0.03 * first, (2, 9): 0.05 * second}
    found = _by_majority(votes, apart, Counter({9: 10}), lambda track: track)

    assert found.found == expected
    assert set(found.reasons) == (set() if expected else {1, 2} if second == 3 else {1})


def still(place: Sequence[float], *, frames: range = range(FRAMES_EACH)) -> Path3:
    return [place if k in frames else None for k in range(FRAMES_EACH)]


def make_run(
    folder: Path,
    objects: Mapping[int, Path3],
    *,
    work: str = "",
    digest: str = "xxh3-128:one",
    fixed_frame: str | None = "map",
    size: float | tuple[float, float, float] = 0.08,
    labels: Mapping[int, str] | None = None,
) -> Path:
    """Write the tables of a run whose tracks are at the given positions."""
    folder.mkdir(parents=True)
    work = work or f"w{folder.name}"
    about = {"path": f"/recordings/{folder.name}.mcap", "digest": digest, "files": []}
    model = {"categories": ["cup", "can", "bowl"]}
    run = run_info(id=new_id(), work=work, input=about, fixed_frame=fixed_frame, model=model)
    write_run(folder, run)
    rows = [
        (track, frame, place)
        for track, path in objects.items()
        for frame, place in enumerate(path)
        if place is not None
    ]
    stamps = [1_000 + 33 * frame for _, frame, _ in rows]
    seen: dict[int, int] = {}
    detections = []
    for _, frame, _ in rows:
        detections.append(seen.get(frame, 0))
        seen[frame] = detections[-1] + 1
    columns: dict[str, Any] = {
        "track": [track for track, _, _ in rows],
        "topic": ["/depth"] * len(rows),
        "frame": [frame for _, frame, _ in rows],
        "stamp_ns": stamps,
        "detection": pa.array(detections, pa.int32()),
        "center_fixed": [list(place) for _, _, place in rows],
        "posterior": [[1.0, 0.0, 0.0]] * len(rows),
    }
    full = {name: [None] * len(rows) for name in TRACKS.names if "_full" in name}
    write_table(folder / "tracks.parquet", full | columns, TRACKS)
    order = sorted(range(len(rows)), key=lambda k: (rows[k][1], detections[k]))
    found = {name: [columns[name][k] for k in order] for name in ("topic", "frame", "stamp_ns")}
    empty = {field.name: [None] * len(rows) for field in DETECTIONS}
    sides = size if isinstance(size, tuple) else (size, size, 1.3 * size)
    found = {**empty, **found, "size": [list(sides)] * len(rows)}
    write_table(folder / "detections.parquet", found, DETECTIONS)
    write_table(folder / "frames.parquet", {f.name: [] for f in FRAMES}, FRAMES)
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
    return {row.track: row.label for row in read_track_table(folder / "tracks.csv").rows}


def shifted(place: Sequence[float], x: float = 0, y: float = 0, z: float = 0) -> list[float]:
    return [place[0] + x, place[1] + y, place[2] + z]


# ---- whose table it is


def test_the_table_of_another_run_is_refused_with_both_names(tmp_path: Path) -> None:
    """Track numbers say nothing across runs: seven objects were mislabelled without a word."""
    mine = make_run(tmp_path / "mine", {1: still(CUP)})
    theirs = make_run(tmp_path / "theirs", {1: still(CAN)}, labels={1: "bowl"})
    with pytest.raises(OutputError) as refused:
        adopt_labels(theirs / "tracks.csv", mine)

    for words in ("wmine", "wtheirs", "/recordings/theirs.mcap", str(mine), "--by-place"):
        assert words in str(refused.value)
    assert labels_of(mine) == {1: ""}


def test_a_table_that_was_copied_over_the_runs_own_is_refused(tmp_path: Path) -> None:
    mine = make_run(tmp_path / "mine", {1: still(CUP)})
    write_csv(mine / "tracks.csv", {1: still(CAN)}, "wtheirs", {1: "bowl"})

    with pytest.raises(OutputError, match="wtheirs"):
        adopt_labels(mine / "tracks.csv", mine)
    with pytest.raises(OutputError, match="wtheirs"):
        read_labels(mine / "tracks.csv")


def test_mixed_tables_are_refused(tmp_path: Path) -> None:
    mine = make_run(tmp_path / "mine", {1: still(CUP), 2: still(CAN)})
    text = (mine / "tracks.csv").read_text().splitlines()
    text[-1] = text[-1].replace("wmine", "wtheirs")
    (tmp_path / "mixed.csv").write_text("\n".join(text))

    with pytest.raises(OutputError, match="several runs"):
        adopt_labels(tmp_path / "mixed.csv", mine)


def test_a_table_without_the_column_is_the_runs_own_or_refused(tmp_path: Path) -> None:
    """If a user deletes the column, the positions decide; a hand-made table has none."""
    mine = make_run(tmp_path / "mine", {1: still(CUP)})
    theirs = make_run(tmp_path / "theirs", {1: still(shifted(CUP, y=0.01))})
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


def test_the_name_survives_a_spreadsheet(tmp_path: Path) -> None:
    """Semicolons, a byte order mark, another order of columns, decimal commas."""
    mine = make_run(tmp_path / "mine", {1: still(CUP)}, work="w12e4567890123456")
    text = "\ufeffrun;label;confidence;category;track\nw12e4567890123456;bowl;0,9;cup;1,0\n"
    (tmp_path / "saved.csv").write_text(text, "utf-8")

    adopt_labels(tmp_path / "saved.csv", mine)

    assert labels_of(mine) == {1: "bowl"}


# ---- one recording, processed again


def test_labels_find_the_tracks_that_were_in_the_same_places(tmp_path: Path) -> None:
    """Other numbers, some centimetres of difference; no two coordinates may be exchanged."""
    labels = {1: "mug", 2: "delete", 3: "merge with 1"}
    objects = {1: still(CUP), 2: still(CAN), 3: still(BOWL)}
    source = make_run(tmp_path / "source", objects, labels=labels)
    moved = {
        7: still(shifted(BOWL, z=0.02)),
        8: still(shifted(CUP, x=0.02)),
        9: still(shifted(CAN, y=-0.02)),
    }
    target = make_run(tmp_path / "target", moved)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {7: "merge with 8", 8: "mug", 9: "delete"}
    assert not transfer.missed
    assert {item.distance_m for item in transfer.transferred} == {0.02}
    listed = read_run(target)["corrections"]
    assert listed["from"] == "wsource"
    assert {item["track"] for item in listed["transferred"]} == {7, 8, 9}
    assert read_track_table(target / "tracks.original.csv").rows[0].label == ""


def test_frames_of_one_recording_are_not_compared_in_two_coordinate_frames(tmp_path: Path) -> None:
    """A cup in the one frame may be where a bowl is in the other, at every moment."""
    source = make_run(
        tmp_path / "source", {1: still(CUP), 2: still(CAN)}, labels={1: "mug"}, fixed_frame="odom"
    )
    target = make_run(tmp_path / "target", {1: still(CAN), 2: still(CUP)})

    with pytest.raises(OutputError, match="fixed frames differ"):
        transfer_labels(source, target)
    assert set(labels_of(target).values()) == {""}


def test_time_tells_apart_what_changed_places(tmp_path: Path) -> None:
    """Two objects swap places halfway: their medians are the same, their times are not."""
    half = FRAMES_EACH // 2
    first = [CUP] * half + [CAN] * half
    second = [CAN] * half + [CUP] * half
    source = make_run(tmp_path / "source", {1: first, 2: second}, labels={1: "mug", 2: "tin"})
    target = make_run(tmp_path / "target", {5: second, 6: first})

    transfer_labels(source, target)

    assert labels_of(target) == {5: "tin", 6: "mug"}


def test_frames_that_the_other_run_skipped_do_not_vote(tmp_path: Path) -> None:
    """Half of the frames were processed before: no label would find a majority of all of them."""
    every_2nd = range(0, FRAMES_EACH, 2)
    source = make_run(tmp_path / "source", {1: still(CUP, frames=every_2nd)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: still(CUP)})

    transfer_labels(source, target)

    assert labels_of(target) == {5: "mug"}


def test_a_track_that_came_in_two_pieces_is_labelled_whole(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"})
    pieces = {4: still(CUP, frames=range(4)), 5: still(CUP, frames=range(4, 10))}
    target = make_run(tmp_path / "target", pieces)

    transfer_labels(source, target)

    assert labels_of(target) == {4: "mug", 5: "mug"}


def test_two_labels_for_one_track_are_told_not_guessed(tmp_path: Path) -> None:
    objects = {1: still(CUP, frames=range(5)), 2: still(CUP, frames=range(5, 10))}
    source = make_run(tmp_path / "source", objects, labels={1: "mug", 2: "tin"})
    target = make_run(tmp_path / "target", {9: still(CUP)})

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {9: ""}
    assert {item.old_track for item in transfer.missed} == {1, 2}
    assert all("9" in item.reason for item in transfer.missed)


@pytest.mark.parametrize("digest", ["xxh3-128:one", "xxh3-128:two"])
def test_merged_tracks_that_are_one_now_need_no_merge(tmp_path: Path, digest: str) -> None:
    """By place, one part could be another candidate for the place of the other."""
    objects = {1: still(CUP, frames=range(7)), 2: still(CUP, frames=range(7, 10))}
    labels = {1: "mug", 2: "merge with 1"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    target = make_run(tmp_path / "target", {9: still(CUP, frames=range(8))}, digest=digest)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {9: "mug"}
    assert not [item for item in transfer.missed if item.old_track == 1]


def test_what_is_gone_is_told(tmp_path: Path) -> None:
    """Also a merge whose partner is gone."""
    objects = {1: still(CUP), 2: still(CAN), 3: still(BOWL)}
    labels = {1: "mug", 2: "tin", 3: "merge with 2"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    target = make_run(tmp_path / "target", {1: still(BOWL), 2: still(CUP)})

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {1: "", 2: "mug"}
    assert {item.old_track: item.reason for item in transfer.missed} == {
        2: "nothing was found there",
        3: "track 2, which it is merged with: nothing was found there",
    }


def test_a_neighbour_is_not_taken_for_what_is_not_seen(tmp_path: Path) -> None:
    """The labelled object is missing in the target, and its neighbour is the nearest track."""
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"}, size=0.05)
    beside = {5: still(shifted(CUP, y=0.08))}
    target = make_run(tmp_path / "target", beside, size=0.05)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {5: ""}
    assert [item.old_track for item in transfer.missed] == [1]


@pytest.mark.parametrize("part_first", [False, True])
def test_parts_and_pieces_become_one_whole(tmp_path: Path, part_first: bool) -> None:
    """The target has two pieces, in one of which the part is; the order of lines is no matter."""
    whole = [None if 5 <= k < 8 else CUP for k in range(FRAMES_EACH)]
    part = still(shifted(CUP, y=0.01), frames=range(5, 8))
    objects = {2: part, 1: whole} if part_first else {1: whole, 2: part}
    labels = {1: "mug", 2: "merge with 1"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    pieces = {9: still(CUP, frames=range(5)), 10: still(CUP, frames=range(5, 10))}
    target = make_run(tmp_path / "target", pieces)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {9: "mug", 10: "mug"}
    assert not transfer.missed


def test_a_chain_of_merges_leads_to_the_whole(tmp_path: Path) -> None:
    """Merges with one another would lead in a circle, and all labels would be lost."""
    third = range(3), range(3, 6), range(6, 10)
    objects = {k: still(CUP, frames=frames) for k, frames in enumerate(third, start=1)}
    labels = {1: "merge with 2", 2: "merge with 3"}
    source = make_run(tmp_path / "source", objects, labels=labels)
    pieces = {k + 10: still(CUP, frames=frames) for k, frames in enumerate(third)}
    target = make_run(tmp_path / "target", pieces)

    transfer_labels(source, target)

    assert labels_of(target) == {10: "merge with 12", 11: "merge with 12", 12: ""}


# ---- what is there already, and what cannot be read


def test_what_a_person_wrote_in_the_target_stays(tmp_path: Path) -> None:
    """It was replaced without a word."""
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: still(CUP)}, labels={5: "teapot"})

    (missed,) = transfer_labels(source, target).missed

    assert missed.reason == "track 5 already has the label teapot"
    assert labels_of(target) == {5: "teapot"}


def test_a_label_that_was_carried_over_can_be_replaced(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: still(CUP)})
    transfer_labels(source, target)
    write_csv(source / "tracks.csv", {1: still(CUP)}, "wsource", {1: "teapot"})

    assert not transfer_labels(source, target).missed
    assert labels_of(target) == {5: "teapot"}


def test_a_label_that_was_carried_over_and_then_corrected_stays(tmp_path: Path) -> None:
    """A second transfer knows what the first one wrote, and must not take it for that."""
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"})
    target = make_run(tmp_path / "target", {5: still(CUP)})
    transfer_labels(source, target)
    write_csv(target / "tracks.csv", {5: still(CUP)}, "wtarget", {5: "teapot"})

    (missed,) = transfer_labels(source, target).missed

    assert missed.reason == "track 5 already has the label teapot"
    assert labels_of(target) == {5: "teapot"}


def test_one_label_that_contradicts_does_not_cost_the_others(tmp_path: Path) -> None:
    """A user merged a track of the target that the source says to delete."""
    labels = {1: "delete", 3: "mug"}
    source = make_run(tmp_path / "source", {1: still(CUP), 3: still(BOWL)}, labels=labels)
    objects = {5: still(CUP), 6: still(CAN), 7: still(BOWL)}
    target = make_run(tmp_path / "target", objects, labels={6: "merge with 5"})

    (missed,) = transfer_labels(source, target).missed

    assert (missed.old_track, "track 5 is deleted" in missed.reason) == (1, True)
    assert labels_of(target) == {5: "", 6: "merge with 5", 7: "mug"}


def test_one_misspelt_label_does_not_cost_the_others(tmp_path: Path) -> None:
    labels = {1: "mug", 2: "bowll"}
    source = make_run(tmp_path / "source", {1: still(CUP), 2: still(CAN)}, labels=labels)
    target = make_run(tmp_path / "target", {5: still(CUP), 6: still(CAN)})

    (missed,) = transfer_labels(source, target).missed

    assert (missed.old_track, "did you mean bowl" in missed.reason) == (2, True)
    assert labels_of(target) == {5: "mug", 6: ""}


@pytest.mark.parametrize(
    ("found", "broken", "told"),
    [
        ("\n2,", "\nx,", "line 3: expected a whole number"),
        ("wsource\r\n2,", "wb\r\n2,", "several runs"),
    ],
)
def test_lines_are_not_left_out_without_a_word(
    tmp_path: Path, found: str, broken: str, told: str
) -> None:
    labels = {1: "mug", 2: "tin"}
    source = make_run(tmp_path / "source", {1: still(CUP), 2: still(CAN)}, labels=labels)
    table = (source / "tracks.csv").read_bytes().decode()
    assert found in table
    (source / "tracks.csv").write_bytes(table.replace(found, broken).encode())
    target = make_run(tmp_path / "target", {5: still(CUP), 6: still(CAN)})

    with pytest.raises(OutputError, match=told):
        transfer_labels(source, target)
    assert labels_of(target) == {5: "", 6: ""}


# ---- a second recording of the same place


def second(folder: Path, objects: Mapping[int, Path3], **options: Any) -> Path:
    return make_run(folder, objects, digest="xxh3-128:two", **options)


def test_what_stands_still_is_found_in_another_recording(tmp_path: Path) -> None:
    """The stamps are the same by chance: they say nothing across recordings."""
    objects = {1: still(CUP), 2: still(CAN)}
    source = make_run(tmp_path / "source", objects, labels={1: "mug", 2: "delete"})
    there = {1: still(shifted(CAN, z=0.02)), 2: still(shifted(CUP, y=0.03))}
    target = second(tmp_path / "target", there)

    transfer_labels(source, target)

    assert labels_of(target) == {1: "delete", 2: "mug"}


def test_what_was_moved_is_told_not_guessed(tmp_path: Path) -> None:
    path = [shifted(CUP, x=0.05 * k) for k in range(FRAMES_EACH)]
    source = make_run(tmp_path / "source", {1: path}, labels={1: "mug"})
    target = second(tmp_path / "target", {1: still(shifted(CUP, x=0.22))})

    (missed,) = transfer_labels(source, target).missed

    assert "moved" in missed.reason
    assert labels_of(target) == {1: ""}


@pytest.mark.parametrize(
    ("size", "moved"),
    [(0.08, True), (0.31, False), ((0.31, 0.08, 0.1), False), ((0.08, 0.31, 0.1), False)],
)
def test_a_large_object_may_scatter_more_than_a_small_one(
    tmp_path: Path, size: float | tuple[float, float, float], *, moved: bool
) -> None:
    """From another side, the centre of the visible part of a box is elsewhere."""
    path = [shifted(CUP, x=0.025 * k) for k in range(FRAMES_EACH)]  # half of it within 6 cm
    source = make_run(tmp_path / "source", {1: path}, labels={1: "mug"}, size=size)
    target = second(tmp_path / "target", {1: still(shifted(CUP, x=0.11))}, size=size)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {1: "" if moved else "mug"}
    assert ["moved" in one.reason for one in transfer.missed] == [True] * moved


def test_two_candidates_are_told_not_guessed(tmp_path: Path) -> None:
    """They stand around the old place, equally near."""
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"})
    around = {1: still(shifted(CUP, x=0.03)), 2: still(shifted(CUP, x=-0.035))}
    target = second(tmp_path / "target", around)

    (missed,) = transfer_labels(source, target).missed

    assert "both there" in missed.reason
    assert labels_of(target) == {1: "", 2: ""}


def test_identical_cups_that_swap_are_told_not_guessed(tmp_path: Path) -> None:
    """They stand side by side, and in the second recording each is nearly where the other was."""
    labels = {1: "mug", 2: "tin"}
    beside = shifted(CUP, y=0.06)
    source = make_run(tmp_path / "source", {1: still(CUP), 2: still(beside)}, labels=labels)
    swapped = {1: still(shifted(CUP, y=0.025)), 2: still(shifted(CUP, y=0.035))}
    target = second(tmp_path / "target", swapped)

    transfer = transfer_labels(source, target)

    assert labels_of(target) == {1: "", 2: ""}
    assert {item.old_track for item in transfer.missed} == {1, 2}


def test_something_of_another_size_is_another_thing(tmp_path: Path) -> None:
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"})
    target = second(tmp_path / "target", {1: still(CUP)}, size=0.2)

    (missed,) = transfer_labels(source, target).missed

    assert "another size" in missed.reason


@pytest.mark.parametrize("frame", [None, "odom"])
def test_places_in_other_frames_are_not_compared(tmp_path: Path, frame: str | None) -> None:
    source = make_run(tmp_path / "source", {1: still(CUP)}, labels={1: "mug"}, fixed_frame=frame)
    target = second(tmp_path / "target", {1: still(CUP)})

    with pytest.raises(OutputError, match="fixed frame"):
        match_labels(source, target)


@pytest.mark.parametrize("place", ["downloads", "other"])
def test_a_table_alone_is_matched_by_its_places(tmp_path: Path, place: str) -> None:
    """Also if it was saved beside the tables of another run, whose tracks are other objects."""
    (tmp_path / "downloads").mkdir()
    make_run(tmp_path / "other", {4: still(CAN), 5: still(CUP)})
    table = tmp_path / place / "table.csv"
    write_csv(table, {4: still(CUP), 5: still(CAN)}, "wfar", {4: "mug"})
    target = second(tmp_path / "target", {1: still(CAN), 2: still(shifted(CUP, z=0.01))})

    transfer = transfer_labels(table, target)

    assert labels_of(target) == {1: "", 2: "mug"}
    assert transfer.by == TABLE_ALONE


# ---- the real command


@pytest.fixture(scope="module")
def corrected(shapecat: Run, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Process a recording, and correct one track: by its own name, with a name of its own."""
    folder = tmp_path_factory.mktemp("corrected")
    recording = record(folder / "lab.mcap", 24)
    shapecat("process", recording, "--out", folder / "out", "--no-rrd", "--jobs", 1)
    return recording, folder / "out" / "lab"


def rows_of(run: Path) -> list[dict[str, str]]:
    with (run / "tracks.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def label_first(run: Path, label: str) -> dict[str, str]:
    rows = rows_of(run)
    rows[0]["label"] = label
    with (run / "tracks.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    return rows[0]


def place_of(row: Mapping[str, str]) -> list[float]:
    return [float(row[name]) for name in "xyz"]


def annotated(run: Path) -> set[str]:
    """Return the classes in annotated.mcap."""
    found = set()
    with (run / "annotated.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for *_, message in reader.iter_decoded_messages(topics=["/shapecat/detections"]):
            found |= {item.results[0].hypothesis.class_id for item in message.detections}
    return found


def test_overwriting_keeps_corrections(shapecat: Run, corrected: tuple[Path, Path]) -> None:
    """They were dropped without a word, and the outputs showed the model's own labels."""
    recording, run = corrected
    before = label_first(run, "teapot")
    again = ("process", recording, "--out", run.parent, "--no-rrd", "--jobs", 1, "--overwrite")
    done = shapecat(*again, "--every", 2)

    assert done.exit_code == 0
    assert "lab.mcap: transferred 1 of 1 corrected labels" in done.stderr
    (row,) = [row for row in rows_of(run) if row["label"]]
    assert row["label"] == "teapot"
    assert np.allclose(place_of(row), place_of(before), atol=0.02)
    assert read_run(run)["corrections"]["transferred"][0]["label"] == "teapot"
    assert labels_in(run / "tracks.previous.csv") == {"teapot"}
    assert "teapot" in annotated(run)

    done = shapecat(*again, "--discard-labels")

    assert "transferred" not in done.stderr
    assert labels_in(run / "tracks.csv") == set()
    assert "teapot" not in annotated(run)


def test_labels_are_not_discarded_without_overwriting(shapecat: Run, tmp_path: Path) -> None:
    """Without --overwrite the option has no effect, and was ignored without a word."""
    done = shapecat("process", tmp_path / "lab.mcap", "--out", tmp_path, "--discard-labels")

    assert done.exit_code == 2
    assert "--discard-labels needs --overwrite" in done.stderr


def labels_in(table: Path) -> set[str]:
    return {row.label for row in read_track_table(table).rows if row.label}


def test_labels_that_find_nothing_are_named_and_kept(
    shapecat: Run, corrected: tuple[Path, Path]
) -> None:
    """Nothing is in reach of the sensor in the new run."""
    recording, run = corrected
    label_first(run, "teapot")
    done = shapecat(
        *("process", recording, "--out", run.parent, "--no-rrd", "--jobs", 1, "--overwrite"),
        *("--set", "detection.max_range_m=0.2"),
    )

    assert done.exit_code == 0, done.stderr
    assert "transferred 0 of 1 corrected labels" in done.stderr
    assert "teapot: nothing was found there" in done.stderr
    assert labels_in(run / "tracks.previous.csv") == {"teapot"}


def test_labels_of_another_run_go_by_place_when_asked(
    shapecat: Run, corrected: tuple[Path, Path], tmp_path: Path
) -> None:
    recording, _ = corrected
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
    assert "teapot" in annotated(two)
