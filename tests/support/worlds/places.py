"""Places, routes and environments that render in milliseconds, or not at all."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from support.worlds.fields import blob, filled

from mi_nerfattack.deploy.car import CAR, Car
from mi_nerfattack.deploy.environment import AbstractEnvironment, CameraFrame
from mi_nerfattack.deploy.place import Place
from mi_nerfattack.deploy.roadside.surroundings import Surroundings
from mi_nerfattack.deploy.simulated import SimulatedEnvironment
from mi_nerfattack.deploy.sites import AbstractSite
from mi_nerfattack.deploy.vehicle import KinematicVehicle, Motion
from mi_nerfattack.deploy.views.paste import AbstractView
from mi_nerfattack.evaluation import work as evaluate_work
from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.fields.io import save_field
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, from_fov
from mi_nerfattack.render.camera.rig import Rig
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.training.settings import CollectSettings
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.route.route import Route

SCENE = """<scene version="3.0.0">
  <integrator type="path"><integer name="max_depth" value="3"/></integrator>
  <emitter type="constant"/>
  <shape type="rectangle" id="ground">
    <transform name="to_world"><scale value="60"/></transform>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.3"/></bsdf>
  </shape>
  <shape type="cube" id="block">
    <transform name="to_world"><translate x="12" y="3" z="1"/></transform>
  </shape>
</scene>"""
POINTS = np.stack([np.linspace(0, 40, 41), np.zeros(41)], axis=1)


def write_place(folder: Path, width: int = 12, height: int = 6) -> Place:
    """Write a scene, a field, an object and two routes, and return their place."""
    (folder / "scene.xml").write_text(SCENE)
    straight, bend = POINTS, POINTS + [0, 1] * np.sin(POINTS / 40)
    table = {"straight": route_entry(0, straight), "bend": route_entry(1, bend)}
    (folder / "routes.json").write_text(json.dumps(table))
    save_field(folder / "field.safetensors", ground_field())
    save_field(folder / "object.safetensors", blob(np.random.default_rng(1)))
    return Place(
        scene=folder / "scene.xml",
        field=folder / "field.safetensors",
        routes=folder / "routes.json",
        objects=(folder / "object.safetensors",),
        camera=from_fov(width, height, 90.0),
        mount=CameraMount(),
    )


def ground_field() -> GridField:
    """Make a slab of the ground, 4 m deep, coloured at random."""
    box = np.array([[-60.0, -60.0, -4.0], [60.0, 60.0, 0.0]])
    field = GridField(GridLayout(2, 8, 16), *box, step_m=0.5)
    colours = np.random.default_rng(0).normal(0, 1, (field.n_vertices, 3))
    return filled(field, 1.0, colours)


def route_entry(goal: int, points: np.ndarray) -> dict[str, object]:
    table = {"goal": goal, "points_m": points.tolist()}
    return table | {"lane_width_m": 3.5, "speed_ms": 5.0}


ROUTES = {"straight": route_entry(0, np.array([[0, 0], [20, 0], [40, 0]]))}
PAINTED = """<scene version="3.0.0">
<integrator type="direct"/>
<shape type="rectangle"><transform name="to_world">
<scale x="90" y="90"/></transform></shape>
<emitter type="constant"/>
</scene>"""
CALLABLE = ("--set", "policy.kind=callable", "--set", "policy.trust_code=true")
STILL = "def drive(image, goal, step):\n    return [0.0] * len(image)\n"


def make_place(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Files of a place and a policy, and the painted environment under every name."""
    (folder / "scene.xml").write_text(PAINTED)
    (folder / "still.py").write_text(STILL)
    files.write_json(folder / "routes.json", ROUTES)
    made: list[PaintedEnvironment] = []

    def make(name, where, conditions=None):
        made.append(PaintedEnvironment(where.camera, Grey()))
        made[-1].name = name
        return made[-1]

    monkeypatch.setattr(evaluate_work, "make_environment", make)
    monkeypatch.chdir(folder)
    options = ["--scene", "scene.xml", "--routes-file", "routes.json"]
    options += ["--workers", "1", *CALLABLE, "--runs", "2"]
    return ["evaluate", "still.py:drive", "--environments", "mitsuba", *options]


def with_policy(name: str, place: list[str]) -> list[str]:
    """Name a policy that needs no word about how it is called."""
    return ["evaluate", name, *(word for word in place[2:] if word not in CALLABLE)]


class BlankView(AbstractView):
    """A view of nothing that notes with which seeds it was asked to render."""

    def __init__(self) -> None:
        self.camera, self.seeds = from_fov(4, 2, 90.0), []

    def render(self, camera_to_world: np.ndarray, seed: int) -> CameraFrame:
        self.seeds.append(seed)
        depth = np.full((2, 4), np.inf, np.float32)
        return CameraFrame(np.zeros((2, 4, 3), np.uint8), depth, camera_to_world)

    def show(self, objects) -> None:
        pass

    def close(self) -> None:
        pass


def blank_environment(mount: CameraMount | None = None) -> SimulatedEnvironment:
    motion, mount = Motion(Dubins(max_heading_rate=1.5)), mount or CameraMount()
    vehicle = KinematicVehicle(motion, 0.1, 1.5)
    view = BlankView()
    rig = Rig.of_one(view.camera, mount)
    return SimulatedEnvironment("blank", vehicle, [view], rig, 0.1)


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


def small_grid(height: float = 0.8) -> GridField:
    lower, upper = np.array([-0.2, -0.2, 0.0]), np.array([0.2, 0.2, height])
    return GridField(GridLayout(3, 5, 12), lower, upper, density_scale=50.0)


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
        self.rig = Rig.of_one(camera, CameraMount())
        self.states: list[np.ndarray] = []
        self.shown: list[list[PosedField]] = []
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
        turn = control * self.period
        chord = self._speed * self.period * np.sinc(turn / 2 / np.pi)
        x, y, theta = self._state
        dx, dy = chord * np.cos(theta + turn / 2), chord * np.sin(theta + turn / 2)
        self._state = np.array([x + dx, y + dy, theta + turn])
        return self._observe()

    def show(self, objects):
        self.objects = list(objects)

    def close(self):
        pass

    def _observe(self):
        self.states.append(self._state)
        self.shown.append(list(self.objects))
        shape = self.camera.height, self.camera.width
        image = np.broadcast_to(painted(self._state, self.conditions), (*shape, 3))
        return CameraFrame(image.copy(), np.full(shape, np.inf, "f4"), np.eye(4))


MIDDLE = Grey()


def painted(state: np.ndarray, conditions: Grey = MIDDLE) -> np.ndarray:
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
    def rig(self) -> Rig:
        return Rig.of_one(from_fov(*self.size_px, 90.0), CameraMount())

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
        self.opened.append(PaintedEnvironment(self.rig.cameras[0], conditions))
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
    scene = {"type": "scene", "i": {"type": "direct"}, "l": {"type": "constant"}}
    scene |= {"road": plate(0.0, 0.0, 50.0), "pavement": plate(KERB_M, 26.5, 23.5)}
    scene["wall"] = {"type": "cube", "to_world": wall}
    return mi.load_dict(scene, parallel=False)


def small(**changes) -> CollectSettings:
    base = {"frames": 24, "group": 4, "shard": 12, "seed": 5, "objects": 1}
    return CollectSettings(**(base | changes))
