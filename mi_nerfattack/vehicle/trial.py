"""Trial of a vehicle model of the user's own, before anything is driven with it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, to_control, to_state
from mi_nerfattack.vehicle.user_model import require_finite

#: Step of the central differences, relative to one plus the magnitude.
STEP = 1e-6
#: Slope that a difference must show before a zero derivative is called wrong.
VISIBLE = 1e-4
#: Vehicles with which a model is tried.
TRIALS = 3


def try_model(name: str, dynamics: AbstractDynamics, limits: Sequence[float]) -> None:
    """Try a model near the origin and its initial state; see :func:`require_model`.

    Args:
        name: of the model, for messages.
        dynamics: the model.
        limits: of each control, in its unit.
    """
    rng, size = np.random.default_rng(0), dynamics.state_size
    states = dynamics.extend(rng.normal(size=(TRIALS, 3)))
    # Off the initial values of the other rows: there a model may have a kink.
    states[:, 3:] += 1e-3 * rng.uniform(0.5, 1, (TRIALS, size - 3))
    shares = rng.uniform(0.1, 0.5, (len(limits), TRIALS))
    control = to_control(shares.T * limits)
    require_model(name, dynamics, to_state(states), u=control)


def require_model(name: str, dynamics: AbstractDynamics, state: Any, u: Any) -> None:
    """Try a model and its derivatives at a few states.

    A derivative that is zero where the model does change is one that was lost: by
    NumPy, by detaching, by a rounded or a Python number. Others are not compared, so
    that a model may have kinks.

    Args:
        name: of the model, for messages.
        dynamics: the model.
        state: (m, n), n >= 2, double precision, away from kinks.
        u: (n,) or (k, n) control within its limit.

    Raises:
        InputError: values or derivatives are not finite, a derivative is lost, or one
            vehicle depends on another.
    """
    # A vehicle alone must move as it does among others
    value = _values(dynamics, state, u)
    require_finite(name, value.T)
    alone = _values(dynamics, _first(state), _first(u))
    if not np.allclose(alone[:, 0], value[:, 0], rtol=1e-9, atol=1e-12):
        raise InputError(
            f"{name}: gave {value[:, 0].tolist()} for a vehicle among others and "
            f"{alone[:, 0].tolist()} for it alone; vehicles must not mix"
        )
    columns = [*dynamics.jacobian(state, u), *_by_controls(dynamics, state, u)]
    size = len(state)
    for j, column in enumerate(columns):
        derivative = np.broadcast_to(column.numpy(), value.shape)
        source = (
            f"row {j} of the state" if j < size else _control_name(dynamics, j - size)
        )
        if not np.isfinite(derivative).all():
            raise InputError(
                f"{name}: its derivative by {source} is {derivative[:, 0].tolist()}; "
                "finite numbers are needed"
            )
        # A derivative is lost if it is 0 although the central difference is not
        slope = _difference(dynamics, state, u, row=j)
        lost = (derivative == 0).all(axis=1) & (np.abs(slope) > VISIBLE).any(axis=1)
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


def _control_name(dynamics: AbstractDynamics, index: int) -> str:
    """Name a control for a message."""
    single = dynamics.control_size == 1
    return "the control" if single else f"control {index}"


def _rows(control: Any) -> list[Any]:
    """Return the rows of controls (n,) or (k, n)."""
    return [control] if dr.depth_v(control) == 1 else list(control)


def _joined(rows: list[Any], like: Any) -> Any:
    """Undo `_rows`."""
    return rows[0] if dr.depth_v(like) == 1 else type(like)(*rows)


def _by_controls(dynamics: AbstractDynamics, state: Any, u: Any) -> Iterator[Any]:
    """Compute df/du of each control, (m, n), in forward mode."""
    for index in range(dynamics.control_size):
        with dr.resume_grad():
            rows = [type(row)(dr.detach(row)) for row in _rows(u)]
            dr.enable_grad(rows[index])
            slope = dynamics.derivative(dr.detach(state), _joined(rows, u))
            dr.set_grad(rows[index], 1)
            flags = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad
            yield dr.detach(dr.forward_to(slope, flags=flags))


def _difference(dynamics: AbstractDynamics, state: Any, u: Any, row: int) -> np.ndarray:
    """Compute one column of the derivatives, (m, n); the last are the controls'."""
    ends, size = [], len(state)
    for sign in (1, -1):
        rows = [type(item)(item) for item in (*state, *_rows(u))]
        step = STEP * (1 + np.abs(rows[row].numpy()))
        rows[row] += type(rows[row])(sign * step)
        moved_state, moved_u = type(state)(*rows[:size]), _joined(rows[size:], u)
        ends.append(_values(dynamics, moved_state, moved_u) / (2 * step))
    return ends[0] - ends[1]


def _first(array: Any) -> Any:
    """Return the first vehicle of rows (n,) or (k, n)."""
    rows = [type(row)(row.numpy()[:1]) for row in _rows(array)]
    return _joined(rows, array)
