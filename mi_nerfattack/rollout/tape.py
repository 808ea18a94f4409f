"""The whole drive on Dr.Jit's tape: the independent way to its derivatives."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.rollout.adjoint import AbstractAdjoint
from mi_nerfattack.rollout.cost import Cost
from mi_nerfattack.rollout.loop import ClosedLoop, Step, Trajectory
from mi_nerfattack.rollout.objective import StateHistory
from mi_nerfattack.rollout.sweep import Gradient, Options, differentiable


@dataclass(frozen=True)
class FullTape(AbstractAdjoint):
    """Records every operation of a drive, down to the samples of each ray.

    For checking the others, and for short horizons with small images: neither
    costates, nor products of sensors, nor replayed marches are used; only the
    policy's derivative is the same. Memory: tens of bytes times the arithmetic of all
    samples of all frames. Time: each step of each march is a kernel of its own.

    Raises (from :meth:`gradient`):
        TypeError: a policy with memory, an exact composite, a scene of splats, or a
            request for the gradient by periods: these are not taped.
    """

    def keep(self, loop: ClosedLoop, step: Step) -> Any:
        """See :meth:`AbstractAdjoint.keep`: nothing; the tape is made afterwards."""
        del loop, step

    def gradient(
        self, loop: ClosedLoop, drive: Trajectory, cost: Cost, options: Options
    ) -> Gradient:
        """See :meth:`AbstractAdjoint.gradient`."""
        sensor = differentiable(loop)
        if options.recorder is not None:
            raise TypeError("FullTape: has no gradient by periods; use Replay")
        if loop.policy.initial_memory(drive.count):
            name = type(loop.policy).__name__
            raise TypeError(f"FullTape: the memory of {name} is not taped; use Replay")
        tape = _Tape(loop, drive, options)
        try:
            return self._record(tape, drive, cost, options)
        finally:  # takes the sensor off the tape
            sensor.set_textures([dr.detach(texture) for texture in tape.textures])

    def _record(
        self, tape: _Tape, drive: Trajectory, cost: Cost, options: Options
    ) -> Gradient:
        for step in range(drive.horizon):
            if options.on_step is not None:
                options.on_step(step)
            tape.advance(step)
        history = StateHistory(
            _stack(tape.states[1:]), drive.count, drive.horizon, drive.dt
        )
        dr.backward(cost.scale * cost.attached(history), flags=dr.ADFlag.ClearEdges)
        return Gradient(
            [dr.grad(texture) for texture in tape.textures],
            np.array(dr.grad(tape.offsets), np.float64) if options.offsets else None,
            dr.grad(tape.states[0]),
            -np.stack([np.array(dr.grad(state)).T for state in tape.states[1:]]),
            None,
        )


class _Tape:
    """A drive that is being recorded; states and parameters are leaves or attached."""

    def __init__(self, loop: ClosedLoop, drive: Trajectory, options: Options) -> None:
        self.loop, self.attached = loop, options.attached
        sensor = differentiable(loop)
        self.textures = [_leaf(texture) for texture in sensor.textures()]
        self.offsets = None
        if options.offsets:
            double = sys.modules[mi.Float.__module__].TensorXf64
            self.offsets = _leaf(double(sensor.offsets()))
        self.states = [_leaf(drive.states[0])]
        self.controls: list[Any] = []

    def advance(self, step: int) -> None:
        """Record one control period."""
        loop, state = self.loop, self.states[-1]
        viewed = state if self.attached else dr.detach(state)
        image = differentiable(loop).trace(viewed, step, self.textures, self.offsets)
        control = dr.custom(_PolicyOp, loop.policy, image, loop.goal)
        self.controls.append(dr.value_t(type(state))(control))
        pair = loop.transition.controls(self.controls, step, state)
        self.states.append(loop.transition.trace(state, *pair))
        dr.eval(self.states[-1], self.controls[-1])


class _PolicyOp(dr.CustomOp):
    """A policy without memory, as an operation of Dr.Jit."""

    def eval(self, policy: Any, image: Any, goal: int) -> Any:
        self.policy, self.image, self.goal = policy, dr.detach(image), goal
        return policy.control(self.image, goal)

    def backward(self) -> None:
        row = dr.array_t(self.image)(self.grad_out())
        dr.eval(row)
        self.set_grad_in("image", self.policy.vjp(self.image, self.goal, row)[1])


def _leaf(value: Any) -> Any:
    leaf = type(value)(dr.detach(value))
    dr.enable_grad(leaf)
    return leaf


def _stack(states: list[Any]) -> Any:
    """Lay states (m, n) of T periods side by side, drive by drive: (m, n T)."""
    count, horizon, kind = dr.width(states[0]), len(states), type(states[0])
    row = dr.value_t(kind)
    index = dr.arange(dr.uint32_array_t(dr.detached_t(row)), count * horizon)
    source = (index % horizon) * count + index // horizon
    rows = [
        dr.gather(row, dr.concat([state[axis] for state in states]), source)
        for axis in range(len(states[0]))
    ]
    return kind(*rows)
