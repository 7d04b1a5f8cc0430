"""Output: labels at full resolution, boxes, what stands on what, the scene."""
