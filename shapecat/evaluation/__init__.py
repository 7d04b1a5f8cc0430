"""Evaluation of models on labelled data sets, and of runs against a reference (thesis ch. 8)."""

from shapecat.evaluation.dataset import Dataset, View, read_dataset
from shapecat.evaluation.folder import evaluate_folder
from shapecat.evaluation.report import Report, evaluate, format_report

__all__ = [
    "Dataset",
    "Report",
    "View",
    "evaluate",
    "evaluate_folder",
    "format_report",
    "read_dataset",
]
