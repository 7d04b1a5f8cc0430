"""Tests of evaluation: metrics, training and reports on a data set folder, and pages."""

import errno
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import unquote
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from click.testing import CliRunner, Result
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn import metrics as reference

from shapecat.arrays import F4
from shapecat.config import Settings
from shapecat.description import DESCRIPTOR_NAMES
from shapecat.errors import ModelError, OutputError, RecordingError
from shapecat.evaluation import (
    Report,
    baselines,
    evaluate_folder,
    format_report,
    metrics,
    read_dataset,
)
from shapecat.evaluation.dataset import View
from shapecat.evaluation.fused import Fused, fuse_views
from shapecat.evaluation.metrics import Bin
from shapecat.evaluation.names import require_category_names
from shapecat.evaluation.page import (
    accuracy_svg,
    calibration_svg,
    confusion_svg,
    format_markdown,
    format_page,
    write_page,
)
from shapecat.evaluation.report import Compared, _accuracy_by_range, evaluate
from shapecat.evaluation.training import (
    fit_views,
    learn_on_folder,
    split_instances,
    train_on_folder,
)
from shapecat.evaluation.views import DescribedView, DescribedViews, describe_views
from shapecat.learning import Categorizer, load_model
from shapecat.learning.training import LearningSettings
from shapecat.runs.labels.meaning import order_categories


def test_calibration_error_weights_bins_by_views() -> None:
    """Of three views with a confidence of 0.9, two are right; one with 0.6 is wrong."""
    posteriors = np.array([[0.9, 0.1], [0.1, 0.9], [0.9, 0.1], [0.6, 0.4]])
    truth = np.array([0, 1, 1, 1])

    error = metrics.expected_calibration_error(truth, posteriors)

    assert error == pytest.approx(0.75 * (0.9 - 2 / 3) + 0.25 * 0.6)


@settings(deadline=None, max_examples=30)
@given(st.integers(1, 60), st.integers(2, 6), st.integers(0, 10_000))
def test_metrics_agree_with_scikit_learn(n: int, categories: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth, predicted = rng.integers(0, categories, (2, n))
    scores = rng.integers(0, 5, n).astype(np.float64)  # many ties
    table = metrics.confusion(truth, predicted, categories)

    assert metrics.accuracy(truth, predicted) == reference.accuracy_score(truth, predicted)
    assert np.array_equal(
        table, reference.confusion_matrix(truth, predicted, labels=range(categories))
    )
    expected = reference.recall_score(
        truth, predicted, labels=np.unique(truth), average="macro", zero_division=0
    )
    assert metrics.balanced_accuracy(table) == pytest.approx(expected)
    if 0 < np.sum(truth == 0) < n:
        area = metrics.auroc(scores[truth == 0], scores[truth != 0])
        assert area == pytest.approx(reference.roc_auc_score(truth == 0, scores))


def test_calibration_error_of_known_cases() -> None:
    """Over- and under-confidence count alike, and confidence 1 belongs to the last bin."""
    certain = np.array([[1.0, 0.0]] * 10)
    assert metrics.expected_calibration_error(np.zeros(10, int), certain) == 0
    assert metrics.expected_calibration_error(np.ones(10, int), certain) == 1
    uncertain = np.array([[0.6, 0.4]] * 10)
    assert metrics.expected_calibration_error(np.zeros(10, int), uncertain) == pytest.approx(0.4)
    half = np.repeat([0, 1], [6, 4])
    assert metrics.expected_calibration_error(half, uncertain) == pytest.approx(0)


def test_metrics_of_empty_input_are_nan() -> None:
    nothing = np.zeros(0, np.int64)

    assert np.isnan(metrics.accuracy(nothing, nothing))
    assert np.isnan(metrics.balanced_accuracy(np.zeros((3, 3), int)))
    assert np.isnan(metrics.expected_calibration_error(nothing, np.zeros((0, 3))))
    assert np.isnan(metrics.auroc(np.zeros(0), np.ones(2)))


def test_balanced_accuracy_ignores_categories_without_views() -> None:
    """A mean over categories with 0 of 0 right would be NaN."""
    table = np.array([[3, 1, 0], [0, 2, 0], [0, 0, 0]])

    assert metrics.balanced_accuracy(table) == pytest.approx((0.75 + 1) / 2)


# --- data sets ---------------------------------------------------------------------------------


def visible_points(shape: str, size: float, rng: np.random.Generator) -> F4:
    """Return noisy points (n, 3) of a shape that stands at z = 0, seen from +x, +y and above.

    ``size`` is its radius or half its width. Sizes and points are in metres.
    """
    points = rng.normal(size=(12_000, 3))
    if shape == "ball":
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    else:
        points /= np.abs(points).max(axis=1, keepdims=True)
        points[:, 2] *= {"box": 1.0, "plate": 0.1, "post": 2.5}[shape]
    points = points * size + [0, 0, np.abs(points[:, 2]).max() * size]
    visible = (points - points.mean(axis=0)) @ np.array([1, 1, 1.2]) > 0
    noisy: F4 = points[visible] + rng.normal(size=(int(visible.sum()), 3)) * 5e-4
    return noisy.astype(np.float32)


def write_dataset(
    root: Path, shapes: tuple[str, ...], *, instances: int = 5, seed: int = 0
) -> Path:
    """Write two views of each instance of the shapes (``unknown``: posts); return ``root``."""
    rng = np.random.default_rng(seed)
    for name in shapes:
        for instance in range(instances):
            folder = root / name / f"{name}_{instance}"
            folder.mkdir(parents=True)
            size = rng.uniform(0.03, 0.06)
            for view in range(2):
                points = visible_points("post" if name == "unknown" else name, size, rng)
                np.savez(folder / f"{view}.npz", points=points, viewpoint=[0.7, 0.7, 0.8])
    return root


@pytest.fixture(scope="module", autouse=True)
def few_rounds() -> Iterator[None]:
    """Boost for a fifth of the usual rounds, which suffices for some views of three shapes."""
    with pytest.MonkeyPatch.context() as patch:
        fewer = partial(LearningSettings, rounds=100)
        patch.setattr("shapecat.evaluation.training.LearningSettings", fewer)
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("trained")
    dataset = write_dataset(folder / "data", ("box", "ball", "unknown"))
    train_on_folder(dataset, folder / "model.npz", seed=1)
    return folder / "model.npz"


def test_model_is_trained_and_evaluated_on_folders(trained: Path, tmp_path: Path) -> None:
    """Users train on corrected crops. The evaluation uses instances the model has not seen."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball", "unknown"), instances=3, seed=9)
    report = evaluate_folder(dataset, trained)
    values = json.loads(json.dumps(report.as_dict()))

    assert values["n"] == 12
    assert values["categories"] == ["box", "ball"]
    assert values["accuracy"] == values["balanced_accuracy"] == 1.0
    assert values["confusion"] == [[6, 0], [0, 6]]
    assert values["recall"] == {"box": 1.0, "ball": 1.0}
    assert values["novelty"]["auroc"] > 0.9
    assert 0 <= values["ece"] < 0.5
    assert len(values["model"]) == 16
    text = format_report(report)
    assert "balanced accuracy" in text
    assert max(map(len, text.splitlines())) <= 100


def test_evaluation_is_reproducible(
    shapecat: Callable[..., Result], trained: Path, tmp_path: Path
) -> None:
    """Users compare the reports of two models: any difference must come from the models."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball", "unknown"), instances=3, seed=9)
    command = ("evaluate", dataset, "--model", trained, "--report", tmp_path / "page.html")
    results = []
    for options in ((), ("--json",)) * 2:
        printed = shapecat(*command, *options).stdout
        results.append((printed, (tmp_path / "page.html").read_bytes()))

    assert results[:2] == results[2:]


