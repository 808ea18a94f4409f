"""Camera paths: poses from `transforms.json`, or along a route at its speed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_nerfattack.capture.transforms import find_transforms, read_frames
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.video import check_fps
from mi_nerfattack.render.camera.intrinsics import CameraMount, mount_matrix
from mi_nerfattack.vehicle.route.route import Route


def read_path(path: str | Path) -> np.ndarray:
    """Read the poses of a `transforms.json`; its images need not exist.

    Only `frames[i].transform_matrix` is read: camera to world, OpenGL axes, as
    nerfstudio, Instant-NGP and Blender write it. The lens is that of whatever sensor
    the poses are given to.

    Args:
        path: JSON file, or the folder of `transforms.json`.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes, in the order of the file, n >= 1.

    Raises:
        InputError: no such file, no frames, or a frame whose matrix is missing, not
            finite, or more than rotation and translation.
    """
    source = find_transforms(Path(path))
    table = files.read_json(source)
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not frames:
        raise InputError(
            f"{source}: frames: missing or empty; a camera path is a list of "
            '{"transform_matrix": 4 x 4 numbers}'
        )
    return read_frames(source, dict(enumerate(frames)))


def route_path(route: Route, mount: CameraMount, fps: float) -> np.ndarray:
    """Drive along the middle of a route at its nominal speed.

    Args:
        route: from its first to its last point.
        mount: where the camera sits on the vehicle.
        fps: frames per second.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes, one pose every 1 / fps seconds.
    """
    check_fps(fps)
    count = int(np.floor(route.length * fps / route.speed_ms + 1e-9)) + 1
    s = np.arange(count) * (route.speed_ms / fps)
    states = route.pose_at(s)
    states[:, 2] = route.heading_at(s)
    return mount_matrix(states, mount)
