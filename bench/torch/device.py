"""Where PyTorch's side of a comparison computes: on the GPU, if the variant does."""

from __future__ import annotations

import os

import torch

from mi_nerfattack import variant


def choose() -> None:
    """Let PyTorch make its tensors on the GPU where a `cuda_*` variant is chosen."""
    if os.environ.get(variant.VARIABLE, variant.DEFAULT).startswith("cuda"):
        torch.set_default_device("cuda")


def wait() -> None:
    """Wait until all that was asked of the GPU is done; without one, at once."""
    if torch.get_default_device().type == "cuda":
        torch.cuda.synchronize()


def memory() -> dict[str, float]:
    """Return the largest memory of the GPU that tensors took, MB; nothing without."""
    if torch.get_default_device().type == "cuda":
        return {"gpu_memory_mb": torch.cuda.max_memory_allocated() / 1e6}
    return {}
