"""Tests of corrections of tracks.csv, as users write them and as spreadsheets save them."""

import json
import shutil
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from hypothesis import given, settings
from hypothesis import strategies as st

from shapecat.errors import OutputError
from shapecat.outputs.wording import safe_name
from shapecat.pipeline import annotate_again
from shapecat.runs.finished import FinishedRun, find_runs
from shapecat.runs.labelled_frames import read_labelled_frames
from shapecat.runs.labelled_tracks import _last_in
from shapecat.runs.labels import meaning
from shapecat.runs.labels.corrections import _valid_labels, adopt_labels, read_labels, relabel
from shapecat.runs.labels.meaning import TrackLabel
from shapecat.runs.labels.track_table import (
    TrackRow,
    TrackTable,
    read_track_table,
    write_track_table,
)
from shapecat.runs.perceive.perceived import FrameRow, PerceptionTables
from shapecat.runs.tracks import _CSV, _line, _write_csv
from shapecat.tracking.records import Track
from shapecat.types import Box, Candidate, Detection, NeuralGas, Perception, Plane, Scene
from tests.mcap_files import read_ros
from tests.run_info import run_info
from tests.track_tables import write_tracks

HEADER = "track,first_s,category,confidence,label,topic\n"
QUARTER = np.array([-(0.5**0.5), 0, 0, 0.5**0.5])  # the z axis points down, along y
ORIGINAL = HEADER + "".join(
    f"{track},0.000,{category},0.500,,/depth\n"
    for track, category in [(4, "unknown"), (2, "can"), (1, "cup"), (3, "cup")]
)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    folder.mkdir()
    write_table(folder, ORIGINAL)
    (folder / "run.json").write_text(
        json.dumps(run_info(model={"categories": ["cup", "can", "cactus"]}))
    )
    return folder


def write_table(folder: Path, text: str) -> None:
    """Write the table of a run, and its original."""
    for name in ("tracks.original.csv", "tracks.csv"):
        (folder / name).write_text(text)


def labelled(**labels: str) -> str:
    """Return the table with some labels, for example ``t4="bowl"`` for track 4."""
    text = ORIGINAL
    for track, label in labels.items():
        at = text.index(f"\n{track[1:]},") + 1
        end = text.index("\n", at)
        text = text[:at] + text[at:end].replace(",,", f",{label},") + text[end:]
    return text


def test_every_kind_of_label_is_read(run: Path) -> None:
    (run / "tracks.csv").write_text(labelled(t4="teapot", t2="merge with 1", t3="delete"))

    assert read_labels(run / "tracks.csv") == {
        4: TrackLabel(4, "teapot", 1.0),
        2: TrackLabel(1, "cup", 0.5),
        1: TrackLabel(1, "cup", 0.5),
    }


@pytest.mark.parametrize(
    ("label", "meant"),
    [
        ("Bowl", "bowl"),
        ("  bowl ", "bowl"),
        ("unknown", "unknown"),
        ("cactus", "cactus"),
        ("towel", "towel"),  # two letters from bowl
        ("bagel", "bagel"),
        ("wine  glass", "wine glass"),
        ("new pan", "pan"),
        ("vase (blue)", "vase (blue)"),
        ("Öllampe", "Öllampe"),
    ],
)
def test_category_names_are_normalised(run: Path, label: str, meant: str) -> None:
    (run / "tracks.csv").write_text(labelled(t4=label))

    assert read_labels(run / "tracks.csv", ["cactus"])[4] == TrackLabel(4, meant, 1.0)


def test_damaged_table_of_shapecat_is_refused(run: Path) -> None:
    """Confidences come from tracks.original.csv: a NaN there ended in a traceback."""
    (run / "tracks.original.csv").write_text(ORIGINAL.replace("0.500", "nan", 1))

    with pytest.raises(OutputError, match=r"tracks.original.csv, line \d: expected a track number"):
        read_labels(run / "tracks.csv")


@pytest.mark.parametrize(
    ("label", "message"),
    [
        ("botle", "line 2: 'botle': did you mean bottle?"),
        ("cpu", "did you mean cup?"),
        ("catcus", "did you mean cactus?"),
        ("delte", "did you mean delete?"),
        ("pan", "For a new category write `new pan`"),
        ("merge with", "is not a category, `delete` or `merge with N`"),
        ("merge 2", "line 2: 'merge 2': did you mean merge with 2?"),
        ("Merge to #12", "did you mean merge with 12?"),
        ("merge-7", "did you mean merge with 7?"),
        ("merged7", "did you mean merge with 7?"),
        ("merge with 2 or 3", "is not a category"),
        ("new delete", "is not a category"),
        ("new merge with 1", "is not a category"),
        ("merge with 77", "there is no track #77"),
        ("merge with 4", "forms a loop: #4 -> #4"),
        ("7", "is not a category"),
        ("../../etc", "is not a category"),
        ("a/b", "a category is a letter followed by letters, digits, spaces and - _ . + & ' ( )"),
        ("box.", "; the last is a letter, a digit, _ or )"),
        ("merge", "is not a category"),
        ("del", "is not a category"),
        ("marge with 2", "did you mean merge with 2?"),
        ("merge_with_2", "did you mean merge with 2?"),
        ("mergewith 2", "did you mean merge with 2?"),
        ("\uff42\uff4f\uff57\uff4c", "did you mean bowl?"),  # full-width letters
        ("\uff44elete", "did you mean delete?"),
        (".", "is not a category"),
        ("x" * 61, "is not a category"),
    ],
)
def test_unknown_label_is_refused_with_suggestion(run: Path, label: str, message: str) -> None:
    """A typo would become its own category, and a folder in exports."""
    (run / "tracks.csv").write_text(labelled(t4=label))

    with pytest.raises(OutputError) as raised:
        read_labels(run / "tracks.csv", ["cactus"])
    assert message in str(raised.value)


