"""Where driving frames come from: environments of a place, in drawn conditions."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.deploy.car import Car, acceleration_of
from mi_nerfattack.deploy.environment import AbstractEnvironment
from mi_nerfattack.deploy.place import Conditions, Place
from mi_nerfattack.deploy.registry import (
    ENVIRONMENTS,
    environment_versions,
    make_environment,
    offered_environment,
)
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.deploy.vehicle import Motion
from mi_nerfattack.errors import InputError
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fields.io import load_grid
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.conventions import to_colmap
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.render.pathtrace.load import DAYLIGHT, load_scene, scene_files
from mi_nerfattack.vehicle.expert import AbstractExpert, expert_for
from mi_nerfattack.vehicle.route.route import Route, load_routes

#: The environment whose light does not change.
SURROGATE = "surrogate"
#: The environment that a server decides about.
CARLA = "carla"


@dataclass(frozen=True)
class Weather:
    """Conditions of which every shard of frames gets a new draw.

    Args:
        skies: times of day, equally likely.
        exposures_ev: of the camera, in powers of two, equally likely; few, because an
            environment is loaded for each.
        spp: samples per pixel of path-traced images.
    """

    skies: tuple[str, ...] = ("day",)
    exposures_ev: tuple[float, ...] = (0.0,)
    spp: int = 4

    def __post_init__(self) -> None:
        if not self.skies or not self.exposures_ev:
            raise InputError("Weather: no skies or no exposures; at least one of each")
        for sky in self.skies:
            for exposure in self.exposures_ev:
                Conditions(sky, exposure, self.spp)

    def draw(self, rng: np.random.Generator) -> Conditions:
        """Draw conditions."""
        sky = self.skies[int(rng.integers(len(self.skies)))]
        exposure = self.exposures_ev[int(rng.integers(len(self.exposures_ev)))]
        return Conditions(sky, exposure, self.spp)


#: All times of day, and exposures from half to twice the light.
ANY_WEATHER = Weather(tuple(DAYLIGHT), (-1.0, -0.5, 0.0, 0.5, 1.0))


class AbstractSite(ABC):
    """Source of environments and objects; picklable, to be sent to workers.

    Attributes:
        name: of the environments, and of the folder of their frames.
    """

    name: str

    @property
    @abstractmethod
    def rig(self) -> Rig:
        """The cameras of the frames."""

    @property
    @abstractmethod
    def car(self) -> Any:
        """What drives: its `control_unit`, `max_control` and `wheelbase`."""

    @property
    @abstractmethod
    def period(self) -> float:
        """Seconds between two images."""

    @abstractmethod
    def draw(self, rng: np.random.Generator) -> Any:
        """Draw conditions: comparable, and JSON by `dataclasses.asdict`."""

    @abstractmethod
    def typical(self) -> Any:
        """Return the conditions of validation."""

    @abstractmethod
    def open(self, conditions: Any) -> AbstractEnvironment:
        """Make the environment under conditions."""

    @abstractmethod
    def load_objects(self, least: int = 1) -> list[GridField]:
        """Load the fields that stand at the roadside; may be empty.

        Args:
            least: number of fields, each with a separate texture; where the site has
                fewer objects, some come several times.
        """

    @abstractmethod
    def load_surroundings(self) -> Surroundings:
        """Load what decides where objects can stand."""

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """Return all that decides about the frames, as JSON: files by checksum."""


@dataclass(frozen=True)
class PlaceSite(AbstractSite):
    """A registered environment of a place.

    Args:
        name: key of `deploy.registry.ENVIRONMENTS`, or of another package.
        place: files, camera, car.
        weather: conditions of the shards.
        motion: makes the place's motion where an environment is opened: no process can
            send a user's vehicle.
        vehicle: what decides about it, as JSON.
    """

    name: str
    place: Place
    weather: Weather = field(default_factory=Weather)
    motion: Callable[[], Motion] | None = None
    vehicle: Mapping[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.name not in ENVIRONMENTS:
            offered_environment(self.name)
        if self.name == SURROGATE and self.place.field is None:
            raise InputError(
                f"environment {SURROGATE!r}: the place has no field; make one with "
                "'mi-nerfattack fit' and give it, or leave this environment out"
            )

    @property
    def rig(self) -> Rig:
        """The place's cameras."""
        return self.place.rig

    @property
    def car(self) -> Any:
        """The place's car."""
        return self.place.car

    @property
    def period(self) -> float:
        """The place's period."""
        return self.place.period

    def draw(self, rng: np.random.Generator) -> Conditions:
        """Draw from the weather; the light of the surrogate is in its field."""
        if self.name == SURROGATE:
            return self.typical()
        return self.weather.draw(rng)

    def typical(self) -> Conditions:
        """Return the first sky without exposure."""
        return Conditions(self.weather.skies[0], 0.0, self.weather.spp)

    def open(self, conditions: Conditions) -> AbstractEnvironment:
        """Make the environment by its name."""
        place = self.place
        if self.motion is not None:
            place = replace(place, motion=self.motion())
        return make_environment(self.name, place, conditions)

    def load_objects(self, least: int = 1) -> list[GridField]:
        """Load the place's objects, in turns."""
        paths = self.place.objects
        count = max(len(paths), least) if paths else 0
        return [load_grid(path) for path in islice(cycle(paths), count)]

    def load_surroundings(self, routes: Sequence[Route] = ()) -> Surroundings:
        """Load the place's scene, and all its routes, or take these routes."""
        place = self.place
        return Surroundings(
            load_scene(place.scene),
            routes or load_routes(place.routes),
            place.camera,
            mount=place.mount,
            period=place.period,
        )

    def describe(self) -> dict[str, Any]:
        """Return checksums of the files, and the numbers."""
        place = self.place
        paths = [*scene_files(place.scene), *place.objects, place.routes]
        if place.field is not None:
            paths.append(place.field)
        return {
            "environment": self.name,
            "files": _checksums(paths),
            **_order(place.objects),
            "camera": to_colmap(place.camera)[1],
            "mount": place.mount.described(),
            "car": _car(place.car),
            "period": place.period,
            "weather": asdict(self.weather),
            **({} if self.vehicle is None else {"vehicle": dict(self.vehicle)}),
            **_engine(self.name, place),
            **_posed(place),
            **_others(place),
        }


