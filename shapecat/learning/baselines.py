"""Plain learners to print beside the full chain: the chain has to earn its place."""

from collections.abc import Callable, Mapping
from typing import Any

from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from shapecat.learning.pnn import ProbabilisticNeuralNetwork

__all__ = ["make_baselines"]


def make_baselines(
    blocks: Mapping[str, slice], *, seed: int, jobs: int | None = None
) -> dict[str, Callable[[], Any]]:
    """Return makers of unfitted baselines by name; all classify whole descriptors.

    ``forest`` votes directly, ``linear`` works on the standardised descriptor, ``pnn`` multiplies
    the Parzen densities of the blocks.
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
    }
