"""Merging: the segments of one object are joined again."""
