"""A stand-in for CARLA's client and server, in this process and without rendering.

No CARLA server runs where the tests run. These classes mimic those of the client
0.9.16 as far as `mi_nerfattack.deploy` uses them; `test_stand_in.py` compares their
names and parameters with the real client's where that is installed. A car is a bicycle
model and an image is one colour with a wall at one distance: what they show says
nothing about CARLA's pictures or physics.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from helpers.carla_stand_in_data import (
    ROAD_HEIGHT,
    WALL,
    Image,
    Location,
    Map,
    Rotation,
    Transform,
    Vector2D,
    Vector3D,
    VehicleControl,
    VehiclePhysicsControl,
    WeatherParameters,
    WheelPhysicsControl,
    WorldSettings,
    along,
)

COLOUR = (90, 60, 30)  # red, green, blue
AXLE, WHEELBASE, MAX_STEER_DEG = 1.45, 2.9, 70.0  # metres, degrees
STEERING_CURVE = ((0.0, 1.0), (20.0, 0.9), (60.0, 0.8))
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

        names = (Location, Vector3D, Rotation, Transform, VehicleControl)
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
            actor._advance(server.settings.fixed_delta_seconds)
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


_CAMERA = {
    "image_size_x": "800",
    "image_size_y": "600",
    "fov": "90",
    "sensor_tick": "0",
}
_SENSORS = {
    "sensor.camera.rgb": {
        **_CAMERA,
        "motion_blur_intensity": "0.45",
        "exposure_compensation": "0.0",
    },
    "sensor.camera.depth": _CAMERA,
}


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

    def _advance(self, seconds: float | None) -> None:
        pass

    def _deliver(self, frame: int) -> None:
        pass


class Vehicle(Actor):
    """A bicycle model whose origin is midway between its axles."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._speed, self._physics = 0.0, True
        self._control = VehicleControl()

    def set_simulate_physics(self, enabled: bool = True) -> None:
        self._physics = enabled

    def apply_control(self, control: VehicleControl) -> None:
        assert -1 <= control.steer <= 1 and 0 <= control.throttle <= 1
        self._control = control

    def set_target_velocity(self, velocity: Location) -> None:
        x, y = along(self._place.rotation.yaw)
        self._speed = velocity.x * x + velocity.y * y
        assert math.isclose(self._speed, math.hypot(velocity.x, velocity.y))

    def get_velocity(self) -> Location:
        x, y = along(self._place.rotation.yaw)
        return Vector3D(self._speed * x, self._speed * y, 0.0)

    def get_physics_control(self) -> VehiclePhysicsControl:
        x, y = along(self._place.rotation.yaw)
        here, wheels = self._place.location, []
        for ahead, side, angle in (
            (AXLE, -0.8, MAX_STEER_DEG),
            (AXLE, 0.8, MAX_STEER_DEG),
            (-AXLE, -0.8, 0.0),
            (-AXLE, 0.8, 0.0),
        ):
            place = here.x + ahead * x - side * y, here.y + ahead * y + side * x
            centimetres = Vector3D(100 * place[0], 100 * place[1], 35.0)
            wheels.append(WheelPhysicsControl(max_steer_angle=angle))
            wheels[-1].position = centimetres
        return VehiclePhysicsControl(
            wheels=wheels, steering_curve=[Vector2D(*pair) for pair in STEERING_CURVE]
        )

    def _advance(self, seconds: float | None) -> None:
        if not self._physics:
            return
        assert seconds is not None
        self._place.location.z = ROAD_HEIGHT
        control, count = self._control, 20
        if control.hand_brake:
            self._speed = 0.0
        knots = np.array(STEERING_CURVE).T
        for _ in range(count):
            step = seconds / count
            force = 4 * control.throttle - 8 * control.brake - 0.1 * self._speed
            if not control.hand_brake:
                self._speed = max(self._speed + step * force, 0.0)
            share = np.interp(3.6 * self._speed, *knots)
            steer = math.radians(control.steer * MAX_STEER_DEG * float(share))
            self._roll(step, steer)

    def _roll(self, seconds: float, steer: float) -> None:
        """Move the rear axle, and the origin with it."""
        place = self._place
        x, y = along(place.rotation.yaw)
        way = seconds * self._speed
        rear_x = place.location.x - AXLE * x + way * x
        rear_y = place.location.y - AXLE * y + way * y
        place.rotation.yaw += math.degrees(way / WHEELBASE * math.tan(steer))
        x, y = along(place.rotation.yaw)
        place.location.x, place.location.y = rear_x + AXLE * x, rear_y + AXLE * y


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
        return Transform(
            Location(
                base.location.x + own.location.x * x - own.location.y * y,
                base.location.y + own.location.x * y + own.location.y * x,
                base.location.z + own.location.z,
            ),
            Rotation(own.rotation.pitch, base.rotation.yaw + own.rotation.yaw),
        )
