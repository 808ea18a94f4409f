"""Metric scale and world of motion capture, which follows a body on the camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from mi_nerfattack.capture.colmap.reconstruct import Structure
from mi_nerfattack.capture.photographs.staging import copied
from mi_nerfattack.capture.pose_files import read_poses
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import CameraMount
from mi_nerfattack.render.camera.pose import poses_at

_LEAST = 6  # photographs that have both poses
_LEAST_TURN = 0.1  # radians about a second axis, root of the mean square
_LARGEST_TURN = 2.5  # radians, beyond which a turn's axis is uncertain
_OUTLIER = 0.02  # metres, or radians, from which on a residual counts less
_WRONG = 0.1  # residual as a share of the path's extent


@dataclass(frozen=True, eq=False)
class Tracked:
    """Poses of a body that is fixed to the camera.

    Attributes:
        where: they are from, for messages.
        body_to_world: (4, 4) by the name of the photograph, metres; the world is the
            tracker's, the body's axes are any.
    """

    where: str
    body_to_world: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class HandEye:
    """What brings a reconstruction into the tracker's world.

    Attributes:
        scale: metres of a unit.
        rotation: (3, 3), of the reconstruction in the tracker's world.
        translation: (3,), of its origin there, metres.
        camera_to_body: (4, 4), of the camera (OpenCV axes) on the body, metres.
        residual_m: root mean square between the camera's places by both, metres.
        residual_deg: the same of their directions, degrees.
        photographs: that both have poses of.
    """

    scale: float
    rotation: list[list[float]]
    translation: list[float]
    camera_to_body: list[list[float]]
    residual_m: float
    residual_deg: float
    photographs: int


def read_tracked(path: Path, times: Mapping[str, float] | None = None) -> Tracked:
    """Read a tracker's poses.

    Args:
        path: pose file, as of recordings (see `pose_files`), of the body: with `file`,
            the photographs' names; or of a video with `time_s`, between which poses
            are interpolated.
        times: of a video's frames by name, seconds, on the tracker's clock; None for
            photographs.

    Raises:
        InputError: it cannot be read, or lacks names or times.
    """
    table = read_poses(path, CameraMount())
    if times is None:
        if not table.names:
            raise InputError(f"{path}: its rows name no photographs; add 'file'")
        names = (copied(Path(name).name) for name in table.names)
        named = zip(names, table.camera_to_world, strict=True)
        return Tracked(str(path), dict(named))
    if table.times is None or not (np.diff(table.times) > 0).all():
        raise InputError(
            f"{path}: needs time_s in each row, increasing, in seconds from the start "
            "of the video"
        )
    matrices, is_known = poses_at(
        table.times, table.camera_to_world, np.array(list(times.values()))
    )
    named = zip(times, matrices, is_known, strict=True)
    poses = {name: pose for name, pose, known in named if known}
    return Tracked(str(path), poses)


def fit_tracked(structure: Structure, tracked: Tracked) -> HandEye:
    """Find scale, rotation and translation of a world, and the camera on the body.

    Let B be the pose of the body, X the camera's pose on the body, C the camera's pose
    in the photographs' frame, and W, with a scale s, this frame's pose in the world.
    Then B X = W C. Body and camera make equal turns between two photographs, up to X.
    So the turns give the rotation of X, and then the rotation of W. The places are
    linear in the translations of X and W and in s. At last all are refined together;
    outliers count less.

    Args:
        structure: poses of any frame and unit.
        tracked: poses of the same photographs, or of some.

    Raises:
        InputError: too few photographs have both poses, the camera hardly turned about
            two axes, or the poses contradict each other.

    Source: Park and Martin 1994, robot sensor calibration; with a scale.
    """
    shared = _shared(structure, tracked)
    body = np.stack([tracked.body_to_world[structure.names[i]] for i in shared])
    camera = structure.camera_to_world[shared]
    turned = Rotation.from_matrix(body[:, :3, :3])
    camera_rotations = Rotation.from_matrix(camera[:, :3, :3])
    start = _start(
        tracked.where,
        turned,
        camera_rotations,
        places=body[:, :3, 3],
        camera_places=camera[:, :3, 3],
    )

    def residuals(x: np.ndarray) -> np.ndarray:
        mount, world = (Rotation.from_rotvec(v) for v in (x[:3], x[3:6]))
        there = np.exp(x[12]) * world.apply(camera[:, :3, 3]) + x[9:12]
        place = turned.apply(x[6:9]) + body[:, :3, 3] - there
        turn = (turned * mount * (world * camera_rotations).inv()).as_rotvec()
        return np.concatenate([place.ravel(), turn.ravel()])

    fit = least_squares(residuals, start, loss="soft_l1", f_scale=_OUTLIER)
    place, turn = residuals(fit.x).reshape(2, -1, 3)
    off, angle = (float(np.sqrt((v**2).sum(1).mean())) for v in (place, turn))
    extent = float(np.linalg.norm(np.ptp(body[:, :3, 3], axis=0)))
    if off > _WRONG * extent or angle > _WRONG:
        raise InputError(
            f"{tracked.where}: its poses and those of the photographs differ by "
            f"{off:.3g} m on a path of {extent:.3g} m, and by {np.degrees(angle):.3g} "
            "degrees; see that the clocks agree, that the body did not move on the "
            "camera, and that quaternions are w, x, y, z"
        )
    mount = np.eye(4)
    mount[:3, :3] = Rotation.from_rotvec(fit.x[:3]).as_matrix()
    mount[:3, 3] = fit.x[6:9]
    return HandEye(
        scale=float(np.exp(fit.x[12])),
        rotation=Rotation.from_rotvec(fit.x[3:6]).as_matrix().tolist(),
        translation=fit.x[9:12].tolist(),
        camera_to_body=mount.tolist(),
        residual_m=off,
        residual_deg=float(np.degrees(angle)),
        photographs=len(shared),
    )


def _shared(structure: Structure, tracked: Tracked) -> list[int]:
    """Return the indices of the photographs that have both poses."""
    shared = [i for i, n in enumerate(structure.names) if n in tracked.body_to_world]
    if len(shared) < _LEAST:
        raise InputError(
            f"{tracked.where}: has poses of {len(shared)} of {len(structure.names)} "
            f"placed photographs, at least {_LEAST} are needed; see that names, or the "
            "clocks of the video and the tracker, agree"
        )
    return shared


def _start(
    where: str,
    turned: Any,
    camera_rotations: Any,
    places: np.ndarray,
    camera_places: np.ndarray,
) -> np.ndarray:
    """Return rotation vectors of X and W, X's and W's translation, and log scale.

    Args:
        where: for messages.
        turned: n rotations of B; `Any`, as SciPy's stubs index with one integer alone.
        camera_rotations: n rotations of C.
        places: (n, 3), of B, metres.
        camera_places: (n, 3), of C, units.
    """
    first, second = np.triu_indices(len(places), 1)
    by_body = (turned[first].inv() * turned[second]).as_rotvec()
    by_camera = (camera_rotations[first].inv() * camera_rotations[second]).as_rotvec()
    is_sure = np.linalg.norm(by_body, axis=1) < _LARGEST_TURN
    by_body, by_camera = by_body[is_sure], by_camera[is_sure]
    spread = np.linalg.svd(by_body, compute_uv=False) / np.sqrt(max(1, len(by_body)))
    if len(by_body) < 2 or spread[1] < _LEAST_TURN:
        raise InputError(
            f"{where}: the camera turned about one axis at most, which does not tell "
            "where it is on the body; tilt or roll it while filming, too"
        )
    mount = Rotation.align_vectors(by_body, by_camera)[0]
    world = (turned * mount * camera_rotations.inv()).mean()
    n = len(places)
    system = np.zeros((n, 3, 7))
    system[:, :, :3] = turned.as_matrix()
    system[:, :, 3:6] = -np.eye(3)
    system[:, :, 6] = -world.apply(camera_places)
    solution = np.linalg.lstsq(system.reshape(-1, 7), -places.ravel(), rcond=None)[0]
    if not solution[6] > 0:
        raise InputError(
            f"{where}: its path is not that of the photographs, at any scale; see that "
            "names, or the clocks of the video and the tracker, agree"
        )
    scale = [np.log(solution[6])]
    return np.concatenate([mount.as_rotvec(), world.as_rotvec(), solution[:6], scale])
