"""Poses of objects and cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.errors import InputError


@dataclass(frozen=True)
class Pose:
    """Rigid pose and uniform scale of a field in the world.

    Attributes:
        rotation: (3, 3) proper rotation, field to world.
        translation: (3,) of the field's origin, metres in the world.
        scale: world metres per metre of the field's frame.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, np.float64)
        good = rotation.shape == (3, 3) and np.isfinite(rotation).all()
        good = good and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not (good and np.linalg.det(rotation) > 0):
            raise ValueError(f"rotation: {rotation.tolist()}; expected a 3x3 rotation")
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"scale: {self.scale}; must be positive and finite")
        if not np.isfinite(self.translation).all():
            raise ValueError(f"translation: {self.translation}; must be finite")

    @staticmethod
    def identity() -> Pose:
        """Return the pose that leaves a field where it is."""
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: np.ndarray) -> Pose:
        """Split a 4x4 matrix into rotation, translation and uniform scale.

        Raises:
            ValueError: the matrix shears, reflects or scales unequally, or its last
                row is not 0 0 0 1, as when it is transposed.
        """
        matrix = np.asarray(matrix, np.float64)
        volume = np.linalg.det(matrix[:3, :3]) if np.isfinite(matrix).all() else 0.0
        scale = float(np.cbrt(abs(volume)))
        if not scale > 0:
            raise ValueError(f"{matrix.tolist()} is singular or not finite")
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
            raise ValueError(f"last row {matrix[3].tolist()}; must be 0 0 0 1")
        return Pose(matrix[:3, :3] / scale, matrix[:3, 3].copy(), scale)

    @staticmethod
    def upright(
        position: tuple[float, float, float], yaw: float, scale: float = 1.0
    ) -> Pose:
        """Return a pose that turns about the z axis by `yaw` radians."""
        c, s = np.cos(yaw), np.sin(yaw)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return Pose(rotation, np.asarray(position, float), scale)

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Turn points (..., 3) of the field into points of the world, metres."""
        return self.scale * points @ self.rotation.T + self.translation

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Turn points (..., 3) of the world, metres, into points of the field."""
        return (points - self.translation) @ self.rotation / self.scale

    def is_near(self, other: Pose) -> bool:
        """Tell whether two poses are equal to about single precision."""
        parts = zip(
            (self.rotation, self.translation, self.scale),
            (other.rotation, other.translation, other.scale),
            strict=True,
        )
        return all(np.allclose(a, b, rtol=1e-6, atol=1e-6) for a, b in parts)

    def moved(self, offset: np.ndarray) -> Pose:
        """Return the pose moved by an offset.

        Args:
            offset: (6,), shift in metres, then rotation vector in radians about the
                field's origin, both along the world's axes.
        """
        from scipy.spatial.transform import Rotation  # slow to import

        turn = Rotation.from_rotvec(offset[3:]).as_matrix()
        return Pose(turn @ self.rotation, self.translation + offset[:3], self.scale)

    @property
    def yaw(self) -> float:
        """Angle about the world's z axis from its x axis to the field's, radians."""
        return float(np.arctan2(self.rotation[1, 0], self.rotation[0, 0]))


def offset_gradient(
    matrix: np.ndarray, by_matrix: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """Turn a derivative by a moved pose's matrix into that by the offset.

    Args:
        matrix: (4, 4), field to world.
        by_matrix: (4, 4), derivative by it.
        offset: (6,), by which :meth:`Pose.moved` made it.

    Returns:
        (6,), per metre and per radian.

    Source: Chirikjian 2012, "Stochastic Models, Information Theory, and Lie Groups",
    vol. 2, section 10.6 (the left Jacobian of the rotation vector).
    """
    # Torque about the field's origin
    torque = np.cross(matrix[:3, :3].T, by_matrix[:3, :3].T).sum(0)
    by_turn = left_jacobian(offset[3:]).T @ torque
    return np.concatenate([by_matrix[:3, 3], by_turn])


def left_jacobian(vector: np.ndarray) -> np.ndarray:
    """Return (3, 3) J with ``d exp([w]) = [J dw] exp([w])`` for a rotation vector."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-4:
        return np.eye(3) + cross / 2 + cross @ cross / 6
    first = (1 - np.cos(angle)) / angle**2
    second = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + first * cross + second * cross @ cross


def check_rigid(matrix: np.ndarray, where: str) -> None:
    """Check that a (4, 4) matrix is a rotation and a translation.

    Raises:
        InputError: with `where`, if it scales, shears, reflects or is not finite.
    """
    if not np.all(np.isfinite(matrix)):
        raise InputError(f"{where}: the matrix contains NaN or infinity")
    rotation = matrix[:3, :3]
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{where}: last row {matrix[3].tolist()}; must be 0 0 0 1")
    error = np.abs(rotation).max()  # whose square may overflow
    if error < 2:
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > 1e-3:
        lengths = [round(math.hypot(*column), 6) for column in rotation.T.tolist()]
        raise InputError(
            f"{where}: not a rigid pose, the columns have lengths {lengths}; they "
            "must be orthonormal, without scale or shear"
        )
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"{where}: the pose is a reflection (determinant -1); "
            "the camera axes must be right-handed"
        )
