"""The labels of two runs, or of a run and other labels, compared."""

from shapecat.evaluation.comparison.comparing import Comparison, compare

__all__ = ["Comparison", "compare"]
