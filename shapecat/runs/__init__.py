"""Runs: identity, folder, tables, and corrected labels."""
