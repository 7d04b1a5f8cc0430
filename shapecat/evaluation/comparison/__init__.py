"""The labels of two runs, or of a run and other labels, compared."""
