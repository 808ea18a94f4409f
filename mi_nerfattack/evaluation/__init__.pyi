from .evaluate import EvaluateSettings as EvaluateSettings
from .field_and_scene import CompareOptions as CompareOptions
from .field_and_scene import compare_with_scene as compare_with_scene
from .identity import EnvironmentUnder as EnvironmentUnder
from .work import EvaluateDrives as EvaluateDrives
from .work import run_evaluation as run_evaluation
