"""The phases that perceive the frames of a recording, and their reports."""
