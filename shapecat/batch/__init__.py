"""Batches of recordings: plan them, process them, and record the state of each recording."""
