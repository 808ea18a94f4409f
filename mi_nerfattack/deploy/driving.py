"""The one way of driving: a policy in an environment, start to end."""

from __future__ import annotations

from collections.abc import Callable

import mitsuba as mi
import numpy as np

from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.policy.base import AbstractPolicy
from mi_nerfattack.rollout.drive import Drive
from mi_nerfattack.vehicle.route.route import Route


def drive(
    environment: AbstractEnvironment,
    policy: AbstractPolicy,
    route: Route,
    pose: np.ndarray,
    seed: int,
    steps: int,
    on_step: Callable[[int], None] | None = None,
    case: str = "no_object",
    run: int = 0,
    label: str | None = None,
) -> Drive:
    """Let a policy drive in an environment.

    Args:
        environment: is reset; what it shows is left alone.
        policy: sees sRGB images (1, height, width, 3) of eight bits, in [0, 1]; one
            with memory starts with its initial one.
        route: whose goal the policy gets, and to which errors are measured.
        pose: (3,), of the start, metres and radians.
        seed: of the environment.
        steps: control periods; fewer where the environment is over before.
        on_step: called after each with its index; an exception ends the drive.
        case: of the result.
        run: of the result.
        label: what the result calls the environment; its name by default.

    Raises:
        InputError: the policy does not take the camera's images, or its control is
            not finite.
    """
    frame = environment.reset(route, np.asarray(pose, np.float64), seed)
    memory = policy.initial_memory(1)
    states, controls = [environment.state[:3]], []
    for index in range(steps):
        row, memory = policy.step(policy_image(frame.image), route.goal, memory)
        controls.append(float(np.array(row)[0]))
        frame = environment.step(controls[-1])
        states.append(environment.state[:3])
        if on_step is not None:
            on_step(index)
        if environment.is_over:
            break
    return Drive(
        environment=label or environment.name,
        route=route.name,
        case=case,
        run=run,
        seed=seed,
        states=np.stack(states),
        controls=np.array(controls),
        cross_track_m=route.cross_track_numpy(np.stack(states[1:])),
        time_s=environment.period * np.arange(1, len(controls) + 1),
    )


def policy_image(image: np.ndarray) -> mi.TensorXf:
    """Return what a policy gets: (1, height, width, 3), sRGB in [0, 1].

    Args:
        image: (height, width, 3), uint8 sRGB.
    """
    return mi.TensorXf(np.divide(image[None], 255, dtype=np.float32))
