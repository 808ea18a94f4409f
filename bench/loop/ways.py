"""Two ways to a closed-loop gradient, and two ways to write its policy."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from bench.loop.setting import (
    CAR,
    HYDRANT,
    MOUNT,
    PERIOD_S,
    START,
    TorchRule,
    camera_at,
    cost,
    drjit_rule,
    load_scene,
)
from bench.render.sides import Clock
from mi_nerfattack.deploy.surrogate.scene import scene_sensor
from mi_nerfattack.policy.drjit_network import DrJitNetwork
from mi_nerfattack.policy.goals import NoGoal
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.adjoint import AbstractAdjoint
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.system.memory import peak_memory_mb
from mi_nerfattack.vehicle.integrators import RK4


class AbstractLoop(ABC):
    """A closed loop in a process of its own.

    Args:
        policy: ``torch`` or ``drjit``, the library of the policy.
        width: of the image, pixels.
        height: of the image, pixels.
    """

    def __init__(self, policy: str, width: int, height: int) -> None:
        torch.set_num_threads(1)  # as the commands do: more would wait spinning
        self.policy, self.width, self.height = policy, width, height
        self.scene = load_scene(width, height)
        self.leaf: Any = None

    @abstractmethod
    def value(self, frames: int) -> Any:
        """Drive and return the cost, attached to `self.leaf`, which is fresh."""

    @abstractmethod
    def by_colour(self) -> np.ndarray:
        """Return the last gradient by the colours of the hydrant, (n, 3)."""

    def gradient(self, frames: int) -> dict[str, float]:
        """Drive and differentiate the cost by the leaf.

        Returns:
            ``seconds`` and ``cpu_seconds``, and the cost as ``loss``.
        """
        clock = Clock()
        value = self.value(frames)
        dr.backward(value)
        dr.eval(dr.grad(self.leaf))
        dr.sync_thread()
        return clock.per_step(1) | {"loss": float(dr.detach(value)[0])}

    def write(self, path: str) -> None:
        """Write :meth:`by_colour` as a file of NumPy's."""
        np.save(Path(path), self.by_colour())

    def memory(self) -> dict[str, float]:
        """Return the largest resident size of the process so far, in MB."""
        return {"peak_memory_mb": peak_memory_mb()}


class RolloutLoop(AbstractLoop):
    """The rollout of the package.

    Args:
        adjoint: how derivatives are made.
        policy: as for :class:`AbstractLoop`.
        width: of the image, pixels.
        height: of the image, pixels.
    """

    def __init__(
        self, adjoint: AbstractAdjoint, policy: str, width: int, height: int
    ) -> None:
        super().__init__(policy, width, height)
        self.adjoint = adjoint
        self.sensor = scene_sensor(self.scene, MOUNT, [HYDRANT])
        module = TorchRule() if policy == "torch" else DrJitNetwork(self._network)
        driver = TorchPolicy(module, NoGoal())
        # mi.render rounds no image to eight bits
        self.loop = ClosedLoop(
            self.sensor, driver, 0, CAR, RK4(), PERIOD_S, eight_bit=False
        )

    def value(self, frames: int) -> Any:
        """See :meth:`AbstractLoop.value`."""
        rollout = Rollout(self.loop, StageSum(cost), frames, adjoint=self.adjoint)
        (key,) = self.sensor.keys
        self.leaf = _leaf(self.sensor.params[key])
        return rollout({key: self.leaf}, self.loop.initial(np.array([START])))

    def by_colour(self) -> np.ndarray:
        """See :meth:`AbstractLoop.by_colour`."""
        return dr.grad(self.leaf).numpy()

    def _network(self, features: Any) -> Any:
        """Return controls (1, n) of features (3 height width, n), colour by colour."""
        planes = dr.reshape(type(features), features, (3, -1, features.shape[1]))
        return drjit_rule(dr.mean(planes, axis=0), self.width)


class _EvaluatedCostate(dr.CustomOp):
    """Return a state; in the backward pass, evaluate the derivative by it.

    Without this, the backward pass evaluates no derivative by a state, so that each
    frame compiles a kernel that contains the vehicle's steps of all later frames.
    """

    def eval(self, state: Any) -> Any:
        return type(state)(state)

    def backward(self) -> None:
        d_state = self.grad_out()
        dr.eval(d_state)
        self.set_grad_in("state", d_state)


class PlainLoop(AbstractLoop):
    """A loop over `mi.render`, as a user of Mitsuba writes it."""

    def __init__(self, policy: str, width: int, height: int) -> None:
        super().__init__(policy, width, height)
        self.parameters = mi.traverse(self.scene)
        self.key = f"fields.{HYDRANT}.colour"
        self.rule = TorchRule()
        to_torch = dr.wrap(source="drjit", target="torch")
        in_torch = policy == "torch"
        self.steer = to_torch(self._steer_torch) if in_torch else self._steer_drjit

    def value(self, frames: int) -> Any:
        """See :meth:`AbstractLoop.value`."""
        self.leaf = _leaf(self.parameters[self.key])
        self.parameters[self.key] = self.leaf
        self.parameters.update()
        state: Any = mi.Vector3d(*START)
        dr.make_opaque(state)
        total: Any = dr.opaque(mi.Float64, 0)
        for _ in range(frames):
            # One sensor per frame: the backward pass renders from the sensor again.
            x, y, heading = (float(row[0]) for row in dr.detach(state))
            view = camera_at((x, y, heading), self.width, self.height)
            sensor: Any = mi.load_dict(view, parallel=False)
            image = mi.render(self.scene, self.parameters, sensor=sensor, spp=1)
            seen = dr.linear_to_srgb(image[..., :3])
            dr.eval(seen)
            control = CAR.saturate(mi.Float64(self.steer(seen).array))
            state = RK4().step(CAR, state, control, PERIOD_S)
            state = dr.custom(_EvaluatedCostate, state)
            total = total + cost(state)
            dr.eval(state, total)
        return total

    def _steer_torch(self, image: torch.Tensor) -> torch.Tensor:
        """Return the heading rate (1,) for an image (height, width, 3)."""
        return self.rule(image.permute(2, 0, 1)[None])

    def _steer_drjit(self, image: Any) -> Any:
        """Return the heading rate (1, 1) for an image (height, width, 3)."""
        pixels = dr.reshape(type(image), image, (-1, 3))
        return drjit_rule(dr.mean(pixels, axis=1)[:, None], self.width)

    def by_colour(self) -> np.ndarray:
        """See :meth:`AbstractLoop.by_colour`."""
        return dr.grad(self.leaf).numpy()


def _leaf(parameter: Any) -> Any:
    """Return a copy of a parameter that collects a gradient."""
    leaf = type(parameter)(dr.detach(parameter))
    dr.enable_grad(leaf)
    return leaf
