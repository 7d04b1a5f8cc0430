"""A descriptor from the literature, for comparison."""

import numpy as np

from shapecat.arrays import F4

__all__ = ["shape_functions"]

_SAMPLES = 4096
"""Number of random samples in each histogram."""


def shape_functions(points: F4, rng: np.random.Generator) -> F4:
    """Return scale-invariant shape distributions (96,) of points (n, 3).

    These are three histograms of random samples: the distance between two points (D2), the root of
    the area of a triangle of three points (D3), and the angle at one of three points (A3). Each bin
    is a fraction of all samples. Distances and roots beyond 3 times their mean are in no bin.

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
    counts = [np.histogram(values, 32, (0.0, 3.0))[0] for values in scaled]
    return (np.concatenate(counts) / _SAMPLES).astype(np.float32)
