"""A training step beside PyTorch."""
