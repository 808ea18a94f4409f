"""A closed loop in double precision whose camera sees a formula, not a field.

It runs in milliseconds. :func:`make_pair` returns it together with the same loop
written in plain PyTorch, where derivatives are autograd's through time.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.sensor import AbstractDifferentiableSensor, Observation
from mi_nerfattack.vehicle import (
    RK4,
    Ackermann,
    Dubins,
    ExplicitEuler,
    ImplicitMidpoint,
    KinematicBicycle,
    RateLimitedAckermann,
)
from mi_nerfattack.vehicle.dynamics import state_type

HEIGHT, WIDTH, TEXELS = 4, 6, 5
SPACING = 0.7  # phase between two texels, radians

_rng = np.random.default_rng(11)
#: Phase of each pixel: coefficients of px, py, theta, and a constant.
BY_POSE = _rng.uniform(-1, 1, (3, HEIGHT * WIDTH)) * np.array([[0.3], [0.9], [1.5]])
CONSTANT = _rng.uniform(0, 2 * np.pi, HEIGHT * WIDTH)
#: Coefficients of an object's six offsets.
BY_OFFSET = _rng.uniform(-0.5, 0.5, (6, HEIGHT * WIDTH))

VEHICLES = {
    "dubins": Dubins(5.0, 1.5),
    "ackermann": Ackermann(4.0, 2.5, 0.6),
    "ackermann_rate": RateLimitedAckermann(4.0, 2.5, 0.6, 0.9, 0.15),
    "bicycle": KinematicBicycle(4.0, 1.1, 1.4, 0.6),
}
INTEGRATORS = {"euler": ExplicitEuler(), "rk4": RK4()}
INTEGRATORS["implicit_midpoint"] = ImplicitMidpoint()


@dataclass(frozen=True)
class AnalyticObservation(Observation):
    """An image and the phase shift of its control period."""

    shift: Any = None


class AnalyticSensor(AbstractDifferentiableSensor):
    """Sees ``sigmoid(cos q + sum_k sin((o + 1) q + b_o + SPACING k) texture_o[k])``.

    The phase q of a pixel is affine in px, py and theta and, for object o of several,
    b_o in its offsets. A shift of q that depends on the control period stands for
    random numbers. Its parameters are ``texture0``, ``texture1``, ... and ``offsets``,
    by which it is always differentiated.
    """

    objects = ()
    keys: Any = ("offsets",)

    def __init__(self, textures: list[np.ndarray]) -> None:
        self._textures = [tensor(texture) for texture in textures]
        self.offsets = tensor(np.zeros((len(textures), 6)))
        self.renders = 0
        self.start_gradient()

    def observe(self, state: Any, step: int) -> AnalyticObservation:
        shift = dr.opaque(row_type(), period_shift(step))
        image = self._image(dr.detach(state), shift, self._textures, self.offsets)
        dr.eval(image)
        self.renders += dr.width(state)
        return AnalyticObservation(image, shift=shift)

    def vjp(self, observation: Any, state: Any, d_image: Any, attached: bool) -> Any:
        with dr.resume_grad():
            leaf = state_type()(*[row_type()(dr.detach(state[i])) for i in range(3)])
            textures = [type(t)(dr.detach(t)) for t in self._textures]
            offsets = type(self.offsets)(dr.detach(self.offsets))
            dr.enable_grad(leaf, textures, offsets)
            image = self._image(leaf, observation.shift, textures, offsets)
            dr.backward_from(dr.sum(image.array * dr.detach(d_image.array)))
            for i, texture in enumerate(textures):
                self._gradients[i] += dr.grad(texture)
            self._by_offsets += dr.grad(offsets)
            result = dr.grad(leaf)
        dr.eval(result, self._gradients, self._by_offsets)
        return result if attached else None

    def select(self, keys: Any) -> None:
        self.keys = tuple(keys)

    def set_parameters(self, values: Any) -> None:
        for key, value in values.items():
            if key == "offsets":
                self.offsets = tensor(dr.detach(value))
            else:
                self._textures[int(key[7:])] = tensor(dr.detach(value))

    def gradients(self) -> dict[str, Any]:
        named = {f"texture{i}": value for i, value in enumerate(self._gradients)}
        return {key: (named | {"offsets": self._by_offsets})[key] for key in self.keys}

    def start_gradient(self, extra_keys: Any = ()) -> None:
        self._gradients = [dr.zeros(tensor_type(), t.shape) for t in self._textures]
        self._by_offsets = dr.zeros(tensor_type(), self.offsets.shape)

    def texture_gradients(self) -> list[Any]:
        return list(self._gradients)

    def textures(self) -> list[Any]:
        return list(self._textures)

    def set_textures(self, textures: list[Any]) -> None:
        self._textures = [tensor(dr.detach(texture)) for texture in textures]

    def _image(self, state: Any, shift: Any, textures: list[Any], offsets: Any) -> Any:
        """Evaluate the formula, (n, HEIGHT, WIDTH, 3), for rows px, py, theta."""
        count, row = dr.width(state), row_type()
        index = dr.arange(dr.uint32_array_t(row), count * HEIGHT * WIDTH * 3)
        channel, ray = index % 3, index // 3
        pixel, vehicle = ray % (HEIGHT * WIDTH), ray // (HEIGHT * WIDTH)
        phase = dr.gather(row, row(CONSTANT), pixel) + shift
        for axis in range(3):
            pose = dr.gather(row, row(state[axis]), vehicle)
            phase += pose * dr.gather(row, row(BY_POSE[axis]), pixel)
        total = dr.cos(phase)
        for number, texture in enumerate(textures):
            own = (number + 1) * phase
            for axis in range(6):
                offset = dr.gather(row, offsets.array, 6 * number + axis)
                own += offset * dr.gather(row, row(BY_OFFSET[axis]), pixel)
            for k in range(texture.shape[0]):
                colour = dr.gather(row, texture.array, 3 * k + channel)
                total += dr.sin(own + SPACING * k) * colour
        return tensor_type()(1 / (1 + dr.exp(-total)), (count, HEIGHT, WIDTH, 3))


class AnalyticPolicy(torch.nn.Module):
    """A small smooth network in double precision; its gain is strong."""

    goals = 3

    def __init__(self, gain: float = 1.2) -> None:
        super().__init__()
        kind = {"generator": torch.Generator().manual_seed(3), "dtype": torch.float64}
        self.gain = gain
        self.first = torch.nn.Parameter(torch.randn(3 * HEIGHT * WIDTH, 8, **kind) / 4)
        self.second = torch.nn.Parameter(torch.randn(8, **kind) / 3)

    def forward(self, image: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        turn = 0.1 * goal.to(image)[:, None]
        hidden = torch.tanh((image.flatten(1) - 0.5) @ self.first + turn)
        return self.gain * torch.tanh(hidden @ self.second)


@dataclass
class TorchLoop:
    """The loop in plain PyTorch: a graph through all of time.

    Vehicle and integrator are keys of `VEHICLES` and `INTEGRATORS`; the module maps
    images and goals to controls; substeps and delay are those of `ClosedLoop`, the
    delay a number or one for each vehicle. States and images are those of the last
    drive, with their graph.
    """

    vehicle: str
    integrator: str
    module: torch.nn.Module
    goal: int
    dt: float
    substeps: int = 1
    delay: float | torch.Tensor = 0
    states: list[torch.Tensor] = field(default_factory=list)
    images: list[torch.Tensor] = field(default_factory=list)

    def drive(
        self,
        initial: torch.Tensor,
        textures: list[torch.Tensor],
        horizon: int,
        attached: bool,
        offsets: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return states (n, horizon + 1, m) and raw controls (n, horizon)."""
        states, controls, state, steps = [initial], [], initial, 0
        goals = torch.full((len(initial),), self.goal)
        self.images = []
        for period in range(horizon):
            camera_state = state if attached else state.detach()
            image = torch_image(camera_state, period, textures, offsets)
            self.images.append(image)
            controls.append(self.module(image.permute(0, 3, 1, 2), goals))
            for _ in range(self.substeps):
                command = self._command(controls, steps)
                state = self._advance(state, limited(self.vehicle, command))
                steps += 1
            states.append(state)
        self.states = states
        return torch.stack(states, 1), torch.stack(controls, 1)

    def _command(self, controls: list[torch.Tensor], step: int) -> torch.Tensor:
        """Return the mean of what arrives in an integration step, (n,)."""
        start = step - torch.as_tensor(self.delay, dtype=torch.float64)
        command = torch.zeros_like(controls[0])
        for period, control in enumerate(controls):
            held = period * self.substeps, (period + 1) * self.substeps
            overlap = (start + 1).clamp(max=held[1]) - start.clamp(min=held[0])
            command = command + overlap.clamp(min=0) * control
        return command

    def _advance(self, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        h, f = self.dt / self.substeps, TORCH_VEHICLES[self.vehicle]
        if self.integrator == "euler":
            return x + h * f(x, u)
        if self.integrator == "rk4":
            a = f(x, u)
            b = f(x + a * h / 2, u)
            c = f(x + b * h / 2, u)
            return x + (a + 2 * b + 2 * c + f(x + c * h, u)) * h / 6
        return midpoint_step(f, x, u, h)


def midpoint_step(f: Any, x: torch.Tensor, u: torch.Tensor, h: float) -> torch.Tensor:
    """Solve ``y = x + h f((x + y)/2, u)``, every Newton iteration in the graph."""

    def defect(y: torch.Tensor, x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return y - x - h * f((x + y)[None] / 2, u[None])[0]

    y = x
    for _ in range(6):
        matrix = torch.func.vmap(torch.func.jacrev(defect))(y, x, u)
        y = y - torch.linalg.solve(matrix, torch.func.vmap(defect)(y, x, u))
    return y


def torch_image(
    state: torch.Tensor,
    period: int,
    textures: list[torch.Tensor],
    offsets: torch.Tensor | None,
) -> torch.Tensor:
    """The formula of `AnalyticSensor`, (n, HEIGHT, WIDTH, 3)."""
    q = state[:, :3] @ torch.tensor(BY_POSE) + torch.tensor(CONSTANT)
    q = q + period_shift(period)
    logit = q.cos()[:, :, None]
    for number, texture in enumerate(textures):
        own = q * (number + 1)
        if offsets is not None:
            own = own + offsets[number] @ torch.tensor(BY_OFFSET)
        texels = SPACING * torch.arange(len(texture), dtype=torch.float64)
        waves = torch.sin(own[:, :, None] + texels)
        logit = logit + waves @ texture
    return torch.sigmoid(logit).unflatten(1, (HEIGHT, WIDTH))


def limited(vehicle: str, control: torch.Tensor) -> torch.Tensor:
    model = VEHICLES[vehicle]
    limit = model.max_heading_rate if vehicle == "dubins" else model.max_steer
    return soft(control, limit)


def soft(value: torch.Tensor, limit: float) -> torch.Tensor:
    return value / (1 + (value / limit) ** 8) ** 0.125


def _bicycle(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    slip = torch.atan(1.4 / 2.5 * u.tan())
    course = x[:, 2] + slip
    return torch.stack([4 * course.cos(), 4 * course.sin(), 4 / 1.4 * slip.sin()], 1)


def _ahead(x: torch.Tensor, speed: float, turn: torch.Tensor) -> torch.Tensor:
    return torch.stack([speed * x[:, 2].cos(), speed * x[:, 2].sin(), turn], 1)


def _ackermann_rate(x: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    rate = soft((u - x[:, 3]) / 0.15, 0.9)
    return torch.cat([_ahead(x, 4, 4 / 2.5 * x[:, 3].tan()), rate[:, None]], 1)


TORCH_VEHICLES = {
    "dubins": lambda x, u: _ahead(x, 5, u),
    "ackermann": lambda x, u: _ahead(x, 4, 4 / 2.5 * u.tan()),
    "ackermann_rate": _ackermann_rate,
    "bicycle": _bicycle,
}


def make_pair(
    vehicle: str = "dubins",
    integrator: str = "rk4",
    substeps: int = 1,
    delay: int = 0,
    objects: int = 1,
    dt: float = 0.1,
    goal: int = 1,
) -> tuple[ClosedLoop, TorchLoop]:
    """Return the loop with textures drawn at random, and its twin in torch."""
    module, sensor = AnalyticPolicy(), AnalyticSensor(random_textures(objects))
    model, method, policy = (
        VEHICLES[vehicle],
        INTEGRATORS[integrator],
        TorchPolicy(module),
    )
    loop = ClosedLoop(
        sensor, policy, goal, model, method, dt, substeps, delay, eight_bit=False
    )  # as the twin, whose derivatives are exact
    return loop, TorchLoop(vehicle, integrator, module, goal, dt, substeps, delay)


def random_textures(objects: int = 1, seed: int = 7) -> list[np.ndarray]:
    """Draw textures, each (TEXELS, 3); those of several objects differ in size."""
    rng = np.random.default_rng(seed)
    return [rng.normal(0, 0.8, (TEXELS + i, 3)) for i in range(objects)]


def random_poses(count: int, seed: int = 8) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 0.3, (count, 3))


def period_shift(period: int) -> float:
    """Phase that the images of a control period are shifted by, radians."""
    return 0.4 * float(np.sin(1.7 * period))


def row_type() -> Any:
    return dr.value_t(state_type())


def tensor_type() -> Any:
    return sys.modules[mi.Float.__module__].TensorXf64


def tensor(values: Any) -> Any:
    """Upload an array in double precision, opaque."""
    result = tensor_type()(values)
    dr.make_opaque(result)
    return result
