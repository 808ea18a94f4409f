"""Networks of Dr.Jit (``drjit.nn``) as torch modules, with their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from mi_nerfattack.backend.torch_arrays import to_torch
from mi_nerfattack.errors import InputError


class DrJitNetwork(torch.nn.Module):
    """A function of Dr.Jit tensors, single precision.

    Args:
        network: a ``drjit.nn`` module with weights that are not packed, or any
            function that Dr.Jit differentiates. It maps a tensor (features, n) to
            (k, n). The features of an image are its values in the layout's order,
            row by row, of several images one after the other, then numbers and those
            of a one-hot goal.
    """

    def __init__(self, network: Callable[[Any], Any]) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: torch.Tensor, *others: torch.Tensor) -> torch.Tensor:
        """Return (n, k)."""
        blocks = (part.to(image).reshape(len(image), -1) for part in (image, *others))
        features = torch.cat(list(blocks), dim=1)
        result: Any = _Call.apply(self.network, features)
        return result


class _Call(torch.autograd.Function):
    """Call a Dr.Jit function on (n, features); its graph is made for a derivative."""

    @staticmethod
    def forward(network: Callable[[Any], Any], features: torch.Tensor) -> torch.Tensor:
        """Evaluate without a graph."""
        with dr.suspend_grad():
            return _from_drjit(_call(network, _to_drjit(features)), features)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        """Keep the features."""
        del output
        ctx.network = inputs[0]
        ctx.save_for_backward(inputs[1])

    @staticmethod
    def backward(ctx: Any, *cotangents: torch.Tensor) -> tuple[None, torch.Tensor]:
        """Evaluate again and go back."""
        (features,) = ctx.saved_tensors
        leaf = _to_drjit(features)
        with dr.resume_grad(), dr.isolate_grad():  # whatever the caller is in
            dr.enable_grad(leaf)
            result = _call(ctx.network, leaf)
            dr.set_grad(result, _to_drjit(cotangents[0]))
            dr.enqueue(dr.ADMode.Backward, result)
            dr.traverse(dr.ADMode.Backward)
            return None, _from_drjit(dr.grad(leaf), features)


def _call(network: Callable[[Any], Any], features: Any) -> Any:
    result = network(features)
    shape = tuple(getattr(result, "shape", ()))
    if not dr.is_tensor_v(result) or len(shape) != 2 or shape[1] != features.shape[1]:
        raise InputError(
            f"{type(network).__name__}: gives {type(result).__name__} of shape {shape} "
            f"for features {tuple(features.shape)}; a tensor (k, n) is needed"
        )
    return result


def _to_drjit(values: torch.Tensor) -> Any:
    """Make an evaluated tensor (features, n) of rows (n, features)."""
    columns = values.detach().to(torch.float32).T.contiguous()
    kind: Any = mi.TensorXf
    return kind(columns if columns.is_cuda else columns.numpy())


def _from_drjit(tensor: Any, like: torch.Tensor) -> torch.Tensor:
    """Make rows (n, k) of a tensor (k, n); a copy, which torch owns."""
    return to_torch(tensor).T.to(like.device, like.dtype).clone()
