"""Clean-up: structure rejection, and filling of holes and contact boundaries."""
