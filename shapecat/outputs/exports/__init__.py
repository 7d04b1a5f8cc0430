"""Exports of labels in the formats of other tools."""
