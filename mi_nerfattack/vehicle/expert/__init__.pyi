from .base import AbstractExpert as AbstractExpert
from .choose import expert_for as expert_for
from .lane_follower import LaneFollower as LaneFollower
from .lane_follower import SteeringFollower as SteeringFollower
from .pid import PIDExpert as PIDExpert
