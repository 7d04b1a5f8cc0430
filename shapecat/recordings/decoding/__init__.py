"""Decode messages to point clouds, depth images and colour images."""
