"""Mutation testing: flip an operator and check that a test fails."""