def test_training_on_folder_is_reproducible(trained: Path, tmp_path: Path) -> None:
    second = train_on_folder(trained.parent / "data", tmp_path / "again.npz", seed=1)

    assert second["model"] == load_model(trained).model_id
    assert (tmp_path / "again.npz").read_bytes() == trained.read_bytes()


def test_model_is_calibrated_on_held_out_instances(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Calibrated on the views it learned, a model would be overconfident.

    The saved model has learned all views, so it takes the calibration of a model that has not.
    """
    made: list[Categorizer] = []

    def fit(*views: DescribedViews, **options: Any) -> Categorizer:
        made.append(fit_views(*views, **options))
        return made[-1]

    monkeypatch.setattr("shapecat.evaluation.training.fit_views", fit)
    dataset = write_dataset(tmp_path / "data", ("box", "ball", "unknown"), instances=2)
    train_on_folder(dataset, tmp_path / "m.npz")

    partial, whole = made
    model = load_model(tmp_path / "m.npz")
    assert (model.temperature, model.threshold) == (partial.temperature, partial.threshold)
    assert partial.temperature != whole.temperature
    assert partial.threshold != whole.threshold


def test_new_category_is_learned_from_folder(trained: Path, tmp_path: Path) -> None:
    """Crops of unknown objects beside the new category must not become a category as well."""
    dataset = write_dataset(tmp_path / "new", ("plate", "unknown"))
    done = learn_on_folder(trained, dataset, tmp_path / "m.npz")
    assert (done["added"], done["categories"]) == (["plate"], ["box", "ball", "plate"])
    assert done["model"] == load_model(tmp_path / "m.npz").model_id
    test = write_dataset(tmp_path / "test", ("box", "ball", "plate"), instances=3, seed=5)

    report = evaluate_folder(test, tmp_path / "m.npz")

    assert report.categories == ("box", "ball", "plate")
    assert report.accuracy is not None
    assert report.accuracy > 0.9


def test_learning_without_new_category_raises(trained: Path, tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path / "data", ("box",), instances=1)

    with pytest.raises(ModelError, match="already knows all its categories"):
        learn_on_folder(trained, dataset, tmp_path / "m.npz")


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (("Box", "cone"), "Box: the model calls it box; rename the folder"),
        (("Unknown", "cone"), "Unknown: the model calls it unknown"),
        (("cone", "Cone"), "cone: there is also a folder Cone"),
        (("tea  pot", "cone"), "tea  pot: expected 'tea pot'"),
        (("cafe\u0301", "cone"), "expected 'caf\u00e9' instead of 'cafe\\\\u0301'"),
        (("delete", "cone"), "delete: reserved"),
        (("merge with 3", "cone"), "merge with 3: reserved"),
        (("DontCare", "cone"), "DontCare: reserved"),
        (("50%", "cone"), "50%: reserved, or not a letter"),
    ],
)
def test_folder_names_that_no_label_can_have_are_refused(
    tmp_path: Path, names: tuple[str, ...], reason: str
) -> None:
    """Runs of a model with such a category could not be exported."""
    for name in names:
        (tmp_path / "data" / name / "x").mkdir(parents=True)
        (tmp_path / "data" / name / "x" / "0.npz").touch()

    with pytest.raises(RecordingError, match=reason):
        learn_on_folder(None, tmp_path / "data", tmp_path / "m.npz")
    if names[0] != "Box":
        with pytest.raises(RecordingError, match=reason):
            train_on_folder(tmp_path / "data", tmp_path / "m.npz")


def test_folder_with_decomposed_accents_is_distinguished_from_its_category(tmp_path: Path) -> None:
    """On macOS, accents are decomposed: `does not know café (it knows café)` would help nobody.

    Nor would `there is also a folder café`, if there is one with composed accents.
    """
    for name in ("box", "caf\u00e9", "cafe\u0301"):
        (tmp_path / "data" / name / "x").mkdir(parents=True)
        (tmp_path / "data" / name / "x" / "0.npz").touch()
    expected = "expected 'caf\u00e9' instead of 'cafe\\\\u0301'; rename the folder"

    with pytest.raises(RecordingError, match=expected):
        evaluate_folder(tmp_path / "data")
    with pytest.raises(RecordingError, match=expected):
        require_category_names(tmp_path / "data", ["cafe\u0301"], ["caf\u00e9"])


def test_too_many_categories_are_refused_before_views_are_described(tmp_path: Path) -> None:
    """Otherwise the error comes only after the fit. The default model has seven categories."""
    for k in range(255):
        (tmp_path / "data" / f"kind {k}" / "x").mkdir(parents=True)
        (tmp_path / "data" / f"kind {k}" / "x" / "0.npz").touch()

    with pytest.raises(ModelError, match="can have 254 categories, not 262"):
        learn_on_folder(None, tmp_path / "data", tmp_path / "m.npz")
    with pytest.raises(ModelError, match="can have 254 categories, not 255"):
        train_on_folder(tmp_path / "data", tmp_path / "m.npz")


def test_categories_without_usable_views_are_named(trained: Path, tmp_path: Path) -> None:
    """Otherwise `learn` would claim to know all categories, and `train` would silently omit one."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball"), instances=2)
    (dataset / "pen" / "x").mkdir(parents=True)
    for k in range(3):
        np.savez(dataset / "pen" / "x" / f"{k}.npz", points=np.eye(3) * 0.01)

    with pytest.raises(RecordingError, match="no view of pen with enough points"):
        learn_on_folder(trained, dataset, tmp_path / "m.npz")
    done = train_on_folder(dataset, tmp_path / "m.npz")
    assert (done["lost"], done["skipped"], done["categories"]) == (["pen"], 3, ["box", "ball"])


