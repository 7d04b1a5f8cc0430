"""Scenes of objects on supports, arranged at random or by physics, at rest or in motion."""