def test_message_about_a_wrong_table_is_short(run: Path) -> None:
    """The table of another program has thousands of lines, and whole texts in its cells."""
    others = "".join(f"{track},0.000,cup,0.500,,/depth\n" for track in range(1000, 2000))
    (run / "tracks.csv").write_text(labelled(t4="9" * 5000) + others)

    with pytest.raises(OutputError) as caught:
        read_labels(run / "tracks.csv")

    _, first, *rest = str(caught.value).splitlines()
    assert first.startswith(f"  line 2: '{'9' * 80}…' is not a category")
    assert rest[0] == "  line 6: there is no track #1000"
    assert (len(rest), rest[-1]) == (20, "  and 981 more problems")


def test_missing_original_table_is_named(run: Path) -> None:
    """Without it nobody knows which tracks and categories the run has."""
    (run / "tracks.original.csv").unlink()

    with pytest.raises(OutputError, match=r"tracks\.original\.csv: cannot be read: No such file"):
        read_labels(run / "tracks.csv")
    with pytest.raises(OutputError, match=r"tracks\.original\.csv: cannot be read: No such file"):
        adopt_labels(run / "tracks.csv", run)


@pytest.mark.parametrize("own", [True, False])
def test_labels_in_table_with_other_decimal_point_are_adopted(run: Path, *, own: bool) -> None:
    """German spreadsheets save 0.500 as 500; the labels of such a table could not be applied."""
    corrected = (run if own else run.parent) / "tracks.csv"
    corrected.write_text(labelled(t4="bowl").replace("0.", "").replace(",", ";"))
    adopt_labels(corrected, run)

    assert (run / "tracks.csv").read_text() == labelled(t4="bowl")
    assert read_labels(run / "tracks.csv")[2] == TrackLabel(2, "can", 0.5)


def test_chains_of_merges_end_in_one_track(run: Path) -> None:
    corrected = labelled(t4="merge with 2", t2="merged into #3", t3="bowl")
    (run / "tracks.csv").write_text(corrected)
    labels = read_labels(run / "tracks.csv")

    assert {labels[k] for k in (2, 3, 4)} == {TrackLabel(3, "bowl", 1.0)}

    for wrong, message in [
        ({"t4": "merge with 2", "t2": "merge with 4"}, "forms a loop"),
        ({"t4": "merge with 2", "t2": "delete"}, "track #2 is deleted"),
    ]:
        (run / "tracks.csv").write_text(labelled(**wrong))
        with pytest.raises(OutputError, match=message):
            read_labels(run / "tracks.csv")


def test_merge_into_deleted_track_is_refused(run: Path) -> None:
    """The merged track would vanish although nobody deleted it."""
    rows = read_track_table(run / "tracks.csv").rows
    first, second = sorted(row.track for row in rows)[:2]
    labels = {first: f"merge with {second}", second: "delete"}
    kept, refused = _valid_labels(rows, labels, (), one_frame=True)

    label_of = {row.track: row.label for row in kept}
    assert (label_of[first], label_of[second]) == ("", "delete")
    assert f"track #{second} is deleted" in refused.pop(first)
    assert refused == {}


def test_tracks_of_different_topics_are_not_merged(run: Path) -> None:
    """With one track number on two topics, one annotation would delete the other."""
    for topic, problem in (
        ("/other", "track #1 belongs to another topic, /other"),
        ("", "the table names no topic for track #1"),
    ):
        text = labelled(t4="merge with 1").replace("cup,0.500,,/depth", f"cup,0.500,,{topic}")
        write_table(run, text)

        with pytest.raises(OutputError, match=problem):
            read_labels(run / "tracks.csv")


def test_tracks_with_common_sensor_are_merged(run: Path) -> None:
    """The sensors that see an object change while the robot moves."""
    text = labelled(t4="merge with 1").replace("merge with 1,/depth", "merge with 1,/depth /other")
    write_table(run, text)
    assert read_labels(run / "tracks.csv")[4].track == 1


def test_tracks_of_two_sensors_merge_in_fixed_frame(run: Path) -> None:
    text = labelled(t4="merge with 1").replace("merge with 1,/depth", "merge with 1,/other")
    described = json.loads((run / "run.json").read_text()) | {"fixed_frame": "map"}
    (run / "run.json").write_text(json.dumps(described))
    write_table(
        run, ORIGINAL.replace("4,0.000,unknown,0.500,,/depth", "4,0.000,unknown,0.500,,/other")
    )
    corrected = run.parent / "mine.csv"
    corrected.write_text(text)
    adopt_labels(corrected, run)
    assert read_labels(run / "tracks.csv")[4] == TrackLabel(1, "cup", 0.5)


