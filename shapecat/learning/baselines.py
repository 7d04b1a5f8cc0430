"""Baseline classifiers."""

from collections.abc import Callable, Mapping
from typing import Any

from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from shapecat.learning.dictionary import ForestDictionary, WordLearner
from shapecat.learning.pnn import ProbabilisticNeuralNetwork

__all__ = ["make_baselines"]


def make_baselines(
    blocks: Mapping[str, slice], *, seed: int, jobs: int | None = None
) -> dict[str, Callable[[], Any]]:
    """Return functions that make unfitted baselines, by name; all classify whole descriptors.

    ``forest`` is a random forest; ``linear`` is logistic regression on the standardised descriptor;
    ``pnn`` multiplies the Parzen densities of the blocks; ``forest words`` is the method of the
    thesis: linear one-versus-rest classifiers on the leaves of a forest that is grown on the
    descriptor and its densities.

    Parameters
    ----------
    blocks : range of each block in the descriptor, by name.
    jobs : number of trees grown at the same time.
    """
    spans = {name: (part.start, part.stop) for name, part in blocks.items()}
    return {
        "forest": lambda: RandomForestClassifier(
            400, min_samples_leaf=2, class_weight="balanced", n_jobs=jobs, random_state=seed
        ),
        "linear": lambda: make_pipeline(
            StandardScaler(), LogisticRegression(C=0.1, class_weight="balanced", max_iter=2000)
        ),
        "pnn": lambda: ProbabilisticNeuralNetwork(spans, kernels=300, random_state=seed),
        "forest words": lambda: make_pipeline(
            ProbabilisticNeuralNetwork(spans, kernels=50, random_state=seed),
            ForestDictionary(trees=100, jobs=jobs, random_state=seed),
            WordLearner(strategy="one_vs_rest", C=0.03),
        ),
    }
