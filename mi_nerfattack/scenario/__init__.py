"""The scenario file as models."""
