"""Poses of objects and cameras."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mi_nerfattack.errors import InputError

#: Longest time between a frame and the tracked pose nearest to it, seconds.
POSE_REACH_S = 0.1
#: The same for a frame before the first pose or after the last.
POSE_BEYOND_S = 0.05
_CLOCK_S = 1e-6  # to which seconds since 1970 are kept
#: Columns of a rotation whose numbers are wrong by half a thousandth each.
_ROUNDED = 2e-3


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
        pairs = zip(
            (self.rotation, self.translation, self.scale),
            (other.rotation, other.translation, other.scale),
            strict=True,
        )
        return all(np.allclose(a, b, rtol=1e-6, atol=1e-6) for a, b in pairs)

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


def poses_at(
    known_s: np.ndarray, poses: np.ndarray, times_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate poses in time: positions on a line, rotations at a constant rate.

    Beyond the first and the last pose, the motion continues for half an interval and at
    most `POSE_BEYOND_S`. Then the pose stays.

    Args:
        known_s: (n,), times of the poses, seconds, increasing.
        poses: (n, 4, 4), rigid.
        times_s: (m,), seconds.

    Returns:
        poses (m, 4, 4), and (m,) bool: whether a pose is known within `POSE_REACH_S`
        of the time, beyond the ends within `POSE_BEYOND_S`.
    """
    from scipy.spatial.transform import Rotation  # slow to import

    after = np.clip(np.searchsorted(known_s, times_s), 1, len(known_s) - 1)
    before = np.maximum(after - 1, 0)  # equal to `after` for a single pose
    start, end = known_s[before], known_s[after]
    step = np.where(end > start, end - start, 1.0)
    beyond = np.minimum(0.5 * step, POSE_BEYOND_S)
    reached = np.clip(times_s, start - beyond, end + beyond)
    share = ((reached - start) / step)[:, None]
    away = np.minimum(abs(times_s - start), abs(times_s - end))
    is_inside = (times_s >= known_s[0]) & (times_s <= known_s[-1])
    is_known = away < np.where(is_inside, POSE_REACH_S, POSE_BEYOND_S) + _CLOCK_S
    first = Rotation.from_matrix(poses[before, :3, :3])
    turn = first.inv() * Rotation.from_matrix(poses[after, :3, :3])
    result = np.tile(np.eye(4), (len(times_s), 1, 1))
    result[:, :3, :3] = (
        first * Rotation.from_rotvec(share * turn.as_rotvec())
    ).as_matrix()
    moved = poses[after, :3, 3] - poses[before, :3, 3]
    result[:, :3, 3] = poses[before, :3, 3] + share * moved
    return result, is_known


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


def nearest_rigid(matrix: np.ndarray, where: str) -> np.ndarray:
    """Replace the rotation of a rigid pose (4, 4), rounded to three decimals.

    Raises:
        InputError: with `where`, if it is none; see `check_rigid`.
    """
    check_rigid(matrix, where, _ROUNDED)
    rotation = matrix[:3, :3]
    if np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-6:  # as it was written
        return matrix
    left, _, right = np.linalg.svd(rotation)
    result = matrix.copy()
    result[:3, :3] = left @ right
    return result


def check_rigid(matrix: np.ndarray, where: str, tolerance: float = 1e-3) -> None:
    """Check that a (4, 4) matrix is a rotation and a translation.

    Args:
        matrix: the pose.
        where: for the message.
        tolerance: of the products of the rotation's columns.

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
    if error > tolerance:
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
