"""The phases that perceive the frames of a recording, and what they report."""
