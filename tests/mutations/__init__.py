"""Operators that are flipped on purpose, to see whether a test notices."""
