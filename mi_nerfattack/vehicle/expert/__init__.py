"""Experts that follow a route: what policies imitate."""

from mi_nerfattack.vehicle.expert.base import AbstractExpert
from mi_nerfattack.vehicle.expert.choose import SteeringFollower, expert_for
from mi_nerfattack.vehicle.expert.lane_follower import LaneFollower
from mi_nerfattack.vehicle.expert.pid import PIDExpert

__all__ = [
    "AbstractExpert",
    "LaneFollower",
    "PIDExpert",
    "SteeringFollower",
    "expert_for",
]
