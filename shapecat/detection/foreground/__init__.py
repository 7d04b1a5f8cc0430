"""Foreground: low-profile objects, walls and overhang, where height over a plane is not enough."""
