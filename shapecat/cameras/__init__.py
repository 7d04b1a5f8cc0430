"""Cameras beyond the pinhole: lenses with distortion, and the images of colour."""
