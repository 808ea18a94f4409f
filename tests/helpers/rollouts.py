"""Rollouts through the toy loop, and their gradients, by any adjoint."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.rollout.adjoint import Checkpointed, KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.objective import StageSum

INITIAL = np.array([[0.0, 0.35, 0.02]])
OFFSET = np.array([[0.05, -0.1, 0.08, 0.1, -0.2, 0.15]])
ADJOINTS = {
    "replay": Replay(),
    "kept": KeptBackgrounds(),
    "checkpointed": Checkpointed(3),
}


def make_rollout(toy, loop, horizon, attached=False, adjoint="replay"):
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


def along_texture(toy, rollout, item, direction):
    """Return J as a function of a step along a direction of the texture."""
    base = toy.texture_of(item)

    def value(s):
        moved = base + s * direction
        rollout.loop.sensor.set_textures([moved.astype(np.float32)])
        result = objective(rollout)
        rollout.loop.sensor.set_textures([base])
        return result

    return value
