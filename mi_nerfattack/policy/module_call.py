"""The call of a torch module of the user: what it gets, and what it must give."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from mi_nerfattack.errors import InputError, is_interrupt
from mi_nerfattack.policy.checks import misfit, usual_shape
from mi_nerfattack.policy.pilotnet import PilotNet

#: Part of the largest value by which two evaluations of one image may differ.
TOLERANCE = 1e-4


def call_module(
    module: torch.nn.Module, name: str, *arguments: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Call a module with tensors of its own, and check what it returns.

    The camera's image is a view of memory that the loop reads again, and has the
    strides of (n, h, w, 3). A foreign network may write into its input, or view it
    as the contiguous array of its training, so that it gets copies; `PilotNet` does
    neither, and convolves the view as it is.

    Args:
        module: is called as ``module(*arguments)``.
        name: for messages.
        arguments: image, goal, and hidden states.

    Returns:
        The control and the hidden states.

    Raises:
        InputError: the module takes images of another shape, which is told, raises an
            exception, or returns something else than tensors.
    """
    try:
        if isinstance(module, PilotNet):
            result = module(*arguments)
        else:
            result = module(*(a.clone(memory_format=_PLAIN) for a in arguments))
    except (InputError, torch.OutOfMemoryError, MemoryError):
        raise
    except Exception as err:  # a user's module raises whatever it likes
        if is_interrupt(err):
            raise
        shapes = [tuple(part.shape) for part in arguments]
        wanted = usual_shape(module, arguments[0], arguments[1:])
        if wanted not in (None, shapes[0]):
            raise InputError(f"{name}: {misfit(wanted, shapes[0])}") from err
        raise InputError(
            f"{name}: fails on an input of shape {shapes[0]}, with goal and hidden "
            f"states {shapes[1:]}: {type(err).__name__}: {err}; declare "
            "policy.preprocess, goal and recurrent as the network needs them"
        ) from err
    return _tensors(result, name)


def check_repeatable(
    module: torch.nn.Module, evaluate: Callable[[], torch.Tensor], name: str
) -> None:
    """Refuse a module that answers the same image twice differently.

    The loop evaluates a control period anew for its derivative, and begins every
    drive with the same module. Buffers that change betray what no answer shows yet.

    Args:
        module: the module; `PilotNet` is known to be repeatable.
        evaluate: gives the control (n,).
        name: for messages.

    Raises:
        InputError: the two controls differ, or a buffer has changed.
    """
    if isinstance(module, PilotNet):
        return
    with torch.no_grad():
        before = {key: value.clone() for key, value in module.named_buffers()}
        first, second = evaluate(), evaluate()
        changed = [
            key
            for key, value in module.named_buffers()
            if key in before and not torch.equal(before[key].to(value), value)
        ]
        difference = float((first - second).abs().max())
        limit = TOLERANCE * float(torch.maximum(first.abs(), second.abs()).max())
    if changed or difference > limit:
        what = f"its buffer {changed[0]!r} changes" if changed else "its controls are"
        values = "" if changed else f" {first.tolist()[:2]}, then {second.tolist()[:2]}"
        raise InputError(
            f"{name}: evaluated twice on one image, {what}{values}; it was exported in "
            "training mode (dropout, batch statistics): export network.eval(); or it "
            "keeps a state in itself: take and return it as a hidden state, "
            "policy.recurrent"
        )


def _tensors(result: Any, name: str) -> tuple[torch.Tensor, ...]:
    """Take a tensor, or a tuple or list of them, and nothing else."""
    parts = tuple(result) if isinstance(result, (tuple, list)) else (result,)
    wrong = [type(p).__name__ for p in parts if not isinstance(p, torch.Tensor)]
    if wrong or not parts:
        raise InputError(
            f"{name}: returns {f'a {wrong[0]}' if wrong else 'an empty tuple'}; the "
            "control as a tensor, or a tuple of it and the hidden states, is needed"
        )
    return parts


_PLAIN = torch.contiguous_format
