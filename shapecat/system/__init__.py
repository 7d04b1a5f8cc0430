"""Atomic files and folders, locks, signals that ask to stop, progress, and garbage collection."""
