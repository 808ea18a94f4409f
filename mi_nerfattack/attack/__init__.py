"""Attacks on a closed loop: gradient, baselines, objectives."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .gradient import GradientAttack as GradientAttack
    from .objectives import AbsoluteDeviation as AbsoluteDeviation
    from .objectives import CrossTrackDeviation as CrossTrackDeviation
    from .objectives import DepartureTime as DepartureTime
    from .objectives import HeadingDeviation as HeadingDeviation
    from .objectives import TargetDistance as TargetDistance
    from .user_cost import UserCost as UserCost

__getattr__, __dir__ = lazy(__name__)
