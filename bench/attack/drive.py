"""The drive that `bench attack` measures, as both sides read it.

The bundled intersection as it is, PilotNet on the route `right`, 12.5 m of road in 2.5
seconds, past the hydrant (twice its size, 1.5 m tall) beside the lane: from less than
1 % of the frame it grows to a quarter of it, and is passed. A longer horizon drives the
same road in finer steps, so that frames of all horizons are alike. The policy's image
is the camera's middle part of its shape, resized; so it drives much alike at all sizes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from bench.render.cameras import FOV_DEG
from mi_nerfattack.policy.pilotnet import IMAGE_SHAPE, PilotNet
from mi_nerfattack.policy.preprocess import AbstractTransform, Crop, Resize
from mi_nerfattack.render.camera.intrinsics import Camera, CameraMount, from_fov
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import Route

SECONDS = 2.5
START_M = 6.0  # from the route's first point
SPEED_MS, MAX_HEADING_RATE = 5.0, 1.5
LATERAL_SD_M = 0.1
ROUNDING_M = 0.05  # of the objective's absolute value
RATE = 1e-6  # of Adam; small, so that all iterations drive alike
MOUNT = CameraMount()
APART_M = 1.5  # of further objects
OBJECT_POSE = Pose.upright((-4.0, -3.4, 0.0), 0.0, 2.0)


@dataclass(frozen=True)
class Job:
    """A drive.

    Attributes:
        width, height: of the camera's image, pixels.
        poses: vehicles in the batch.
        horizon: control periods.
        objects: the hydrant, and others of its kind around it; one beside a peer.
    """

    width: int
    height: int
    poses: int
    horizon: int
    objects: int = 1

    @property
    def dt(self) -> float:
        """Control period, seconds."""
        return SECONDS / self.horizon

    @property
    def camera(self) -> Camera:
        """Intrinsics."""
        return from_fov(self.width, self.height, FOV_DEG)

    def initial(self) -> np.ndarray:
        """Return initial states (poses, 3); the first one is on the lane's centre."""
        lateral = np.random.default_rng(0).normal(0, LATERAL_SD_M, self.poses)
        lateral[0] = 0.0
        return route().pose_at(np.full(self.poses, START_M), lateral)

    def object_poses(self) -> list[Pose]:
        """Return where the objects stand: in two rows, away from the road."""
        x, y, _ = OBJECT_POSE.translation
        places = [
            (x + APART_M * (k // 2), y - APART_M * (k % 2), 0.0)
            for k in range(self.objects)
        ]
        return [Pose.upright(place, 0.0, OBJECT_POSE.scale) for place in places]

    def transforms(self) -> list[AbstractTransform]:
        """Return the pre-processing: the middle part, resized."""
        height, width = IMAGE_SHAPE
        rows = min(self.height, round(self.width * height / width))
        above = (self.height - rows) // 2
        crop = Crop(top=above, bottom=self.height - rows - above, left=0, right=0)
        return [crop, Resize(width, height)]


def route() -> Route:
    """Return the route."""
    return Route.from_file(bundled("intersection/routes.json"), "right")


def network() -> torch.nn.Module:
    """Return the policy's network."""
    return PilotNet.load(bundled("policy/pilotnet.safetensors"))
