"""The closed loop and its adjoint."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .adjoint import AbstractAdjoint as AbstractAdjoint
    from .adjoint import Checkpointed as Checkpointed
    from .adjoint import KeptBackgrounds as KeptBackgrounds
    from .adjoint import Replay as Replay
    from .drive import Drive as Drive
    from .field_sensor import FieldSensor as FieldSensor
    from .function import Evaluation as Evaluation
    from .function import Rollout as Rollout
    from .loop import ClosedLoop as ClosedLoop
    from .loop import Trajectory as Trajectory
    from .loop import simulate as simulate
    from .objective import AbstractObjective as AbstractObjective
    from .objective import StageSum as StageSum
    from .objective import Terminal as Terminal
    from .objective import WeightedSum as WeightedSum
    from .reduction import AbstractReduction as AbstractReduction
    from .reduction import CVaR as CVaR
    from .reduction import Mean as Mean
    from .reduction import Worst as Worst
    from .sensor import AbstractDifferentiableSensor as AbstractDifferentiableSensor
    from .sensor import AbstractSensor as AbstractSensor
    from .sensor import Observation as Observation

__getattr__, __dir__ = lazy(__name__)
