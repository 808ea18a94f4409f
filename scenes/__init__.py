"""Bundled scenes."""
