"""What every policy checks: images, goals, hidden states and controls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import torch

from mi_nerfattack.backend.torch_arrays import to_torch
from mi_nerfattack.errors import InputError


def check_hidden(shapes: Sequence[Sequence[int]]) -> tuple[tuple[int, ...], ...]:
    """Check shapes of hidden states: positive sizes and one -1, for the vehicles."""
    for shape in shapes:
        if list(shape).count(-1) != 1 or any(s < 1 and s != -1 for s in shape):
            raise InputError(
                f"recurrent: shape {list(shape)}; sizes of at least 1, and one -1 for "
                "the number of vehicles"
            )
    return tuple(tuple(shape) for shape in shapes)


def check_images(image: torch.Tensor) -> None:
    """Refuse what is not (n, height, width, 3)."""
    if image.ndim != 4 or image.shape[3] != 3:
        raise InputError(
            f"image: shape {tuple(image.shape)}; (n, height, width, 3) is needed"
        )


def expand_goals(goal: Any, image: torch.Tensor) -> torch.Tensor:
    """Expand goals to (n,) int64 on the device of images (n, ...)."""
    if dr.is_array_v(goal):
        goal = to_torch(goal)
    values = torch.as_tensor(goal).to(image.device, torch.int64)
    if values.shape not in (torch.Size([]), image.shape[:1]):
        raise InputError(f"goal: shape {tuple(values.shape)} for {len(image)} images")
    return values.expand(len(image))


def steering(
    values: torch.Tensor, count: int, output: int | None, name: str
) -> torch.Tensor:
    """Take the control (n,) out of a network's answer, and refuse NaN.

    Args:
        values: (n,), (n, 1), or (n, k) where `output` is given.
        count: n.
        output: column of the control.
        name: of the policy, for messages.
    """
    shape = tuple(values.shape)
    if shape != (count,):
        column = 0 if output is None and shape == (count, 1) else output
        if len(shape) != 2 or shape[0] != count or column is None or column >= shape[1]:
            raise InputError(
                f"{name}: controls {shape} for {count} images; the policy must return "
                "one number for each image, (n,) or (n, 1), or several, (n, k), and "
                f"policy.output (is {output}) must tell the column of the control"
            )
        values = values[:, column]
    bad = (~torch.isfinite(values)).nonzero().flatten().tolist()
    if bad:
        raise InputError(
            f"{name}: control {float(values[bad[0]])} for image {bad[0]} of {count}; "
            "it must be finite: check the weights and policy.preprocess"
        )
    return values