def test_all_problems_are_reported_at_once(run: Path) -> None:
    """Users would fix one problem at a time. No label is adopted before all are fixed."""
    corrected = run.parent / "mine.csv"
    corrected.write_text(
        labelled(t4="botle", t2="merge with 9", t1="bowl") + "77,0,cup,0.5,bowl,/depth\n"
        "1,0,cup,0.5,can,/depth\nx,0,cup,0.5,can,/depth\n"
    )

    with pytest.raises(OutputError) as raised:
        adopt_labels(corrected, run)

    lines = [line.split(":")[0].strip() for line in str(raised.value).splitlines()[1:]]
    assert lines == ["line 2", "line 3", "line 6", "line 7", "line 8"]
    assert (run / "tracks.csv").read_text() == ORIGINAL
    names = {"run.json", "tracks.csv", "tracks.original.csv"}
    assert {path.name for path in run.iterdir()} == names


def test_adopting_corrections_keeps_original_table(run: Path) -> None:
    corrected = run.parent / "mine.csv"
    for label in ("bowl", "plate"):
        corrected.write_text(labelled(t4=label))
        adopt_labels(corrected, run)

        assert read_labels(run / "tracks.csv")[4] == TrackLabel(4, label, 1.0)
        assert (run / "tracks.original.csv").read_text() == ORIGINAL


def test_table_edited_in_place_keeps_its_original(run: Path) -> None:
    (run / "tracks.csv").write_text(labelled(t4="bowl"))
    adopt_labels(run / "tracks.csv", run)

    assert (run / "tracks.original.csv").read_text() == ORIGINAL
    assert read_labels(run / "tracks.csv")[4].category == "bowl"


def test_original_table_excludes_labels_not_yet_applied(run: Path) -> None:
    """A user may edit tracks.csv, then adopt another table: the edits would count as original."""
    (run / "tracks.csv").write_text(labelled(t4="bowl"))
    other = run.parent / "other"
    shutil.copytree(run, other)
    (run.parent / "mine.csv").write_text(labelled(t2="box"))
    adopt_labels(run.parent / "mine.csv", run)

    assert relabel(other, {2: "box"}) == {}
    for folder in (run, other):
        assert (folder / "tracks.original.csv").read_text() == ORIGINAL
    assert read_labels(other / "tracks.csv")[4].category == "bowl"


def test_line_deleted_from_own_table_is_refused(run: Path) -> None:
    """The object would silently leave all outputs, with its label."""
    (run / "tracks.csv").write_text(labelled(t4="bowl"))
    adopt_labels(run / "tracks.csv", run)
    header, _, _, *others = labelled(t4="bowl", t1="box").splitlines(keepends=True)
    (run / "tracks.csv").write_text(header + "".join(others))
    (run.parent / "mine.csv").write_text(labelled(t2="plate"))

    missing = r"  missing tracks: #4, #2; restore the lines from tracks\.original\.csv"
    with pytest.raises(OutputError, match=missing):
        read_labels(run / "tracks.csv")
    for corrected in (run / "tracks.csv", run.parent / "mine.csv"):
        with pytest.raises(OutputError, match=missing):
            adopt_labels(corrected, run)
    with pytest.raises(OutputError, match=missing):
        relabel(run, {2: "plate"})
    assert (run / "tracks.csv").read_text() == header + "".join(others)


