"""Meshes of objects: the seven categories, and objects that belong to none."""
