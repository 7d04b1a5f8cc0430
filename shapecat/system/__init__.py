"""Atomic files and folders, locks, signals, progress, memory, standard streams, and imports."""
