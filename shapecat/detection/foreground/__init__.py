"""Foreground segmentation where the height above the plane does not suffice."""