def test_folder_without_views_is_named(
    shapecat: Callable[..., Result], trained: Path, tmp_path: Path
) -> None:
    """Files of another format, or an export that failed, leave a category out of the model."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball"), instances=2)
    (dataset / "pen" / "x").mkdir(parents=True)
    (dataset / "pen" / "x" / "0.xyz").write_text("0 0 0\n")

    done = shapecat("train", dataset, "--out", tmp_path / "m.npz")
    assert (done.exit_code, done.stderr) == (
        0, "Warning: pen: no usable views (.pcd, .ply or .npz)\n",
    )  # fmt: skip
    with pytest.raises(RecordingError, match="no view of pen"):
        learn_on_folder(trained, dataset, tmp_path / "m2.npz")


def test_train_prints_the_accuracy_on_held_out_objects(
    shapecat: Callable[..., Result], tmp_path: Path
) -> None:
    """Users would evaluate the model on the views it was trained on, and find 100 %."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball"), instances=2)

    done = shapecat("train", dataset, "--out", tmp_path / "m.npz")
    held_out = train_on_folder(dataset, tmp_path / "m.npz")["held_out"]

    n, accuracy = held_out["n"], held_out["accuracy"]
    assert done.stdout.splitlines()[1] == (
        f"trained without {n} views of other objects, it has an accuracy of {accuracy:.3f} on them"
    )


def test_views_in_another_frame_are_noticed(
    shapecat: Callable[..., Result], trained: Path, tmp_path: Path
) -> None:
    """A category learned from clouds in the camera frame would match no object of a run."""
    dataset = write_dataset(tmp_path / "data", ("ball", "plate", "unknown"), instances=2)
    plates, model = list((dataset / "plate").glob("*/*.npz")), tmp_path / "m.npz"
    shift(dataset / "ball" / "ball_0" / "1.npz", -0.06)
    shift(plates[0], 0.06)  # most are right
    for view in plates[1:]:
        shift(view, 0.045)
    upright = shapecat("learn", trained, dataset, "--out", tmp_path / "right.npz")
    for view in plates[1:]:
        shift(view, -0.1)

    answers = [
        shapecat("learn", trained, dataset, "--out", model),
        shapecat("train", dataset, "--out", tmp_path / "trained.npz"),
        shapecat("evaluate", dataset, "--model", model),
    ]

    said = "Warning: plate: most views do not stand at z = 0: z must point up, with the support at"
    assert [(each.exit_code, each.stderr.count(said)) for each in answers] == [(0, 1)] * 3
    assert (upright.exit_code, upright.stderr) == (0, "")


def shift(view: Path, by_m: float) -> None:
    """Move the points and the viewpoint of a view along z."""
    content = np.load(view)
    np.savez(view, **{name: content[name] + [0, 0, by_m] for name in ("points", "viewpoint")})


def test_evaluation_on_untrained_category_raises(trained: Path, tmp_path: Path) -> None:
    """Counted as wrong, its views would distort the metrics without notice."""
    dataset = write_dataset(tmp_path / "data", ("plate",), instances=1)

    with pytest.raises(ModelError, match="does not know plate"):
        evaluate_folder(dataset, trained)


