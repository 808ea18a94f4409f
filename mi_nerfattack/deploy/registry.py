"""Environments by name: what they need, and how each is made."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import signature
from typing import TYPE_CHECKING, Any

from mi_nerfattack.deploy.built_in import built_in_shapes
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.simulated import AbstractSimulation, SimulatedEnvironment
from mi_nerfattack.deploy.surrogate.environment import SurrogateEnvironment
from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.deploy.vehicle import AbstractVehicle, KinematicVehicle, Motion
from mi_nerfattack.deploy.views.mitsuba import MitsubaView
from mi_nerfattack.deploy.views.paste import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.io import load_field
from mi_nerfattack.render.pathtrace.load import load_scene, set_daylight
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.vehicle.dynamics import Ackermann, Dubins

if TYPE_CHECKING:
    from mi_nerfattack.system.entry_points import Offer


def kinematic_vehicle(place: Place) -> KinematicVehicle:
    """Make what drives at a place, where an environment has no physics."""
    car, motion = place.car, place.motion
    if motion is None:
        steered = Ackermann(wheelbase=car.wheelbase, max_steer=car.max_control)
        turned = Dubins(max_heading_rate=car.max_control)
        motion = Motion(steered if car.control_unit == "rad" else turned)
    return KinematicVehicle(
        motion,
        place.period,
        car.max_control,
        control_unit=car.control_unit,
        more_controls=car.more_controls,
        reference=car.reference,
    )


def mitsuba_views(place: Place, conditions: Conditions) -> list[MitsubaView]:
    """Load a place's scene, seen by each of its cameras under conditions."""
    scene = load_scene(place.scene, shapes=built_in_shapes(conditions.built_in))
    set_daylight(scene, conditions.sky)
    return [
        MitsubaView(scene, camera, conditions.spp, exposure_ev=conditions.exposure_ev)
        for camera in place.rig.cameras
    ]


def _surrogate(place: Place, conditions: Conditions) -> AbstractEnvironment:
    if place.field is None:
        raise InputError(
            "environment 'surrogate': the place has no field; make one with "
            "'mi-nerfattack fit' and give it"
        )
    _refuse_built_in("surrogate", conditions)
    scene = PosedField(load_field(place.field), place.field_pose)
    sensor = field_sensor(scene, [], place.camera, mount=place.mount).with_rig(
        place.rig
    )
    return SurrogateEnvironment(sensor, kinematic_vehicle(place))


def _mitsuba(place: Place, conditions: Conditions) -> AbstractEnvironment:
    vehicle = kinematic_vehicle(place)
    return _pair("mitsuba", vehicle, mitsuba_views(place, conditions), place=place)


