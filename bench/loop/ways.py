"""Two ways to the gradient of one drive, and two ways to write its policy.

The scene is the bundled street and the bundled hydrant, twice its size, in the `depth`
composite. The vehicle drives 3.5 m in 200 control periods of 0.05 s, so that the
hydrant comes closer and stays in the image. The policy steers by the mean column of the
dark pixels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from bench.worker import Clock
from mi_nerfattack.deploy.surrogate.scene import scene_sensor
from mi_nerfattack.policy.drjit_network import DrJitNetwork
from mi_nerfattack.policy.inputs import NoGoal
from mi_nerfattack.policy.torch_policy import TorchPolicy
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.rollout.adjoint import KeptBackgrounds, Replay
from mi_nerfattack.rollout.function import Rollout
from mi_nerfattack.rollout.loop import ClosedLoop
from mi_nerfattack.rollout.objective import StageSum
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.dynamics import Dubins
from mi_nerfattack.vehicle.integrators import RK4

HYDRANT = "hydrant"  # id of its volume
HYDRANT_AT = (-14.0, -4.2, 0.12)
HYDRANT_SCALE = 2.0
FOV_DEG = 90.0
MOUNT = CameraMount()
PERIOD_S = 0.05
START = (-22.0, -1.45, 0.0)  # x and y in metres, heading in radians
LANE_Y_M = -1.75  # of the lane's centre
CAR = Dubins(speed=0.35, max_heading_rate=1.5)

DARK = 0.35  # sRGB value below which a pixel is dark
SHARPNESS = 20.0  # of the step between dark and bright
GAIN = 0.5  # rad/s to the left for dark pixels at the right edge


def load_scene(width: int, height: int) -> mi.Scene:
    """Load street, hydrant and camera.

    Args:
        width: of the image, pixels.
        height: of the image, pixels.
    """
    place = mi.ScalarTransform4f().translate(HYDRANT_AT).scale(HYDRANT_SCALE)
    integrator = {
        "type": "field_integrator",
        "id": "fields",
        "composite": "depth",
        "scene": {
            "type": "ngp_field",
            "filename": str(bundled("intersection/field.safetensors")),
        },
        HYDRANT: {
            "type": "grid_field",
            "filename": str(bundled("hydrant/field.safetensors")),
            "to_world": place,
        },
    }
    sensor = camera_at(START, width, height)
    document = {"type": "scene", "integrator": integrator, "sensor": sensor}
    scene: Any = mi.load_dict(document, parallel=False)
    return scene


def camera_at(
    state: tuple[float, float, float], width: int, height: int
) -> dict[str, Any]:
    """Describe the camera of a vehicle for `mi.load_dict`.

    One sample per pixel falls on the centre of the pixel.

    Args:
        state: x and y in metres, heading in radians.
        width: of the image, pixels.
        height: of the image, pixels.
    """
    x, y, heading = state
    rotate = mi.ScalarTransform4f().rotate
    mounted = (
        mi.ScalarTransform4f().translate([x, y, MOUNT.height_m])
        @ rotate([0, 0, 1], float(dr.rad2deg(heading)))
        @ mi.ScalarTransform4f().translate([MOUNT.forward_m, 0, 0])
        @ rotate([0, 1, 0], MOUNT.pitch_deg)
    )
    ahead = mi.ScalarTransform4f().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])
    return {
        "type": "perspective",
        "fov": FOV_DEG,
        "to_world": mounted @ ahead,
        "sampler": {"type": "stratified", "sample_count": 1, "jitter": False},
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "rfilter": {"type": "box"},
        },
    }


def cost(state: Any) -> Any:
    """Return the squared distance from the lane's centre, (n,), of states (3, n)."""
    return dr.square(state[1] - LANE_Y_M)


class TorchRule(torch.nn.Module):
    """Steer by the mean column of the dark pixels."""

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return heading rates (n,) for images (n, 3, height, width), sRGB."""
        dark = torch.sigmoid(SHARPNESS * (DARK - image.mean(1)))
        columns = torch.linspace(-1, 1, image.shape[3])
        return GAIN * (dark * columns).sum((1, 2)) / dark.sum((1, 2))


def drjit_rule(grey: Any, width: int) -> Any:
    """Steer as :class:`TorchRule` does, in Dr.Jit operations.

    Args:
        grey: tensor (height width, n), means of the colours of n images, sRGB.
        width: of the images, pixels.

    Returns:
        heading rates, a tensor (1, n).
    """
    dark = 1 / (1 + dr.exp(SHARPNESS * (grey - DARK)))
    column = dr.arange(mi.UInt32, len(grey)) % width
    position = type(grey)(2 * mi.Float(column) / (width - 1) - 1, (len(grey), 1))
    total = dr.sum(dark * position, axis=0) / dr.sum(dark, axis=0)
    return GAIN * dr.reshape(type(grey), total, (1, -1))


class AbstractLoop(ABC):
    """A closed loop in a process of its own.

    Args:
        policy: ``torch`` or ``drjit``, the library of the policy.
        width: of the image, pixels.
        height: of the image, pixels.
    """

    def __init__(self, policy: str, width: int, height: int) -> None:
        self.policy, self.width, self.height = policy, width, height
        self.scene = load_scene(width, height)
        self.leaf: Any = None

    @abstractmethod
    def value(self, frames: int) -> Any:
        """Drive and return the cost, attached to `self.leaf`, which is fresh."""

    def by_colour(self) -> np.ndarray:
        """Return the last gradient by the colours of the hydrant, (n, 3)."""
        return dr.grad(self.leaf).numpy()

    def gradient(self, frames: int) -> dict[str, float]:
        """Drive and differentiate the cost by the leaf.

        Returns:
            ``seconds`` and ``cpu_seconds``, and the cost as ``loss``.
        """
        clock = Clock()
        value = self.value(frames)
        dr.backward(value)
        dr.eval(dr.grad(self.leaf))
        dr.sync_thread()
        return clock.per_step() | {"loss": float(dr.detach(value)[0])}

    def write(self, path: str) -> None:
        """Write :meth:`by_colour` as a file of NumPy's."""
        np.save(Path(path), self.by_colour())


