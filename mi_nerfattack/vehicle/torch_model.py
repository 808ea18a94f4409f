"""The user's own vehicle model, given as a function of torch tensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import drjit as dr
import torch

from mi_nerfattack.backend.torch_arrays import to_torch
from mi_nerfattack.errors import InputError
from mi_nerfattack.vehicle.user_model import (
    AbstractUserDynamics,
    call_model,
    require_finite,
)


@dataclass(frozen=True)
class TorchDynamics(AbstractUserDynamics):
    """Vehicle model `dx/dt = function(state, control)` with derivatives by autograd.

    Cost: a call and, in reverse mode, one graph an evaluation; forward mode and an
    iteration of `ImplicitMidpoint` take m reverse passes. Each waits for the device,
    and nothing of it can be recorded: prefer `FunctionDynamics` where the model can
    be written in Dr.Jit operations.

    Args:
        function: maps a state (n, m) and a control (n,), or several (n, k), within
            its limit, both on the device and in the precision of the loop, to the
            derivative (n, m). It treats each vehicle alone, and changes nothing between
            two calls.
        size: m, at least 3; the first columns are px, py, theta.
        limit: of ``|control|``, in its unit; applied by `soft_limit`. Of several
            controls one for all, or one for each.
        rest_state: initial values of the m - 3 columns after theta; zeros if left out.
        controls: k, their number.
    """

    recordable: ClassVar[bool] = False

    def derivative(self, state: Any, control: Any) -> Any:
        """Call the function.

        Raises:
            InputError: it returned something else than a finite tensor (n, m); while
                differentiating, one that autograd cannot follow to the control.
        """
        # The value needs no graph: `_Derivative` evaluates again where it needs one
        with torch.no_grad():
            value = _to_state(self.evaluate(*_tensors(state, control)), state)
        if not dr.grad_enabled(state, control):
            return value
        return dr.custom(_Derivative, self, state, control, value)

    def jacobian(self, state: Any, control: Any) -> list[Any]:
        """Compute the columns of df/dx by m reverse passes over one graph."""
        result, leaves = self._graph(*_tensors(state, control))
        # A reverse pass gives a row of df/dx; stacked, the last axis counts columns
        rows = [
            self._reverse(result, leaves, unit.expand_as(result))[0]
            for unit in torch.eye(self.size).to(result)
        ]
        return [_to_state(column, state) for column in torch.stack(rows, 1).unbind(2)]

    def evaluate(self, state: torch.Tensor, control: torch.Tensor) -> torch.Tensor:
        """Call the function with (n, m) and (n,) or (n, k), and check its result."""
        result = call_model(self.name, self.function, state, control=control)
        if not isinstance(result, torch.Tensor) or result.shape != state.shape:
            shape = getattr(result, "shape", None)
            description = type(result).__name__ + (
                f" of shape {tuple(shape)}" if shape else ""
            )
            raise InputError(
                f"{self.name}: returned {description}; a tensor {tuple(state.shape)} "
                "is needed, a row for each vehicle"
            )
        require_finite(self.name, result.detach().cpu().numpy())
        return result.to(state)

    def vjp(
        self, state: torch.Tensor, control: torch.Tensor, cotangent: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Multiply (n, m) by the derivatives: (n, m), and (n,) or (n, k)."""
        result, leaves = self._graph(state, control)
        return self._reverse(result, leaves, cotangent)

    def jvp(
        self,
        state: torch.Tensor,
        control: torch.Tensor,
        d_state: torch.Tensor,
        d_control: torch.Tensor,
    ) -> torch.Tensor:
        """Multiply the derivatives by (n, m), and (n,) or (n, k): (n, m).

        By a reverse pass a column, so that every function of autograd will do.
        """
        result, leaves = self._graph(state, control)
        columns = []
        for unit in torch.eye(self.size).to(result):
            rows = unit.expand_as(result)
            by_state, by_control = self._reverse(result, leaves, rows)
            product = by_control * d_control
            by_all = product if product.ndim == 1 else product.sum(1)
            columns.append((by_state * d_state).sum(1) + by_all)
        return torch.stack(columns, 1)

    def _graph(
        self, state: torch.Tensor, control: torch.Tensor
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
        """Evaluate with a graph; return the result and the leaves."""
        leaves = state.requires_grad_(), control.requires_grad_()
        with torch.enable_grad():
            return self.evaluate(state, control), leaves

    def _reverse(
        self,
        result: torch.Tensor,
        leaves: tuple[torch.Tensor, torch.Tensor],
        cotangent: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        if not result.requires_grad:
            raise InputError(self._no_derivative())
        by_state, by_control = torch.autograd.grad(
            result, leaves, cotangent, retain_graph=True, allow_unused=True
        )
        if by_control is None:
            raise InputError(self._no_derivative())
        if by_state is None:
            by_state = torch.zeros_like(leaves[0])
        return by_state, by_control

    def _no_derivative(self) -> str:
        return (
            f"{self.name}: what it returned has no derivative by the control; "
            "write it in torch operations, without NumPy, .detach() and .item()"
        )


class _Derivative(dr.CustomOp):
    """`TorchDynamics.derivative` with its derivatives in both modes."""

    def eval(
        self, dynamics: TorchDynamics, state: Any, control: Any, value: Any
    ) -> Any:
        self.dynamics, self.state, self.control = dynamics, state, control
        return type(value)(value)

    def forward(self) -> None:
        count = dr.width(self.state)
        d_state = _to_columns(self.grad_in("state"), count)
        d_control = _to_columns(self.grad_in("control"), count)
        state, control = _tensors(self.state, self.control)
        result = self.dynamics.jvp(state, control, d_state, d_control=d_control)
        self.set_grad_out(_to_state(result, self.state))

    def backward(self) -> None:
        cotangent = _to_columns(self.grad_out(), dr.width(self.state))
        state, control = _tensors(self.state, self.control)
        by_state, by_control = self.dynamics.vjp(state, control, cotangent)
        self.set_grad_in("state", _to_state(by_state, self.state))
        if by_control.ndim == 1:
            self.set_grad_in("control", _to_row(by_control, type(self.control)))
        else:
            self.set_grad_in("control", _to_state(by_control, self.control))

    def name(self) -> str:
        return self.dynamics.name


def _tensors(state: Any, control: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Copy a state (m, n) as (n, m), and a control (n,), or (k, n) as (n, k)."""
    count = dr.width(state, control)
    return _to_columns(state, count), _to_columns(control, count)


def _to_columns(array: Any, count: int) -> torch.Tensor:
    """Copy rows (m, n) or (n,), of one entry where all are equal, as (n, m) or (n,)."""
    values = to_torch(array)
    values = values.expand(*values.shape[:-1], count)
    return (values.mT if values.ndim == 2 else values).clone()


def _to_state(values: torch.Tensor, like: Any) -> Any:
    """Upload (n, m) as a state of the type of `like`, (m, n)."""
    return type(like)(*[_to_row(column, type(like[0])) for column in values.T])


def _to_row(values: torch.Tensor, kind: Any) -> Any:
    """Upload (n,), never as a literal."""
    values = values.detach().contiguous()
    if not values.is_cuda:
        # a list: memory from torch has an alignment of its own, and so its own kernels
        return kind(values.tolist())
    # Dr.Jit has a stream of its own
    torch.cuda.current_stream(values.device).synchronize()
    return kind(values)
