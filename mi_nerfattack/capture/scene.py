"""Views of a Mitsuba scene along its routes, as posed images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.capture.transforms import begin_posed, write_poses
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    mount_matrix,
)
from mi_nerfattack.render.pathtrace.load import load_scene
from mi_nerfattack.render.pathtrace.views import iterate_views, require_colour
from mi_nerfattack.vehicle.route.route import Route, load_routes

#: In widths of a lane: 0.9 m, and 1.5 m beside the lane or beyond its ends, of 3.5 m.
_LATERAL_SD, _BEYOND = 0.25, 3 / 7
_BESIDE_SHARE = 0.4
_HEADING_SD_DEG, _ANY_HEADING_SHARE = 15.0, 0.3
_OTHER_HEIGHT_SHARE, _PITCH_SD_DEG = 0.3, 6.0
_HEIGHTS = 4 / 7, 15 / 7  # in heights of the camera: 0.8 to 3 m, of 1.4 m
_ROUNDS = 20  # of draws in place of views from within things


def drive_poses(
    routes: Sequence[Route], n: int, seed: int, mount: CameraMount | None = None
) -> np.ndarray:
    """Scatter camera poses along routes, for fitting what a drive may see.

    The routes take turns. A lane 3.5 m wide is surrounded by 1.5 m, others in
    proportion. Arc length is uniform, 1.5 m beyond the ends of open routes too; lateral
    offset normal with standard deviation 0.9 m, cut at the lane's edges, or for 40 % of
    the poses uniform up to 1.5 m beside the lane; heading normal around the route's
    with 15 degrees, or for 30 % uniform over all headings. Another 30 % sit at a height
    uniform in 0.8 to 3 m, of a camera 1.4 m high and others in proportion, with the
    pitch scattered by 6 degrees, the rest as mounted.

    Args:
        routes: at least one.
        n: number of poses.
        seed: of the scatter.
        mount: the driving camera; None for the default mount.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes.
    """
    from scipy.stats import truncnorm

    if not routes or n < 1:
        raise InputError(
            f"drive_poses: {len(routes)} routes, n {n}; at least 1 of both"
        )
    if seed < 0:
        raise InputError(f"seed: {seed}; at least 0")
    mount = CameraMount() if mount is None else mount
    rng = np.random.default_rng(seed)
    along = rng.uniform(0, 1, n)
    cut = 0.5 / _LATERAL_SD
    lateral = _LATERAL_SD * np.asarray(
        truncnorm.rvs(-cut, cut, size=n, random_state=rng)
    )
    beside = rng.uniform(size=n) < _BESIDE_SHARE
    reach = 0.5 + _BEYOND
    lateral = np.where(beside, rng.uniform(-reach, reach, n), lateral)
    any_heading = rng.uniform(size=n) < _ANY_HEADING_SHARE
    heading = np.where(
        any_heading,
        rng.uniform(-np.pi, np.pi, n),
        rng.normal(0, np.radians(_HEADING_SD_DEG), n),
    )
    is_other = rng.uniform(size=n) < _OTHER_HEIGHT_SHARE
    low, high = (factor * mount.height_m for factor in _HEIGHTS)
    height = np.where(is_other, rng.uniform(low, high, n), mount.height_m)
    pitch = mount.pitch_deg + is_other * rng.normal(0, _PITCH_SD_DEG, n)
    poses = []
    for i in range(n):
        route = routes[i % len(routes)]
        width = route.lane_width_m
        margin = 0.0 if route.closed else _BEYOND * width
        arc = along[i] * (route.length + 2 * margin) - margin
        state = route.pose_at(arc, lateral[i] * width, heading[i])
        here = CameraMount(float(height[i]), mount.forward_m, float(pitch[i]))
        poses.append(mount_matrix(state, here)[0])
    return np.stack(poses)


def _free_poses(
    scene: Any, routes: Sequence[Route], n: int, seed: int, mount: CameraMount | None
) -> np.ndarray:
    """Draw poses; those from which something hides the lane's middle, anew."""
    poses, turn = drive_poses(routes, n, seed, mount), 0
    while (hidden := _is_hidden(scene, routes, poses)).any():
        turn += 1
        if turn > _ROUNDS:
            raise InputError(
                f"views: {hidden.sum()} of {n} are within things that stand beside the "
                "lane; is the mount of the camera that of the car?"
            )
        poses[hidden] = drive_poses(routes, n, seed + turn, mount)[hidden]
    return poses


def _is_hidden(scene: Any, routes: Sequence[Route], poses: np.ndarray) -> np.ndarray:
    """Tell whether something stands between cameras and the lane beside them, (n,)."""
    middle = np.concatenate([route.points for route in routes])
    eyes = poses[:, :3, 3]
    away = eyes[:, None, :2] - middle
    near = np.square(away).sum(2).argmin(1)
    start = np.column_stack([middle[near], eyes[:, 2]])
    ray = mi.Ray3f(mi.Point3f(start.T), mi.Vector3f((eyes - start).T))
    ray.maxt = 1.0
    return np.array(scene.ray_test(ray))


def capture_scene(
    scene_path: str | Path,
    routes_path: str | Path,
    out_folder: str | Path,
    n: int,
    camera: Camera,
    spp: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
    mount: CameraMount | None = None,
) -> Path:
    """Write posed sRGB images of a driving scene, for fitting a field.

    A view from where something stands between the camera and the lane's middle, as
    within furniture, is drawn anew.

    Writes `images/0000.png`..., `depth.safetensors` (tensor `depth`, (n, height,
    width), metres, see `View.depth`) and, last, `transforms.json`.

    Args:
        scene_path: Mitsuba XML.
        routes_path: routes file of the scene; all its routes are used.
        out_folder: made if needed.
        n: number of views; see `drive_poses`.
        camera: intrinsics.
        spp: samples per pixel.
        seed: of poses and samples.
        progress: called with (views done, n) after each view.
        mount: the driving camera; None for the default mount.

    Returns:
        Path of `transforms.json`.

    Raises:
        InputError: the scene has no integrator, or leaves no free place for a view.
    """
    require_colour()
    routes = load_routes(routes_path)
    scene = load_scene(scene_path)
    if scene.integrator() is None:
        raise InputError(f"{scene_path}: has no integrator; add one, for instance path")
    poses = _free_poses(scene, routes, n, seed, mount)
    path = begin_posed(out_folder)
    root = path.parent
    names = [f"images/{i:04d}.png" for i in range(n)]
    depth = np.empty((n, camera.height, camera.width), np.float32)
    for i, view in enumerate(iterate_views(scene, camera, poses, spp, seed)):
        files.write_image(root / names[i], linear_to_uint8(view.rgb))
        depth[i] = view.depth
        progress(i + 1, n)
    files.write_safetensors(root / "depth.safetensors", {"depth": depth})
    extra = {
        "units": "metre",
        "depth_file": "depth.safetensors",
        "spp": spp,
        "seed": seed,
    }
    write_poses(path, names, camera, poses, extra)
    return path
