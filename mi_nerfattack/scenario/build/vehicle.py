"""The vehicle of a scenario: its model and its time step."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_nerfattack.scenario.scenario import VehicleSection, resolve
from mi_nerfattack.scenario.user_code import check_trust, import_function, load_function
from mi_nerfattack.vehicle.ackermann_rate import RateLimitedAckermann
from mi_nerfattack.vehicle.bicycle import KinematicBicycle
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, Ackermann, Dubins
from mi_nerfattack.vehicle.integrators import (
    RK4,
    AbstractIntegrator,
    ExplicitEuler,
    ImplicitMidpoint,
)
from mi_nerfattack.vehicle.state import to_state
from mi_nerfattack.vehicle.trial import require_model
from mi_nerfattack.vehicle.user_model import FunctionDynamics

#: Vehicles with which a user's model is tried.
TRIALS = 3


def build_dynamics(section: VehicleSection, base: str | Path = ".") -> AbstractDynamics:
    """Make the vehicle model; a variant must be set for a custom one.

    Args:
        section: its description.
        base: folder that the path of a function starts from.

    Raises:
        InputError: a function cannot be loaded, or is no model of a vehicle.
    """
    if section.model == "custom":
        return _custom_dynamics(section, base)
    speed, length = section.speed_ms, section.wheelbase_m
    steer = float(np.radians(section.max_steer_deg))
    if section.model == "ackermann":
        return Ackermann(speed, length, steer)
    if section.model == "ackermann_rate":
        rate = float(np.radians(section.max_steer_rate_deg_s))
        return RateLimitedAckermann(speed, length, steer, rate, section.steer_time_s)
    if section.model == "bicycle":
        front, rear = section.front_axle_m, section.rear_axle_m
        return KinematicBicycle(speed, front, rear, steer)
    return Dubins(speed, section.max_heading_rate)


def build_integrator(section: VehicleSection) -> AbstractIntegrator:
    """Make the time step."""
    members: dict[str, AbstractIntegrator] = {
        "euler": ExplicitEuler(),
        "rk4": RK4(),
        "implicit_midpoint": ImplicitMidpoint(),
    }
    return members[section.integrator]


def _custom_dynamics(section: VehicleSection, base: str | Path) -> AbstractDynamics:
    """Load the user's function, and try it near the origin and the initial state."""
    assert section.function is not None and section.control_limit is not None
    check_trust("vehicle.function", section.function, section.trust_code)
    file, _, name = section.function.rpartition(":")
    if file.endswith(".py"):
        function = load_function(resolve(file, base), name)
    else:
        function = import_function(section.function)
    limit, rest = section.control_limit, section.rest_state
    if section.framework == "drjit":
        dynamics = FunctionDynamics(function, section.state_size, limit, rest)
    else:
        from mi_nerfattack.vehicle.torch_model import (
            TorchDynamics,  # torch only if needed
        )

        dynamics = TorchDynamics(function, section.state_size, limit, rest)
    rng = np.random.default_rng(0)
    states = dynamics.extend(rng.normal(size=(TRIALS, 3)))
    # Off the initial values of the other rows: there a model may have a kink.
    states[:, 3:] += 1e-3 * rng.uniform(0.5, 1, (TRIALS, section.state_size - 3))
    state = to_state(states)
    control = type(state[0])(limit * rng.uniform(0.1, 0.5, TRIALS))
    require_model(dynamics.name, dynamics, state, control)
    return dynamics
