"""Policies as programs: torch.export and TorchScript."""
