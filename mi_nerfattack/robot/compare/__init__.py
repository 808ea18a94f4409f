"""A real car's drives beside those of a run: alignment, criteria, sequential test."""
