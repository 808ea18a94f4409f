from .policy.kinds import PolicySection as PolicySection
from .policy.kinds import load_policy as load_policy
from .scenario import Scenario as Scenario
from .scenario import load_scenario as load_scenario
from .world import World as World
from .world import build_world as build_world
