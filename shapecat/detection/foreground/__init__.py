"""Foreground segmentation where height above the plane is not enough."""
