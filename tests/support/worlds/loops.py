"""Closed loops through fields, formulas and a walled scene that run in milliseconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch
from support.worlds.cameras import load
from support.worlds.fields import empty_border, filled, small_ngp, vertices

from mi_nerfattack.deploy.surrogate.scene import field_sensor
from mi_nerfattack.fields import GridField, GridLayout, save_field
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.conventions import opencv_to_mitsuba
from mi_nerfattack.render.camera.disturbance import Disturbance
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.adjoint import Checkpointed, KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.objective import AbstractObjective, StageSum
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import ExplicitEuler
from mi_nerfattack.vehicle.route.route import Route

WIDTH, HEIGHT = 24, 10
DT, SPEED, LIMIT = 0.1, 5.0, 1.5
EULER = ExplicitEuler()
MOUNT = CameraMount(height_m=1.2, forward_m=0.3, pitch_deg=4.0)
OBJECT_POSE = Pose.upright((7.0, 0.6, 1.0), 0.3, 1.6)
ROUTE = Route("line", 0, np.array([[-50.0, 0.0], [50.0, 0.0]]))


def blob(layout: GridLayout, half: float, peak: float, step: float, seed: int):
    """Return a field whose density falls off smoothly before the box ends."""
    field = GridField(layout, np.full(3, -half), np.full(3, half), step_m=step)
    radius = ((vertices(field) / half) ** 2).sum(1)
    rng = np.random.default_rng(seed)
    colours = rng.normal(0, 0.7, (field.n_vertices, 3))
    return filled(field, (peak - 11 * radius) / layout.levels, colours)


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
    objects, camera = [PosedField(item, OBJECT_POSE)], from_fov(WIDTH, HEIGHT, 70.0)
    sensor = field_sensor(
        PosedField(scene), objects, camera, MOUNT, jitter_seed, 0.0, composite
    )
    loop = close_loop(sensor, integrator or ExplicitEuler())
    return replace(loop, disturbance=disturbance or Disturbance()), item


def square_error(state):
    return ROUTE.cross_track(state) ** 2


def texture_of(field: GridField) -> np.ndarray:
    return field.texture.numpy().copy()


INITIAL = np.array([[0.0, 0.35, 0.02]])
OFFSET = np.array([[0.05, -0.1, 0.08, 0.1, -0.2, 0.15]])
ADJOINTS = {
    "replay": Replay(),
    "kept": KeptBackgrounds(),
    "checkpointed": Checkpointed(3),
}


def make_rollout(loop, horizon, attached=False, adjoint="replay"):
    objective = StageSum(square_error)
    return Rollout(
        loop, objective, horizon, adjoint=ADJOINTS[adjoint], attached=attached
    )


def gradient(rollout, initial=INITIAL, **options):
    return rollout.gradient(rollout.run(rollout.loop.initial(initial)), **options)


def objective(rollout, initial=INITIAL):
    return rollout.run(rollout.loop.initial(initial)).value


def texture_gradient(rollout, initial=INITIAL):
    return gradient(rollout, initial).textures[0].numpy().astype(float)


def unit(value):
    return value / np.linalg.norm(value)


def along_texture(rollout, item, direction):
    """Return J as a function of a step along a direction of the texture."""
    base = texture_of(item)

    def value(s):
        moved = base + s * direction
        rollout.loop.sensor.set_textures([moved.astype(np.float32)])
        result = objective(rollout)
        rollout.loop.sensor.set_textures([base])
        return result

    return value


# --- the analytic loop and its twin in PyTorch ---------------------------------------


class Wave(AbstractObjective):
    """A function of position, heading and time that no two states share."""

    def evaluate(self, states):
        x, y, theta = (states.rows[i] for i in range(3))
        value = dr.sin(1.3 * y + 0.2 * x) + dr.square(theta) * dr.cos(x)
        return states.total(value * (1 + states.time))


def wave_in_torch(states, dt):
    """The same, (n,) from states (n, T + 1, m)."""
    x, y, theta = states[:, 1:, :3].unbind(2)
    time = dt * torch.arange(1, states.shape[1], dtype=torch.float64)
    value = torch.sin(1.3 * y + 0.2 * x) + theta**2 * torch.cos(x)
    return (value * (1 + time)).sum(1)


def expected_gradient(loop, twin, initial, horizon, attached, reduce=torch.mean):
    """Differentiate the twin by textures, initial states and offsets."""
    textures = [
        torch.tensor(texture.numpy(), requires_grad=True)
        for texture in loop.sensor.textures()
    ]
    start = torch.tensor(initial, requires_grad=True)
    offsets = torch.tensor(loop.sensor.offsets.numpy(), requires_grad=True)
    states, _ = twin.drive(start, textures, horizon, attached, offsets)
    value = reduce(wave_in_torch(states, twin.dt))
    value.backward()
    grads = [texture.grad.numpy() for texture in textures]
    return float(value.detach()), [*grads, start.grad.numpy(), offsets.grad.numpy()]


def flat(gradient):
    """Lay a gradient out as `expected_gradient` does."""
    textures = [texture.numpy() for texture in gradient.textures]
    by_offsets = gradient.parameters["offsets"].numpy()
    return [*textures, np.array(gradient.initial).T, by_offsets]


def assert_close(actual, expected, tolerance=1e-8):
    for a, b in zip(actual, expected, strict=True):
        scale = np.linalg.norm(b)
        assert np.linalg.norm(a - b) <= tolerance * scale, (a, b)


LENS = {"type": "opencv_camera", "fx": 17.0, "fy": 16.5, "cx": 11.6, "cy": 5.3}
LENS |= {"k1": -0.12, "p1": 0.004}
PERSPECTIVE = {"type": "perspective", "fov": 70.0, "near_clip": 0.3}


def write_fields(folder: Path) -> None:
    save_field(folder / "near.safetensors", blob(GridLayout(3, 6, 12), 1, 2, 0.2, 2))
    save_field(folder / "far.safetensors", blob(GridLayout(3, 6, 12), 1, 3, 0.2, 3))
    save_field(folder / "fog.safetensors", blob(GridLayout(2, 6, 9), 25, -2, 1, 1))
    save_field(folder / "sky.safetensors", small_ngp())


def volume(folder: Path, name: str, position: list[float], scale: float) -> Any:
    to_world = mi.ScalarTransform4f().translate(position).scale(scale)
    file = str(folder / f"{name}.safetensors")
    return {"type": "grid_field", "filename": file, "to_world": to_world}


def scene_dict(
    folder: Path, lens: dict[str, Any] = LENS, walls: bool = True, **integrator: Any
) -> dict[str, Any]:
    """Describe the scene; without walls there is no surface and no nested integrator.

    A point light and two bounces leave nothing random, beyond where the samples are.
    """
    t = mi.ScalarTransform4f()
    blue = {"type": "rgb", "value": [0.2, 0.6, 0.9]}
    paint = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": blue}}
    wall = t.translate([6, 0.2, 0.9]).rotate([0, 1, 0], -90).scale([0.9, 0.5, 1])
    built = {
        "wall": {"type": "rectangle", "to_world": wall, "bsdf": paint},
        "lamp": {"type": "point", "position": [0, 1, 4], "intensity": 60.0},
    }
    fields = {
        "far": volume(folder, "far", [8.0, 0.5, 1.0], 1.6),
        "near": volume(folder, "near", [3.5, -0.6, 1.0], 0.7),
        "scene": volume(folder, "fog", [0, 0, 0], 1),
    }
    nested = {"behind": {"type": "path", "max_depth": 2}} if walls else {}
    marched = {"type": "field_integrator", "composite": "depth", "stop": 0.0}
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb"}
    film["rfilter"] = {"type": "box"}
    sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
    return {
        "type": "scene",
        "integrator": marched | fields | nested | integrator,
        **(built if walls else {}),
        "sensor": {**lens, "sampler": sampler, "film": film},
    }


def rendered(description: dict[str, Any], state: np.ndarray) -> np.ndarray:
    """Let Mitsuba render what a vehicle with `MOUNT` sees, linear (h, w, 3)."""
    matrix = opencv_to_mitsuba(mount_matrix(state, MOUNT)[0])
    sensor = {**description["sensor"], "to_world": mi.ScalarTransform4f(matrix)}
    scene = load({**description, "sensor": sensor})
    return mi.render(scene, spp=1).numpy()[..., :3]


def close_loop(sensor: Any, integrator: Any = EULER) -> ClosedLoop:
    """Drive by the toy's policy, to be compared with finite differences."""
    policy, vehicle = TorchPolicy(SmoothPolicy()), Dubins(SPEED, LIMIT)
    return ClosedLoop(sensor, policy, 0, vehicle, integrator, DT, eight_bit=False)
