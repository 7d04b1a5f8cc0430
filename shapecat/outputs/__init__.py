"""What a run writes for people and other tools: annotated recordings, reviews, pages, exports."""
