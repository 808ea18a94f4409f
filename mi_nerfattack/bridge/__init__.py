"""Parts of the closed loop that are shared with PyTorch."""
