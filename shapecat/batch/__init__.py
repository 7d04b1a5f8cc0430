"""Batches of recordings: plan, process, and record the state of each."""
