"""Rendering and its derivative beside PyTorch."""
