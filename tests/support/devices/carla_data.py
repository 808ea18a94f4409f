"""Values of the stand-in for CARLA's client: see `carla`."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

ROAD_HEIGHT, WALL = 0.25, 20.0  # metres


@dataclass
class Location:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


Vector3D = type("Vector3D", (Location,), {})


@dataclass
class Rotation:
    pitch: float = 0.0
    yaw: float = 0.0
    roll: float = 0.0


@dataclass
class Transform:
    location: Location = field(default_factory=Location)
    rotation: Rotation = field(default_factory=Rotation)


@dataclass
class WorldSettings:
    synchronous_mode: bool = False
    no_rendering_mode: bool = False
    fixed_delta_seconds: float | None = None
    substepping: bool = True
    max_substep_delta_time: float = 0.01
    max_substeps: int = 10


@dataclass
class WeatherParameters:
    cloudiness: float = 0.0


WeatherParameters.ClearNoon = WeatherParameters(5.0)  # type: ignore[attr-defined]


WeatherParameters.CloudyNoon = WeatherParameters(60.0)  # type: ignore[attr-defined]


@dataclass
class WheelPhysicsControl:
    position: Location


@dataclass
class VehiclePhysicsControl:
    wheels: list[WheelPhysicsControl]


@dataclass
class Image:
    frame: int
    width: int
    height: int
    raw_data: bytes
    transform: Transform


class Map:
    """Road 1 along x from 0 to 50 m; then 2 straight on, or 3 to the right.

    Road 3 is a quarter of a circle of 10 m and then straight along +y, which is to
    the right of +x in CARLA's axes.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    def get_spawn_points(self) -> list[Transform]:
        return [Transform(Location(5.0, 0.0, ROAD_HEIGHT))]

    def get_waypoint(self, location: Location) -> Waypoint:
        if location.y > 5:
            return Waypoint(3, _ARC + max(location.y - 10, 0.0))
        x = min(max(location.x, 0.0), 100.0)
        return Waypoint(1, x) if x < 50 else Waypoint(2, x - 50)


_ARC = 5 * math.pi  # metres, a quarter of a circle of radius 10 m


_LENGTHS = {1: 50.0, 2: 50.0, 3: _ARC + 40}


@dataclass
class Waypoint:
    road_id: int
    s: float

    lane_id, section_id, lane_width = -1, 0, 3.5

    @property
    def transform(self) -> Transform:
        if self.road_id < 3:
            x = self.s + 50 * (self.road_id - 1)
            return Transform(Location(x, 0.0, ROAD_HEIGHT))
        angle = min(self.s / 10, math.pi / 2)
        x, y = 50 + 10 * math.sin(angle), 10 - 10 * math.cos(angle)
        y += max(self.s - _ARC, 0.0)
        return Transform(Location(x, y, ROAD_HEIGHT), Rotation(0, math.degrees(angle)))

    def next(self, distance: float) -> list[Waypoint]:
        s, length = self.s + distance, _LENGTHS[self.road_id]
        if s <= length:
            return [Waypoint(self.road_id, s)]
        return [Waypoint(i, s - length) for i in (2, 3)] if self.road_id == 1 else []


def along(yaw_deg: float) -> tuple[float, float]:
    return math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
