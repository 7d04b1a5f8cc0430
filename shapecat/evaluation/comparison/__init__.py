"""Comparison of a run's labels with another run or with other labels."""

from shapecat.evaluation.comparison.comparing import Comparison, compare

__all__ = ["Comparison", "compare"]
