"""Tests of learning: the fitted pipeline, prediction, novelty and new categories."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse
from scipy.optimize import minimize
from sklearn.linear_model import LogisticRegression

from shapecat.arrays import F4
from shapecat.evaluation.baseline_classifiers import Densities, make_baselines
from shapecat.evaluation.shape_functions import shape_functions
from shapecat.learning import Categorizer
from shapecat.learning.boosted import BoostedEnsemble, grow_ensemble
from shapecat.learning.boosting import Tree, grow_tree
from shapecat.learning.calibration import fit_temperature, softmax
from shapecat.learning.features import fit_standardisation
from shapecat.learning.forest import FlatForest
from shapecat.learning.incremental import _STEPS, _fit_new, _Inputs, _shift, add_categories
from shapecat.learning.known_views import choose_evenly
from shapecat.learning.training import (
    Examples,
    LearningSettings,
    calibrate,
    encode,
    fit_categorizer,
)
from shapecat.system import stopping
from shapecat.types import UNKNOWN

NAMES = tuple(f"x{k}" for k in range(8))
BLOCKS = {"first": slice(0, 3), "second": slice(3, 8)}
CATEGORIES = ("cup", "can", "ball")
SMALL = LearningSettings(rounds=20, leaves=6, known_views=200)


def blobs(per_category: int, seed: int, categories: tuple[str, ...] = CATEGORIES) -> Examples:
    """Return views of 8 numbers around the centre of each category, two views per object."""
    rng = np.random.default_rng(seed)
    centres = {"cup": 0.0, "can": 2.0, "ball": 4.0, "cone": 6.0, "spoon": 8.0, UNKNOWN: -4.0}
    labels = np.repeat(categories, per_category)
    offsets = np.array([centres[label] for label in labels])[:, None]
    signs = np.array([1, -1, 1, 1, -1, 1, -1, 1])
    x = (offsets * signs + rng.normal(size=(labels.size, 8))).astype(np.float32)
    return Examples(x, labels, np.arange(labels.size) // 2)


def fit(settings: LearningSettings = SMALL, seed: int = 0) -> Categorizer:
    return fit_categorizer(
        blobs(60, 1, (*CATEGORIES, UNKNOWN)),
        blobs(40, 2),
        descriptor_names=NAMES,
        categories=CATEGORIES,
        settings=settings,
        seed=seed,
    )


@pytest.fixture(scope="module")
def categorizer() -> Categorizer:
    return fit()


def grow(x: F4, labels: np.ndarray, **options: Any) -> BoostedEnsemble:
    chosen = {"leaves": 4, "rate": 0.1, "jobs": None, **options}
    return grow_ensemble(x, labels, rng=np.random.default_rng(0), **chosen)


def logits_of(ensemble: BoostedEnsemble, x: F4) -> Any:
    return ensemble.leaf_values[ensemble.forest.apply(x)].sum(axis=1) + ensemble.bias


def test_trees_are_evaluated_to_the_leaf() -> None:
    """Values exactly at a threshold, or just above it, must not change sides."""
    data = blobs(50, 3)
    flat = grow(data.descriptors, encode(data.labels, CATEGORIES), rounds=10).forest
    at_thresholds = np.repeat(flat.threshold[flat.left > 0][:500, None], 8, axis=1)
    x = np.concatenate([data.descriptors, at_thresholds, np.nextafter(at_thresholds, np.inf)])

    leaf_ids = flat.apply(x)

    leaves = np.flatnonzero(flat.left == 0)
    for row, found in zip(x, leaf_ids, strict=True):
        for root, leaf_id in zip(flat.roots, found, strict=True):
            node = int(root)
            while flat.left[node]:
                node = int(flat.left[node]) + int(row[flat.feature[node]] > flat.threshold[node])
            assert leaves[leaf_id] == node


def test_prediction_matches_fitted_chain() -> None:
    """The compiled kernel is a second implementation and must give the same results.

    Its trees are checked by `test_trees_are_evaluated_to_the_leaf`.
    """
    test, model = blobs(50, 9), fit()
    leaf_ids = model.forest.apply(model.standardisation.standardise(test.descriptors))
    logits = model.leaf_values.astype(float)[leaf_ids].sum(axis=1) + model.bias

    prediction = model.predict(test.descriptors)

    expected = softmax(logits[:, :3] / model.temperature)
    np.testing.assert_allclose(prediction.posteriors, expected, atol=1e-6)
    doubt = softmax(logits / model.temperature)[:, 3]
    odds = np.log(doubt / (1 - doubt)) - model.threshold
    np.testing.assert_allclose(prediction.novelty, 2 / (1 + np.exp(-odds)), atol=1e-6)
    assert (
        np.mean(np.argmax(prediction.posteriors, axis=1) == encode(test.labels, CATEGORIES)) > 0.9
    )


def test_first_tree_makes_the_best_split(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model with inferior splits still learns, so that the gains of all are recalculated here."""
    data = blobs(40, 3, ("cup", "can"))
    x, y = data.descriptors, (data.labels == "can").astype(int)
    monkeypatch.setattr("shapecat.learning.boosted._COLUMNS", 1.0)
    monkeypatch.setattr("shapecat.learning.boosted._ROWS", 1.0)
    model = grow(x, y, rounds=1, leaves=2)
    gradient, hessian = (
        0.5 - (y == 0),
        np.full(len(y), 0.5),
    )  # both categories have half of the views
    gains = {}
    for feature in range(8):
        for cut in np.quantile(x[:, feature], np.linspace(0, 1, 65)[1:-1]).astype(np.float32):
            low = x[:, feature] <= cut
            gains[feature, cut] = sum(
                gradient[part].sum() ** 2 / (hessian[part].sum() + 2) for part in (low, ~low)
            )
    feature, cut = max(gains, key=lambda key: gains[key])
    left = x[:, feature] <= cut
    step = [-0.1 * gradient[part].sum() / (hessian[part].sum() + 2) for part in (left, ~left)]

    assert (int(model.forest.feature[0]), float(model.forest.threshold[0])) == (feature, cut)
    np.testing.assert_allclose(model.leaf_values[:2, 0], step, rtol=2e-3)


