"""Plots: matplotlib is imported here alone."""
