"""The report of a run: a page to open as a file, or to serve so that corrections are saved."""

from shapecat.outputs.report.writing import Reports, read_reports

__all__ = ["Reports", "read_reports"]
