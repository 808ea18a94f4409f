"""Routes, an environment and a scene for tests of collection and validation."""

from __future__ import annotations

from dataclasses import dataclass, field

import mitsuba as mi
import numpy as np

from mi_nerfattack.deploy.car import CAR, Car
from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, from_fov
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.training.settings import CollectSettings
from mi_nerfattack.vehicle.route.route import Route

KERB_M = 0.12


def straight() -> Route:
    return Route("straight", 0, np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]]))


def bent() -> Route:
    angle = np.linspace(0, np.pi / 2, 30)
    arc = np.stack([10 + 8 * np.sin(angle), 8 - 8 * np.cos(angle)], axis=1)
    return Route("left", 1, np.concatenate([[[0, 0]], arc, [[18, 30]]]))


def surroundings(*routes: Route, scene=None) -> Surroundings:
    """Of a camera 200 px wide, on flat ground 100 m wide unless a scene is given."""
    scene = scene or mi.load_dict({"type": "scene", "ground": plate(0.0, 0.0, 50.0)})
    return Surroundings(scene, routes, from_fov(200, 66, 90.0), CameraMount(), 0.1)


def small_grid() -> GridField:
    """Transparent grey box 0.4 m wide and 0.8 m tall, standing on z = 0."""
    layout = GridLayout(levels=3, base_resolution=5, max_resolution=12)
    return GridField(
        layout,
        np.array([-0.2, -0.2, 0.0]),
        np.array([0.2, 0.2, 0.8]),
        density_scale=50.0,
    )


@dataclass(frozen=True)
class Grey:
    """Conditions of the fake site: a level that is added to all images."""

    level: int = 0


class PaintedEnvironment(AbstractEnvironment):
    """Paints the state into flat images, and remembers states and objects.

    Channels of every pixel: x, y (0.2 m a level) and heading (0.02 rad a level).
    """

    name = "painted"
    control_unit = "rad/s"
    max_control = 1.5
    period = 0.1

    def __init__(self, camera: Camera, conditions: Grey) -> None:
        self.camera, self.conditions = camera, conditions
        self.states: list[np.ndarray] = []
        self.seen: list[list[PosedField]] = []
        self.seeds: list[int] = []
        self.starts: list[int] = []
        self.objects: list[PosedField] = []
        self._speed, self._state = 0.0, np.zeros(3)

    @property
    def state(self) -> np.ndarray:
        return self._state

    def reset(self, route, pose=None, seed=0):
        self._speed, self._state = route.speed_ms, np.array(pose, np.float64)
        self.starts.append(len(self.states))
        self.seeds.append(seed)
        return self._observe()

    def step(self, control):
        """Drive an arc."""
        turn = control * self.period
        chord = self._speed * self.period * np.sinc(turn / 2 / np.pi)
        x, y, theta = self._state
        middle = theta + turn / 2
        self._state = np.array(
            [x + chord * np.cos(middle), y + chord * np.sin(middle), theta + turn]
        )
        return self._observe()

    def show(self, objects):
        self.objects = list(objects)

    def close(self):
        pass

    def _observe(self):
        self.states.append(self._state)
        self.seen.append(list(self.objects))
        shape = self.camera.height, self.camera.width
        image = np.broadcast_to(painted(self._state, self.conditions), (*shape, 3))
        return CameraFrame(image.copy(), np.full(shape, np.inf, "f4"), np.eye(4))


def painted(state: np.ndarray, conditions: Grey = Grey()) -> np.ndarray:  # noqa: B008
    """Colour (3,) uint8 of the images of a state."""
    levels = 128 + conditions.level + state[:3] / [0.2, 0.2, 0.02]
    return np.clip(np.round(levels), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class PaintedSite(AbstractSite):
    """Site of painted environments; `opened` remembers those of this process."""

    name: str = "painted"
    objects: bool = True
    size_px: tuple[int, int] = (8, 4)
    opened: list[PaintedEnvironment] = field(default_factory=list, compare=False)

    @property
    def camera(self) -> Camera:
        return from_fov(*self.size_px, 90.0)

    @property
    def car(self) -> Car:
        return CAR

    @property
    def period(self) -> float:
        return PaintedEnvironment.period

    def draw(self, rng):
        return Grey(int(rng.integers(3)))

    def typical(self):
        return Grey()

    def open(self, conditions):
        self.opened.append(PaintedEnvironment(self.camera, conditions))
        self.opened[-1].name = self.name
        return self.opened[-1]

    def load_objects(self, least=1):
        return [small_grid() for _ in range(max(1, least))] if self.objects else []

    def load_surroundings(self):
        return surroundings(straight(), bent())

    def describe(self):
        return {"environment": self.name, "size": self.size_px}


def plate(z, y, half_y):
    to_world = mi.ScalarTransform4f().translate([0, y, z]).scale([50, half_y, 1])
    return {"type": "rectangle", "to_world": to_world}


def kerb_scene():
    """Road at z = 0 for y < 3, pavement above; a wall; nothing beyond 50 m."""
    wall = mi.ScalarTransform4f().translate([20, 0, 1.5]).scale([0.5, 0.5, 1.5])
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "direct"},
            "road": plate(0.0, 0.0, 50.0),
            "pavement": plate(KERB_M, 26.5, 23.5),
            "wall": {"type": "cube", "to_world": wall},
            "light": {"type": "constant"},
        },
        parallel=False,
    )


def small(**changes) -> CollectSettings:
    base = {"frames": 24, "group": 4, "shard": 12, "seed": 5, "objects": 1}
    return CollectSettings(**(base | changes))
