"""Merging: segments that are of one object come together again."""
