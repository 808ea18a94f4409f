"""Optimise a field to posed images."""
