"""The phases that perceive the frames of a recording, and warnings about their results."""
