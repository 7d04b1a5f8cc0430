"""Plain learners to print beside the full chain: the chain has to earn its place."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from shapecat.arrays import F4
from shapecat.learning.pnn import ProbabilisticNeuralNetwork

__all__ = ["distance_histogram", "make_baselines"]

_PAIRS = 4096


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


def distance_histogram(points: F4, rng: np.random.Generator, *, bins: int = 32) -> F4:
    """Return the distances between random pairs of points (n, 3), scale-free: (bins,), sum 1.

    The plain shape distribution D2, up to 3 times the mean distance (Osada et al. 2002): the
    baseline of descriptors.
    """
    first, second = rng.integers(0, len(points), (2, _PAIRS))
    distances = np.linalg.norm(points[first] - points[second], axis=1)
    counts, _ = np.histogram(distances / max(float(distances.mean()), 1e-9), bins, (0.0, 3.0))
    return (counts / _PAIRS).astype(np.float32)