def _car(car: Car) -> dict[str, Any]:
    """Return a car's numbers; of a car with one control nothing about others."""
    extra = ("more_controls",) if car.more_controls else ()
    names = [f.name for f in fields(car) if f.name != "more_controls"]
    return {name: asdict(car)[name] for name in (*names, *extra)}


def expert_of(site: AbstractSite, route: Route) -> AbstractExpert:
    """Make the expert that labels a site's frames on a route."""
    car = site.car
    return expert_for(
        car.control_unit,
        route,
        site.period,
        max_control=car.max_control,
        wheelbase=car.wheelbase,
        acceleration=acceleration_of(car.more_controls),
    )


def probe_expert(site: AbstractSite, route: Route) -> list[float]:
    """Return an expert's steering at three poses near a route's middle.

    The values identify the expert: other experts steer differently there.
    """
    expert, controls = expert_of(site, route), []
    for lateral, heading in ((0.1, 0.0), (-0.2, 0.05), (0.0, -0.1)):
        state = route.pose_at(route.length / 2, lateral, heading)
        controls.append(round(float(np.ravel(expert.control(state))[0]), 4))
    return controls


def _order(objects: Sequence[Path]) -> dict[str, list[str]]:
    """Return checksums in the order of several objects, which decides who is shown."""
    return {"objects": [files.sha256(x) for x in objects]} if objects[1:] else {}


def _posed(place: Place) -> dict[str, Any]:
    """Return where the field is put, if it is."""
    pose = place.field_pose
    if pose is None:
        return {}
    rows = pose.rotation.tolist(), pose.translation.tolist()
    return {"field_pose": [*rows, pose.scale]}


def _others(place: Place) -> dict[str, Any]:
    """Return all cameras, if there are several."""
    return {} if place.others is None else {"cameras": place.rig.described()}


def _engine(name: str, place: Place) -> dict[str, str]:
    """Return versions and server of what an environment needs besides Mitsuba."""
    server = {"server": place.server} if name == CARLA else {}
    return {**environment_versions(name), **server}


def _checksums(paths: Sequence[Path]) -> dict[str, str]:
    """Return checksums by file and folder, which tells files of equal names apart."""
    sums: dict[str, str] = {}
    for path in paths:
        key = f"{path.resolve().parent.name}/{path.name}"
        # where folders, too, have equal names, one checksum follows the other
        sums[key] = sums.get(key, "") + files.sha256(path)
    return sums
