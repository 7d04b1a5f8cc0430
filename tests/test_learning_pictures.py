"""Tests of the pictures of the worst mistakes on the model card."""

from pathlib import Path

import numpy as np
from PIL import Image

from shapecat.evaluation import View
from shapecat.learning import Categorizer
from shapecat.learning.categorizer import Prediction
from shapecat.models.pictures import draw, worst_mistakes
from shapecat.models.simulated_views import SimulatedView


class Oracle:
    """A model that reads its answer from the descriptor: posterior of cup, then novelty."""

    categories = ("cup", "box")

    def predict(self, descriptors: np.ndarray) -> Prediction:
        """Return the predictions that the descriptors encode."""
        cup = descriptors[:, 0]
        return Prediction(np.stack([cup, 1 - cup], axis=1), descriptors[:, 1])


def seen(label: str, instance: str, cup: float, novelty: float) -> SimulatedView:
    points = np.random.default_rng(0).normal(0, 0.03, (200, 3)) + np.array([0, 0, 0.05])
    view = View(points, np.array([0.5, 0.0, 0.5]), label, instance)
    descriptor = np.array([cup, novelty], np.float32)
    return SimulatedView(
        descriptor, label, instance, 200, 0.7, "upright", "truth", 1.0, 1.0, "kinect", view,
    )  # fmt: skip


def test_worst_mistakes_are_most_confident_and_one_per_object(tmp_path: Path) -> None:
    views = [
        seen("box", "a", 0.7, 0.2),  # mistaken for a cup
        seen("box", "a", 0.9, 0.2),  # the same object, more confident
        seen("cup", "b", 0.9, 1.96),  # called unknown
        seen("cup", "c", 0.9, 0.1),  # right
        seen("unknown", "d", 0.5, 1.5),  # right
    ]
    model: Categorizer = Oracle()  # type: ignore[assignment]
    found = worst_mistakes(views, model)

    assert [(m.simulated.instance, m.predicted) for m in found] == [("b", "unknown"), ("a", "cup")]
    assert found[0].confidence > found[1].confidence > 0.8 * 0.9
    draw(tmp_path / "worst.png", found)
    with Image.open(tmp_path / "worst.png") as picture:
        assert np.asarray(picture.convert("L")).std() > 5


def test_number_of_mistakes_is_limited() -> None:
    views = [seen("box", str(k), 0.9, 0.0) for k in range(9)]
    model: Categorizer = Oracle()  # type: ignore[assignment]

    assert len(worst_mistakes(views, model, count=4)) == 4
