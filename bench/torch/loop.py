"""The peer of an attack iteration: the closed loop in PyTorch, autograd through time.

Background without tape; the object's colours with tape; `backward` once, at the end of
the drive. The policy sees a constant state, as ours does (appendix A.12). A frame in
which no ray meets the object leaves no tape behind.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from bench.torch.fit import encode
from bench.torch.ngp import TorchNGP
from bench.torch.object import ObjectView, TorchObject
from mi_nerfattack.policy.preprocess import AbstractTransform
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount


class TorchCamera:
    """A pinhole camera on a vehicle.

    Args:
        camera: intrinsics, without distortion.
        mount: where it sits.
    """

    def __init__(self, camera: Camera, mount: CameraMount) -> None:
        self.width, self.height, self.mount = camera.width, camera.height, mount
        x = (torch.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (torch.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        y, x = torch.meshgrid(y, x, indexing="ij")
        local = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3)
        self.pixels = F.normalize(local, dim=1)

    def rays(self, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Make a ray through every pixel's centre.

        Args:
            state: (n, 3), metres and radians.

        Returns:
            origins and unit directions, each (n height width, 3), single precision.
        """
        px, py, theta = state.float().unbind(1)
        sin, cos = torch.sin(theta), torch.cos(theta)
        pitch = math.radians(self.mount.pitch_deg)
        down, ahead = math.sin(pitch), math.cos(pitch)
        forward_m, zero = self.mount.forward_m, torch.zeros_like(px)
        height = torch.full_like(px, self.mount.height_m)
        origin = torch.stack([px + forward_m * cos, py + forward_m * sin, height], 1)
        columns = [
            torch.stack([sin, -cos, zero], 1),
            torch.stack([-cos * down, -sin * down, zero - ahead], 1),
            torch.stack([cos * ahead, sin * ahead, zero - down], 1),
        ]
        direction = self.pixels @ torch.stack(columns, 1)  # (n, pixels, 3)
        origin = origin[:, None].expand_as(direction)
        return origin.reshape(-1, 3), direction.reshape(-1, 3)


