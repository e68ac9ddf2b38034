"""Simulated motors, a family a file: boards that behave as their firmware, those of AK motors in `ak`."""
