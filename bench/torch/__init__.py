"""The peer: the same fields and loop in PyTorch."""