class TorchView:
    """The images of a camera in a scene with an object.

    Args:
        scene: the background, a constant.
        item: the object.
        camera: on the vehicle.
        chunk: rays of the background that are marched at once.
    """

    def __init__(
        self, scene: TorchNGP, item: TorchObject, camera: TorchCamera, chunk: int
    ) -> None:
        self.scene, self.item, self.camera = scene, item, camera
        self.chunk = chunk

    def image(self, state: torch.Tensor) -> torch.Tensor:
        """Render, with tape of the texture's part.

        Args:
            state: (n, 3), metres and radians; taken as a constant.

        Returns:
            (n, 3, height, width), sRGB.
        """
        with torch.no_grad():
            origin, direction = self.camera.rays(state)
            radiance, passed, moment, sky = self.background(origin, direction)
            pixels = encode(radiance + passed[:, None] * sky)
        view = self.item.see(origin, direction)
        if len(view.ray):
            colour = compose(
                view,
                radiance[view.ray],
                passed[view.ray],
                moment=moment[view.ray],
                sky=sky[view.ray],
            )
            pixels = pixels.index_copy(0, view.ray, encode(colour))
        shape = (len(state), self.camera.height, self.camera.width, 3)
        return pixels.view(shape).permute(0, 3, 1, 2)

    def background(
        self, origin: torch.Tensor, direction: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """March all rays through the scene, chunk by chunk.

        Returns:
            what :meth:`TorchNGP.march` does, and the sky (n, 3), linear.
        """
        rays = zip(origin.split(self.chunk), direction.split(self.chunk), strict=True)
        march, sky = self.scene.march, self.scene.background
        chunks = [(*march(o, d), sky(d)) for o, d in rays]
        return tuple(torch.cat(some) for some in zip(*chunks, strict=True))


def compose(
    view: ObjectView,
    radiance: torch.Tensor,
    passed: torch.Tensor,
    moment: torch.Tensor,
    sky: torch.Tensor,
) -> torch.Tensor:
    """Lay object and background over each other by expected depth; appendix A.6."""
    depth = moment / (1 - passed)  # nothing there: not a number, and so behind
    item = view.moment / (1 - view.passed)
    behind = (depth < item)[:, None]
    front = view.radiance + view.passed[:, None] * radiance
    back = radiance + passed[:, None] * view.radiance
    both = (view.passed * passed)[:, None] * sky
    return torch.where(behind, back, front) + both


class TorchRoute:
    """The distance from a polyline.

    Args:
        points: (n, 2), metres.
        rounding_m: radius of the rounded corner of the absolute value.
    """

    def __init__(self, points: np.ndarray, rounding_m: float) -> None:
        self.points = torch.tensor(points)
        self.edges = self.points.diff(dim=0)
        self.square = (self.edges**2).sum(1)
        self.rounding_m = rounding_m

    def cost(self, states: torch.Tensor) -> torch.Tensor:
        """Return minus the rounded distance of states (k, 3): (k,), metres."""
        place = states[:, :2]
        with torch.no_grad():
            along = self._along(place[:, None] - self.points[:-1], slice(None))
            miss = place[:, None] - self.points[:-1] - along[..., None] * self.edges
            nearest = (miss**2).sum(-1).argmin(1)
        offset = place - self.points[nearest]
        along = self._along(offset, nearest)
        square = ((offset - along[:, None] * self.edges[nearest]) ** 2).sum(1)
        return self.rounding_m - torch.sqrt(square + self.rounding_m**2)

    def _along(self, offset: torch.Tensor, index: torch.Tensor | slice) -> torch.Tensor:
        """Return the place on segments, 0 to 1; beyond the ends, their prolongation."""
        along = (offset * self.edges[index]).sum(-1) / self.square[index]
        low, high = torch.zeros(len(self.edges)), torch.ones(len(self.edges))
        low[0], high[-1] = -math.inf, math.inf
        return along.clamp(low.double()[index], high.double()[index])


@dataclass(frozen=True)
class TorchVehicle:
    """A Dubins car, one step of RK4 a control period.

    Attributes:
        speed: metres per second.
        max_heading_rate: radians per second.
        dt: seconds.
    """

    speed: float
    max_heading_rate: float
    dt: float

    def step(self, state: torch.Tensor, control: torch.Tensor) -> torch.Tensor:
        """Advance states (n, 3) under raw controls (n,), double precision."""
        rate = self._saturate(control.double())

        def slope(x: torch.Tensor) -> torch.Tensor:
            cos, sin = torch.cos(x[:, 2]), torch.sin(x[:, 2])
            return torch.stack([self.speed * cos, self.speed * sin, rate], 1)

        dt, k1 = self.dt, slope(state)
        k2 = slope(state + 0.5 * dt * k1)
        k3 = slope(state + 0.5 * dt * k2)
        k4 = slope(state + dt * k3)
        return state + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def _saturate(self, control: torch.Tensor) -> torch.Tensor:
        ratio = control / self.max_heading_rate
        return control * (1 + ratio**8) ** (-1 / 8)


class TorchLoop:
    """A drive and its derivative by the texture.

    Args:
        view: what the policy sees.
        policy: maps images (n, 3, height, width) and goals (n,) to controls (n,);
            its parameters are frozen.
        transforms: from the camera's planes to the policy's images.
        goal: of the route.
        vehicle: one control period.
        route: the objective's stage cost.
    """

    def __init__(
        self,
        view: TorchView,
        policy: torch.nn.Module,
        transforms: Sequence[AbstractTransform],
        goal: int,
        vehicle: TorchVehicle,
        route: TorchRoute,
    ) -> None:
        self.view, self.vehicle, self.route = view, vehicle, route
        self.policy, self.goal = policy.eval().requires_grad_(False), goal
        self.transforms = transforms

    def drive(self, initial: torch.Tensor, horizon: int) -> torch.Tensor:
        """Drive from states (n, 3): (horizon, n, 3); taped if the texture asks."""
        goals = torch.full((len(initial),), self.goal)
        state, states = initial, []
        for _ in range(horizon):
            planes = self.view.image(state.detach())
            for transform in self.transforms:
                planes = transform.apply(planes)
            control = self.policy(planes, goals)
            state = self.vehicle.step(state, control)
            states.append(state)
        return torch.stack(states)

    def objective(self, states: torch.Tensor) -> torch.Tensor:
        """Return the mean over poses of the summed cost of states (horizon, n, 3)."""
        return self.route.cost(states.reshape(-1, 3)).sum() / states.shape[1]
