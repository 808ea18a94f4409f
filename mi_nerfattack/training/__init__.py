"""Collecting frames, imitation, DAgger."""
