from .gradient import GradientAttack as GradientAttack
from .objectives import AbsoluteDeviation as AbsoluteDeviation
from .objectives import CrossTrackDeviation as CrossTrackDeviation
from .objectives import DepartureTime as DepartureTime
from .objectives import HeadingDeviation as HeadingDeviation
from .objectives import TargetDistance as TargetDistance
from .user_cost import UserCost as UserCost