def test_error_lists_few_of_many_missing_tracks(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapecat.errors._MOST_NAMES", 2)
    (run / "tracks.csv").write_text(HEADER)

    with pytest.raises(OutputError, match="missing tracks: #4, #2 and 2 more; restore"):
        read_labels(run / "tracks.csv")


@pytest.mark.parametrize("edited", ["cupp", "", "../../evil"])
def test_edited_category_is_refused(run: Path, edited: str) -> None:
    """An edited category would become the name of a folder or of a class without any check."""
    wrong = ORIGINAL.replace("2,0.000,can,", f"2,0.000,{edited},")
    for path in (run / "tracks.csv", run.parent / "mine.csv"):
        path.write_text(wrong)
        with pytest.raises(OutputError, match="line 3: the category of track #2 is 'can', not"):
            adopt_labels(path, run)
    with pytest.raises(OutputError, match="write corrections into the column label"):
        read_labels(run / "tracks.csv")


def test_only_labels_and_additional_columns_can_be_edited(run: Path) -> None:
    header, *lines = labelled(t4="bowl").replace(",0.500,", ",0.9,").splitlines()
    table = "\n".join([f"note,{header}", *(f"dusty,{line}" for line in reversed(lines))])
    (run / "tracks.csv").write_text(table)
    adopt_labels(run / "tracks.csv", run)

    assert read_labels(run / "tracks.csv")[2] == TrackLabel(2, "can", 0.5)
    header, *lines = (run / "tracks.csv").read_text().splitlines()
    assert (header, lines[0]) == (
        f"{HEADER.strip()},note",
        "4,0.000,unknown,0.500,bowl,/depth,dusty",
    )
    assert relabel(run, {2: "box"}) == {}
    assert "2,0.000,can,0.500,box,/depth,dusty" in (run / "tracks.csv").read_text()


def test_table_needs_no_confidence(run: Path) -> None:
    """Confidences are not read, but tables without that column were refused."""
    corrected = run.parent / "mine.csv"
    corrected.write_text("track,category,label\n4,unknown,bowl\n")
    adopt_labels(corrected, run)
    assert (run / "tracks.csv").read_text() == labelled(t4="bowl")

    cut = (run / "tracks.csv").read_text().replace(",confidence,", ",").replace(",0.500,", ",")
    (run / "tracks.csv").write_text(cut)
    assert read_labels(run / "tracks.csv")[2] == TrackLabel(2, "can", 0.5)
    adopt_labels(run / "tracks.csv", run)
    assert (run / "tracks.csv").read_text() == labelled(t4="bowl")

    corrected.write_text("track,label\n4,cup\n")  # perhaps of another run
    with pytest.raises(OutputError, match="no column category; expected a table like"):
        adopt_labels(corrected, run)


def test_notes_in_columns_without_a_name_are_kept(run: Path) -> None:
    """Only the last of several such columns was written again."""
    names = f"{HEADER.strip()},,,topic"
    lines = [f"{line},dusty,left shelf,can" for line in labelled(t4="bowl").splitlines()[1:]]
    (run / "tracks.csv").write_text("\n".join([names, *lines]))
    adopt_labels(run / "tracks.csv", run)

    saved = (run / "tracks.csv").read_text().splitlines()
    assert saved[1] == "4,0.000,unknown,0.500,bowl,/depth,dusty,left shelf,can"
    adopt_labels(run / "tracks.csv", run)
    assert (run / "tracks.csv").read_text().splitlines() == saved


@pytest.mark.parametrize("own", [True, False])
def test_table_with_two_columns_of_labels_is_refused(run: Path, *, own: bool) -> None:
    """Only one would be read: the labels that a second person added beside it would be lost."""
    corrected = (run if own else run.parent) / "tracks.csv"
    corrected.write_text(labelled(t4="bowl").replace("topic\n", "topic,Label\n"))

    with pytest.raises(OutputError, match="several columns label; keep one"):
        adopt_labels(corrected, run)


@pytest.mark.parametrize("label", ["none", "new None", "DontCare", "NA", "new nan", "Null"])
def test_names_that_mean_no_object_to_readers_are_refused(run: Path, label: str) -> None:
    """KITTI readers ignore DontCare, pandas drops NA, and class 0 of point labels is "none"."""
    (run / "tracks.csv").write_text(labelled(t4=label))

    with pytest.raises(OutputError, match="is not a category"):
        read_labels(run / "tracks.csv")


def test_outdated_page_undoes_no_labels(run: Path) -> None:
    """A report page holds all labels as they were when it was made; later labels must stay."""
    corrected = run.parent / "mine.csv"
    corrected.write_text(labelled(t4="bowl", t1="box"))
    adopt_labels(corrected, run)
    header, *lines = labelled(t2="plate", t1="can").splitlines()
    corrected.write_text("\n".join([f"{header},label_seen", *(f"{line}," for line in lines)]))
    adopt_labels(corrected, run)

    labels = read_labels(run / "tracks.csv")
    assert [labels[k].category for k in (4, 2, 1, 3)] == ["bowl", "plate", "can", "cup"]
    assert "label_seen" not in (run / "tracks.csv").read_text()
    assert (run / "tracks.previous.csv").read_text() == labelled(t4="bowl", t1="box")


def test_added_label_leaves_table_of_replaced_labels(run: Path) -> None:
    """The labels that were replaced before would be lost."""
    corrected = run.parent / "mine.csv"
    for labels in ({"t4": "bowl"}, {"t4": "plate"}, {"t4": "plate", "t1": "can"}):
        corrected.write_text(labelled(**labels))
        adopt_labels(corrected, run)

    assert (run / "tracks.csv").read_text() == labelled(t4="plate", t1="can")
    assert (run / "tracks.previous.csv").read_text() == labelled(t4="bowl")


def test_page_table_in_place_of_own_table_clears_labels_later(run: Path) -> None:
    """If its column label_seen stayed, a label cleared in a copy of the table would come back."""
    header, *lines = labelled(t4="mug").splitlines()
    own = run / "tracks.csv"
    own.write_text("\n".join([f"{header},label_seen", *(f"{line}," for line in lines)]))
    adopt_labels(own, run)
    assert "label_seen" not in own.read_text()
    corrected = run.parent / "mine.csv"
    corrected.write_text(own.read_text().replace("mug", ""))
    adopt_labels(corrected, run)

    assert read_labels(own)[4].category == "unknown"


def test_linked_table_gets_corrections(run: Path) -> None:
    """Tables may be links to files under version control, which must get the corrections."""
    kept = run.parent / "kept.csv"
    (run / "tracks.csv").rename(kept)
    (run / "tracks.csv").symlink_to(kept)
    corrected = run.parent / "mine.csv"
    corrected.write_text(labelled(t4="bowl"))
    adopt_labels(corrected, run)
    relabel(run, {1: "box"})

    assert (run / "tracks.csv").is_symlink()
    labels = read_labels(kept.rename(run / "tracks.csv"))
    assert [labels[k].category for k in (4, 1)] == ["bowl", "box"]


def test_cleared_labels_are_reported_and_kept_in_copy(
    shapecat: Callable[..., Result], guessed_run: Path, tmp_path: Path
) -> None:
    """An old table given by mistake would silently clear hours of labels."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    unlabelled = tmp_path / "old.csv"
    shutil.copy(folder / "tracks.csv", unlabelled)
    first, second, *_ = sorted(row.track for row in read_track_table(unlabelled).rows)
    relabel(folder, {first: "salad bowl", second: "delete"})
    labelled_table = (folder / "tracks.csv").read_text()
    done = shapecat("annotate", folder, "--labels", unlabelled)

    assert done.exit_code == 0, done.output
    cleared = f"{folder}: 2 labels cleared (#{first} salad bowl, #{second} delete)"
    assert done.output.splitlines()[-1] == cleared
    assert (folder / "tracks.previous.csv").read_text() == labelled_table


def test_labels_of_someone_else_are_not_silently_replaced(
    shapecat: Callable[..., Result], guessed_run: Path, tmp_path: Path
) -> None:
    """Of two people with copies of one table, the second is told which labels were replaced."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    rows = sorted(read_track_table(folder / "tracks.csv").rows, key=lambda row: row.track)
    first = rows[0]
    lines = [f"{row.track},{row.category},0.5," for row in rows]
    mine = tmp_path / "mine.csv"
    mine.write_text(
        "\n".join(["track,category,confidence,label", f"{lines[0]}bowl", f"{lines[1]}box"])
    )
    relabel(folder, {first.track: "mug"})
    done = shapecat("annotate", folder, "--labels", mine)

    told = f"{folder}: 1 label set, 1 label replaced (#{first.track} mug)"
    assert done.output.splitlines()[-1] == told


def test_annotate_says_that_report_page_is_old(
    shapecat: Callable[..., Result], guessed_run: Path, tmp_path: Path
) -> None:
    """Whoever opens the page would take the labels that were replaced for the final ones."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    (folder / "report.html").touch()
    row = read_track_table(folder / "tracks.csv").rows[0]
    table = tmp_path / "mine.csv"
    table.write_text(f"track,category,confidence,label\n{row.track},{row.category},0.5,vase\n")
    first, again = (shapecat("annotate", folder, "--labels", table) for _ in range(2))

    assert f"renew it: shapecat report {folder}" in first.output
    assert "renew it" not in again.output  # the same labels


def test_missing_lines_keep_their_label(run: Path) -> None:
    """A filtered spreadsheet must not delete the labels of hidden lines."""
    corrected = run.parent / "mine.csv"
    corrected.write_text(labelled(t4="bowl"))
    adopt_labels(corrected, run)
    corrected.write_text("track,category,confidence,label\n2,can,0.5,box\n")
    adopt_labels(corrected, run)

    labels = read_labels(run / "tracks.csv")
    assert [labels[k].category for k in (4, 2, 1, 3)] == ["bowl", "box", "cup", "cup"]


def edited_table(folder: Path, content: bytes, tracks: Sequence[int] = (4,)) -> Path:
    """Write ``content`` to tracks.csv, beside an original table in which ``tracks`` are unknown."""
    lines = [f"{track},unknown,0.5,\n" for track in tracks]
    original = "track,category,confidence,label\n" + "".join(lines)
    (folder / "tracks.original.csv").write_text(original)
    path = folder / "tracks.csv"
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbftrack;category;confidence;label\r\n4;unknown;0,5;bowl\r\n",
        b"sep=;\r\ntrack;category;confidence;label\r\n4;unknown;0,5;bowl\r\n",
        b'"label","track","of","confidence","category"\n"bowl","4","a, ""b""\nc",".5","unknown"\n',
        b"Track,Category,Confidence,Label,\r\n4.0,unknown,.5, Bowl ,\r\n,,,,\r\n\r\n",
        "track\tcategory\tconfidence\tlabel\n4\tunknown\t0.5\tbowl\n".encode("utf-16"),
        "track,category,confidence,label,größe\n4,unknown,0.5,bowl,ü\n".encode("cp1252"),
        b"track,category,confidence,label\r4,unknown,0.5,bowl\r",
    ],
    ids=["excel", "sep", "quoted", "numbers", "utf16", "cp1252", "mac"],
)
def test_tables_saved_by_spreadsheets_are_read(tmp_path: Path, content: bytes) -> None:
    path = edited_table(tmp_path, content)

    assert read_labels(path) == {4: TrackLabel(4, "bowl", 1.0)}


@pytest.mark.parametrize(
    ("label", "encoding"),
    [
        ("コップ", "cp932"),
        ("кружка", "cp1251"),
        ("stół", "cp1250"),
        ("컵", "cp949"),
        ("Krügel", "cp1252"),
    ],
)
def test_label_in_unknown_encoding_is_refused(tmp_path: Path, label: str, encoding: str) -> None:
    """Read in another encoding, the label would become a category in other letters."""
    text = f"track,category,confidence,label\n4,unknown,0.5,{label}\n"
    path = edited_table(tmp_path, text.encode(encoding))
    with pytest.raises(OutputError, match=r"line 2: the label .* save the table as CSV UTF-8"):
        read_labels(path)

    path.write_text(text, "utf-8")
    assert read_labels(path) == {4: TrackLabel(4, label, 1.0)}


def opened_in_excel(path: Path) -> str:
    """Return the text that Excel shows in western Europe."""
    content = path.read_bytes()
    return content.decode("utf-8-sig" if content.startswith(b"\xef\xbb\xbf") else "cp1252")


@pytest.mark.parametrize("label", ["Schüssel", "can"])
def test_labels_survive_a_spreadsheet(run: Path, label: str) -> None:
    """Excel turned *Schüssel* into *SchÃ¼ssel*, which then counted as a new category."""
    assert relabel(run, {2: label}) == {}
    corrected = run.parent / "mine.csv"
    corrected.write_text(opened_in_excel(run / "tracks.csv"), "utf-8-sig")
    adopt_labels(corrected, run)

    assert read_labels(run / "tracks.csv")[2].category == label
    assert (run / "tracks.csv").read_bytes().startswith(b"track,") == label.isascii()


def test_new_table_with_umlauts_opens_in_a_spreadsheet(tmp_path: Path) -> None:
    """Corrections were refused, as Excel had changed the umlauts in the model's categories."""
    line = dict.fromkeys(_CSV, 1) | dict.fromkeys(("category", "guess", "topic", "run"), "Krügel")
    _write_csv(tmp_path / "tracks.csv", [line])

    assert "Krügel" in opened_in_excel(tmp_path / "tracks.csv")


@pytest.mark.parametrize("topic", ["=cmd|'/C calc'!A0", "+1", "-d", "@SUM(1)", "/depth"])
def test_topic_is_no_formula_in_a_spreadsheet(tmp_path: Path, topic: str) -> None:
    """Topics of MCAP files may be formulas, which a spreadsheet would run; labels cannot be."""
    one = np.zeros(1, np.int64)
    causal = np.ones((1, 1), np.float32)
    track = Track(1, (topic,), 1, one, one, one, np.zeros((1, 3)), causal, causal[0], 1.0, 0.0)
    _write_csv(tmp_path / "tracks.csv", [_line(track, ["cup"], 0, "")])
    (row,) = read_track_table(tmp_path / "tracks.csv").rows

    assert row.topic == topic
    assert row.cells["topic"][0] in " /"


@pytest.mark.parametrize("label", ["चाकू", "น้ำ", "cafe\u0301"])
def test_label_may_have_combining_letters(tmp_path: Path, label: str) -> None:
    """Indian and Thai scripts have vowel signs; macOS writes accents as combining letters."""
    text = f"track,category,confidence,label\n4,unknown,0.5,{label}\n"
    path = edited_table(tmp_path, text.encode())

    assert read_labels(path)[4].category == unicodedata.normalize("NFC", label)
    assert safe_name(label) == label


@pytest.mark.parametrize("labels", [("new pan", "pan"), ("pan", "new pan")])
def test_new_name_counts_for_all_lines(tmp_path: Path, labels: tuple[str, str]) -> None:
    """*pan* is one letter from *can*, so only *new* tells that *pan* is meant."""
    lines = [f"{k},unknown,0.5,{label}\n" for k, label in enumerate(labels)]
    text = "track,category,confidence,label\n" + "".join(lines)
    path = edited_table(tmp_path, text.encode(), range(len(labels)))

    assert {label.category for label in read_labels(path).values()} == {"pan"}


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"id,label\n1,cup\n", b"\xff\xfe\x00", b"\x00" * 9]
)
def test_invalid_table_is_refused(tmp_path: Path, content: bytes) -> None:
    path = edited_table(tmp_path, content)

    with pytest.raises(OutputError, match=r"tracks\.csv"):
        read_labels(path)


