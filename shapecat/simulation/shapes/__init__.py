"""Meshes of objects: the seven categories, and what belongs to none."""
