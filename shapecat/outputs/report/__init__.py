"""The report of a run as a page that works from a file, and served to correct tracks on disk."""

from shapecat.outputs.report.writing import Reports, read_reports, write_reports

__all__ = ["Reports", "read_reports", "write_reports"]
