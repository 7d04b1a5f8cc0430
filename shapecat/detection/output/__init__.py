"""Output: labels at full resolution, boxes, support relations, the scene."""
