"""Deployment environments: worlds that an attack was never optimised against."""

from typing import TYPE_CHECKING

from mi_nerfattack._lazy import lazy

if TYPE_CHECKING:
    from .built_in import make_built_in as make_built_in
    from .car import CAR as CAR
    from .car import Car as Car
    from .carla.drivers import KinematicDriver as KinematicDriver
    from .carla.drivers import PhysicalDriver as PhysicalDriver
    from .carla.environment import CarlaEnvironment as CarlaEnvironment
    from .carla.route import route_from_town as route_from_town
    from .carla.session import CarlaServer as CarlaServer
    from .carla.session import load_client as load_client
    from .environment import AbstractEnvironment as AbstractEnvironment
    from .environment import CameraFrame as CameraFrame
    from .mujoco.car import Handling as Handling
    from .mujoco.spec import world_spec as world_spec
    from .mujoco.spec import write_mjcf as write_mjcf
    from .mujoco.vehicle import HeadingRate as HeadingRate
    from .mujoco.vehicle import MujocoVehicle as MujocoVehicle
    from .mujoco.vehicle import SteeringAngle as SteeringAngle
    from .path_traced_sensor import PathTracedSensor as PathTracedSensor
    from .place import Conditions as Conditions
    from .place import bundled_place as bundled_place
    from .registry import make_environment as make_environment
    from .replay.environment import ReplayEnvironment as ReplayEnvironment
    from .replay.environment import open_recording as open_recording
    from .sites import ANY_WEATHER as ANY_WEATHER
    from .sites import AbstractSite as AbstractSite
    from .sites import PlaceSite as PlaceSite
    from .sites import Weather as Weather
    from .vehicle import AbstractVehicle as AbstractVehicle
    from .views.paste import paste_layer as paste_layer

__getattr__, __dir__ = lazy(__name__)
