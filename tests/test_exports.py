"""Tests of exports, read back by parsers written from the specifications of their formats."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from click.testing import Result
from numpy.testing import assert_allclose

from shapecat.errors import OutputError, RecordingError
from shapecat.evaluation.dataset import read_dataset
from shapecat.geometry import rotation_from_quaternion
from shapecat.outputs.exports import crops
from shapecat.outputs.exports.crops import Origin
from shapecat.outputs.exports.formats import common_categories, export_run
from shapecat.outputs.exports.kitti import rectified_from_sensor
from shapecat.runs.finished import open_source, read_finished
from shapecat.runs.folder import read_run, write_run
from shapecat.runs.labels.corrections import adopt_labels
from shapecat.runs.labels.track_table import read_track_table
from shapecat.runs.selection import read_frames
from tests.kitti_files import read_calibration, read_labels
from tests.track_tables import rows

Run = Callable[..., Result]


@pytest.fixture(scope="module")
def run(guessed_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a corrected run: track 1 is deleted, 2 is a `wine glass` (new), 3 is unknown."""
    folder = tmp_path_factory.mktemp("corrected") / "table"
    shutil.copytree(guessed_run, folder)
    relabel(folder, {1: "delete", 2: "wine glass", 3: "unknown"})
    return folder


def relabel(folder: Path, labels: dict[int, str]) -> None:
    corrected = folder.parent / "corrected.csv"
    with corrected.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("track", "category", "confidence", "label"))
        writer.writerows((track, "cup", 0, label) for track, label in labels.items())
    adopt_labels(corrected, folder)


def boxes(folder: Path, suffix: str = "_full") -> dict[int, list[tuple[int, np.ndarray]]]:
    """Return for each frame the track and the corners (8, 3) of each box, read from the tables.

    Full boxes are those of tracks; visible boxes (``suffix`` is empty) are those of detections.
    """
    owner = {
        (row["frame"], row["detection"]): row
        for row in rows(folder, "tracks")
        if row["detection"] is not None
    }
    kept = read_finished(folder).labels
    found: dict[int, list[tuple[int, np.ndarray]]] = {}
    for row in rows(folder, "detections"):
        track_row = owner.get((row["frame"], row["detection"]), {"track": 0})
        track = track_row["track"]
        if track in kept:
            box = {**row, **track_row}
            half = np.array(box[f"size{suffix}"]) / 2
            unit = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            corners = (unit * half) @ rotation_from_quaternion(box[f"orientation{suffix}"]).T
            found.setdefault(row["frame"], []).append((track, corners + box[f"center{suffix}"]))
    return found


