"""Lens distortion, and the records of colour cameras and their images."""
