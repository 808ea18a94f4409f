"""Plots by matplotlib, which is slow to import."""
