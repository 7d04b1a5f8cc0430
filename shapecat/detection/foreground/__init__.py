"""Foreground: samples that belong to objects, where their height alone does not decide."""
