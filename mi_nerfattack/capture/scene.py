"""Views of a Mitsuba scene along its routes, as posed images."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.capture.transforms import FILE_NAMES, begin_posed, write_poses
from mi_nerfattack.errors import InputError
from mi_nerfattack.io import files
from mi_nerfattack.io.resumable import Record, Unit, differences, flatten, refuse
from mi_nerfattack.render.camera.conventions import to_colmap
from mi_nerfattack.render.camera.intrinsics import (
    Camera,
    CameraMount,
    mount_matrix,
)
from mi_nerfattack.render.pathtrace.ground import (
    arc_lengths,
    ground_findings,
    wall_findings,
)
from mi_nerfattack.render.pathtrace.load import load_scene, named_files
from mi_nerfattack.render.pathtrace.views import (
    ViewRenderer,
    require_colour,
    view_seeds,
)
from mi_nerfattack.vehicle.route.route import Route, load_routes

#: In widths of a lane: 0.9 m, and 1.5 m beside the lane or beyond its ends, of 3.5 m.
_LATERAL_SD, _BEYOND = 0.25, 3 / 7
_BESIDE_SHARE = 0.4
_HEADING_SD_DEG, _ANY_HEADING_SHARE = 15.0, 0.3
_OTHER_HEIGHT_SHARE, _PITCH_SD_DEG = 0.3, 6.0
_HEIGHTS = 4 / 7, 15 / 7  # in heights of the camera: 0.8 to 3 m, of 1.4 m
_FORMAT = "mi_nerfattack captured view 1"
_IDENTITY = "capture"  # key of transforms.json
_DEPTH = "depth.safetensors"
_VIEWS = "views"  # folder of views until all are there
_REMEDY = "choose another folder, or remove this one"
_ROUNDS = 20  # of draws in place of views from within things


def drive_poses(
    routes: Sequence[Route], n: int, seed: int, mount: CameraMount | None = None
) -> np.ndarray:
    """Scatter camera poses along routes, for fitting what a drive may see.

    The routes take turns. The lengths below hold for a lane 3.5 m wide and a camera
    1.4 m high; they grow in proportion to the lane's width and the camera's height.

    - The arc length is uniform. On an open route it begins 1.5 m before the start and
      ends 1.5 m after the end.
    - The lateral offset is normal with standard deviation 0.9 m, cut at the lane's
      edges. For 40 % of the poses it is uniform instead, up to 1.5 m outside the lane.
    - The heading is normal around the route's heading with standard deviation 15
      degrees. For 30 % of the poses it is uniform over all headings instead.
    - The camera is as mounted. For 30 % of the poses its height is uniform from 0.8 to
      3 m instead, and its pitch is normal with standard deviation 6 degrees.

    Args:
        routes: at least one.
        n: number of poses.
        seed: of the scatter.
        mount: the driving camera; None for the default mount.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes.
    """
    if not routes or n < 1:
        raise InputError(
            f"drive_poses: {len(routes)} routes, n {n}; at least 1 of both"
        )
    if seed < 0:
        raise InputError(f"seed: {seed}; at least 0")
    mount = CameraMount() if mount is None else mount
    rng = np.random.default_rng(seed)
    # Along the lane and across it, in shares of the route's length and lane widths
    along = rng.uniform(0, 1, n)
    lateral = _lateral(rng, n)
    # Where the car heads, from the route's heading
    any_heading = rng.uniform(size=n) < _ANY_HEADING_SHARE
    heading = np.where(
        any_heading,
        rng.uniform(-np.pi, np.pi, n),
        rng.normal(0, np.radians(_HEADING_SD_DEG), n),
    )
    # How the camera is mounted: as given, or higher, lower and pitched
    is_other = rng.uniform(size=n) < _OTHER_HEIGHT_SHARE
    low, high = (factor * mount.height_m for factor in _HEIGHTS)
    height = np.where(is_other, rng.uniform(low, high, n), mount.height_m)
    pitch = mount.pitch_deg + is_other * rng.normal(0, _PITCH_SD_DEG, n)
    poses = []
    for i in range(n):
        state = _scattered(
            routes[i % len(routes)], along[i], lateral[i], heading=heading[i]
        )
        drawn_mount = replace(
            mount, height_m=float(height[i]), pitch_deg=float(pitch[i])
        )
        poses.append(mount_matrix(state, drawn_mount)[0])
    return np.stack(poses)


def _lateral(rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw offsets (n,) to the left of the lane's centre, widths of the lane."""
    from scipy.stats import truncnorm

    cut = 0.5 / _LATERAL_SD
    inside = truncnorm.rvs(-cut, cut, size=n, random_state=rng)
    beside = rng.uniform(size=n) < _BESIDE_SHARE
    reach = 0.5 + _BEYOND
    anywhere = rng.uniform(-reach, reach, n)
    return np.where(beside, anywhere, _LATERAL_SD * np.asarray(inside))


def _scattered(
    route: Route, along: float, lateral: float, heading: float
) -> np.ndarray:
    """Return x, y and heading beside a route, from beyond its start to its end.

    Args:
        route: of the lane.
        along: share of the length, beyond the ends included.
        lateral: offset to the left, widths of the lane.
        heading: from that of the route, radians.
    """
    width = route.lane_width_m
    margin = 0.0 if route.closed else _BEYOND * width
    arc = along * (route.length + 2 * margin) - margin
    return route.pose_at(arc, lateral * width, heading)


