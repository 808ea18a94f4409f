"""Offsets of an object's pose: a shift and a rotation vector about its origin."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from mi_nerfattack.render.camera.pose import Pose


def offset_pose(pose: Pose, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Move a pose.

    Args:
        pose: field to world.
        offset: (6,), shift in metres and rotation vector in radians, world axes.

    Returns:
        rotation (3, 3) and translation (3,), field to world.
    """
    turn = Rotation.from_rotvec(offset[3:]).as_matrix()
    return turn @ pose.rotation, pose.translation + offset[:3]


def offset_gradient(wrench: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Turn what rays see of a motion into the derivative by the offset.

    Args:
        wrench: (6,): sums over rays of ``g_o`` and of ``v x g_o + d x g_d``, with g
            the objective's derivatives by origin and direction d of a ray as the
            object sees it, v from the object's origin to the ray's.
        offset: (6,), where the derivative is taken.

    Returns:
        (6,), per metre and per radian.

    Source: Chirikjian 2012, "Stochastic Models, Information Theory, and Lie Groups",
    vol. 2, section 10.6 (the left Jacobian of the rotation vector).
    """
    return np.concatenate([-wrench[:3], -left_jacobian(offset[3:]).T @ wrench[3:]])


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
