"""Environments by name: what they need, and how each is made."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mi_nerfattack.deploy.built_in import BuiltInObject, built_in_shapes
from mi_nerfattack.deploy.car import CAR, SMALL_CAR, Car
from mi_nerfattack.deploy.daylight import DAYLIGHT, set_daylight
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.field_view import FieldView
from mi_nerfattack.deploy.kinematic import KinematicVehicle
from mi_nerfattack.deploy.mitsuba_view import MitsubaView
from mi_nerfattack.deploy.simulated import SimulatedEnvironment
from mi_nerfattack.deploy.vehicle import AbstractVehicle
from mi_nerfattack.deploy.view import AbstractView
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.io import load_field
from mi_nerfattack.render.camera import Camera, CameraMount, from_fov
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.scene import load_scene
from mi_nerfattack.vehicle.dynamics import Ackermann, Dubins
from mi_nerfattack.vehicle.integrators import RK4


@dataclass(frozen=True)
class Place:
    """Files of a scene in its forms, and what drives there.

    Args:
        scene: Mitsuba XML.
        field: the scene's field, of the surrogate; None where there is none.
        routes: JSON.
        objects: grid fields that may stand beside the road.
        camera: of the vehicle.
        mount: the camera's place on it.
        period: seconds between two images.
        car: what drives.
        recording: of `replay`: a folder, a video or a log.
        server: of `carla`: "HOST:PORT" or "HOST:PORT/TOWN".
    """

    scene: Path
    field: Path | None
    routes: Path
    objects: tuple[Path, ...]
    camera: Camera
    mount: CameraMount
    period: float = 0.1
    car: Car = CAR
    recording: Path | None = None
    server: str = "127.0.0.1:2000"

    def __post_init__(self) -> None:
        """Check the period."""
        if not 0 < self.period < float("inf"):
            raise InputError(f"place.period: {self.period!r}; a positive time, seconds")


@dataclass(frozen=True)
class Conditions:
    """What changes between drives at one place.

    Args:
        sky: time of day, key of `DAYLIGHT`: "day" (the file's), "morning", "noon",
            "evening", "overcast".
        exposure_ev: of the camera, in powers of two.
        spp: samples per pixel of path-traced images.
        built_in: objects with geometry, lit and shadowed by the environment.
    """

    sky: str = "day"
    exposure_ev: float = 0.0
    spp: int = 16
    built_in: tuple[BuiltInObject, ...] = ()

    def __post_init__(self) -> None:
        """Check the ranges."""
        if self.sky not in DAYLIGHT:
            raise InputError(f"sky: {self.sky!r}; one of {', '.join(DAYLIGHT)}")
        if not math.isfinite(self.exposure_ev):
            raise InputError(f"exposure_ev: {self.exposure_ev}; must be finite")
        if not isinstance(self.spp, int) or self.spp < 1:
            raise InputError(f"spp: {self.spp!r}; at least 1 sample per pixel, whole")


def kinematic_vehicle(car: Car, period: float) -> KinematicVehicle:
    """Make the kinematic model of a car: Dubins for "rad/s", Ackermann for "rad"."""
    model: Any
    if car.control_unit == "rad":
        model = Ackermann(wheelbase=car.wheelbase, max_steer=car.max_control)
    else:
        model = Dubins(max_heading_rate=car.max_control)
    return KinematicVehicle(model, RK4(), period, car.max_control, car.control_unit)


def mitsuba_view(place: Place, conditions: Conditions) -> MitsubaView:
    """Load a place's scene as seen under conditions."""
    scene = load_scene(place.scene, shapes=built_in_shapes(conditions.built_in))
    set_daylight(scene, conditions.sky)
    return MitsubaView(scene, place.camera, conditions.spp, conditions.exposure_ev)


def _surrogate(place: Place, conditions: Conditions) -> AbstractEnvironment:
    if place.field is None:
        raise InputError(
            "environment 'surrogate': the place has no field; make one with "
            "'mi-nerfattack fit' and give it"
        )
    _refuse_built_in("surrogate", conditions)
    view = FieldView(PosedField(load_field(place.field)), place.camera)
    return _pair("surrogate", kinematic_vehicle(place.car, place.period), view, place)


def _mitsuba(place: Place, conditions: Conditions) -> AbstractEnvironment:
    vehicle = kinematic_vehicle(place.car, place.period)
    return _pair("mitsuba", vehicle, mitsuba_view(place, conditions), place)


def _mujoco(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.mujoco_vehicle import MujocoVehicle

    vehicle = MujocoVehicle(place.car, period=place.period)
    return _pair("mujoco", vehicle, mitsuba_view(place, conditions), place)


def _mujoco_gl(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.mujoco_vehicle import MujocoVehicle
    from mi_nerfattack.deploy.mujoco_view import MujocoView

    scene = load_scene(place.scene)
    set_daylight(scene, conditions.sky)
    view = MujocoView(scene, place.camera, conditions.built_in, conditions.exposure_ev)
    vehicle = MujocoVehicle(place.car, period=place.period)
    return _pair("mujoco_gl", vehicle, view, place)


def _carla(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.carla_drivers import KinematicDriver
    from mi_nerfattack.deploy.carla_environment import CarlaEnvironment
    from mi_nerfattack.deploy.carla_session import CarlaServer

    _refuse_built_in("carla", conditions)
    server = CarlaServer.parse(place.server, weather=_CARLA_WEATHER[conditions.sky])
    driver = KinematicDriver(kinematic_vehicle(place.car, place.period))
    exposure = {"exposure_compensation": str(conditions.exposure_ev)}
    return CarlaEnvironment(
        server,
        place.camera,
        place.mount,
        driver,
        place.period,
        attributes=exposure if conditions.exposure_ev else None,
    )


def _replay(place: Place, conditions: Conditions) -> AbstractEnvironment:
    from mi_nerfattack.deploy.replay import ReplayEnvironment, open_recording

    if place.recording is None:
        raise InputError(
            "environment 'replay': the place has no recording; give it a folder, a "
            "video or an MCAP log"
        )
    _refuse_built_in("replay", conditions)
    recording = open_recording(place.recording, place.camera, place.mount, place.period)
    car = place.car
    return ReplayEnvironment(
        recording, place.mount, place.period, car.max_control, car.control_unit
    )


def _refuse_built_in(name: str, conditions: Conditions) -> None:
    if conditions.built_in:
        raise InputError(
            f"environment {name!r}: takes no built-in objects; show fields, which it "
            "pastes or composes"
        )


def _pair(
    name: str, vehicle: AbstractVehicle, view: AbstractView, place: Place
) -> SimulatedEnvironment:
    return SimulatedEnvironment(name, vehicle, view, place.mount, place.period)


#: CARLA's weather for our times of day; its sun is not ours.
_CARLA_WEATHER = {
    "day": "ClearNoon",
    "morning": "ClearSunset",
    "noon": "ClearNoon",
    "evening": "ClearSunset",
    "overcast": "CloudyNoon",
}

#: What makes an environment of a place under conditions, by name.
ENVIRONMENTS: Mapping[str, Callable[[Place, Conditions], AbstractEnvironment]] = {
    "surrogate": _surrogate,
    "mitsuba": _mitsuba,
    "mujoco": _mujoco,
    "mujoco_gl": _mujoco_gl,
    "replay": _replay,
    "carla": _carla,
}


def make_environment(
    name: str, place: Place, conditions: Conditions | None = None
) -> AbstractEnvironment:
    """Make an environment.

    Args:
        name: key of `ENVIRONMENTS`.
        place: its files.
        conditions: of light and camera; those of the files unless given.

    Raises:
        InputError: unknown name, a package that is not installed, a file that is
            missing or cannot be read.
    """
    if name not in ENVIRONMENTS:
        known = ", ".join(ENVIRONMENTS)
        raise InputError(f"environment: {name!r}; one of {known}")
    return ENVIRONMENTS[name](place, conditions or Conditions())


def bundled_place(name: str = "intersection") -> Place:
    """Return a bundled scene with its routes, objects and car.

    Args:
        name: "intersection", with the full-size car; or "room", with the small car on
            its square track, which has no field.
    """
    from mi_nerfattack.scenes import bundled  # pyright: ignore[reportMissingImports]

    if name not in _CARS:
        raise InputError(f"place: {name!r}; one of {', '.join(_CARS)}")
    car, mount = _CARS[name]
    field = "intersection/field.safetensors"
    return Place(
        scene=bundled(f"{name}/scene.xml"),
        field=bundled(field) if name == "intersection" else None,
        routes=bundled(f"{name}/routes.json"),
        objects=(bundled("hydrant/field.safetensors"),),
        camera=from_fov(200, 66, 90.0),
        mount=mount,
        car=car,
    )


#: Cars of the bundled places, and where their cameras are.
_CARS = {
    "intersection": (CAR, CameraMount()),
    "room": (SMALL_CAR, CameraMount(height_m=0.2, forward_m=0.3, pitch_deg=10.0)),
}
