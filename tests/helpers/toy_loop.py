"""A closed loop that runs in milliseconds, and the same loop in plain PyTorch."""

from __future__ import annotations

import numpy as np
import torch

from mi_nerfattack.fields import GridField, GridLayout
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov, mount_matrix
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.rollout.field_sensor import FieldSensor
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import ExplicitEuler
from mi_nerfattack.vehicle.route.route import Route

WIDTH, HEIGHT = 24, 10
DT, SPEED, LIMIT = 0.1, 5.0, 1.5
MOUNT = CameraMount(height_m=1.2, forward_m=0.3, pitch_deg=4.0)
OBJECT_POSE = Pose.upright((7.0, 0.6, 1.0), 0.3, 1.6)
ROUTE = Route("line", 0, np.array([[-50.0, 0.0], [50.0, 0.0]]))


def vertices(field: GridField) -> np.ndarray:
    """Positions of all vertices, (n, 3) in [-1, 1]; padding sits at the centre."""
    parts = []
    encoding = field.encoding
    for level in range(field.layout.levels):
        scale = encoding._level_scale(level)
        count = encoding._resolution(scale)
        axis = np.arange(count) / scale * 2 - 1
        z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
        points = np.stack([x, y, z], -1).reshape(-1, 3)
        size = encoding.level_offset(level + 1) - encoding.level_offset(level)
        parts.append(np.pad(points, ((0, size - len(points)), (0, 0))))
    return np.concatenate(parts)


def blob(layout: GridLayout, half: float, peak: float, step: float, seed: int):
    """Return a field whose density falls off smoothly before the box ends."""
    field = GridField(layout, np.full(3, -half), np.full(3, half), step_m=step)
    radius = (vertices(field) ** 2).sum(1)
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
    integrator=None, jitter_seed=None, coarse=False, fog=-2.0
) -> tuple[ClosedLoop, GridField]:
    """Return a loop through a foggy scene with one object, and the object's field.

    A coarse one has few samples a ray; `fog` is the logarithm of the scene's density.
    """
    wider = 12 if coarse else 1
    scene = blob(GridLayout(2, 6, 9), 25.0, fog, 0.5 * wider, 1)
    item = blob(GridLayout(3, 6, 12), 1.0, 2.5, 0.08 * wider, 2)
    sensor = FieldSensor(
        PosedField(scene),
        [PosedField(item, OBJECT_POSE)],
        from_fov(WIDTH, HEIGHT, 70.0),
        MOUNT,
        jitter_seed,
        stop=0.0,
    )
    policy = TorchPolicy(SmoothPolicy())
    loop = ClosedLoop(
        sensor, policy, 0, Dubins(SPEED, LIMIT), integrator or ExplicitEuler(), DT
    )
    return loop, item


def square_error(state):
    """Stage cost: the squared cross-track error."""
    return ROUTE.cross_track(state) ** 2


# --- the same loop in PyTorch, float64, written from the equations --------------------


def torch_field(field: GridField, texture: torch.Tensor, points: torch.Tensor):
    """Evaluate density and radiance at (n, 3) points of the field's frame."""
    lower, upper = torch.as_tensor(field.lower), torch.as_tensor(field.upper)
    unit = ((points - lower) / (upper - lower)).clamp(0, 1 - 1e-6)
    density = torch.as_tensor(field._density.numpy().astype(np.float64))
    table = torch.cat([density[:, None], texture], dim=1)
    total = torch.zeros(len(points), 4, dtype=torch.float64)
    for level in range(field.layout.levels):
        scale = field.layout.base_resolution * field.layout.growth**level - 1
        count = field.encoding._resolution(field.encoding._level_scale(level))
        position = unit * scale
        cell = position.floor()
        fraction = position - cell
        for corner in range(8):
            bits = torch.tensor([(corner >> axis) & 1 for axis in range(3)])
            weight = torch.where(bits == 1, fraction, 1 - fraction).prod(1)
            x, y, z = (cell.long() + bits).T
            index = x + count * (y + count * z) + field.encoding.level_offset(level)
            total = total + weight[:, None] * table[index]
    sigma = torch.exp(total[:, 0])
    srgb = torch.sigmoid(total[:, 1:])
    linear = torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return sigma, linear