def farthest(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest distance from a corner of one box (8, 3) to the nearest of the other."""
    distances = np.linalg.norm(a[:, None] - b[None], axis=-1)
    return float(max(distances.min(axis=0).max(), distances.min(axis=1).max()))


def test_crops_are_a_data_set_with_corrected_labels(run: Path, tmp_path: Path) -> None:
    count = export_run(read_finished(run), "crops", tmp_path)

    views = list(read_dataset(tmp_path))
    by_track: dict[int, list[Any]] = {}
    for view in views:
        by_track.setdefault(int(view.instance.rsplit("-", 1)[1]), []).append(view)
    labels = read_finished(run).labels
    assert len(views) == count > 50
    assert set(by_track) == set(labels)
    assert 1 not in by_track
    assert {view.category for view in by_track[2]} == {"wine glass"}
    assert {view.category for view in by_track[3]} == {"unknown"}
    for track, found in by_track.items():
        assert {view.category for view in found} == {labels[track].category}


def test_crops_are_upright_at_height_zero_with_viewpoint(run: Path, tmp_path: Path) -> None:
    """In another coordinate frame, a view would have other descriptors than in the run."""
    export_run(read_finished(run), "crops", tmp_path)
    truth = json.loads(
        (Path(read_finished(run).info["input"]["path"]).with_suffix(".truth.json")).read_text()
    )
    camera_height = {}
    for frame in truth:
        table = next(plane for plane in frame["planes"] if plane["name"] != "floor")
        camera_height[frame["frame"]] = -table["offset"]
    above = []  # the height of each object's support over the table
    for path in tmp_path.glob("*/*/*.pcd"):
        header = path.read_bytes()[:400].decode("ascii", "replace").splitlines()
        viewpoint = next(line.split()[1:] for line in header if line.startswith("VIEWPOINT"))
        eye = np.array(list(map(float, viewpoint[:3])))
        up = rotation_from_quaternion(np.array(list(map(float, viewpoint[3:])))[[1, 2, 3, 0]])
        above.append(camera_height[int(path.stem)] - eye[2])
        assert (up @ [0, -1, 0])[2] > 0  # the upper side of the image is up
    assert min(above) > -0.02
    assert np.mean(np.abs(above) < 0.01) > 0.7  # some stand on others
    for view in read_dataset(tmp_path):
        assert -0.02 < np.percentile(view.points[:, 2], 1) < 0.05
        assert_allclose(view.points[:, :2].mean(axis=0), 0, atol=1e-4)


@pytest.mark.parametrize(
    ("form", "second", "problem"),
    [
        ("crops", "lab", "hold the same frames of a recording; export only one"),
        ("crops", "lab2", "hold the same frames of a recording; export only one"),
        ("coco --depth", "lab2", "hold the same frames of a recording; export only one"),
        ("kitti", "lab", "have the same name; export them to different folders"),
    ],
)
def test_exports_of_two_runs_do_not_collide(
    run: Path, tmp_path: Path, shapecat: Run, form: str, second: str, problem: str
) -> None:
    """The second export would replace the first."""
    folders = [tmp_path / "left" / "lab", tmp_path / "right" / second]
    for folder in folders:
        shutil.copytree(run, folder)
    result = shapecat("export", *folders, "--format", *form.split(), "--out", tmp_path / "out")

    assert result.exit_code != 0
    assert problem in result.output
    assert not (tmp_path / "out").exists()


def test_run_given_by_several_paths_is_exported_once(
    run: Path, tmp_path: Path, shapecat: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run given twice was refused as another run with the same frames, or exported twice."""
    monkeypatch.chdir(run.parent)
    (tmp_path / "way").symlink_to(run)
    options = ("--format", "crops", "--every", 4)
    once = shapecat("export", run.name, *options, "--out", tmp_path / "once")
    paths = (".", run, tmp_path / "way")
    result = shapecat("export", *paths, *options, "--out", tmp_path / "several")

    assert result.exit_code == 0, result.output
    assert result.output.count("labelled views") == once.output.count("labelled views") == 1
    made, expected = (
        sorted(path.relative_to(out).as_posix() for path in out.rglob("*.pcd"))
        for out in (tmp_path / "several", tmp_path / "once")
    )
    assert made == expected != []


def test_linked_runs_are_exported_by_their_own_names(
    run: Path, tmp_path: Path, shapecat: Run
) -> None:
    """Otherwise the folder of an export would depend on the path by which a run was given."""
    links = []
    for name in ("left", "right"):
        shutil.copytree(run, tmp_path / name / "lab")
        links.append(tmp_path / f"to {name}")
        links[-1].symlink_to(tmp_path / name / "lab")
    options = ("--format", "point-labels", "--every", 4, "--out", tmp_path / "out")
    both = shapecat("export", *links, *options)

    assert both.exit_code == 1
    assert "have the same name; export them to different folders" in both.output
    assert shapecat("export", links[0], *options).exit_code == 0
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["lab"]


def test_exporting_again_removes_views_with_earlier_labels(run: Path, tmp_path: Path) -> None:
    """A stale view teaches the model the mistake that was corrected."""
    folder = tmp_path / "table"
    shutil.copytree(run, folder)
    own = tmp_path / "crops" / "cup" / "mine"
    own.mkdir(parents=True)
    (own / "view.pcd").write_text("of another data set")
    events: list[tuple[str, int, int | None]] = []
    export_run(
        read_finished(folder),
        "crops",
        tmp_path / "crops",
        every=4,
        observe=lambda *what: events.append(what),
    )
    assert events[-1][1:] == (len(events), len(events))  # the progress ends at its total
    relabel(folder, {2: "vase", 3: "delete"})
    export_run(read_finished(folder), "crops", tmp_path / "crops", every=4)

    places = {path.name: path.parent.name for path in (tmp_path / "crops").glob("*/*.track-*")}
    assert sum(name.endswith("track-2") for name in places) == 1
    assert not any(name.endswith("track-3") for name in places)
    assert next(c for name, c in places.items() if name.endswith("track-2")) == "vase"
    assert not (tmp_path / "crops" / "wine glass").exists()
    assert (own / "view.pcd").exists()


def test_long_categories_of_all_scripts_are_whole_in_crops(run: Path, tmp_path: Path) -> None:
    """`learn` takes the name of the folder: a cut one is another category than the label."""
    folder = tmp_path / "table"
    shutil.copytree(run, folder)
    names = {2: "椀" * 60, 3: "椀" * 50 + "皿" * 10}
    relabel(folder, names)
    export_run(read_finished(folder), "crops", tmp_path / "crops", every=4)

    assert {*names.values()} <= {*read_dataset(tmp_path / "crops").categories}


def test_exports_at_the_same_time_do_not_repeat_views(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each would miss the views of the other, and objects would be in training and test set."""
    folder = tmp_path / "copy"
    shutil.copytree(run, folder)
    out = tmp_path / "crops"
    second = Thread(
        target=export_run, args=(read_finished(folder), "crops", out), kwargs={"every": 4}
    )
    replace = crops._replace

    def replace_meanwhile(*places: Any) -> None:
        if second.ident is None:
            second.start()
            second.join(1)
        replace(*places)

    monkeypatch.setattr(crops, "_replace", replace_meanwhile)
    count = export_run(read_finished(run), "crops", out, every=4)
    second.join()

    assert len(list(out.glob("*/*/*.pcd"))) == count > 0


@pytest.mark.parametrize("suffix", [pytest.param("", marks=pytest.mark.many), "_full"])
def test_kitti_boxes_match_tables_within_1_mm(run: Path, tmp_path: Path, suffix: str) -> None:
    """Detectors are trained on whole objects; visible boxes are optional."""
    export_run(read_finished(run), "kitti", tmp_path, visible_boxes=not suffix)
    out = tmp_path / "table"
    camera = intrinsics(run)
    worst, kinds = 0.0, set()
    with (out / "frames.csv").open() as file:
        index = list(csv.DictReader(file))
    table_boxes = boxes(run, suffix)
    for entry in index:
        projection = read_calibration(out, entry["number"])["P2"]
        sensor_from_rectified = np.linalg.inv(camera) @ projection[:, :3]
        assert_allclose(sensor_from_rectified @ sensor_from_rectified.T, np.eye(3), atol=1e-6)
        labels = read_labels(out, entry["number"])
        expected = table_boxes[int(entry["frame"])]
        assert len(labels) == len(expected)
        for label, (_, wanted) in zip(labels, expected, strict=True):
            worst = max(worst, farthest(label.corners @ sensor_from_rectified.T, wanted))
            kinds.add(label.kind)
    assert len(index) == 8
    assert worst < 0.001
    assert {"wine_glass", "unknown"} <= kinds


def test_kitti_refuses_categories_with_the_same_type(
    shapecat: Run, guessed_run: Path, tmp_path: Path
) -> None:
    """Objects of two categories would have one type; which was which could not be recovered."""
    folder = tmp_path / "table"
    shutil.copytree(guessed_run, folder)
    relabel(folder, {1: "new wine glass", 2: "new wine_glass"})
    result = shapecat("export", folder, "--format", "kitti", "--out", tmp_path / "kitti")

    assert result.exit_code == 1
    assert "'wine glass' and 'wine_glass' have the same KITTI type" in result.output
    assert not (tmp_path / "kitti" / "table").exists()


def test_kitti_accepts_equal_types_that_no_two_tracks_have(run: Path, tmp_path: Path) -> None:
    """A model may know `wine_glass` although all tracks were relabelled `wine glass`."""
    finished = read_finished(run)
    finished.info["model"]["categories"] += ["wine_glass"]

    assert "wine glass" in {label.category for label in finished.labels.values()}
    assert export_run(finished, "kitti", tmp_path) > 8


def intrinsics(run: Path) -> np.ndarray:
    finished = read_finished(run)
    with open_source(finished.info) as recording:
        camera = next(read_frames(recording, finished.info["options"]))[0].camera
    assert camera is not None
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


@pytest.mark.parametrize("up", [(0, -1, 0), (0, -0.8, -0.6), (0, -0.02, -1), (0.1, -0.7, 0.7)])
def test_rectified_camera_is_level(up: tuple[float, ...]) -> None:
    rotation = rectified_from_sensor(np.array(up), optical=True)

    assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    assert_allclose(rotation @ up / np.linalg.norm(up), [0, -1, 0], atol=1e-12)


def test_labelcloud_formats_agree(run: Path, tmp_path: Path) -> None:
    """Centroid and size are read, or computed from vertices, as in labelCloud 1.1."""
    export_run(read_finished(run), "labelcloud", tmp_path, every=3)
    out = tmp_path / "table"
    worst, count = 0.0, 0
    for cloud in sorted((out / "pointclouds").iterdir()):
        name = f"{cloud.stem}.json"
        kinds = [
            json.loads((out / folder / name).read_text())["objects"]
            for folder in ("labels", "labels_centroid_abs", "labels_vertices")
        ]
        table_boxes = boxes(run)[3 * int(cloud.stem)]
        assert [len(kind) for kind in kinds] == [len(table_boxes)] * 3
        for relative, absolute, vertices, (_, wanted) in zip(*kinds, table_boxes, strict=True):
            radians, degrees = relative["rotations"]["z"], absolute["rotations"]["z"]
            assert 0 <= degrees < 360
            assert_allclose(np.exp(1j * radians), np.exp(1j * np.radians(degrees)), atol=1e-6)
            v = np.array(vertices["vertices"])
            assert_allclose(
                (v[4] - v[2]) / 2 + v[2], list(relative["centroid"].values()), atol=1e-6
            )
            sizes = [np.linalg.norm(v[0] - v[k]) for k in (3, 1, 4)]
            assert_allclose(sizes, list(relative["dimensions"].values()), atol=1e-6)
            x, y, _ = v[3] - v[0]
            assert_allclose(np.arctan2(y, x), radians, atol=1e-5)
            assert len(set(v[:4, 2])) == 1
            edges = np.linalg.norm(wanted[0] - wanted[1:], axis=1).min()
            worst = max(worst, abs(edges - min(sizes)))
            count += 1
    classes = json.loads((out / "labels" / "_classes.json").read_text())
    assert {"unknown", "wine glass", "cup"} <= {entry["name"] for entry in classes["classes"]}
    assert len({entry["id"] for entry in classes["classes"]}) == len(classes["classes"])
    assert count > 20
    assert worst < 1e-5


def test_runs_exported_together_share_category_numbers(
    shapecat: Run, run: Path, tmp_path: Path
) -> None:
    """Otherwise the first new category of each run would get the same number."""
    image = pytest.importorskip("PIL.Image")
    labels = {"a": "zebra", "b": "apple"}
    for name, label in labels.items():
        shutil.copytree(run, tmp_path / "runs" / name)
        relabel(tmp_path / "runs" / name, {2: label})
    legends: Any = []
    for kind, file in (("labelcloud", "labels/_classes.json"), ("point-labels", "labels.json")):
        options = ("--format", kind, "--out", tmp_path / kind, "--every", 6)
        assert shapecat("export", tmp_path / "runs", *options).exit_code == 0
        legends = [json.loads((tmp_path / kind / n / file).read_text())["classes"] for n in labels]
        assert legends[0] == legends[1]

    for name, label in labels.items():
        instance, semantic = (
            np.asarray(image.open(tmp_path / "point-labels" / name / kind / "000000.png"))
            for kind in ("instance", "semantic")
        )
        (number,) = set(semantic[instance == 2].tolist())
        assert legends[0][str(number)] == label


def test_numbers_of_categories_depend_on_their_names_alone(run: Path, tmp_path: Path) -> None:
    """Otherwise exports of runs in another order, or with a later model, could not be combined."""
    runs = [tmp_path / name for name in "ab"]
    for folder, label in zip(runs, ("zebra", "apple"), strict=True):
        shutil.copytree(run, folder)
        relabel(folder, {2: label})
    names = common_categories([read_finished(folder) for folder in runs])
    info = read_run(runs[0])
    info["model"]["categories"] += ["zebra"]
    write_run(runs[0], info)

    assert names[-2:] == ("apple", "zebra")
    learned = [read_finished(folder) for folder in runs]
    assert common_categories(learned) == common_categories(learned[::-1]) == names


def test_point_labels_match_pixels_of_each_object(run: Path, tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    export_run(read_finished(run), "point-labels", tmp_path)
    out = tmp_path / "table"
    legend = json.loads((out / "labels.json").read_text())
    owner = {
        (row["frame"], row["detection"]): row["track"]
        for row in rows(run, "tracks")
        if row["detection"] is not None
    }
    labels = read_finished(run).labels
    images = {
        path.stem: [
            np.asarray(image.open(out / kind / path.name)).ravel()
            for kind in ("instance", "semantic", "depth")
        ]
        for path in (out / "instance").iterdir()
    }
    for row in rows(run, "detections"):
        track = owner.get((row["frame"], row["detection"]), 0)
        instance, semantic, depth = images[f"{row['frame']:06d}"]
        if track not in labels:
            assert not instance[row["indices"]].any()
            continue
        assert instance.dtype == np.uint16
        assert (instance[row["indices"]] == track).all()
        (value,) = set(semantic[row["indices"]].tolist())
        assert legend["classes"][str(value)] == labels[track].category
        assert legend["instances"][str(track)] == labels[track].category
        assert 300 < np.median(depth[row["indices"]]) < 2500
        assert ((instance > 0) == (semantic > 0)).all()


@pytest.mark.parametrize("format", ["kitti", "point-labels"])
def test_frames_without_pose_are_left_out(run: Path, tmp_path: Path, format: str) -> None:  # noqa: A002  the word users know
    """Objects in such frames have no tracks; a model would learn that they are background."""
    lost = shutil.copytree(run, tmp_path / "lost")
    table = pq.read_table(lost / "frames.parquet")
    for name in ("fixed_translation", "fixed_rotation"):
        column = pa.array([None, *table[name].to_pylist()[1:]], table[name].type)
        table = table.set_column(table.column_names.index(name), name, column)
    pq.write_table(table, lost / "frames.parquet")
    tracks = pq.read_table(lost / "tracks.parquet")
    pq.write_table(tracks.filter(pc.greater(tracks["frame"], 0)), lost / "tracks.parquet")
    export_run(read_finished(lost), format, tmp_path / "out")

    with (tmp_path / "out" / "lost" / "frames.csv").open() as file:
        frames = [int(row["frame"]) for row in csv.DictReader(file)]
    assert frames == list(range(1, len(table)))


def test_export_never_replaces_its_run(run: Path) -> None:
    """With `--out results`, the folder that contains the run, an export would replace the run."""
    before = sorted(path.name for path in run.iterdir())

    with pytest.raises(OutputError, match="choose another --out"):
        export_run(read_finished(run), "kitti", run.parent)

    assert sorted(path.name for path in run.iterdir()) == before


def test_export_replaces_only_export_of_same_format(run: Path, tmp_path: Path) -> None:
    """An export states its format and source, so that no other export is replaced by mistake."""
    folder = shutil.copytree(run, tmp_path / "table")
    info = read_run(folder)
    info["options"] |= {"start_s": 0.0, "end_s": 99.5}
    write_run(folder, info)
    objects = {
        export_run(read_finished(folder), "point-labels", tmp_path / "out", every=6)
        for _ in range(2)
    }
    out = tmp_path / "out" / "table"

    assert len(list((out / "semantic").iterdir())) == 2
    assert json.loads((out / "export.json").read_text()) == {
        "format": "point-labels",
        "run": info["id"],
        "input": info["input"],
        "topics": ["/camera/depth/image_raw"],
        "range_s": [0.0, 99.5],
        "objects": objects.pop(),
        "made": sorted(path.name for path in out.iterdir() if path.name != "export.json"),
    }
    with pytest.raises(OutputError, match="holds point-labels"):
        export_run(read_finished(folder), "kitti", tmp_path / "out")


def test_missing_or_changed_recording_is_refused(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "table"
    shutil.copytree(run, folder)
    info = json.loads((folder / "run.json").read_text())
    source = Path(info["input"]["path"])
    copy = tmp_path / "copy.mcap"
    info["input"]["path"] = str(copy)
    (folder / "run.json").write_text(json.dumps(info))

    with pytest.raises(RecordingError):
        export_run(read_finished(folder), "crops", tmp_path / "crops")
    changed = bytearray(source.read_bytes())
    changed[len(changed) // 3] ^= 1
    copy.write_bytes(changed)
    with pytest.raises(OutputError, match="has changed"):
        export_run(read_finished(folder), "crops", tmp_path / "crops")
    assert not (tmp_path / "crops").exists()


def several_runs(run: Path, results: Path) -> None:
    """Copy a run to folders a to d; b and c lack their recordings, and a label of d is invalid."""
    for name in "abcd":
        shutil.copytree(run, results / name)
        place = results / name / "run.json"
        info = json.loads(place.read_text())
        info["input"] |= {"digest": f"xxh3-128:{name}"}
        info["input"] |= {"path": f"/moved/{name}.mcap"} if name in "bc" else {}
        place.write_text(json.dumps(info))
    table = results / "d" / "tracks.csv"
    header, first, *rest = table.read_text().splitlines()
    cells = first.split(",")
    cells[header.split(",").index("label")] = "merge 7"
    table.write_text("\n".join([header, ",".join(cells), *rest]) + "\n")


@pytest.mark.parametrize("kind", ["kitti", "crops"])
def test_runs_with_errors_are_named_and_skipped(
    shapecat: Run, run: Path, tmp_path: Path, kind: str
) -> None:
    """A moved recording or an unusable table must not stop the export of the other runs."""
    results, out = tmp_path / "results", tmp_path / "out"
    several_runs(run, results)
    result = shapecat("export", results, "--format", kind, "--out", out, "--every", 6)

    assert result.exit_code == 1
    for name in "bc":
        advice = f"`shapecat annotate {results / name} --recording PATH`"
        assert f"/moved/{name}.mcap: the recording is missing; if it was moved" in result.stderr
        assert advice in result.stderr
    assert f"Error: {results / 'd' / 'tracks.csv'}: the table cannot be used" in result.stderr
    assert result.stderr.endswith("skipped 3 of 4 runs\n")
    assert result.stdout.startswith(f"{results / 'a'}: ")
    assert result.stdout.count("labelled view") == 1
    assert out.exists()


def test_export_without_usable_run_fails(shapecat: Run, run: Path, tmp_path: Path) -> None:
    """If the errors of all runs have the same exit code, it is returned, otherwise 1."""
    results, out = tmp_path / "results", tmp_path / "out"
    several_runs(run, results)
    for names, code in (("bc", 3), ("bd", 1)):
        runs = [results / name for name in names]
        result = shapecat("export", *runs, "--format", "kitti", "--out", out)
        assert (result.exit_code, result.stdout) == (code, "")
        assert result.stderr.endswith("Error: no run is left to export\n")
        assert not out.exists()


def test_export_command_reports_views_and_errors(shapecat: Run, run: Path, tmp_path: Path) -> None:
    result = shapecat("export", run, "--format", "crops", "--out", tmp_path / "c", "--every", 6)

    assert result.exit_code == 0
    assert "labelled views in" in result.stdout
    assert shapecat("export", run, "--format", "voc", "--out", tmp_path).exit_code == 2
    missing = shapecat("export", tmp_path / "none", "--format", "crops", "--out", tmp_path)
    assert missing.exit_code == 1
    assert "no run.json" in missing.output


@pytest.mark.parametrize("kind", ["crops", "kitti", "labelcloud", "point-labels", "coco"])
def test_nothing_is_exported_into_run(shapecat: Run, run: Path, kind: str) -> None:
    """Categories would become folders among the tables of the run."""
    before = sorted(path.name for path in run.iterdir())
    result = shapecat("export", run, "--format", kind, "--out", run)

    assert result.exit_code == 1
    assert "choose another --out" in result.stderr
    assert sorted(path.name for path in run.iterdir()) == before


def test_scene_prints_plane_and_known_tracks(shapecat: Run, run: Path) -> None:
    result = shapecat("scene", run, "--frame", 5)

    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("plane 0")
    known = {str(row.track) for row in read_track_table(run / "tracks.csv").rows}
    found = {line.split("#")[1].split(":")[0] for line in result.stdout.splitlines() if "#" in line}
    assert len(found) > 4
    assert found <= known - {"1"}
    assert shapecat("scene", run, "--frame", 99).exit_code == 1


def test_scene_follows_corrections(shapecat: Run, run: Path, tmp_path: Path) -> None:
    """Other outputs show merged tracks as one object, and no deleted ones."""
    folder = shutil.copytree(run, tmp_path / "run")
    before = shapecat("scene", folder, "--frame", 5).stdout.splitlines()
    first, second, *rest = [line.split("#")[1].split(":")[0] for line in before if "#" in line]
    relabel(folder, {int(first): "delete", int(second): f"merge with {rest[0]}"})
    after = shapecat("scene", folder, "--frame", 5).stdout.splitlines()

    assert len(after) == len(before) - 2
    assert sorted(line.split("#")[1].split(":")[0] for line in after if "#" in line) == sorted(rest)


def test_crops_of_ranges_within_a_second_are_told_apart() -> None:
    """Rounded to whole seconds, 0 to 1.4 s and 1.4 to 2.4 s could replace each other."""
    first, second = Origin("0123456789ab", 0.0, 1.4), Origin("0123456789ab", 1.4, 2.4)

    assert Origin.read(f"lab.{second}.track-3") == second
    assert not first.shares_frames(second)