def test_training_needs_two_categories(tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path / "data", ("box", "unknown"), instances=1)

    with pytest.raises(RecordingError, match=r"at least two categories .* found: box"):
        train_on_folder(dataset, tmp_path / "m.npz")


@pytest.mark.parametrize(("more", "calibrated"), [(("plate",), False), ((), True)])
def test_model_is_called_calibrated_only_if_half_of_its_categories_were_held_out(
    tmp_path: Path, more: tuple[str, ...], *, calibrated: bool
) -> None:
    """Users act on the confidence. A category with a single object has no views to hold out."""
    dataset = write_dataset(tmp_path / "data", ("box",), instances=3)
    write_dataset(dataset, ("ball", *more), instances=1)
    done = train_on_folder(dataset, tmp_path / "m.npz")

    assert done["calibrated"] is calibrated
    assert (load_model(tmp_path / "m.npz").temperature != 1) is calibrated
    assert done["held_out"]["n"] == 2


@pytest.mark.usefixtures("few_trees")
def test_too_few_views_give_no_model(tmp_path: Path) -> None:
    """Trees without a split give all objects the same posterior, and thus the same category."""
    dataset = write_dataset(tmp_path / "data", ("ball", "box"), instances=1)
    for path in dataset.glob("*/*/1.*"):
        path.unlink()

    with pytest.raises(RecordingError, match="2 views are too few to tell box, ball apart"):
        train_on_folder(dataset, tmp_path / "m.npz")
    assert not (tmp_path / "m.npz").exists()


def test_error_of_empty_folder_shows_the_layout(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"cup/red_mug/000\.pcd"):
        read_dataset(tmp_path)


def test_instances_are_not_split_between_training_and_test() -> None:
    """Views of one object in both would make any model look good."""
    instances = np.array([f"{k // 3}" for k in range(60)])
    labels = np.where(np.arange(60) < 45, "cup", "can")
    labels[-3:] = "rare"
    held_out = split_instances(labels, instances, np.random.default_rng(0))

    assert not set(instances[held_out]) & set(instances[~held_out])
    for label, count in (("cup", 9), ("can", 3), ("rare", 0)):
        assert np.sum(held_out & (labels == label)) == count


def test_added_categories_follow_the_default_ones() -> None:
    assert order_categories(["spoon", "can", "cup", "unknown", "fork"]) == (
        "cup",
        "can",
        "fork",
        "spoon",
    )


def test_page_is_complete_and_escapes_names(trained: Path, tmp_path: Path) -> None:
    """Folder names are untrusted; a page must not run code that they contain."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball"), instances=2)
    report = replace(evaluate_folder(dataset, trained), categories=("<script>", "ball"))
    write_page(tmp_path / "report.html", report, title="a & b")
    page = (tmp_path / "report.html").read_text("utf-8")

    assert "<script>" not in page
    assert "a &amp; b" in page
    for picture in re.findall(r"<svg.*?</svg>", page, re.DOTALL):
        ET.fromstring(picture)  # noqa: S314  we wrote it
    assert page.count("<svg") == 2 + len(report.breakdowns) == 5


def test_full_disk_leaves_the_former_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a page would be mistaken for a whole one."""
    page = tmp_path / "page.html"
    page.write_text("former")

    def fill(path: Path, text: str, _encoding: str) -> None:
        path.write_bytes(text[:99].encode())
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", fill)
    with pytest.raises(OutputError, match="No space left"):
        write_page(page, worked(), title="a")

    assert page.read_text() == "former"
    assert list(tmp_path.iterdir()) == [page]


def test_accuracies_over_ranges_match_hand_calculation() -> None:
    """A view at a limit is in the upper range; a range without views is left out."""
    values, right = np.array([2.0, 1.0, 5.5, 1.5, 2.9, 5.0]), np.array([1, 1, 1, 0, 1, 0], bool)

    assert _accuracy_by_range(values, right, (1, 2, 3, 5, math.inf), " m") == (
        ("1-2 m", 2, 0.5),
        ("2-3 m", 2, 1.0),
        ("5 m or more", 2, 0.5),
    )


def test_report_metrics_match_hand_calculation() -> None:
    """Six known views of three objects, and two unknown shapes, which count only for novelty."""
    posteriors = [[0.9, 0.1], [0.01, 0.99], [0.8, 0.2], [0.4, 0.6], [0.3, 0.7], [0.6, 0.4]]
    novelty = np.array([0.5, 1.5, 0.2, 0.1, 0.3, 2.0, 1.2, 0.8])
    predicted = SimpleNamespace(
        posteriors=np.array([*posteriors, [0.5, 0.5], [0.2, 0.8]]), novelty=novelty
    )
    categories = ("cup", "can")
    model: Any = SimpleNamespace(model_id="m", categories=categories, predict=lambda _: predicted)
    views = DescribedViews(
        np.zeros((8, 1), np.float32),
        np.array([*["cup"] * 4, "can", "can", "unknown", "unknown"]),
        np.array([f"x/{name}" for name in "acaabbuv"]),
        points=np.array([50, 60, 70, 130, 130, 130, 50, 50]),
        distances=np.array([0.5, 0.9, 0.9, 1.0, 1.2, 2.5, 0.5, 0.5]),
        skipped=3,
    )
    report = evaluate(views, model)

    assert (report.n, report.skipped, report.accuracy) == (6, 3, 0.5)
    assert report.recall == {"cup": 0.5, "can": 0.5}
    assert report.confusion == ((2, 2), (1, 1))
    assert report.rejected_known == pytest.approx(2 / 6)
    assert report.novelty == {"n": 2, "auroc": pytest.approx(8 / 12), "rejected": 0.5}
    # The views of a: 0.9 * 0.8 * 0.4 against 0.1 * 0.2 * 0.6. Fused with c, they would be a can.
    assert [(one.views, one.groups, one.accuracy) for one in report.fused] == [(3, 1, 1.0)]
    assert [row[:2] for row in report.by_distance] == [
        ("0-0.8 m", 1), ("0.8-1.1 m", 3), ("1.1-1.4 m", 1), ("1.7 m or more", 1)
    ]  # fmt: skip
    assert [row[:2] for row in report.by_points] == [("0-60", 1), ("60-120", 2), ("120-250", 3)]
    assert report.by_elevation == ()


