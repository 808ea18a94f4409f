"""What a fit learns about the cameras: exposure and corrections of the poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

EXPOSURE = "exposure"
POSES = "poses"


class CameraCorrections:
    """Parameters of each fitted image: exposure (3) and pose (6), zero at first.

    Exposure multiplies linear radiance by ``exp(e)``, channel by channel. A pose is
    corrected by a rotation vector about the camera's position and by a shift, both
    in world axes.

    Args:
        count: fitted images.
        learn: which of `EXPOSURE` and `POSES` are parameters.
    """

    def __init__(self, count: int, learn: Sequence[str]) -> None:
        self.count = count
        sizes = {EXPOSURE: 3, POSES: 6}
        self.values = {name: dr.zeros(mi.Float, count * sizes[name]) for name in learn}
        dr.make_opaque(self.values)

    def install(self, values: Any) -> None:
        """Replace the parameters by those of an optimiser."""
        self.values = {name: values[name] for name in self.values}

    def gain(self, image: mi.UInt32) -> mi.Color3f | None:
        """Return the factor of linear radiance in images (n,), (3, n); None for 1.

        Gains are relative to their geometric mean over all images, which the field
        keeps.
        """
        if EXPOSURE not in self.values:
            return None
        value = self.values[EXPOSURE]
        own = [dr.gather(mi.Float, value, 3 * image + c) for c in range(3)]
        index = dr.arange(mi.UInt32, self.count)
        mean = [dr.mean(dr.gather(mi.Float, value, 3 * index + c)) for c in range(3)]
        return dr.exp(mi.Color3f(*own) - mi.Color3f(*mean))

    def move(
        self, image: mi.UInt32, origin: Any, columns: Sequence[Any]
    ) -> tuple[Any, list[Any]]:
        """Correct the poses of images (n,); differentiable in the parameters."""
        if POSES not in self.values:
            return origin, list(columns)
        value = [
            dr.gather(mi.Float, self.values[POSES], 6 * image + c) for c in range(6)
        ]
        turn, shift = mi.Vector3f(*value[:3]), mi.Vector3f(*value[3:])
        return origin + shift, [_rotate(turn, column) for column in columns]

    def gains(self) -> np.ndarray | None:
        """Return the gains of all images, (count, 3), or None."""
        if EXPOSURE not in self.values:
            return None
        value = self.values[EXPOSURE].numpy().reshape(-1, 3).astype(np.float64)
        return np.exp(value - value.mean(axis=0))

    def poses(self, camera_to_world: np.ndarray) -> np.ndarray | None:
        """Return the corrected poses of all images, (count, 4, 4), or None.

        Args:
            camera_to_world: (count, 4, 4), as given to the fit.
        """
        from scipy.spatial.transform import Rotation

        if POSES not in self.values:
            return None
        value = self.values[POSES].numpy().reshape(-1, 6).astype(np.float64)
        result = np.array(camera_to_world, np.float64)
        turn = Rotation.from_rotvec(value[:, :3]).as_matrix()
        result[:, :3, :3] = turn @ result[:, :3, :3]
        result[:, :3, 3] += value[:, 3:]
        return result


def _rotate(turn: mi.Vector3f, v: Any) -> mi.Vector3f:
    """Rotate v by a rotation vector (Rodrigues), smooth at zero."""
    square = dr.maximum(dr.squared_norm(turn), 1e-16)
    angle = dr.sqrt(square)
    sine, cosine = dr.sincos(angle)
    cross = dr.cross(turn, v)
    twice = dr.cross(turn, cross)
    return mi.Vector3f(v + cross * (sine / angle) + twice * ((1 - cosine) / square))
