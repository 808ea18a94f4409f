"""An attack iteration beside PyTorch with autograd through time."""