def test_missing_table_is_reported(run: Path) -> None:
    with pytest.raises(OutputError, match=r"gone\.csv: cannot be read"):
        adopt_labels(run / "gone.csv", run)


UTF8 = st.characters(exclude_categories=["Cs"])
"""All characters of UTF-8: Hypothesis's own list of them takes ten seconds on a new machine."""


@settings(max_examples=60, deadline=None)
@given(
    st.text(UTF8, max_size=200)
    | st.text("track,category;confidence\tlabel\n\r\"'1.0 merge with", max_size=300)
)
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_text("track,category,confidence,label\n" + text, "utf-8", newline="")
    try:
        labels = read_labels(path)
    except OutputError:
        return
    assert len(labels) <= len(read_track_table(path).rows)


def write_run(folder: Path) -> None:
    """Write three frames with two objects side by side, tracks 1 and 2; track 3 continues 2."""
    plane = Plane(np.array([0, -1, 0]), -0.5, np.zeros((3, 3)), 1.0, 0.0)
    with PerceptionTables(folder, categories=("cup", "can"), model_id="m") as tables:
        for index in range(3):
            found = tuple(
                Detection(
                    Candidate(
                        indices=np.arange(4) + 3 * k,
                        box=Box(np.array([0.2 * k, 0.4, 1]), np.array([0.1, 0.1, 0.2]), QUARTER),
                        plane=0,
                        on_candidate=None,
                        support_m=0.0,
                        touches_border=k == 1,
                        occluded=k == 1,
                    ),
                    NeuralGas(np.full((3, 3), k), np.array([[0, 1], [1, 2]])),
                    np.zeros(2),
                    np.array([0.9 - 0.6 * k, 0.1 + 0.6 * k]),
                    0.5,
                    0.0,
                )
                for k in range(2)
            )
            scene = Scene(np.array([0, -1, 0]), (plane,), ())
            perception = Perception("/d", index, index, "cam", scene, found, {})
            tables.write([perception], [FrameRow(0, None)])
    rows = [(1, 0, 0), (1, 1, 0), (1, 2, 0), (2, 0, 1), (3, 1, 1), (3, 2, 1)]
    write_tracks(folder, rows, topics=["/d"] * len(rows), begin_ns=0)