def test_sensor_pose_is_relative_to_centre_of_object(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Views without a surface are left out of all columns, and counted."""
    eyes, centre = ([0.3, 0.4, 1.35], [9, 9, 9], [-0.5, 1.2, 0.15]), np.array([0.0, 0.0, 0.15])
    points = (np.array([[0.01, 0.02, -0.03], [-0.01, -0.02, 0.03]]) + centre).astype(np.float32)
    found = iter((0.1, None, 0.2))

    def describe(*_: object, **__: object) -> DescribedView | None:
        value = next(found)
        row = np.full(len(DESCRIPTOR_NAMES), value, np.float32)
        return None if value is None else DescribedView(row, 7)

    monkeypatch.setattr("shapecat.evaluation.views.describe_view", describe)
    dataset = [View(points, np.array(eye, float), "cup", f"mug{k}") for k, eye in enumerate(eyes)]
    views = describe_views(dataset, settings=Settings())

    assert (views.skipped, views.instances.tolist()) == (1, ["cup/mug0", "cup/mug2"])
    assert views.distances == pytest.approx([1.3, 1.3], abs=1e-6)
    assert views.elevations == pytest.approx([math.degrees(math.atan2(1.2, 0.5)), 0], abs=1e-5)
    assert views.descriptors[:, 0] == pytest.approx([0.1, 0.2])


def test_confusion_picture_has_true_categories_in_rows() -> None:
    """A transposed matrix would claim that cans are mistaken for cups."""
    root = ET.fromstring(confusion_svg(("cup", "can"), [[4, 3], [0, 7]]))  # noqa: S314  we drew it
    texts = {e.text: e.attrib for e in root.iter() if e.tag.endswith("text")}
    heads = [e.attrib for e in root.iter() if e.text == "can"]  # of its row and its column
    cup = next(e.attrib for e in root.iter() if e.text == "cup")

    assert texts["3"]["y"] == cup["y"]
    assert float(texts["3"]["x"]) == max(float(head["x"]) for head in heads)
    assert texts["7"]["y"] == heads[0]["y"] != cup["y"]
    assert "0" not in texts


def test_long_names_fit_into_confusion_picture() -> None:
    """Users add categories of any length; a column is only 46 pixels wide."""
    name = "a rather long category"
    svg = confusion_svg((name, "can"), [[4, 3], [0, 7]])
    (left, *_), heads = drawn(svg, "rect", "x")[0], drawn(svg, "text", "text", "transform")

    assert float(str(left)) > 6 * len(name)
    assert [rotation.split()[0] for text, rotation in heads if rotation] == ["rotate(-90"] * 2


def worked() -> Report:
    """Return a report whose metrics all differ, so that swapped ones are noticed."""
    return Report(
        model="m-7",
        n=57,
        categories=("cup", "can", "box"),
        accuracy=0.8123,
        balanced_accuracy=0.7234,
        ece=0.0456,
        recall={"cup": 0.6667, "can": 0.7777, "box": None},
        confusion=((12, 5, 1), (3, 28, 8), (0, 0, 0)),
        novelty={"n": 9, "auroc": 0.9348, "rejected": 0.5678},
        rejected_known=0.0234,
        skipped=4,
        calibration=(Bin(40, 0.9, 0.75), Bin(10, 0.6, 0.5)),
        by_distance=(("0-0.8 m", 11, 0.5), ("0.8-1.1 m", 44, 0.875)),
        by_points=(("0-60", 13, 0.25),),
        by_elevation=(("below 15°", 17, 0.125),),
        fused=(Fused(3, 19, 0.8877, 0.1122),),
        baselines=(Compared("forest", 140, 0.6657, 0.5544, None),),
    )


FIGURES = {
    "accuracy": "0.812",
    "balanced accuracy": "0.723",
    "calibration error": "0.046",
    "known shapes rejected": "0.023",
    "unknown shapes rejected": "0.568",
    "novelty AUROC": "0.935",
}
TABLES = [
    [["distance", "views", "accuracy"], ["0-0.8 m", "11", "0.500"], ["0.8-1.1 m", "44", "0.875"]],
    [["elevation", "views", "accuracy"], ["below 15°", "17", "0.125"]],
    [["points", "views", "accuracy"], ["0-60", "13", "0.250"]],
    [["views fused", "groups", "accuracy", "calibration error"], ["3", "19", "0.888", "0.112"]],
    [
        ["classifier", "training views", "accuracy", "balanced", "calibration error"],
        ["forest", "140", "0.666", "0.554"],
    ],
]  # fmt: skip


def test_printed_report_has_each_number_under_its_name() -> None:
    """A report with swapped metrics would look plausible."""
    first, *lines = format_report(worked()).splitlines()
    assert [line != "" for line in lines[:2]] == [False, True]
    cells = [re.split(r"\s{2,}", line.strip()) for line in lines if line.strip()]
    split = next(k for k, row in enumerate(cells) if row[0].startswith("rows:"))

    assert first == "57 views, model m-7; skipped 4 without a surface"
    assert cells[:split] == [*map(list, FIGURES.items())]
    head = next(k for k, row in enumerate(cells) if row[-1] == "recall")
    assert cells[split:head] == [["rows: true category; columns: predicted category"]]
    assert cells[head : head + 4] == [
        ["cup", "can", "box", "recall"],
        ["cup", "12", "5", "1", "0.667"],
        ["can", "3", "28", "8", "0.778"],
        ["box", ".", ".", ".", "-"],
    ]
    expected = [row for table in TABLES for row in table]
    expected[-1] = [*expected[-1], "-"]
    assert cells[head + 4 :] == expected


def test_printed_report_of_one_view_says_view() -> None:
    assert format_report(replace(worked(), n=1, skipped=0)).startswith("1 view, model m-7\n")


def test_printed_report_shows_long_and_odd_names_as_they_are() -> None:
    """Wrapped names are unreadable, and markup would change a name or end in a traceback."""
    names = ("cup [big]", "[/bold]", "box :car:", *(f"a rather long category {k}" for k in "abcde"))
    counts = tuple(tuple(100 * (i == k) for i in range(8)) for k in range(8))
    report = replace(worked(), categories=names, confusion=counts, recall=dict.fromkeys(names, 1.0))

    lines = [re.split(r"\s{2,}", line.strip()) for line in format_report(report).splitlines()]
    head = lines.index([*names, "recall"])
    assert [row[0] for row in lines[head + 1 : head + 9]] == list(names)
    assert {len(row) for row in lines[head + 1 : head + 9]} == {10}


def test_html_and_markdown_have_each_number_in_its_place() -> None:
    report = worked()
    page = format_page(report, title="a|b & c")
    names = {name: f"{name}.svg" for name in ("confusion", "calibration", "distance", "points")}
    names["elevation"] = "elevation.svg"
    text = format_markdown(report, title="a|b & c", pictures=names)
    recalls = [("recall of cup", "0.667"), ("recall of can", "0.778"), ("recall of box", "–")]
    figures = [("views", "57"), *FIGURES.items(), ("model", "m-7"), *recalls]
    tables = [[list(row) for row in figures], *TABLES]
    tables[-1] = [tables[-1][0], [*tables[-1][1], "–"]]
    heads = [
        "Confusion", "Calibration", "Accuracy by distance", "Accuracy by elevation",
        "Accuracy by points", "Several views of one object",
        "Classifiers trained on the same views",
    ]  # fmt: skip

    found = [
        [re.findall(r"<t[hd]>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", table)]
        for table in re.findall(r"<table>(.*?)</table>", page)
    ]
    assert found == tables
    assert re.findall(r"<title>(.*?)<|<h1>(.*?)<", page) == [
        ("a|b &amp; c", ""), ("", "a|b &amp; c")
    ]  # fmt: skip
    assert re.findall(r"<h2>(.*?)</h2>", page) == heads
    blocks = [block.splitlines() for block in text.strip().split("\n\n")]
    written = [
        [line.strip("| ").split(" | ") for line in block if "---" not in line]
        for block in blocks
        if block[0].startswith("|")
    ]
    assert written == [[[""], *tables[0]], *tables[1:]]  # the first table has an empty head
    assert [b[0].removeprefix("## ") for b in blocks if b[0].startswith("##")] == heads
    assert blocks[0] == ["# a\\|b &amp; c"]
    for content in (page, text):
        assert "Rows: true category; columns: predicted category." in content
        assert "On the diagonal, 80 % of the views with a confidence of 0.8 are right." in content
    assert re.findall(r"!\[(.*?)\]\((.*?)\)", text) == [
        ("Confusion", "confusion.svg"), ("Calibration", "calibration.svg"),
        ("Accuracy by distance", "distance.svg"), ("Accuracy by elevation", "elevation.svg"),
        ("Accuracy by points", "points.svg"),
    ]  # fmt: skip


def drawn(svg: str, kind: str, *names: str) -> list[tuple[str | None, ...]]:
    """Return attributes of all SVG elements of a ``kind``; the name `text` means their content."""
    found = [e for e in ET.fromstring(svg).iter() if e.tag.endswith(kind)]  # noqa: S314  ours
    return [tuple(e.text if n == "text" else e.get(n) for n in names) for e in found]


def test_report_pictures_are_drawn_to_scale() -> None:
    """Shades show fractions of a row; dot areas and bar thicknesses show numbers of views."""
    report = worked()
    cells = drawn(confusion_svg(report.categories, report.confusion), "rect", "x", "y", "fill")
    ink = np.array([31, 78, 121])
    rows = [(row, k, share) for row, count in enumerate(report.confusion)
            for k, share in enumerate(np.array(count) / max(sum(count), 1))]  # fmt: skip
    assert [(float(str(x)), float(str(y))) for x, y, _ in cells] == [
        (74 + 46 * k, 74 + 46 * row) for row, k, _ in rows
    ]
    shades = [tuple(np.round(255 + (ink - 255) * share).astype(int).tolist()) for *_, share in rows]
    assert [fill for *_, fill in cells] == [f"rgb{shade}" for shade in shades]
    texts = drawn(confusion_svg(report.categories, report.confusion), "text", "text", "fill")
    assert [item for item in texts if item[1]] == [
        ("12", "white"), ("5", "black"), ("1", "black"),
        ("3", "black"), ("28", "white"), ("8", "black"),
    ]  # fmt: skip

    curve = calibration_svg(report.calibration)
    assert drawn(curve, "circle", "cx", "cy", "r") == [
        (f"{46 + 224 * 0.9:.1f}", f"{18 + 224 * 0.25:.1f}", f"{2 + 14 * 0.8**0.5:.1f}"),
        (f"{46 + 224 * 0.6:.1f}", f"{18 + 224 * 0.5:.1f}", f"{2 + 14 * 0.2**0.5:.1f}"),
    ]
    assert drawn(curve, "line", "x1", "y1", "x2", "y2") == [("46.0", "242.0", "270.0", "18.0")]
    assert drawn(curve, "text", "text", "x", "y")[1:] == [
        ("accuracy", None, None),
        ("0", "46.0", "257.0"), ("0", "41.0", "246.0"),
        ("0.5", "158.0", "257.0"), ("0.5", "41.0", "134.0"),
        ("1", "270.0", "257.0"), ("1", "41.0", "22.0"),
    ]  # fmt: skip

    bars = accuracy_svg(report.by_distance)
    assert drawn(bars, "rect", "x", "y", "width", "height")[:-1] == [
        ("96", f"{17 - 9.5 / 2:.1f}", f"{328 * 0.5:.1f}", "9.5"),
        ("96", f"{51 - 26 / 2:.1f}", f"{328 * 0.875:.1f}", "26.0"),
    ]
    confusion = confusion_svg(report.categories, report.confusion)
    for picture, width, height in ((confusion, 212, 212), (curve, 290, 290), (bars, 480, 68)):
        whole = drawn(picture, "svg", "width", "height", "viewBox")  # otherwise they are cut off
        assert whole == [(str(width), str(height), f"0 0 {width} {height}")]
    assert drawn(bars, "text", "text", "y") == [
        ("0-0.8 m", "21.0"), ("0.500", "21.0"), ("0.8-1.1 m", "55.0"), ("0.875", "55.0")
    ]  # fmt: skip


def test_markdown_page_has_its_pictures_beside_it(trained: Path, tmp_path: Path) -> None:
    """A `|` in a name would break the table, and a missing file the picture."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball"), instances=2)
    report = evaluate_folder(dataset, trained)
    changed = replace(report, recall={"a|b": 1.0}, fused=(Fused(3, 4, 1.0, 0.25),))
    write_page(tmp_path / "out" / "all (2).md", changed, title="all")
    page = (tmp_path / "out" / "all (2).md").read_text("utf-8")

    # Spaces and brackets would end the link.
    pictures = re.findall(r"!\[[\w ]+\]\(([\w%.]+)\)", page)
    for name in pictures:
        ET.parse(tmp_path / "out" / unquote(name))  # noqa: S314  we wrote it
    assert page.count("![") == len(pictures) == 5
    assert "recall of a\\|b" in page
    assert "| 3 | 4 | 1.000 | 0.250 |" in page


