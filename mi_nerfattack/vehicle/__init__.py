"""Vehicle models, their integration in time, reference paths."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .ackermann_rate import RateLimitedAckermann as RateLimitedAckermann
    from .bicycle import KinematicBicycle as KinematicBicycle
    from .dynamics import AbstractDynamics as AbstractDynamics
    from .dynamics import Ackermann as Ackermann
    from .dynamics import Dubins as Dubins
    from .integrators import RK4 as RK4
    from .integrators import AbstractIntegrator as AbstractIntegrator
    from .integrators import ExplicitEuler as ExplicitEuler
    from .integrators import ImplicitMidpoint as ImplicitMidpoint
    from .route.route import Route as Route
    from .route.route import load_routes as load_routes
    from .route.route import smooth_absolute as smooth_absolute
    from .route.torch_route import TorchRoute as TorchRoute
    from .torch_model import TorchDynamics as TorchDynamics
    from .user_model import FunctionDynamics as FunctionDynamics

__getattr__, __dir__ = lazy(__name__)