def test_merged_tracks_continue_as_one_track(tmp_path: Path) -> None:
    write_run(tmp_path)
    labels = {
        1: TrackLabel(1, "cup", 0.9),
        2: TrackLabel(2, "can", 1.0),
        3: TrackLabel(2, "can", 1.0),
    }

    frames = list(read_labelled_frames(tmp_path, labels))

    assert [[o.track for o in f.objects] for f in frames] == [[1, 2]] * 3
    assert [f.ended for f in frames] == [()] * 3


def test_merged_parts_of_one_frame_become_one_object(tmp_path: Path) -> None:
    """Two entities with one id in one message would overwrite each other."""
    write_run(tmp_path)
    labels = dict.fromkeys((1, 2, 3), TrackLabel(1, "box", 1.0))

    (item,) = next(read_labelled_frames(tmp_path, labels)).objects

    assert item.indices.tolist() == [0, 1, 2, 3, 4, 5, 6]
    assert np.allclose(item.box.center, [0.1, 0.4, 1], atol=1e-5)
    assert np.allclose(np.sort(item.box.size), [0.1, 0.2, 0.3], atol=1e-5)
    assert item.height_m == pytest.approx(0.1, abs=1e-5)
    assert item.gas.edges.tolist() == [[0, 1], [1, 2], [3, 4], [4, 5]]
    assert item.gas.neurons[:, 0].tolist() == [0, 0, 0, 1, 1, 1]
    assert item.posterior == pytest.approx([0.6, 0.4])  # their mean
    assert (item.touches_border, item.occluded) == (True, True)  # only the second part is
    assert item.detections == (0, 1)


