"""The closed loop as a function of torch tensors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from mi_nerfattack.backend.torch_arrays import to_torch
from mi_nerfattack.rollout.function import Evaluation, Rollout
from mi_nerfattack.vehicle.state import to_state

TorchFunction = Callable[..., torch.Tensor]


def torch_rollout(
    rollout: Rollout, on_run: Callable[[Evaluation], None] | None = None
) -> TorchFunction:
    """Make a function that `torch.autograd` differentiates.

    Args:
        rollout: of the closed loop.
        on_run: told about each evaluation, e.g. to read costs and states.

    Returns:
        ``objective(textures, initial, offsets=None)`` with one tensor
        (n_vertices, 3) of raw colours an object (or a single tensor for a single
        object), initial states (n, m), and offsets (k, 6) as :class:`Rollout` takes
        them; the result is a scalar tensor on the device and in the precision of the
        first texture. Reverse mode, once: no second derivatives.
    """

    def objective(
        textures: torch.Tensor | Sequence[torch.Tensor],
        initial: torch.Tensor,
        offsets: torch.Tensor | None = None,
    ) -> torch.Tensor:
        if isinstance(textures, torch.Tensor):
            textures = [textures]
        value = _RolloutFunction.apply(rollout, on_run, initial, offsets, *textures)
        assert isinstance(value, torch.Tensor)
        return value

    return objective


class _RolloutFunction(torch.autograd.Function):
    """Forward: a batch of drives. Backward: the rollout's adjoint."""

    @staticmethod
    def forward(
        ctx: Any,
        rollout: Rollout,
        on_run: Callable[[Evaluation], None] | None,
        initial: torch.Tensor,
        offsets: torch.Tensor | None,
        *textures: torch.Tensor,
    ) -> torch.Tensor:
        ctx.rollout = rollout
        ctx.textures = [_numpy(texture) for texture in textures]
        rollout.install(ctx.textures, _numpy(offsets))
        ctx.offsets = rollout.installed()
        ctx.evaluation = rollout.run(to_state(_numpy(initial)))
        if on_run is not None:
            on_run(ctx.evaluation)
        ctx.like = initial, offsets, textures
        return textures[0].new_tensor(ctx.evaluation.value)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any, *outputs: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        ctx.rollout.install(ctx.textures, ctx.offsets)  # others may have driven
        initial, offsets, textures = ctx.like
        found = ctx.rollout.gradient(
            ctx.evaluation, offsets is not None, scale=float(outputs[0])
        )
        by_initial = torch.from_numpy(np.array(found.initial).T.copy()).to(initial)
        by_offsets = None
        if found.offsets is not None:
            by_offsets = torch.from_numpy(found.offsets).to(offsets)
        pairs = zip(found.textures, textures, strict=True)
        by_textures = [to_torch(value).to(like) for value, like in pairs]
        return None, None, by_initial, by_offsets, *by_textures


def _numpy(value: torch.Tensor | None) -> Any:
    return None if value is None else value.detach().cpu().numpy().copy()
