"""The peers: the same fields and loop in PyTorch."""