def test_new_categories_come_last(tmp_path: Path) -> None:
    """A new name before the others would renumber the classes of a data set."""
    run = run_info(model={"categories": ["cup", "can"]})
    table = TrackTable((), (), ())
    names = ("vase", "can", "unknown", "pan", "amphora", "jar", "cup", "urn")
    labels = {k: TrackLabel(k, name, 1.0) for k, name in enumerate(names, 1)}

    alone = FinishedRun(tmp_path, run, table, labels)
    beside = FinishedRun(tmp_path, run, table, labels, common=("can", "jug"))

    assert alone.categories == ("cup", "can", "amphora", "jar", "pan", "urn", "vase")
    assert beside.categories == ("can", "jug", "cup", "amphora", "jar", "pan", "urn", "vase")


def test_deleted_track_is_not_shown(tmp_path: Path) -> None:
    write_run(tmp_path)
    labels = {1: TrackLabel(1, "cup", 0.9), 2: TrackLabel(2, "can", 1.0)}

    frames = list(read_labelled_frames(tmp_path, labels))

    assert [[o.track for o in f.objects] for f in frames] == [[1, 2], [1], [1]]
    assert [f.ended for f in frames] == [(), (2,), ()]

    frames = list(read_labelled_frames(tmp_path, {1: labels[1], 3: TrackLabel(3, "can", 1.0)}))

    assert [[o.track for o in f.objects] for f in frames] == [[1], [1, 3], [1, 3]]
    assert [f.ended for f in frames] == [(), (), ()]  # the deleted track 2 was never shown


def test_track_of_two_sensors_ends_after_its_latest_view() -> None:
    """Otherwise the box of the track would stay on one topic forever."""
    frames = {("/a", 0): slice(0, 1), ("/a", 1): slice(1, 2), ("/b", 0): slice(2, 3)}

    assert _last_in(frames, np.array([7, 7, 7]), np.array([0, 3, 1])) == {("/a", 1): (7,)}


def test_track_does_not_end_where_clock_is_set_back() -> None:
    """Within a topic, the order of the frames counts, not their stamps."""
    frames = {("/a", index): slice(index, index + 1) for index in range(3)}

    assert _last_in(frames, np.array([7, 7, 7]), np.array([10, 20, 5])) == {("/a", 2): (7,)}


def replayed(path: Path) -> list[tuple[int, set[str]]]:
    """Replay a recording's scene; return each message's time and the entities shown after it."""
    alive: dict[str, float] = {}
    shown = []
    for now, scene in read_ros(path, "/shapecat/scene"):
        for deletion in scene.deletions:
            alive.pop(deletion.id, None)
        alive = {name: end for name, end in alive.items() if end > now}
        for entity in scene.entities:
            lifetime = entity.lifetime.sec * 10**9 + entity.lifetime.nanosec
            assert lifetime > 0
            alive[entity.id] = now + lifetime
        assert len({entity.id for entity in scene.entities}) == len(scene.entities)
        shown.append((now, set(alive)))
    return shown


