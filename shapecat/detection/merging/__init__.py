"""Merging: join the segments of each object."""
