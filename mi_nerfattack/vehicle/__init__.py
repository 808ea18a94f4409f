"""Vehicle models, their integration in time, reference paths and experts."""

from mi_nerfattack.vehicle.bicycle import KinematicBicycle
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, Ackermann, Dubins
from mi_nerfattack.vehicle.expert import (
    AbstractExpert,
    LaneFollower,
    PIDExpert,
    SteeringFollower,
    expert_for,
)
from mi_nerfattack.vehicle.function import FunctionDynamics
from mi_nerfattack.vehicle.integrators import (
    RK4,
    AbstractIntegrator,
    ExplicitEuler,
    ImplicitMidpoint,
)
from mi_nerfattack.vehicle.route import Route, smooth_absolute
from mi_nerfattack.vehicle.steering import RateLimitedAckermann

__all__ = [
    "RK4",
    "AbstractDynamics",
    "AbstractExpert",
    "AbstractIntegrator",
    "Ackermann",
    "Dubins",
    "ExplicitEuler",
    "FunctionDynamics",
    "ImplicitMidpoint",
    "KinematicBicycle",
    "LaneFollower",
    "PIDExpert",
    "RateLimitedAckermann",
    "Route",
    "SteeringFollower",
    "expert_for",
    "smooth_absolute",
]
