"""Rollouts through the toy loop, and their gradients, by any adjoint."""

from __future__ import annotations

import numpy as np

INITIAL = np.array([[0.0, 0.35, 0.02]])
OFFSET = np.array([[0.05, -0.1, 0.08, 0.1, -0.2, 0.15]])
ADJOINTS = ("replay", "kept_backgrounds", "checkpointed")


def make_adjoint(name):
    from helpers.tape import FullTape

    from mi_nerfattack.rollout import adjoint

    if name == "tape":
        return FullTape()
    if name == "checkpointed":
        return adjoint.Checkpointed(3)
    return adjoint.Replay() if name == "replay" else adjoint.KeptBackgrounds()


def make_rollout(toy, loop, horizon, attached=False, adjoint="replay"):
    from mi_nerfattack.rollout.function import Rollout
    from mi_nerfattack.rollout.objective import StageSum

    return Rollout(
        loop,
        StageSum(toy.square_error),
        horizon,
        adjoint=make_adjoint(adjoint),
        attached=attached,
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
