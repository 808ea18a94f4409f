"""Experts that follow a route: what policies imitate."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .base import AbstractExpert as AbstractExpert
    from .choose import expert_for as expert_for
    from .lane_follower import LaneFollower as LaneFollower
    from .lane_follower import SteeringFollower as SteeringFollower
    from .pid import PIDExpert as PIDExpert

__getattr__, __dir__ = lazy(__name__)