class RolloutLoop(AbstractLoop):
    """The rollout of the package.

    Args:
        adjoint: ``replay`` or ``kept_backgrounds``, how derivatives are made.
        policy: as for :class:`AbstractLoop`.
        width: of the image, pixels.
        height: of the image, pixels.
    """

    def __init__(self, adjoint: str, policy: str, width: int, height: int) -> None:
        super().__init__(policy, width, height)
        self.adjoint = Replay() if adjoint == "replay" else KeptBackgrounds()
        self.sensor = scene_sensor(self.scene, MOUNT, [HYDRANT])
        module = TorchRule() if policy == "torch" else DrJitNetwork(self._network)
        driver = TorchPolicy(module, NoGoal())
        # mi.render rounds no image to eight bits
        self.loop = ClosedLoop(
            sensor=self.sensor,
            policy=driver,
            goal=0,
            dynamics=CAR,
            integrator=RK4(),
            dt=PERIOD_S,
            eight_bit=False,
        )

    def value(self, frames: int) -> Any:
        """See :meth:`AbstractLoop.value`."""
        rollout = Rollout(self.loop, StageSum(cost), frames, adjoint=self.adjoint)
        (key,) = self.sensor.keys
        self.leaf = _leaf(self.sensor.params[key])
        return rollout({key: self.leaf}, self.loop.initial(np.array([START])))

    def _network(self, features: Any) -> Any:
        """Return controls (1, n) of features (3 height width, n), colour by colour."""
        planes = dr.reshape(type(features), features, (3, -1, features.shape[1]))
        return drjit_rule(dr.mean(planes, axis=0), self.width)


class _EvaluatedCostate(dr.CustomOp):
    """Return a state; in the backward pass, evaluate the derivative by it.

    Without this, the backward pass evaluates no derivative by a state, so that each
    frame compiles a kernel that contains the vehicle's steps of all later frames.
    """

    def eval(self, state: Any) -> Any:
        return type(state)(state)

    def backward(self) -> None:
        d_state = self.grad_out()
        dr.eval(d_state)
        self.set_grad_in("state", d_state)


class PlainLoop(AbstractLoop):
    """A loop over `mi.render`, as a user of Mitsuba writes it."""

    def __init__(self, policy: str, width: int, height: int) -> None:
        super().__init__(policy, width, height)
        self.parameters = mi.traverse(self.scene)
        self.key = f"fields.{HYDRANT}.colour"
        self.rule = TorchRule()
        to_torch = dr.wrap(source="drjit", target="torch")
        in_torch = policy == "torch"
        self.steer = to_torch(self._steer_torch) if in_torch else self._steer_drjit

    def value(self, frames: int) -> Any:
        """See :meth:`AbstractLoop.value`."""
        self.leaf = _leaf(self.parameters[self.key])
        self.parameters[self.key] = self.leaf
        self.parameters.update()
        state: Any = mi.Vector3d(*START)
        dr.make_opaque(state)
        total: Any = dr.opaque(mi.Float64, 0)
        for _ in range(frames):
            # One sensor per frame: the backward pass renders from the sensor again.
            x, y, heading = (float(row[0]) for row in dr.detach(state))
            view = camera_at((x, y, heading), self.width, self.height)
            sensor: Any = mi.load_dict(view, parallel=False)
            image = mi.render(self.scene, self.parameters, sensor=sensor, spp=1)
            srgb = dr.linear_to_srgb(image[..., :3])
            dr.eval(srgb)
            control = CAR.saturate(mi.Float64(self.steer(srgb).array))
            state = RK4().step(CAR, state, control, PERIOD_S)
            state = dr.custom(_EvaluatedCostate, state)
            total = total + cost(state)
            dr.eval(state, total)
        return total

    def _steer_torch(self, image: torch.Tensor) -> torch.Tensor:
        """Return the heading rate (1,) for an image (height, width, 3)."""
        return self.rule(image.permute(2, 0, 1)[None])

    def _steer_drjit(self, image: Any) -> Any:
        """Return the heading rate (1, 1) for an image (height, width, 3)."""
        pixels = dr.reshape(type(image), image, (-1, 3))
        return drjit_rule(dr.mean(pixels, axis=1)[:, None], self.width)


def _leaf(parameter: Any) -> Any:
    """Return a copy of a parameter that collects a gradient."""
    leaf = type(parameter)(dr.detach(parameter))
    dr.enable_grad(leaf)
    return leaf
