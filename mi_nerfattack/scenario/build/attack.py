"""Make the attack that a scenario describes."""

from __future__ import annotations

import numpy as np

from mi_nerfattack.attack.freedom import Freedom
from mi_nerfattack.attack.gradient import GradientAttack
from mi_nerfattack.rollout.adjoint import (
    AbstractAdjoint,
    Checkpointed,
    KeptBackgrounds,
    Replay,
)
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.scenario.build.objective import build_reduction
from mi_nerfattack.scenario.build.world import World, initial_states
from mi_nerfattack.scenario.sections import AttackSection


def build_attack(world: World) -> GradientAttack:
    """Make the attack of a scenario, before its first iteration.

    Args:
        world: what the scenario describes.

    Raises:
        TypeError: the policy has no derivatives.
    """
    scenario, section = world.scenario, world.scenario.attack
    loop = world.loop(world.surrogate)
    poses = initial_states(scenario, world.route, section.poses, 2)
    rollout = Rollout(
        loop,
        world.objective,
        scenario.drive.horizon,
        build_reduction(scenario.objective),
        build_adjoint(section),
        section.attached,
    )
    return GradientAttack(
        rollout, world.route, loop.initial(poses), build_freedom(section)
    )


def build_adjoint(section: AttackSection) -> AbstractAdjoint:
    """Make the way back through a drive."""
    if section.adjoint == "checkpointed":
        return Checkpointed(section.segment)
    return KeptBackgrounds() if section.adjoint == "kept_backgrounds" else Replay()


def build_freedom(section: AttackSection) -> Freedom:
    """Say what the attack may change."""
    return Freedom(
        section.learning_rate if section.parameters != "pose" else None,
        section.pose_learning_rate if section.parameters != "texture" else None,
        section.pose_axes,
        section.pose_limit_m,
        float(np.radians(section.pose_limit_deg)),
    )
