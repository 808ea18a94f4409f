from .choose import expert_for as expert_for
from .lane_follower import AbstractExpert as AbstractExpert
from .lane_follower import LaneFollower as LaneFollower
from .lane_follower import SpeedKeeper as SpeedKeeper
from .lane_follower import SteeringFollower as SteeringFollower
from .lane_follower import future_positions as future_positions
