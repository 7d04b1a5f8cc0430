"""Baseline classifiers, and descriptors from the literature."""

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


def shape_functions(points: F4, rng: np.random.Generator, *, bins: int = 32) -> F4:
    """Return scale-invariant shape distributions (3 * bins,) of points (n, 3).

    These are three histograms, each with sum 1: the distance between two random points (D2), the
    root of the area of a triangle of three points (D3), both up to 3 times their mean, and the
    angle at one of three points (A3).

    Sources: Osada et al. 2002 for D2; Wohlkinger and Vincze 2011 for the ensemble (ESF); differs:
    lines between points are not classified as inside, outside or mixed.
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
