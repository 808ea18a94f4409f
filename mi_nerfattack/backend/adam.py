"""The state of Dr.Jit's Adam as arrays, and back.

Dr.Jit has no function for this. `Optimizer.state` is where it keeps each parameter's
value, learning rate and moments.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import numpy as np
from drjit.opt import Adam

from mi_nerfattack.errors import InputError


def adam_tensors(optimiser: Adam) -> dict[str, np.ndarray]:
    """Return copies of parameters and moments.

    Args:
        optimiser: not one with AMSGrad, whose maxima are left out.

    Returns:
        for each parameter: ``value.NAME``, and the moments ``first.NAME`` and
        ``second.NAME``, float32 in the parameter's shape; ``time.NAME``, (1,) uint32,
        the number of steps.
    """
    result: dict[str, np.ndarray] = {}
    state: dict[str, Any] = optimiser.state
    for name, (value, _, _, (time, first, second, _)) in state.items():
        for part, array in (("value", value), ("first", first), ("second", second)):
            flat = np.array(dr.detach(array), np.float32)
            result[f"{part}.{name}"] = flat.reshape(value.shape)
        result[f"time.{name}"] = np.array([time[0]], np.uint32)
    return result


def load_adam(
    optimiser: Adam,
    tensors: dict[str, np.ndarray],
    names: Iterable[str] | None = None,
) -> None:
    """Load what :func:`adam_tensors` returned; keep the learning rates.

    Args:
        optimiser: has the parameters already.
        tensors: the arrays; they are copied.
        names: of the parameters to load; all by default.

    Raises:
        InputError: an array has another shape than the parameter.
        KeyError: an array is missing.
    """
    state: dict[str, Any] = optimiser.state
    for name in list(state if names is None else names):
        value, promoted, rate, (time, first, _, largest) = state[name]
        shapes = {part: value.shape for part in ("value", "first", "second")}
        for part, shape in {**shapes, "time": (1,)}.items():
            if (actual := tensors[f"{part}.{name}"].shape) != shape:
                raise InputError(
                    f"{part}.{name}: shape {actual}; the parameter has {shape}"
                )
        # copies, because Dr.Jit would share memory with NumPy
        arrays = [np.array(tensors[f"{part}.{name}"], np.float32) for part in shapes]
        fresh = type(value)(arrays[0])
        moments = [type(first)(array.ravel()) for array in arrays[1:]]
        dr.make_opaque(fresh, moments)
        dr.enable_grad(fresh)
        # a literal, as Adam itself counts, so that the same kernel does the next step
        steps = type(time)(int(tensors[f"time.{name}"][0]))
        state[name] = fresh, promoted, rate, (steps, *moments, largest)
