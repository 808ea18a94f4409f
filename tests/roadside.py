"""Routes, a sensor and a scene for tests of collection and validation."""

from __future__ import annotations

import mi_nerfattack  # noqa: F401  before drjit

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.fields.grid import GridField, GridLayout
from mi_nerfattack.policy.adapter import AbstractPolicy
from mi_nerfattack.policy.collect import CollectSettings
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.sensor import Observation
from mi_nerfattack.vehicle.route import Route

KERB_M = 0.12


def straight() -> Route:
    return Route("straight", 0, np.array([[0.0, 0.0], [20.0, 0.0], [40.0, 0.0]]))


def bent() -> Route:
    angle = np.linspace(0, np.pi / 2, 30)
    arc = np.stack([10 + 8 * np.sin(angle), 8 - 8 * np.cos(angle)], axis=1)
    return Route("left", 1, np.concatenate([[[0, 0]], arc, [[18, 30]]]))


def flat_ground(points: np.ndarray) -> np.ndarray:
    return np.zeros(len(points))


def small_grid() -> GridField:
    """Transparent grey box 0.4 m wide and 0.8 m tall, standing on z = 0."""
    layout = GridLayout(levels=3, base_resolution=5, max_resolution=12)
    return GridField(
        layout,
        np.array([-0.2, -0.2, 0.0]),
        np.array([0.2, 0.2, 0.8]),
        density_scale=50.0,
    )


class StateSensor:
    """Paints the state into flat images, and remembers states and objects."""

    def __init__(self) -> None:
        self.objects: list[PosedField] = []
        self.states: list[np.ndarray] = []
        self.seen: list[list[PosedField]] = []

    def observe(self, state, step) -> Observation:
        states = np.array(state).T
        self.states.append(states)
        self.seen.append(list(self.objects))
        shade = np.clip(0.5 + states / 100, 0, 1)[:, None, None, :]
        image = np.broadcast_to(shade, (len(states), 66, 200, 3))
        return Observation(mi.TensorXf(np.ascontiguousarray(image, np.float32)))


class Constant(AbstractPolicy):
    """Returns one control whatever it sees."""

    def __init__(self, value: float) -> None:
        self.value = value

    def control(self, image, goal):
        return dr.opaque(mi.Float, self.value, image.shape[0])

    def vjp(self, image, goal, cotangent):
        raise AssertionError("collection needs no derivative")


def kerb_scene():
    """Road at z = 0 for y < 3, pavement above; a wall; nothing beyond 50 m."""

    def plate(z, y, half_y):
        to_world = mi.ScalarTransform4f().translate([0, y, z]).scale([50, half_y, 1])
        return {"type": "rectangle", "to_world": to_world}

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
    base = {"frames": 24, "group": 4, "groups_a_shard": 3, "seed": 5}
    return CollectSettings(**(base | changes))
