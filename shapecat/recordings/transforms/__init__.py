"""Transforms between frames, poses of cameras, and the up direction."""
