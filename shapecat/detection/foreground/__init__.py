"""Foreground: which samples stand above a plane, where their height alone does not tell."""
