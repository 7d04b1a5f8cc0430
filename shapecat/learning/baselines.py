"""Simple learners as baselines of the full chain."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from sklearn.ensemble import RandomForestClassifier
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from shapecat.arrays import F4
from shapecat.learning.dictionary import ForestDictionary, WordLearner
from shapecat.learning.pnn import ProbabilisticNeuralNetwork

__all__ = ["make_baselines", "shape_functions"]

_SAMPLES = 4096


def make_baselines(
    blocks: Mapping[str, slice], *, seed: int, jobs: int | None = None
) -> dict[str, Callable[[], Any]]:
    """Return makers of unfitted baselines by name; all classify whole descriptors.

    ``forest`` votes directly, ``linear`` works on the standardised descriptor, ``pnn`` multiplies
    the Parzen densities of the blocks, ``forest words`` are the thesis's chain: the leaves of a
    forest grown on descriptor and densities, with linear one-versus-rest learners on top.
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


def shape_functions(points: F4, rng: np.random.Generator, *, bins: int = 32) -> F4:
    """Return plain shape distributions of points (n, 3), scale-free: (3 * bins,).

    Histograms, each of sum 1, of the distance of two random points (D2), the root of the area of
    the triangle of three (D3), both up to 3 times their mean, and the angle at one of three (A3).

    Sources: Osada et al. 2002 for D2; Wohlkinger and Vincze 2011 for the ensemble (ESF); differs:
    lines are not traced to be told inside, outside or mixed.
    """
    a, b, c = points[rng.integers(0, len(points), (3, _SAMPLES))].astype(np.float64)
    ab, ac = b - a, c - a
    distance = np.linalg.norm(ab, axis=1)
    area = np.sqrt(np.linalg.norm(np.cross(ab, ac), axis=1) / 2)
    norm = np.maximum(distance * np.linalg.norm(ac, axis=1), 1e-12)
    angle = np.arccos(np.clip((ab * ac).sum(axis=1) / norm, -1, 1)) * (3 / np.pi)
    scaled = (distance / max(distance.mean(), 1e-9), area / max(area.mean(), 1e-9), angle)
    counts = [np.histogram(values, bins, (0.0, 3.0))[0] for values in scaled]
    return (np.concatenate(counts) / _SAMPLES).astype(np.float32)
