"""Rollouts through the toy and the analytic loop, and their gradients."""

from __future__ import annotations

import drjit as dr
import numpy as np
import torch
from helpers import toy_loop as toy

from mi_nerfattack.rollout.adjoint import Checkpointed, KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import AbstractObjective, StageSum

INITIAL = np.array([[0.0, 0.35, 0.02]])
OFFSET = np.array([[0.05, -0.1, 0.08, 0.1, -0.2, 0.15]])
ADJOINTS = {
    "replay": Replay(),
    "kept": KeptBackgrounds(),
    "checkpointed": Checkpointed(3),
}


def make_rollout(loop, horizon, attached=False, adjoint="replay"):
    objective = StageSum(toy.square_error)
    return Rollout(
        loop, objective, horizon, adjoint=ADJOINTS[adjoint], attached=attached
    )


def gradient(rollout, initial=INITIAL, **options):
    return rollout.gradient(rollout.run(rollout.loop.initial(initial)), **options)


def objective(rollout, initial=INITIAL):
    return rollout.run(rollout.loop.initial(initial)).value


def texture_gradient(rollout, initial=INITIAL):
    return gradient(rollout, initial).textures[0].numpy().astype(float)


def unit(value):
    return value / np.linalg.norm(value)


def along_texture(rollout, item, direction):
    """Return J as a function of a step along a direction of the texture."""
    base = toy.texture_of(item)

    def value(s):
        moved = base + s * direction
        rollout.loop.sensor.set_textures([moved.astype(np.float32)])
        result = objective(rollout)
        rollout.loop.sensor.set_textures([base])
        return result

    return value


# --- the analytic loop and its twin in PyTorch ---------------------------------------


class Wave(AbstractObjective):
    """A function of position, heading and time that no two states share."""

    def evaluate(self, states):
        x, y, theta = (states.rows[i] for i in range(3))
        value = dr.sin(1.3 * y + 0.2 * x) + dr.square(theta) * dr.cos(x)
        return states.total(value * (1 + states.time))


def wave_in_torch(states, dt):
    """The same, (n,) from states (n, T + 1, m)."""
    x, y, theta = states[:, 1:, :3].unbind(2)
    time = dt * torch.arange(1, states.shape[1], dtype=torch.float64)
    value = torch.sin(1.3 * y + 0.2 * x) + theta**2 * torch.cos(x)
    return (value * (1 + time)).sum(1)


def expected_gradient(loop, twin, initial, horizon, attached, reduce=torch.mean):
    """Differentiate the twin by textures, initial states and offsets."""
    textures = [
        torch.tensor(texture.numpy(), requires_grad=True)
        for texture in loop.sensor.textures()
    ]
    start = torch.tensor(initial, requires_grad=True)
    offsets = torch.tensor(loop.sensor.offsets.numpy(), requires_grad=True)
    states, _ = twin.drive(start, textures, horizon, attached, offsets)
    value = reduce(wave_in_torch(states, twin.dt))
    value.backward()
    grads = [texture.grad.numpy() for texture in textures]
    return float(value.detach()), [*grads, start.grad.numpy(), offsets.grad.numpy()]


def flat(gradient):
    """Lay a gradient out as `expected_gradient` does."""
    textures = [texture.numpy() for texture in gradient.textures]
    by_offsets = gradient.parameters["offsets"].numpy()
    return [*textures, np.array(gradient.initial).T, by_offsets]


def assert_close(found, expected, tolerance=1e-8):
    for a, b in zip(found, expected, strict=True):
        scale = np.linalg.norm(b)
        assert np.linalg.norm(a - b) <= tolerance * scale, (a, b)
