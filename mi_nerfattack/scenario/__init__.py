"""The scenario file as models."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .build.policy import load_policy as load_policy
    from .build.world import World as World
    from .build.world import build_world as build_world
    from .scenario import Scenario as Scenario
    from .scenario import load_scenario as load_scenario
    from .sections import PolicySection as PolicySection

__getattr__, __dir__ = lazy(__name__)