def _free_poses(
    scene: Any, routes: Sequence[Route], n: int, seed: int, mount: CameraMount | None
) -> np.ndarray:
    """Draw poses; those from which something hides the lane's middle, anew."""
    poses, turn = drive_poses(routes, n, seed, mount=mount), 0
    while (hidden := _is_hidden(scene, routes, poses)).any():
        turn += 1
        if turn > _ROUNDS:
            raise InputError(
                f"views: {hidden.sum()} of {n} are within things that stand beside the "
                "lane; is the mount of the camera that of the car?"
            )
        poses[hidden] = drive_poses(routes, n, seed + turn, mount=mount)[hidden]
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

    Where a surface hides the lane's middle from the camera, for example where the
    camera is within furniture, the view is drawn again.

    Writes `images/0000.png`..., `depth.safetensors` (tensor `depth`, (n, height,
    width), metres, see `View.depth`) and, last, `transforms.json`. Until then, each
    view is kept in the folder `views`: a call that was interrupted goes on from there.

    Args:
        scene_path: Mitsuba XML.
        routes_path: routes file of the scene; all its routes are used.
        out_folder: made if needed; what it holds must be of the same call.
        n: number of views; see `drive_poses`.
        camera: intrinsics.
        spp: samples per pixel.
        seed: of poses and samples.
        progress: called with (views done, n) after each view.
        mount: the driving camera; None for the default mount.

    Returns:
        Path of `transforms.json`.

    Raises:
        InputError: the scene has no integrator, no ground at z = 0 under a route, a
            surface across a route, or no free place for a view. Also where the folder
            holds views of another call; the message lists the differences.
    """
    require_colour()
    routes = load_routes(routes_path)
    mount = CameraMount() if mount is None else mount
    drawn = {"spp": spp, "seed": seed}
    choices = {"camera": to_colmap(camera)[1], "mount": mount.described(), "views": n}
    identity = _identity(choices | drawn, Path(scene_path), Path(routes_path))
    root, path = Path(out_folder), Path(out_folder) / FILE_NAMES[0]
    if path.exists():
        refuse(path, differences(_made_of(path), identity), _REMEDY)
        shutil.rmtree(root / _VIEWS, ignore_errors=True)
        progress(n, n)
        return path
    scene = load_scene(scene_path)
    _check(scene, Path(scene_path), routes, source=routes_path)
    poses = _free_poses(scene, routes, n, seed=seed, mount=mount)
    begin_posed(out_folder)
    names = _write_views(
        root,
        scene,
        camera,
        poses=poses,
        drawn=drawn,
        identity=identity,
        progress=progress,
    )
    extra = {"units": "metre", "depth_file": _DEPTH, **drawn, _IDENTITY: identity}
    write_poses(path, names, camera, camera_to_world=poses, extra=extra)
    shutil.rmtree(root / _VIEWS, ignore_errors=True)
    return path


def _write_views(
    root: Path,
    scene: Any,
    camera: Camera,
    poses: np.ndarray,
    drawn: Mapping[str, int],
    identity: Mapping[str, str],
    progress: Callable[[int, int], None],
) -> list[str]:
    """Write images and depth, each view once it is kept; return the images' names."""
    n, renderer = len(poses), ViewRenderer(scene, camera)
    names = [f"images/{i:04d}.png" for i in range(n)]
    depth = np.empty((n, camera.height, camera.width), np.float32)
    folder = files.make_folder(root / _VIEWS)
    for i, view_seed in enumerate(view_seeds(drawn["seed"], n)):
        file = folder / f"{i:04d}.safetensors"
        unit = Unit(file, {**identity, "view": str(i)}, Record, remedy=_REMEDY)
        image, depth[i] = _view(
            unit, renderer, poses[i], spp=drawn["spp"], view_seed=view_seed
        )
        files.write_image(root / names[i], image)
        progress(i + 1, n)
    files.write_safetensors(root / _DEPTH, {"depth": depth})
    return names


def _check(scene: Any, path: Path, routes: Sequence[Route], source: str | Path) -> None:
    """Refuse no integrator, and routes without ground or with a surface across."""
    if scene.integrator() is None:
        raise InputError(f"{path}: has no integrator; add one, for instance path")
    for route in routes:
        arc = arc_lengths(0.0, route.length)
        for findings in (ground_findings, wall_findings):
            for line in findings(route, arc, scene, path.name):
                raise InputError(f"{source}: {line}; no view was rendered")


def _view(
    unit: Unit[Record],
    renderer: ViewRenderer,
    pose: np.ndarray,
    spp: int,
    view_seed: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return image and depth of a view, which is rendered unless it is kept."""
    if (done := unit.read()) is not None:
        return done.tensors["image"], done.tensors["depth"]
    view = renderer.render(pose, spp, view_seed)
    tensors = {"image": linear_to_uint8(view.rgb), "depth": view.depth}
    unit.write(tensors, Record())
    return tensors["image"], tensors["depth"]


def _identity(choices: dict[str, Any], scene: Path, routes: Path) -> dict[str, str]:
    identity = {"format": _FORMAT, **versions(), **flatten("capture", choices)}
    for name, file in {"scene": scene, "routes": routes, **named_files(scene)}.items():
        entry = {"file": file.name, "sha256": files.sha256(file)}
        identity[f"file.{name}"] = json.dumps(entry)
    return identity


def is_begun(folder: Path) -> bool:
    """Whether a folder holds what `capture_scene` wrote there."""
    if (folder / _VIEWS).is_dir():
        return True
    try:
        return bool(_made_of(folder / FILE_NAMES[0]))
    except InputError:
        return False


def _made_of(path: Path) -> dict[str, str]:
    document = files.read_json(path)
    made = document.get(_IDENTITY) if isinstance(document, dict) else None
    return {**made} if isinstance(made, dict) else {}
