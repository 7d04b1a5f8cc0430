"""Definitions of the messages that shapecat writes, and the JSON schema of run.json."""