def test_growing_trees_can_be_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    """With many categories, growing takes minutes; a stopped command would still write a model."""
    monkeypatch.setattr(stopping, "_received", [])
    grown = []

    def grow_one(*inputs: Any) -> Tree:
        grown.append(inputs)
        if len(grown) == 5:  # in the second of twenty rounds
            stopping.request()
        return grow_tree(*inputs)

    monkeypatch.setattr("shapecat.learning.boosted.grow_tree", grow_one)
    with pytest.raises(stopping.Stopped):
        fit()
    assert len(grown) == 8


def test_more_rounds_reduce_the_training_loss() -> None:
    """With a wrong derivative, training still learns a little, but overshoots or stalls."""
    data = blobs(50, 1)
    codes = encode(data.labels, CATEGORIES)
    losses = []
    for rounds in (1, 5, 20, 60):
        model = grow(data.descriptors, codes, rounds=rounds)
        posteriors = softmax(logits_of(model, data.descriptors))
        losses.append(-np.log(posteriors[np.arange(len(codes)), codes]).mean())

    assert all(later < 0.8 * earlier for earlier, later in itertools.pairwise(losses))


def test_model_is_reproducible_for_any_number_of_jobs() -> None:
    assert fit(seed=0).model_id == fit(replace(SMALL, jobs=2), seed=0).model_id
    assert fit(seed=0).model_id != fit(seed=1).model_id


@pytest.mark.parametrize("x", [np.zeros((2, 7)), np.full((1, 8), np.nan), np.zeros(8)])
def test_invalid_descriptors_are_rejected(categorizer: Categorizer, x: F4) -> None:
    with pytest.raises(ValueError, match="descriptors"):
        categorizer.predict(x)


def test_empty_input_gives_empty_prediction(categorizer: Categorizer) -> None:
    prediction = categorizer.predict(np.zeros((0, 8), np.float32))

    assert prediction.posteriors.shape == (0, 3)
    assert prediction.novelty.shape == (0,)


def test_unknown_shapes_are_more_novel_than_known_ones(categorizer: Categorizer) -> None:
    known = categorizer.predict(blobs(100, 6).descriptors).novelty
    unknown = categorizer.predict(blobs(100, 6, (UNKNOWN,)).descriptors).novelty

    assert np.mean(known > 1) < 0.08  # 5 % on the held-out views by construction
    assert np.mean(unknown > 1) > 0.8


