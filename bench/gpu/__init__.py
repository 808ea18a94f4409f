"""`bench gpu`: everything that is measured, on an NVIDIA GPU beside PyTorch there."""
