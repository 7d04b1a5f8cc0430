"""Evaluation (thesis ch. 8): tables and figures for any model and labelled data set."""

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
