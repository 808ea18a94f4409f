"""Vehicle models, their integration in time, reference paths."""

from mi_nerfattack.vehicle.ackermann_rate import RateLimitedAckermann
from mi_nerfattack.vehicle.bicycle import KinematicBicycle
from mi_nerfattack.vehicle.dynamics import AbstractDynamics, Ackermann, Dubins
from mi_nerfattack.vehicle.integrators import (
    RK4,
    AbstractIntegrator,
    ExplicitEuler,
    ImplicitMidpoint,
)
from mi_nerfattack.vehicle.route.route import Route, smooth_absolute
from mi_nerfattack.vehicle.user_model import FunctionDynamics

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
    "RateLimitedAckermann",
    "Route",
    "smooth_absolute",
]
