"""Trial of a vehicle model of the user's own, before anything is driven with it."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.dynamics import AbstractDynamics
from mi_nerfattack.vehicle.user_model import require_finite

#: Step of the central differences, relative to one plus the magnitude.
STEP = 1e-6
#: Slope that a difference must show before a zero derivative is called wrong.
VISIBLE = 1e-4


def require_model(name: str, dynamics: AbstractDynamics, state: Any, u: Any) -> None:
    """Try a model and its derivatives at a few states.

    A derivative that is zero where the model does change is one that was lost: by
    NumPy, by detaching, by a rounded or a Python number. Others are not compared, so
    that a model may have kinks.

    Args:
        name: of the model, for messages.
        dynamics: the model.
        state: (m, n), n >= 2, double precision, away from kinks.
        u: (n,) control within its limit.

    Raises:
        InputError: values or derivatives are not finite, a derivative is lost, or one
            vehicle depends on another.
    """
    value = _values(dynamics, state, u)
    require_finite(name, value.T)
    alone = _values(dynamics, type(state)(*[_first(row) for row in state]), _first(u))
    if not np.allclose(alone[:, 0], value[:, 0], rtol=1e-9, atol=1e-12):
        raise InputError(
            f"{name}: gave {value[:, 0].tolist()} for a vehicle among others and "
            f"{alone[:, 0].tolist()} for it alone; vehicles must not mix"
        )
    columns = [*dynamics.jacobian(state, u), _by_control(dynamics, state, u)]
    for j, column in enumerate(columns):
        found = np.broadcast_to(column.numpy(), value.shape)
        source = "the control" if j == len(state) else f"row {j} of the state"
        if not np.isfinite(found).all():
            raise InputError(
                f"{name}: its derivative by {source} is {found[:, 0].tolist()}; finite "
                "numbers are needed"
            )
        slope = _difference(dynamics, state, u, j)
        lost = (found == 0).all(axis=1) & (np.abs(slope) > VISIBLE).any(axis=1)
        if lost.any():
            row = int(np.flatnonzero(lost)[0])
            raise InputError(
                f"{name}: row {row} of what it returned has no derivative by {source}, "
                f"but changes with it, by {slope[row, 0]:.4g}; use operations of the "
                "framework on arrays alone, and detach nothing"
            )


def _values(dynamics: AbstractDynamics, state: Any, u: Any) -> np.ndarray:
    """Evaluate the model: (m, n)."""
    value = dynamics.derivative(state, u).numpy()
    return np.array(np.broadcast_to(value, (len(state), dr.width(state))))


def _by_control(dynamics: AbstractDynamics, state: Any, u: Any) -> Any:
    """Compute df/du, (m, n), in forward mode."""
    with dr.resume_grad():
        leaf = type(u)(dr.detach(u))
        dr.enable_grad(leaf)
        slope = dynamics.derivative(dr.detach(state), leaf)
        dr.set_grad(leaf, 1)
        flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
        return dr.detach(dr.forward_to(slope, flags=flags))


def _difference(dynamics: AbstractDynamics, state: Any, u: Any, row: int) -> np.ndarray:
    """Compute one column of the derivatives, (m, n); the last is the control's."""
    ends = []
    for sign in (1, -1):
        rows = [type(u)(item) for item in (*state, u)]
        step = STEP * (1 + np.abs(rows[row].numpy()))
        rows[row] += type(u)(sign * step)
        ends.append(_values(dynamics, type(state)(*rows[:-1]), rows[-1]) / (2 * step))
    return ends[0] - ends[1]


def _first(row: Any) -> Any:
    return type(row)(row.numpy()[:1])
