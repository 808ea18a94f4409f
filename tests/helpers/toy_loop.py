"""A closed loop through fields that runs in milliseconds."""

from __future__ import annotations

import numpy as np
import torch
from helpers.small_fields import empty_border, vertices

from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import ExplicitEuler
from mi_nerfattack.vehicle.route.route import Route

WIDTH, HEIGHT = 24, 10
DT, SPEED, LIMIT = 0.1, 5.0, 1.5
MOUNT = CameraMount(height_m=1.2, forward_m=0.3, pitch_deg=4.0)
OBJECT_POSE = Pose.upright((7.0, 0.6, 1.0), 0.3, 1.6)
ROUTE = Route("line", 0, np.array([[-50.0, 0.0], [50.0, 0.0]]))


def blob(layout: GridLayout, half: float, peak: float, step: float, seed: int):
    """Return a field whose density falls off smoothly before the box ends."""
    field = GridField(layout, np.full(3, -half), np.full(3, half), step_m=step)
    radius = ((vertices(field) / half) ** 2).sum(1)
    rng = np.random.default_rng(seed)
    field.set_parameter(
        "density", ((peak - 11 * radius) / layout.levels).astype(np.float32)
    )
    texture = rng.normal(0, 0.7, (field.n_vertices, 3)).astype(np.float32)
    field.set_parameter("texture", texture)
    return field


class SmoothPolicy(torch.nn.Module):
    """A fixed smooth functional of the image, with a strong gain."""

    goals = 3

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(5)
        coarse = torch.randn(1, 3, 3, 5, generator=generator)
        weight = torch.nn.functional.interpolate(
            coarse, (HEIGHT, WIDTH), mode="bilinear", align_corners=True
        )
        self.weight = torch.nn.Parameter(weight * 0.02)

    def forward(self, image: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        return torch.tanh(((image - 0.4) * self.weight).sum((1, 2, 3)))


def make_loop(
    integrator=None, jitter_seed=None, coarse=False, composite="depth", disturbance=None
) -> tuple[ClosedLoop, GridField]:
    """Return a loop through a foggy scene with one object, and the object's field.

    A coarse one has few samples a ray.
    """
    wider = 12 if coarse else 1
    scene = blob(GridLayout(2, 6, 9), 25.0, -2.0, 0.5 * wider, 1)
    item = blob(GridLayout(3, 6, 12), 1.0, 2.5, 0.08 * wider, 2)
    for field in (scene, item):
        empty_border(field)
    sensor = field_sensor(
        PosedField(scene),
        [PosedField(item, OBJECT_POSE)],
        from_fov(WIDTH, HEIGHT, 70.0),
        MOUNT,
        jitter_seed,
        0.0,
        composite,
    )
    policy = TorchPolicy(SmoothPolicy())
    loop = ClosedLoop(
        sensor,
        policy,
        0,
        Dubins(SPEED, LIMIT),
        integrator or ExplicitEuler(),
        DT,
        eight_bit=False,  # derivatives are compared with finite differences
        disturbance=disturbance or Disturbance(),
    )
    return loop, item


def square_error(state):
    """Stage cost: the squared cross-track error."""
    return ROUTE.cross_track(state) ** 2


def texture_of(field: GridField) -> np.ndarray:
    """Copy a field's texture."""
    return field.texture.numpy().copy()
