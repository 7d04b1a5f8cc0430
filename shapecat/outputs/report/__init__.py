"""The report of a run: a page to open as a file, or served to write corrections to disk."""

from shapecat.outputs.report.writing import Reports, read_reports, write_reports

__all__ = ["Reports", "read_reports", "write_reports"]
