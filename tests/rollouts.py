"""Rollouts through the toy loop, and their gradients, by any adjoint."""

from __future__ import annotations

import numpy as np

INITIAL = np.array([[0.0, 0.35, 0.02]])
OFFSET = np.array([[0.05, -0.1, 0.08, 0.1, -0.2, 0.15]])
ADJOINTS = ("replay", "kept_backgrounds", "checkpointed", "tape")


def make_adjoint(name):
    from mi_nerfattack.rollout import adjoint, tape

    if name == "tape":
        return tape.FullTape()
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