def torch_march(field, texture, pose: Pose, origin, direction):
    """March rays (n, 3) by the midpoint rule: radiance, opacity, depth."""
    rotation = torch.as_tensor(np.asarray(pose.rotation))
    o = (origin - torch.as_tensor(np.asarray(pose.translation))) @ rotation / pose.scale
    d = direction @ rotation / pose.scale
    lower, upper = torch.as_tensor(field.lower), torch.as_tensor(field.upper)
    a, b = (lower - o) / d, (upper - o) / d
    near = torch.minimum(a, b).amax(1).clamp(min=0)
    far = torch.maximum(a, b).amin(1)
    step = field.step_m * pose.scale
    count = int(far.clamp(min=0).max() / step) + 2
    grid = torch.arange(count, dtype=torch.float64) * step
    start = torch.maximum(grid[None], near[:, None])
    end = torch.minimum(grid[None] + step, far[:, None])
    width = (end - start).clamp(min=0)
    t = 0.5 * (start + end)
    points = o[:, None] + t[..., None] * d[:, None]
    sigma, colour = torch_field(field, texture, points.reshape(-1, 3))
    sigma = sigma.reshape(t.shape) / pose.scale
    passed = torch.exp(-sigma * width)
    before = torch.cumprod(torch.cat([torch.ones_like(t[:, :1]), passed], 1), 1)
    weight = before[:, :-1] * (1 - passed)
    radiance = (weight[..., None] * colour.reshape(*t.shape, 3)).sum(1)
    opacity = 1 - before[:, -1]
    depth = (weight * t).sum(1) / opacity.clamp(min=1e-30)
    return radiance, opacity, torch.where(opacity > 0, depth, torch.inf)


def torch_image(loop: ClosedLoop, texture: torch.Tensor, state: np.ndarray):
    """Render the depth composite, (1, 3, height, width) sRGB."""
    camera = loop.sensor.camera
    matrix = torch.as_tensor(mount_matrix(state[None], MOUNT)[0])
    row, column = torch.meshgrid(
        torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij"
    )
    x, y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    local = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3).double()
    direction = local @ matrix[:3, :3].T
    direction = direction / direction.norm(dim=1, keepdim=True)
    origin = matrix[:3, 3].expand_as(direction)
    scene = loop.sensor.scene.field
    fixed = torch.as_tensor(scene.texture.numpy().astype(np.float64))
    back = torch_march(scene, fixed, Pose.identity(), origin, direction)
    item = loop.sensor.objects[0].field
    front = torch_march(item, texture, OBJECT_POSE, origin, direction)
    nearer = (front[2] <= back[2])[:, None]
    first = [
        torch.where(nearer.view(-1, *[1] * (f.ndim - 1)), f, b)
        for f, b in zip(front, back, strict=True)
    ]
    last = [
        torch.where(nearer.view(-1, *[1] * (f.ndim - 1)), b, f)
        for f, b in zip(front, back, strict=True)
    ]
    linear = first[0] + (1 - first[1])[:, None] * last[0]
    srgb = torch.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055
    )
    return srgb.reshape(1, HEIGHT, WIDTH, 3).permute(0, 3, 1, 2)


def torch_objective(loop, texture: torch.Tensor, initial: np.ndarray, horizon: int):
    """Sum of squared lateral positions; the observed state is detached."""
    state = torch.as_tensor(initial, dtype=torch.float64)
    module = SmoothPolicy().double()
    total = torch.zeros((), dtype=torch.float64)
    for _ in range(horizon):
        image = torch_image(loop, texture, state.detach().numpy())
        control = module(image, torch.zeros(1))[0]
        ratio = control / LIMIT
        control = control / (1 + ratio**8) ** 0.125
        rate = torch.stack(
            [SPEED * torch.cos(state[2]), SPEED * torch.sin(state[2]), control]
        )
        state = state + DT * rate
        total = total + state[1] ** 2
    return total


def texture_of(field: GridField) -> np.ndarray:
    """Copy a field's texture."""
    return field.texture.numpy().copy()
