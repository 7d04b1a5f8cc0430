"""Clean-up: structure rejection and hole filling."""