@pytest.mark.parametrize("given", ["data", "."])
def test_command_writes_the_page(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    """The title of the page names the data set, even if it is given as `.`."""
    dataset = write_dataset(tmp_path / "data", ("box", "ball"), instances=2)
    monkeypatch.chdir(dataset if given == "." else tmp_path)
    page = tmp_path / "page.html"
    command = import_module("shapecat.cli.evaluate").evaluate
    result = CliRunner().invoke(
        command, [given, "--model", str(trained), "--report", str(page), "--json"]
    )

    assert result.exit_code == 0, result.output
    assert "data: 8 views" in page.read_text("utf-8")
    assert result.stderr == f"{page}\n"
    assert json.loads(result.stdout)["n"] == 8


def test_reports_of_other_formats_are_refused(tmp_path: Path) -> None:
    """HTML named .pdf opens nowhere; named .npz, it could replace a model."""
    page = tmp_path / "mine.npz"
    page.write_text("a model")
    command = import_module("shapecat.cli.evaluate").evaluate
    result = CliRunner().invoke(command, [str(tmp_path), "--report", str(page)])

    assert result.exit_code == 2
    assert "name it .html or .md" in result.output
    assert page.read_text() == "a model"


@pytest.fixture(scope="module")
def compared(
    trained: Path,
    few_trees: None,  # noqa: ARG001  in force while it compares
    tmp_path_factory: pytest.TempPathFactory,
) -> Report:
    folder = tmp_path_factory.mktemp("compared")
    dataset = write_dataset(folder / "data", ("box", "ball", "unknown"), instances=3, seed=9)
    return evaluate_folder(dataset, trained, baselines=dataset)


def test_baselines_are_compared_with_shapecat(compared: Report, tmp_path: Path) -> None:
    """All classifiers get the same views, but baselines do not learn from unknown shapes."""
    names = [item.learner for item in compared.baselines]

    assert names[:4] == ["shapecat", "forest", "linear", "pnn"]
    assert names[-2:] == ["forest on D2", "forest on D2, D3, A3 (ESF-like)"]
    assert all(item.accuracy == item.balanced_accuracy for item in compared.baselines)
    assert min(item.accuracy or 0 for item in compared.baselines) >= 0.75
    assert [item.learned for item in compared.baselines] == [12, *[8] * (len(names) - 1)]
    assert len(compared.as_dict()["baselines"]) == len(names)
    assert "forest on D2" in format_report(compared)
    write_page(tmp_path / "page.md", compared, title="compared")
    assert "| forest on D2 | 8 |" in (tmp_path / "page.md").read_text("utf-8")


def test_training_views_of_cross_validation_are_mean_over_folds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first fold's count was reported: far too low if it leaves out an object of many views."""
    sizes = {"cup": [3, 3, 3, 200], "can": [3, 4, 5, 6], "unknown": [8]}
    labels = np.repeat(list(sizes), [sum(views) for views in sizes.values()])
    objects = np.repeat(np.arange(9), np.concatenate(list(sizes.values()))).astype(str)
    nothing = np.zeros(len(labels))
    views = DescribedViews(nothing[:, None], labels, objects, nothing, nothing)

    def chain(_: Any, test: DescribedViews, __: Any) -> np.ndarray:
        return np.full((len(test.labels), 2), 0.5)

    learners = {"shapecat": (chain, True), "plain": (chain, False)}
    monkeypatch.setattr(baselines, "_learners", lambda: learners)
    rows = baselines.compare_learners(views, None, categories=("cup", "can"), root=Path("data"))

    # Each view is tested once, so that it is left out in one of the four folds.
    assert [row.learned for row in rows] == [round(235 * 3 / 4), round(227 * 3 / 4)]


def test_few_unknown_shapes_are_not_a_problem_for_cross_validation() -> None:
    """scikit-learn printed a warning that unknown shapes are too few for all folds."""
    labels, nothing = np.array([*["cup", "can"] * 3, "unknown"]), np.zeros(7)
    objects = np.arange(7).astype(str)
    views = DescribedViews(nothing[:, None], labels, objects, nothing, nothing)

    tested = [sorted(set(test.labels) - {"unknown"}) for _, test in baselines._folds(views)]

    assert tested == [["can", "cup"]] * 3


@pytest.mark.usefixtures("few_trees")
def test_baselines_may_have_their_own_training_set(trained: Path, tmp_path: Path) -> None:
    """A training set may have other categories, in another order: columns must match by name."""
    train = write_dataset(tmp_path / "train", ("ball", "box", "plate"), instances=3, seed=3)
    test = write_dataset(tmp_path / "test", ("box", "ball"), instances=2, seed=4)
    report = evaluate_folder(test, trained, baselines=train)

    assert all((item.accuracy or 0) >= 0.75 for item in report.baselines)
    assert {item.learned for item in report.baselines} == {18}


@pytest.mark.parametrize("name", ["box/box_1/0.npz", "box/renamed/7.npz"])
def test_baselines_are_not_tested_on_objects_they_learned(
    trained: Path, tmp_path: Path, name: str
) -> None:
    """Training on all runs and testing on one of them gave figures that were too good."""
    train = write_dataset(tmp_path / "train", ("ball", "box"), instances=3, seed=3)
    test = write_dataset(tmp_path / "test", ("ball", "box"), instances=2, seed=4)
    path = train / "box" / "box_1" / "0.npz"
    (test / name).parent.mkdir(exist_ok=True)
    shutil.copy(path, test / name)

    with pytest.raises(RecordingError, match=f"{path.name}: is also in .*test"):
        evaluate_folder(test, trained, baselines=train)


def test_baselines_are_not_tested_on_objects_in_linked_folders(
    trained: Path, tmp_path: Path
) -> None:
    """A training set made of links to the tested views gave figures that were too good."""
    test = write_dataset(tmp_path / "test", ("ball", "box"), instances=2, seed=4)
    (tmp_path / "train").mkdir()
    for name in ("ball", "box"):
        (tmp_path / "train" / name).symlink_to(test / name)

    with pytest.raises(RecordingError, match=r"is also in .*test"):
        evaluate_folder(test, trained, baselines=tmp_path / "train")


def test_baselines_need_two_objects_of_each_category(trained: Path, tmp_path: Path) -> None:
    """Views of a single object would be in training and test; the error names its category."""
    write_dataset(tmp_path / "data", ("box",), instances=2)
    dataset = write_dataset(tmp_path / "data", ("ball",), instances=1)

    with pytest.raises(RecordingError, match="of each category; with one only: ball"):
        evaluate_folder(dataset, trained, baselines=dataset)


def test_baselines_are_not_tested_on_unknown_shapes_alone(trained: Path, tmp_path: Path) -> None:
    """scikit-learn raises an error for empty input."""
    test = write_dataset(tmp_path / "test", ("unknown",), instances=1)
    train = write_dataset(tmp_path / "train", ("box", "ball"), instances=2)

    with pytest.raises(RecordingError, match="test: baselines need views with a category"):
        evaluate_folder(test, trained, baselines=train)


def test_accuracy_is_broken_down_by_sensor_pose(compared: Report) -> None:
    """From above, a can looks like a plate, which a single accuracy for all poses hides."""
    assert [name for name, _ in compared.breakdowns] == ["distance", "elevation", "points"]
    assert sum(count for _, count, _ in compared.by_elevation) == compared.n
    assert compared.by_elevation[0][0] == "30-45°"


def test_only_views_of_one_object_are_fused() -> None:
    """Views left over from groups of three must not be fused with those of another object."""
    truth = np.zeros(8, np.int64)
    posteriors = np.array([[0.9, 0.1], [0.45, 0.55], [0.45, 0.55]] * 2 + [[0, 1], [0, 1]], "f4")
    names = np.array(["a", "a", "a", "b", "b", "b", "c", "c"])

    fused = fuse_views(truth, posteriors, names)

    assert [item.views for item in fused] == [3]
    assert fused[0].groups == 2
    assert fused[0].accuracy == 1.0
    assert fused[0].ece == pytest.approx(0.355, abs=1e-3)