def test_no_stale_box_remains_after_corrections(guessed_run: Path, tmp_path: Path) -> None:
    """A box that was deleted or merged away, or outlives its object, misleads the viewer."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    tracks = sorted(row.track for row in read_track_table(folder / "tracks.csv").rows)
    a, b, c = tracks[:3]
    corrected = tmp_path / "mine.csv"
    corrected.write_text(
        f"track,category,confidence,label\n{a},cup,0,delete\n{b},cup,0,merge with {c}\n"
    )

    annotate_again(folder, corrected)

    labels = read_labels(folder / "tracks.csv")
    frames = list(read_labelled_frames(folder, labels))
    shown = replayed(folder / "annotated.mcap")
    assert [time for time, _ in shown] == [frame.log_time_ns for frame in frames]
    for (_, names), frame in zip(shown, frames, strict=True):
        wanted = {str(item.track) for item in frame.objects}
        assert {"".join(filter(str.isdigit, name)) for name in names} == wanted
        assert not {str(a), str(b)} & wanted


def test_annotate_names_only_written_files(
    guessed_run: Path, tmp_path: Path, shapecat: Callable[..., Result]
) -> None:
    """A run made with `--no-rrd` has no review: a user would look for it in vain."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    done = shapecat("annotate", folder)

    assert not (folder / "review.rrd").exists()
    assert done.output.splitlines()[-1] == f"{folder}: wrote annotated.mcap"


def test_pattern_for_a_batch_folder_also_gives_its_files(tmp_path: Path) -> None:
    """`shapecat report results/*` stopped at the manifest of the batch."""
    for name in ("b", "a"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").touch()
    (tmp_path / "manifest.jsonl").touch()

    assert find_runs(sorted(tmp_path.iterdir())) == [tmp_path / "a", tmp_path / "b"]
    with pytest.raises(OutputError, match=r"manifest\.jsonl: no run\.json there"):
        find_runs([tmp_path / "manifest.jsonl"])


def test_table_with_an_endless_cell_is_refused(run: Path) -> None:
    """A quotation mark that is never closed swallows the lines after it, and their labels."""
    text = (run / "tracks.csv").read_text()
    lines = text.splitlines()
    (run / "tracks.csv").write_text("\n".join([*lines[:2], '2,"' + "x" * 140_000]))

    with pytest.raises(OutputError, match=r"line 3: field larger than field limit"):
        read_labels(run / "tracks.csv")


def test_new_category_of_many_tracks_is_not_compared_with_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With 2000 tracks and 200 new categories, reading the table took 27 s."""
    compared: list[str] = []
    monkeypatch.setattr(meaning, "_nearest", lambda name, _names: compared.append(name))
    rows = [TrackRow(n, n, "cup", 0.5, "new pan", "/depth", {}) for n in range(5)]

    labels, misread = meaning.resolve_labels(rows, ["can"], one_frame=True)

    assert {label.category for label in labels.values()} == {"pan"}
    assert not misread
    assert not compared


def refusals(shapecat: Callable[..., Result], folder: Path, out: Path) -> dict[str, str]:
    """Return the error of each command that needs the labels of a run; no file may change."""
    before = {path: path.read_bytes() for path in folder.iterdir()}
    messages = {}
    for name, *options in (("annotate",), ("report",), ("export", "--format", "crops")):
        out_options = ("--out", out) if options else ()
        result = shapecat(name, folder, *options, *out_options)
        assert result.exit_code == 1
        messages[name] = result.stderr
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert not out.exists()
    return messages


@pytest.mark.usefixtures("without_pictures")
@pytest.mark.parametrize("content", [None, b""])
def test_missing_table_of_a_run_can_be_restored(
    guessed_run: Path, tmp_path: Path, shapecat: Callable[..., Result], content: bytes | None
) -> None:
    """The original table is in the same folder, but no message named it."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    (folder / "tracks.csv").unlink()
    if content is not None:
        (folder / "tracks.csv").write_bytes(content)

    path = folder / "tracks.csv"
    message = f"Error: {path}: missing or empty; restore it from tracks.original.csv\n"
    assert set(refusals(shapecat, folder, tmp_path / "crops").values()) == {message}
    shutil.copy(folder / "tracks.original.csv", path)
    assert shapecat("report", folder).exit_code == 0

    path.unlink()
    (folder / "tracks.original.csv").unlink()
    for message in refusals(shapecat, folder, tmp_path / "crops").values():
        assert "restore" not in message


def test_message_about_a_label_names_what_was_not_done(
    guessed_run: Path, tmp_path: Path, shapecat: Callable[..., Result]
) -> None:
    """`report` and `export` said that nothing was written, although they never write labels."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    path = folder / "tracks.csv"
    table = read_track_table(path)
    first = replace(table.rows[0], cells={**table.rows[0].cells, "label": "merge 7"})
    write_track_table(path, replace(table, rows=(first, *table.rows[1:])))

    problem = "\n  line 2: 'merge 7': did you mean merge with 7?\n"
    assert refusals(shapecat, folder, tmp_path / "crops") == {
        "annotate": f"Error: {path}: nothing was written:{problem}",
        "report": f"Error: {path}: the table cannot be used:{problem}",
        "export": f"Error: {path}: the table cannot be used:{problem}",
    }
