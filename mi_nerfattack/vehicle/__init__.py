"""Vehicle models, their integration in time, reference paths and the expert."""

from mi_nerfattack.vehicle.bicycle import KinematicBicycle
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, Ackermann, Dubins
from mi_nerfattack.vehicle.expert import LaneFollower
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
    "AbstractIntegrator",
    "Ackermann",
    "Dubins",
    "ExplicitEuler",
    "FunctionDynamics",
    "ImplicitMidpoint",
    "KinematicBicycle",
    "LaneFollower",
    "RateLimitedAckermann",
    "Route",
    "smooth_absolute",
]
