"""The old place of `shapecat.runs.finished`."""

from shapecat.runs.finished import FinishedRun, open_source

__all__ = ["FinishedRun", "open_source"]