def test_uncertain_views_are_novel_without_unknown_examples() -> None:
    """A model that did not learn `unknown` cannot predict it: novelty must come from confidence."""
    model = fit_categorizer(
        blobs(60, 1), blobs(4000, 2), descriptor_names=NAMES, categories=CATEGORIES,
        settings=SMALL,
    )  # fmt: skip
    prediction = model.predict(blobs(4000, 6).descriptors)
    order = np.argsort(prediction.novelty)

    assert not model.knows_unknown
    assert np.mean(prediction.novelty > 1) == pytest.approx(0.05, abs=0.01)
    assert np.all(np.diff(prediction.posteriors.max(axis=1)[order]) <= 1e-6)


def test_shape_functions_are_normalized_and_scale_invariant() -> None:
    """On a line, all triangles are flat: their angles are 0 or 180 degrees."""
    rng = np.random.default_rng(0)
    line = np.outer(rng.uniform(size=500), [1.0, 2.0, 0.0]).astype(np.float32)
    functions = shape_functions(line, np.random.default_rng(1))

    assert functions.shape == (96,)
    np.testing.assert_allclose(functions.reshape(3, 32).sum(axis=1), 1, atol=0.05)
    np.testing.assert_allclose(
        functions, shape_functions(line * 7, np.random.default_rng(1)), atol=2e-3
    )
    assert functions[[64, 95]].sum() > 0.95


def test_densities_match_their_formula() -> None:
    """Distances, blocks and categories are easily mixed up in flat arrays."""
    rng = np.random.default_rng(1)
    x, y = rng.normal(size=(30, 5)).astype(np.float32), np.arange(30) % 2
    blocks = (slice(0, 2), slice(2, 5))
    fitted = Densities(x, y, blocks, 15)
    new = rng.normal(size=(4, 5)).astype(np.float32)
    found, z = fitted.log_densities(new), fitted.standardise(new)
    np.testing.assert_allclose(z, (new - x.mean(axis=0)) / x.std(axis=0), atol=1e-4)
    for c in range(2):
        own = fitted.standardise(x[y == c])  # each view has a kernel
        for b, block in enumerate(blocks):
            squared = ((z[:, None, block] - own[:, block]) ** 2).sum(axis=2)
            density = np.exp(-squared / (2 * fitted.widths[b] ** 2)).mean(axis=1)
            expected = (np.log(density) - fitted.mean[b]) / fitted.deviation[b]
            np.testing.assert_allclose(found[:, c, b], np.clip(expected, -8, 8), atol=1e-9)


def test_density_of_training_view_leaves_out_the_view_itself() -> None:
    """Otherwise densities would be much higher in training than in use."""
    data = blobs(60, 1)
    fitted = Densities(data.descriptors, data.labels, tuple(BLOCKS.values()), 60)
    views = (data.descriptors, blobs(60, 2).descriptors)
    own, new = (fitted.log_densities(x).max(axis=1).mean() for x in views)

    assert abs(own - new) < 0.3


def test_constant_features_become_zero() -> None:
    """A histogram bin that is always empty has a standard deviation of 0: division gives NaN."""
    data = blobs(30, 1)
    x = data.descriptors.copy()
    x[:, 2] = 7.0
    blocks = tuple(BLOCKS.values())
    z = fit_standardisation(x).standardise(x)

    assert np.all(np.isfinite(z))
    assert np.all(z[:, 2] == 0)
    assert np.all(np.isfinite(Densities(x, data.labels, blocks, 100).log_densities(x)))


