"""Closed-loop error and its intervals; fields against scenes."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .evaluate import EvaluateSettings as EvaluateSettings
    from .field_and_scene import CompareOptions as CompareOptions
    from .field_and_scene import compare_with_scene as compare_with_scene
    from .identity import EnvironmentUnder as EnvironmentUnder
    from .work import EvaluateWork as EvaluateWork
    from .work import run_evaluation as run_evaluation

__getattr__, __dir__ = lazy(__name__)
