"""A stand-in for CARLA's client and server, in this process and without rendering.

No CARLA server runs where the tests run. These classes mimic those of the client
0.9.16 as far as `mi_nerfattack.deploy` uses them; `test_environment.py` compares their
names and parameters with the real client's where that is installed. An image is one
colour with a wall at one distance: what they show says nothing about CARLA's pictures.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from support.devices.carla_data import (
    WALL,
    Image,
    Location,
    Map,
    Rotation,
    Transform,
    Vector3D,
    VehiclePhysicsControl,
    WeatherParameters,
    WheelPhysicsControl,
    WorldSettings,
    along,
)

COLOUR = (90, 60, 30)  # red, green, blue
AXLE = 1.45  # metres
TIMEOUT = "time-out of 500ms while waiting for the simulator"


class Server:
    """The world behind all clients of one stand-in, and the faults it shall have.

    Attributes:
        answers: whether it answers at all.
        ends_after: frames after which it answers no more.
        occupied: kinds of actors that cannot be spawned.
        lost: numbers of frames whose depth image never comes.
        jump: added to the frame numbers of images.
        interrupted: frame upon which Ctrl-C comes.
    """

    def __init__(self) -> None:
        self.version, self.answers = "0.9.16", True
        self.ends_after = self.interrupted = math.inf
        self.occupied: set[str] = set()
        self.lost: set[int] = set()
        self.jump, self.frame, self.time_limits = 0, 100, []
        self.town, self.towns = "Town01", ["/Game/Carla/Maps/Town01", "Town03"]
        self.settings, self.weather = WorldSettings(), WeatherParameters(1.0)
        self.actors: dict[int, Actor] = {}
        self.next_id = 1

    @property
    def is_as_before(self) -> bool:
        """Whether a session left nothing behind."""
        untouched = self.settings == WorldSettings() and not self.actors
        return untouched and self.weather == WeatherParameters(1.0)

    def require(self) -> None:
        if not self.answers or self.frame > self.ends_after:
            raise RuntimeError(TIMEOUT)

    def api(self) -> SimpleNamespace:
        """The module `carla`, with clients that reach this server."""

        def connect(host: str = "127.0.0.1", port: int = 2000) -> Client:
            return Client(host, port, self)

        names = (Location, Vector3D, Rotation, Transform)
        table = {item.__name__: item for item in (*names, WeatherParameters)}
        return SimpleNamespace(Client=connect, **table)


class Client:
    def __init__(self, host: str, port: int, server: Server | None = None) -> None:
        assert server is not None
        self._server = server

    def set_timeout(self, seconds: float) -> None:
        self._server.time_limits.append(seconds)

    def get_client_version(self) -> str:
        return "0.9.16"

    def get_server_version(self) -> str:
        self._server.require()
        return self._server.version

    def get_world(self) -> World:
        self._server.require()
        return World(self._server)

    def get_available_maps(self) -> list[str]:
        return list(self._server.towns)

    def load_world(self, map_name: str) -> World:
        self._server.require()
        self._server.town = map_name
        self._server.settings = WorldSettings()
        return World(self._server)


class World:
    def __init__(self, server: Server) -> None:
        self._server = server

    def get_settings(self) -> WorldSettings:
        self._server.require()
        return copy.copy(self._server.settings)

    def apply_settings(self, settings: WorldSettings, seconds: float = 0.0) -> int:
        self._server.require()
        self._server.settings = copy.copy(settings)
        return self._server.frame

    def get_weather(self) -> WeatherParameters:
        return copy.copy(self._server.weather)

    def set_weather(self, weather: WeatherParameters) -> None:
        self._server.require()
        self._server.weather = copy.copy(weather)

    def get_map(self) -> Map:
        return Map(f"Carla/Maps/{self._server.town}")

    def get_blueprint_library(self) -> BlueprintLibrary:
        return BlueprintLibrary()

    def try_spawn_actor(
        self,
        blueprint: ActorBlueprint,
        transform: Transform,
        attach_to: Actor | None = None,
    ) -> Actor | None:
        self._server.require()
        if blueprint.id in self._server.occupied:
            return None
        kind = Sensor if blueprint.id.startswith("sensor") else Vehicle
        return kind(self._server, blueprint, copy.deepcopy(transform), attach_to)

    def tick(self, seconds: float = 0.0) -> int:
        server = self._server
        server.frame += 1
        server.require()
        assert server.settings.synchronous_mode, "ticked in asynchronous mode"
        for actor in list(server.actors.values()):
            actor._deliver(server.frame)
        if server.frame > server.interrupted:
            raise KeyboardInterrupt
        return server.frame

    def get_snapshot(self) -> WorldSnapshot:
        return WorldSnapshot(self._server)


class WorldSnapshot:
    def __init__(self, server: Server) -> None:
        self._actors = dict(server.actors)

    def find(self, actor_id: int) -> ActorSnapshot | None:
        actor = self._actors.get(actor_id)
        return None if actor is None else ActorSnapshot(actor.get_transform())


@dataclass
class ActorSnapshot:
    _transform: Transform

    def get_transform(self) -> Transform:
        return self._transform


class BlueprintLibrary:
    def find(self, id: str) -> ActorBlueprint:
        if id not in {"vehicle.tesla.model3", *_SENSORS}:
            raise IndexError(f"blueprint '{id}' not found")
        return ActorBlueprint(id)


_CAMERA = dict(image_size_x="800", image_size_y="600", fov="90", sensor_tick="0")
_LENS = dict(motion_blur_intensity="0.45", exposure_compensation="0.0")
_SENSORS = {"sensor.camera.rgb": _CAMERA | _LENS, "sensor.camera.depth": _CAMERA}


class ActorBlueprint:
    def __init__(self, id: str) -> None:
        self.id = id
        self._values = dict(_SENSORS.get(id, {"role_name": "autopilot"}))

    def has_attribute(self, id: str) -> bool:
        return id in self._values

    def set_attribute(self, id: str, value: str) -> None:
        assert isinstance(value, str), "CARLA's attributes are strings"
        self._values[id] = value


class Actor:
    """Any actor; positions in CARLA's axes, angles in degrees."""

    def __init__(
        self,
        server: Server,
        blueprint: ActorBlueprint,
        transform: Transform,
        parent: Actor | None,
    ) -> None:
        self._server, self._place, self._parent = server, transform, parent
        self.id, self.type_id = server.next_id, blueprint.id
        self.attributes = dict(blueprint._values)
        server.next_id += 1
        server.actors[self.id] = self

    def destroy(self) -> bool:
        self._server.require()
        return self._server.actors.pop(self.id, None) is not None

    def get_transform(self) -> Transform:
        return copy.deepcopy(self._place)

    def set_transform(self, transform: Transform) -> None:
        self._place = copy.deepcopy(transform)

    def _deliver(self, frame: int) -> None:
        pass