@settings(deadline=None, max_examples=20)
@given(st.floats(0.2, 5.0), st.integers(0, 1000))
def test_temperature_is_recovered(temperature: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    logits = rng.normal(size=(4000, 5)) * 2
    above = rng.random((4000, 1)) > np.cumsum(softmax(logits), axis=1)
    labels = above[:, :4].sum(axis=1)

    fitted = fit_temperature(logits * temperature, labels, len(labels))
    assert fitted == pytest.approx(temperature, rel=0.12)


@pytest.mark.parametrize("objects", [1, 8, 98])
def test_confidence_is_limited_by_number_of_held_out_objects(objects: int) -> None:
    """If all held-out views are right, the best fit is a confidence of 1, even for later errors."""
    logits = np.eye(3)[np.arange(30) % 3] * 6.0
    temperature = fit_temperature(logits, np.arange(30) % 3, objects)

    confidence = softmax(logits / temperature).max(axis=1)
    assert confidence == pytest.approx((objects + 1) / (objects + 2), abs=1e-4)


@pytest.mark.parametrize(("names", "fitted"), [(("cup",), False), (("cup", "can"), True)])
def test_temperature_needs_views_of_half_of_the_categories(
    categorizer: Categorizer, names: tuple[str, ...], fitted: bool
) -> None:
    """Views of one category say nothing about the others."""
    model = calibrate(categorizer, blobs(20, 2, names), rejected=0.05)

    assert (model.temperature != 1.0) == fitted
    assert model.threshold != categorizer.threshold


@pytest.mark.usefixtures("few_trees")
def test_baselines_learn() -> None:
    train, test = blobs(60, 1), blobs(40, 2)
    for name, make in make_baselines(tuple(BLOCKS.values())).items():
        fitted = make().fit(train.descriptors, train.labels)
        predicted = fitted.classes_[fitted.predict_proba(test.descriptors).argmax(axis=1)]
        assert np.mean(predicted == test.labels) > 0.9, name


def test_known_views_are_chosen_evenly() -> None:
    """A category with many views must not push the others out of the model."""
    codes = np.repeat([0, 1, 2], [1000, 10, 500])

    chosen = choose_evenly(codes, 40, np.random.default_rng(0))

    assert np.bincount(codes[chosen]).tolist() == [15, 10, 15]


def test_category_without_views_raises() -> None:
    with pytest.raises(ValueError, match="no training views of ball"):
        fit_categorizer(
            blobs(20, 1, ("cup", "can")),
            blobs(5, 2),
            descriptor_names=NAMES,
            categories=CATEGORIES,
            settings=SMALL,
        )


def test_new_category_is_learned_on_fixed_trees(categorizer: Categorizer) -> None:
    """The old leaf values stay, bit for bit, and the old categories are still recognised."""
    new = blobs(30, 7, ("cone",))
    extended = add_categories(
        categorizer, new.descriptors, new.labels.tolist(), rng=np.random.default_rng(0)
    )
    test = blobs(100, 8, (*CATEGORIES, "cone"))
    prediction = extended.predict(test.descriptors)
    correct = prediction.posteriors.argmax(axis=1) == encode(test.labels, extended.categories)

    assert extended.categories == (*CATEGORIES, "cone")
    assert np.array_equal(
        extended.leaf_values[:, [0, 1, 2, 4]], categorizer.leaf_values
    )  # unknown stays last
    assert np.array_equal(extended.bias[[0, 1, 2, 4]], categorizer.bias)
    assert np.array_equal(extended.forest.threshold, categorizer.forest.threshold)
    assert correct[test.labels == "cone"].mean() > 0.9
    assert correct[test.labels != "cone"].mean() > 0.9
    assert np.mean(prediction.novelty[test.labels == "cone"] > 1) < 0.2
    unknown = extended.predict(blobs(100, 6, (UNKNOWN,)).descriptors).novelty
    assert np.mean(unknown > 1) > 0.8


def test_learning_new_categories_can_be_interrupted(
    categorizer: Categorizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stopped `learn` would go on for seconds, replace the model and end with exit code 0."""
    monkeypatch.setattr(stopping, "_received", [])
    losses = []

    def minimize_and_stop(loss: Any, start: Any, **options: Any) -> Any:
        losses.append(loss)
        stopping.request()
        return minimize(loss, start, **options)

    monkeypatch.setattr("shapecat.learning.incremental.minimize", minimize_and_stop)
    new = blobs(30, 7, ("cone",))
    with pytest.raises(stopping.Stopped):
        add_categories(
            categorizer, new.descriptors, new.labels.tolist(), rng=np.random.default_rng(0)
        )
    assert len(losses) == 1


def test_categories_can_be_added_twice(categorizer: Categorizer) -> None:
    """The model must keep the data that the next addition needs."""
    rng = np.random.default_rng(0)
    cone = blobs(20, 7, ("cone",))
    once = add_categories(categorizer, cone.descriptors, ["cone"] * 20, rng=rng)
    far = cone.descriptors + 5
    twice = add_categories(once, far, ["spoon"] * 20, rng=rng)

    assert twice.categories[-2:] == ("cone", "spoon")
    assert twice.notes == {**categorizer.notes, "added": ["cone", "spoon"]}
    assert once.notes["added"] == ["cone"]
    assert np.mean(twice.predict(far).posteriors.argmax(axis=1) == 4) > 0.9
    with pytest.raises(ValueError, match="no new category"):
        add_categories(twice, far, ["spoon"] * 20, rng=rng)


def test_learning_stores_a_limited_number_of_views(
    categorizer: Categorizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With all views of large data sets, the model file would be too large to be read."""
    monkeypatch.setattr("shapecat.learning.incremental.KNOWN_VIEWS", 120)
    new = blobs(90, 7, ("cone", "spoon"))
    model = add_categories(
        categorizer, new.descriptors, new.labels.tolist(), rng=np.random.default_rng(0)
    )

    assert np.bincount(categorizer.known_category).tolist() == [50] * 4  # the last are unknown
    assert np.bincount(model.known_category).tolist() == [20] * 6
    z = categorizer.standardisation.standardise(new.descriptors).astype(np.float16)
    before = categorizer.known_descriptors[categorizer.known_category == 3]
    for code, views in ((3, z[new.labels == "cone"]), (4, z[new.labels == "spoon"]), (5, before)):
        stored = model.known_descriptors[model.known_category == code]
        assert all(np.any(np.all(row == views, axis=1)) for row in stored)


@pytest.mark.parametrize("added", [5, None, {"cone": 1}])
def test_any_notes_of_a_model_can_be_extended(categorizer: Categorizer, added: Any) -> None:
    """Model files are untrusted, and notes are not checked: `learn` ended with a traceback."""
    model = replace(categorizer, notes={"added": added})
    cone = blobs(20, 7, ("cone",))
    learned = add_categories(model, cone.descriptors, ["cone"] * 20, rng=np.random.default_rng(0))

    assert learned.notes == {"added": ["cone"]}


@pytest.mark.parametrize("left", [[1, 1, 0], [1, 0], [2, 0, 0], [1, 2, 3, 0, 0]])
def test_cyclic_trees_are_rejected(left: list[int]) -> None:
    """Branches that meet again are rejected, too: their paths double with every level."""
    zeros = np.zeros(len(left), int)

    with pytest.raises(ValueError, match="damaged"):
        FlatForest(np.array([0]), zeros, zeros.astype(float), np.array(left))


@pytest.mark.parametrize("rejected", [0.05, 0.2])
def test_novelty_threshold_rejects_requested_share(rejected: float) -> None:
    """The share is exact on the calibration views and approximate on new ones."""
    model = calibrate(fit(), blobs(4000, 2), rejected=rejected)
    calibrated, fresh = (
        model.predict(blobs(4000, seed).descriptors).novelty > 1 for seed in (2, 3)
    )

    assert np.mean(calibrated) == pytest.approx(rejected, abs=0.003)
    assert np.mean(fresh) == pytest.approx(rejected, abs=0.2 * rejected)


def test_confidence_grows_with_objects_rather_than_views(categorizer: Categorizer) -> None:
    """If all views are right, their number says little: a video has hundreds of one object."""
    views = blobs(4, 2)
    found = categorizer.predict(views.descriptors).posteriors.argmax(axis=1)
    views = views.where(found == encode(views.labels, categorizer.categories))
    video = views.where(np.repeat(np.arange(len(views.labels)), 30))
    names = np.array([f"{k}" for k in range(len(video.labels))])
    one, same, more = (
        calibrate(categorizer, seen, rejected=0.05).temperature
        for seen in (views, video, video._replace(instances=names))
    )
    assert one == pytest.approx(same, rel=1e-4)
    assert more < 0.9 * one


def test_unknown_shapes_do_not_affect_calibration(categorizer: Categorizer) -> None:
    """Counted as known, unknown views would loosen the threshold."""
    known = blobs(60, 2)
    mixed = blobs(60, 2, (*CATEGORIES, UNKNOWN))  # the same views, and 60 unknown ones
    assert np.array_equal(mixed.descriptors[: len(known.labels)], known.descriptors)
    mixed = mixed.where(np.random.default_rng(3).permutation(len(mixed.labels)))
    one, other = (calibrate(categorizer, views, rejected=0.05) for views in (known, mixed))

    assert one.threshold == other.threshold != categorizer.threshold
    assert one.temperature == pytest.approx(other.temperature, rel=1e-5)
    assert one.temperature != 1


def test_unknown_shapes_do_not_raise_confidence(categorizer: Categorizer) -> None:
    """If all views are right, confidence grows with the objects; unknown ones must not count."""
    mixed = blobs(4, 2, (*CATEGORIES, UNKNOWN))
    truth = encode(mixed.labels, categorizer.categories)
    right = categorizer.predict(mixed.descriptors).posteriors.argmax(axis=1) == truth
    known, mixed = mixed.where(right), mixed.where(right | (truth < 0))
    assert len(np.unique(mixed.instances)) > len(np.unique(known.instances))
    one, other = (calibrate(categorizer, views, rejected=0.05) for views in (known, mixed))

    assert one.temperature == other.temperature


def test_shift_of_new_categories_uses_correct_held_out_views(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Wrong views cannot be lost to a new category, and views of the fit are predicted too well.

    Each fit leaves out only one part: on fewer views, the classifier would be worse.
    """
    count = 200
    rows = np.arange(count, dtype=np.float64)[:, None]
    inputs = _Inputs(rows, sparse.csr_array((count, 1)))
    margins = 1.0 + rows[:, 0] / count
    truth = np.zeros(count, np.int64)
    old = np.stack([margins, np.zeros(count)], axis=1)
    old[::2] = [0.0, 0.01]  # every other view is mistaken for another category
    fitted_on: list[set[float]] = []

    def fit_new(some: _Inputs, *_: object) -> Any:
        fitted_on.append(set(some.features[:, 0]))
        return np.zeros((3, 1))

    def logits(some: _Inputs, _: object) -> Any:
        assert not fitted_on[-1] & set(some.features[:, 0])
        return np.zeros((len(some.features), 1))

    monkeypatch.setattr("shapecat.learning.incremental._fit_new", fit_new)
    monkeypatch.setattr("shapecat.learning.incremental._logits", logits)
    shift = _shift(inputs, old, truth, np.zeros((3, 1)), 0.1, np.random.default_rng(0))

    assert len(fitted_on) > 1
    assert sum(map(len, fitted_on)) == (len(fitted_on) - 1) * count  # all but one part each
    assert shift == pytest.approx(float(np.quantile(margins[1::2], 0.004)))


@pytest.mark.parametrize("l2", [1e-1, 1e-2])
def test_classifier_of_new_category_matches_scikit_learn(l2: float) -> None:
    """The logit of the old category is zero. Too few iterations would not converge."""
    rng, count = np.random.default_rng(4), 300
    truth = (np.arange(count) % 5 == 0).astype(np.int64)
    features = rng.normal(truth[:, None] * [1, 0.5, 0.2, 0, -2], [1, 3, 0.1, 10, 1])
    leaves = (rng.random((count, 10)) < 0.3).astype(np.float64)
    start = np.zeros((features.shape[1] + leaves.shape[1] + 1, 1))
    inputs = _Inputs(features, sparse.csr_array(leaves))
    learned = _fit_new(inputs, np.zeros((count, 1)), truth, start, l2, _STEPS)

    exact = LogisticRegression(C=1 / l2, tol=1e-10, max_iter=10_000).fit(
        np.hstack([features, leaves]), truth, sample_weight=0.5 / np.bincount(truth)[truth]
    )
    weights = [*exact.coef_[0], *exact.intercept_]
    assert np.max(np.abs(weights)) > 1
    assert learned[:, 0] == pytest.approx(weights, abs=0.002)


def test_shift_raises_only_odds_of_new_categories(
    categorizer: Categorizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the shift, a category that was learned from few views is seldom predicted."""
    new = blobs(30, 7, ("cone", "spoon"))
    x = blobs(50, 8, (*CATEGORIES, "cone", "spoon")).descriptors
    log_odds = []
    for shift in (0.0, 1.25):
        monkeypatch.setattr("shapecat.learning.incremental._shift", lambda *_, c=shift: c)
        model = add_categories(
            replace(categorizer, temperature=1.6),
            new.descriptors,
            new.labels.tolist(),
            rng=np.random.default_rng(0),
        )
        log_odds.append(np.log(model.predict(x / 4).posteriors))
    rise = log_odds[1] - log_odds[0]
    assert rise[:, 3:] - rise[:, :1] == pytest.approx(1.25, abs=1e-3)
    assert rise[:, :3] - rise[:, :1] == pytest.approx(0, abs=1e-3)
