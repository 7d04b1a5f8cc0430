"""Outputs for people and other tools: annotated recordings, reviews, pages, exports."""
