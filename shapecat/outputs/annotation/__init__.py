"""Annotated recordings: detections, scenes, markers and 2D boxes in each message encoding."""
