"""The drive that `bench loop` differentiates: scene, camera, policy, vehicle, cost.

The scene is the bundled street and the bundled hydrant, twice its size, in the `depth`
composite. The vehicle drives 3.5 m in 200 control periods of 0.05 s, so that the
hydrant comes closer and stays in the image. The policy steers by the mean column of the
dark pixels.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import torch

from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.dynamics import Dubins

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