class Vehicle(Actor):
    """A vehicle whose origin is midway between its axles, and which stands."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._physics = True

    def set_simulate_physics(self, enabled: bool = True) -> None:
        self._physics = enabled

    def get_physics_control(self) -> VehiclePhysicsControl:
        x, y = along(self._place.rotation.yaw)
        centre, wheels = self._place.location, []
        for ahead, side in ((AXLE, -0.8), (AXLE, 0.8), (-AXLE, -0.8), (-AXLE, 0.8)):
            place = centre.x + ahead * x - side * y, centre.y + ahead * y + side * x
            centimetres = Vector3D(100 * place[0], 100 * place[1], 35.0)
            wheels.append(WheelPhysicsControl(centimetres))
        return VehiclePhysicsControl(wheels)


class Sensor(Actor):
    """A camera, fixed to a vehicle that is level."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._callback: Callable[[Image], None] | None = None

    def listen(self, callback: Callable[[Image], None]) -> None:
        self._callback = callback

    def stop(self) -> None:
        self._callback = None

    def _deliver(self, frame: int) -> None:
        is_depth = self.type_id == "sensor.camera.depth"
        if self._callback is None or (is_depth and frame in self._server.lost):
            return
        width, height = (int(self.attributes[f"image_size_{a}"]) for a in "xy")
        pixels = np.empty((height, width, 4), np.uint8)
        if is_depth:
            code = round(WALL / 1000 * (2**24 - 1))
            pixels[:] = code >> 16, code >> 8 & 255, code & 255, 255
            pixels[0] = 255  # a row of sky
        else:
            pixels[:] = (*COLOUR[::-1], 255)
        number = frame + self._server.jump
        where = self._in_world()
        self._callback(Image(number, width, height, pixels.tobytes(), where))

    def _in_world(self) -> Transform:
        assert self._parent is not None
        base, own = self._parent.get_transform(), self._place
        x, y = along(base.rotation.yaw)
        ahead, right = own.location.x, own.location.y
        dx, dy = ahead * x - right * y, ahead * y + right * x
        turn = Rotation(own.rotation.pitch, base.rotation.yaw + own.rotation.yaw)
        at, height = base.location, own.location.z
        return Transform(Location(at.x + dx, at.y + dy, at.z + height), turn)