def _mujoco(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.mujoco.vehicle import MujocoVehicle

    vehicle = MujocoVehicle(place.car, period=place.period)
    return _pair("mujoco", vehicle, mitsuba_views(place, conditions), place=place)


def _mujoco_gl(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.mujoco.vehicle import MujocoVehicle
    from mi_nerfattack.deploy.mujoco.view import MujocoView

    scene = load_scene(place.scene)
    set_daylight(scene, conditions.sky)
    views = [
        MujocoView(
            scene, camera, conditions.built_in, exposure_ev=conditions.exposure_ev
        )
        for camera in place.rig.cameras
    ]
    vehicle = MujocoVehicle(place.car, period=place.period)
    return _pair("mujoco_gl", vehicle, views, place=place)


def _carla(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.carla.drivers import KinematicDriver
    from mi_nerfattack.deploy.carla.environment import CarlaEnvironment
    from mi_nerfattack.deploy.carla.session import CarlaServer

    place.rig.require_one("environment 'carla'", _OTHER)
    _refuse_built_in("carla", conditions)
    _refuse_disturbed("carla", conditions)
    server = CarlaServer.parse(place.server, weather=_CARLA_WEATHER[conditions.sky])
    driver = KinematicDriver(kinematic_vehicle(place))
    exposure = {"exposure_compensation": str(conditions.exposure_ev)}
    return CarlaEnvironment(
        server,
        place.camera,
        place.mount,
        driver=driver,
        period=place.period,
        attributes=exposure if conditions.exposure_ev else None,
    )


def _replay(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.replay.environment import (
        ReplayEnvironment,
        open_recording,
    )
    from mi_nerfattack.deploy.replay.mcap import McapTopics

    if place.recording is None:
        raise InputError(
            "environment 'replay': the place has no recording; give it a folder, a "
            "video or an MCAP log"
        )
    place.rig.require_one("environment 'replay'", _OTHER)
    _refuse_built_in("replay", conditions)
    _refuse_disturbed("replay", conditions)
    recording = open_recording(
        place.recording,
        place.camera,
        place.car.from_axle(place.mount),
        period=place.period,
        topics=McapTopics.parse(place.topics),
    )
    car = place.car
    return ReplayEnvironment(
        recording,
        place.mount,
        period=place.period,
        max_control=car.max_control,
        control_unit=car.control_unit,
        more_controls=car.more_controls,
    )


def _refuse_built_in(name: str, conditions: Conditions) -> None:
    if conditions.built_in:
        raise InputError(
            f"environment {name!r}: takes no built-in objects; show fields, which it "
            "pastes or composes"
        )


def _refuse_disturbed(name: str, conditions: Conditions) -> None:
    if conditions.blur_px or conditions.noise_sd:
        raise InputError(
            f"environment {name!r}: takes no blur_px and no noise_sd; its images are "
            "shown as they come, leave both 0"
        )


def _pair(
    name: str, vehicle: AbstractVehicle, views: Sequence[AbstractView], place: Place
) -> SimulatedEnvironment:
    return SimulatedEnvironment(
        name, vehicle, views, rig=place.rig, period=place.period
    )


#: What takes several cameras.
_OTHER = "drive in 'surrogate', 'mitsuba', 'mujoco' or 'mujoco_gl'"


#: CARLA's weather for our times of day; its sun is not ours.
_CARLA_WEATHER = {
    "day": "ClearNoon",
    "morning": "ClearSunset",
    "noon": "ClearNoon",
    "evening": "ClearSunset",
    "overcast": "CloudyNoon",
}

#: What makes an environment of a place under conditions, by name.
ENVIRONMENTS: Mapping[str, Callable[..., AbstractEnvironment]] = {
    "surrogate": _surrogate,
    "mitsuba": _mitsuba,
    "mujoco": _mujoco,
    "mujoco_gl": _mujoco_gl,
    "replay": _replay,
    "carla": _carla,
}


def offered_environment(
    name: str, where: str = "environment: ", known: Iterable[str] = ()
) -> Offer:
    """Return the function of another package that makes an environment.

    Args:
        name: of the environment.
        where: begins the message of an unknown name.
        known: names of this package, for the message; all by default.

    Raises:
        InputError: unknown name, or a package that cannot be imported.
    """
    from mi_nerfattack.system import entry_points

    group, known = entry_points.ENVIRONMENTS, known or ENVIRONMENTS
    offer = entry_points.find(group, name, known, where=where)
    if not callable(offer.value):
        raise offer.refuse(f"is {offer.value!r}, no function")
    return offer


def make_environment(
    name: str,
    place: Place,
    conditions: Conditions | None = None,
    settings: Mapping[str, Any] | None = None,
) -> AbstractEnvironment:
    """Make an environment.

    Args:
        name: key of `ENVIRONMENTS`, or an environment of another package.
        place: its files.
        conditions: of light and camera; those of the files unless given.
        settings: further arguments of the function of another package.

    Raises:
        InputError: unknown name, a file that is missing or cannot be read, or a
            function that makes no environment.
        SetupError: a package is not installed.
    """
    conditions = conditions or Conditions()
    make, settings = ENVIRONMENTS.get(name), settings or {}
    if make is None:
        make = offered_environment(name).value
        try:
            signature(make).bind(place, conditions, **settings)
        except TypeError as err:
            raise InputError(
                f"environment: {name!r}: {err}; drive there by a scenario, whose "
                "[deployment] gives it"
            ) from err
    environment = make(place, conditions, **settings)
    if not isinstance(environment, AbstractEnvironment):
        raise InputError(
            f"environment: {name!r}: its package makes {type(environment).__name__}; "
            "its function must return an AbstractEnvironment"
        )
    if isinstance(environment, AbstractSimulation):
        environment.blur_px = conditions.blur_px
        environment.noise_sd = conditions.noise_sd
    else:
        _refuse_disturbed(name, conditions)
    return environment


def environment_versions(name: str) -> dict[str, str]:
    """Return the versions of packages that one deployment environment needs.

    Args:
        name: key of `ENVIRONMENTS`, or an environment of another package.
    """
    if name not in ENVIRONMENTS:
        return {name: offered_environment(name).package}
    versions = {}
    for package in _NEEDED.get(name, ()):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"  # making the environment says so
    return versions


_NEEDED = {"mujoco": ("mujoco",), "mujoco_gl": ("mujoco",), "carla": ("carla",)}
