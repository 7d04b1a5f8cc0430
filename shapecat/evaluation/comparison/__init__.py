"""Comparison of a run's labels with ground truth, labels of other tools, or another run."""

from shapecat.evaluation.comparison.comparing import Comparison, compare

__all__ = ["Comparison", "compare"]
