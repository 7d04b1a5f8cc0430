"""Foreground: low-profile objects, walls and overhang, where height over a plane is not enough.

A *low cell* is on a plane, or less than `LowProfileSettings.low_m` above it.
"""
