"""Atomic files and folders, locks, signals that ask to stop, and garbage collection."""
