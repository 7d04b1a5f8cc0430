"""Simulated depth cameras: rendering, and the errors of each sensor."""
