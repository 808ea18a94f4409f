"""Errors of where an object was put, and of how the camera was mounted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.ranges import NonNegative, checked
from mi_nerfattack.render.camera.intrinsics import CameraMount

_STREAM = 6  # of a drive's seed


@dataclass(frozen=True)
@checked("PoseError")
class PoseError:
    """Errors drawn for each drive: normal, of mean 0, a function of its seed.

    Args:
        placement_m: standard deviation of an object's place on the ground, along x
            and along y, metres.
        turn_deg: of its turn about the vertical through its origin.
        pitch_deg: of the camera's pitch on the vehicle.
    """

    placement_m: NonNegative = 0.0
    turn_deg: NonNegative = 0.0
    pitch_deg: NonNegative = 0.0

    @property
    def moves_objects(self) -> bool:
        """Whether objects stand elsewhere in each drive."""
        return bool(self.placement_m or self.turn_deg)

    def offsets(self, offsets: np.ndarray, seed: int) -> np.ndarray:
        """Add a drive's error of placement to the offsets of objects.

        Args:
            offsets: (k, 6), shift in metres and rotation vector of each object, world
                axes, as `Pose.moved` takes them.
            seed: of the drive.

        Returns:
            (k, 6), the offsets with the error, in the same form; `offsets` itself
            where `moves_objects` is false.
        """
        if not self.moves_objects:
            return offsets
        draws = self._rng(seed).normal(size=1 + offsets.size)[1:].reshape(-1, 6)
        moved = offsets.copy()
        moved[:, :2] += self.placement_m * draws[:, :2]
        up = np.radians(self.turn_deg) * draws[:, 2:3] * [0.0, 0.0, 1.0]
        turned = Rotation.from_rotvec(up) * Rotation.from_rotvec(offsets[:, 3:])
        moved[:, 3:] = turned.as_rotvec()
        return moved

    def mount(self, mount: CameraMount, seed: int) -> CameraMount:
        """Return a mount with a drive's error of pitch; without error, `mount`."""
        if not self.pitch_deg:
            return mount
        error = self.pitch_deg * float(self._rng(seed).normal())
        return replace(mount, pitch_deg=mount.pitch_deg + error)

    @staticmethod
    def _rng(seed: int) -> np.random.Generator:
        return np.random.default_rng([seed, _STREAM])
