"""More trees for a model: correct predictions stay, errors are corrected."""

import numpy as np
import pytest

from shapecat.learning import Categorizer
from shapecat.learning.growing import grow_on, widened
from shapecat.learning.training import Examples, LearningSettings, fit_categorizer
from shapecat.types import UNKNOWN

NAMES = ("a", "b", "c", "d")
LONGER = ("a", "b", "new", "c", "d")
SETTINGS = LearningSettings(rounds=12, leaves=6, rate=0.3, known_views=60)


def examples(shift: float, seed: int, names: tuple[str, ...] = NAMES) -> Examples:
    """Return views of two categories and of none; ``shift`` moves all of them along c."""
    rng = np.random.default_rng(seed)
    labels = np.array(["cup", "box", UNKNOWN])[rng.integers(3, size=600)]
    x = rng.normal(0, 0.3, (600, len(names))).astype(np.float32)
    middle = {"cup": 0.0, "box": 1.5, UNKNOWN: 3.0}
    x[:, names.index("c")] += [middle[name] + shift for name in labels]
    return Examples(x, labels, np.arange(600).astype(str))


@pytest.fixture(scope="module")
def model() -> Categorizer:
    return fit_categorizer(
        examples(0.0, 1),
        examples(0.0, 2),
        descriptor_names=NAMES,
        blocks={"all": slice(0, 4)},
        categories=("cup", "box"),
        settings=SETTINGS,
    )


def accuracy(model: Categorizer, views: Examples) -> float:
    known = views.where(views.labels != UNKNOWN)
    best = model.predict(known.descriptors).posteriors.argmax(axis=1)
    return float(np.mean(np.array(model.categories)[best] == known.labels))


def test_more_trees_learn_what_was_wrong(model: Categorizer) -> None:
    grown = grow_on(model, examples(1.2, 3), settings=SETTINGS, seed=0)

    assert accuracy(model, examples(1.2, 4)) < 0.7
    assert accuracy(grown, examples(1.2, 4)) > 0.9
    count = len(model.forest.roots)
    assert np.array_equal(grown.forest.roots[:count], model.forest.roots)
    assert np.array_equal(grown.votes[: len(model.votes)], model.votes)
    assert len(grown.forest.roots) == 2 * count


def test_growing_twice_gives_the_same(model: Categorizer) -> None:
    one, two = (grow_on(model, examples(1.2, 3), settings=SETTINGS, seed=5) for _ in range(2))

    assert one.model_id == two.model_id


def test_new_components_change_no_prediction(model: Categorizer) -> None:
    """Trees name features by number: the old ones must stay where they are."""
    views = examples(0.4, 5, LONGER)
    old = np.delete(views.descriptors, LONGER.index("new"), axis=1)
    blocks = {"all": slice(0, 2), "new": slice(2, 3), "more": slice(3, 5)}
    wider = widened(
        model, views, descriptor_names=LONGER, blocks=blocks, used=("all", "new", "more")
    )

    before, after = model.predict(old), wider.predict(views.descriptors)
    assert np.array_equal(before.posteriors, after.posteriors)
    assert np.array_equal(before.novelty, after.novelty)
    assert wider.bank.mean[-1] == pytest.approx(views.descriptors[:, 2].mean(), abs=1e-4)


def test_a_descriptor_that_lost_a_component_is_refused(model: Categorizer) -> None:
    with pytest.raises(ValueError, match="the descriptor lacks d"):
        widened(
            model,
            examples(0.0, 1),
            descriptor_names=NAMES[:3],
            blocks={"all": slice(0, 3)},
            used=("all",),
        )
