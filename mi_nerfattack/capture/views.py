"""Render posed views of Mitsuba scenes: colour, opacity and depth.

One sensor is kept and moved from view to view. Compared with Mitsuba's `batch` sensor,
whose scene must be built (and whose kernels compiled) again for other poses, it
compiles nothing after the first view, and no reconstruction filter crosses from one
view into the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack import files
from mi_nerfattack.capture.frames import begin_posed, write_poses
from mi_nerfattack.colour import linear_to_uint8
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera import (
    Camera,
    CameraMount,
    generate_rays,
    mount_matrix,
    pose_arrays,
)
from mi_nerfattack.render.conventions import mitsuba_sensor_dict, opencv_to_mitsuba
from mi_nerfattack.render.scene import load_scene
from mi_nerfattack.vehicle.route import Route

_LATERAL_SD, _LATERAL_MAX = 0.8, 2.0  # metres
_HEADING_SD_DEG, _ANY_HEADING_SHARE = 15.0, 0.3
_OTHER_HEIGHT_SHARE, _HEIGHT_RANGE, _PITCH_SD_DEG = 0.3, (0.8, 3.0), 6.0


@dataclass(frozen=True, eq=False)
class View:
    """One rendered view, linear Rec.709.

    Args:
        rgb: (height, width, 3), float32, premultiplied by alpha.
        alpha: (height, width), float32, share of samples that hit a surface (or an
            environment emitter, unless the integrator hides emitters).
        depth: (height, width), float32, metres from the camera along the ray through
            the pixel's centre to the first surface, infinite where there is none.
            A surface with a partly transparent `mask` counts as solid.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray


class ViewRenderer:
    """Renders one scene with one camera from any number of poses.

    After the first view no kernel is compiled. Not differentiable.

    Args:
        scene: any scene; its own sensors are ignored.
        camera: intrinsics.
        integrator: `mi.Integrator` for colour; None for the scene's own.
    """

    def __init__(self, scene: Any, camera: Camera, integrator: Any = None) -> None:
        """Build the sensor."""
        film = {"pixel_format": "rgba"}
        self.scene, self.camera = scene, camera
        self._integrator = scene.integrator() if integrator is None else integrator
        self._sensor = mi.load_dict(mitsuba_sensor_dict(camera, np.eye(4), 1, film))
        self._parameters = mi.traverse(self._sensor)

    def render(self, camera_to_world: np.ndarray, spp: int, seed: int) -> View:
        """Render one view.

        Args:
            camera_to_world: (4, 4), OpenCV axes, metres.
            spp: samples per pixel, at least 1; rounded up to a grid (32 to 35).
            seed: of the samples, in [0, 2^32).
        """
        to_world = mi.Transform4f(opencv_to_mitsuba(camera_to_world))
        dr.make_opaque(to_world)
        self._parameters["to_world"] = to_world
        self._parameters.update()
        image = mi.render(
            self.scene,
            sensor=self._sensor,
            integrator=self._integrator,
            spp=_grid_samples(spp),
            seed=mi.UInt32(seed),
        ).numpy()
        return View(image[..., :3], image[..., 3], self.depth(camera_to_world))

    def depth(self, camera_to_world: np.ndarray) -> np.ndarray:
        """Return the depth image alone; see `View.depth`."""
        origin, rotation = pose_arrays(camera_to_world)
        o, d = generate_rays(self.camera, origin, rotation, 1)
        t = self.scene.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=True).t
        return t.numpy().reshape(self.camera.height, self.camera.width)


def _grid_samples(spp: int) -> int:
    """Round up as the `multijitter` sampler does, which warns where it has to."""
    if spp < 1:
        raise InputError(f"spp: {spp}; must be at least 1")
    rows = math.isqrt(spp)
    return rows * -(-spp // rows)


def iterate_views(
    scene: Any,
    camera: Camera,
    camera_to_world: np.ndarray,
    spp: int,
    seed: int,
    integrator: Any = None,
) -> Iterator[View]:
    """Render views one after the other; see `render_views`."""
    renderer = ViewRenderer(scene, camera, integrator)
    seeds = np.random.SeedSequence(seed).generate_state(len(camera_to_world))
    for matrix, view_seed in zip(camera_to_world, seeds, strict=True):
        yield renderer.render(matrix, spp, int(view_seed))


def render_views(
    scene: Any,
    camera: Camera,
    camera_to_world: np.ndarray,
    spp: int,
    seed: int,
    integrator: Any = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render a scene from n poses.

    Args:
        scene: any scene; its own sensors are ignored.
        camera: intrinsics.
        camera_to_world: (n, 4, 4), OpenCV axes, metres.
        spp: samples per pixel.
        seed: each view has samples of its own derived from it.
        integrator: `mi.Integrator`; None for the scene's own.

    Returns:
        rgb (n, height, width, 3), alpha and depth (n, height, width) as in `View`.
    """
    views = list(iterate_views(scene, camera, camera_to_world, spp, seed, integrator))
    return (
        np.stack([view.rgb for view in views]),
        np.stack([view.alpha for view in views]),
        np.stack([view.depth for view in views]),
    )


def drive_poses(
    routes: Sequence[Route], n: int, seed: int, mount: CameraMount | None = None
) -> np.ndarray:
    """Scatter camera poses along routes, for fitting what a drive may see.

    The routes take turns. Arc length is uniform; lateral offset normal with standard
    deviation 0.8 m, cut at 2 m; heading normal around the route's with 15 degrees, or
    for 30 % of the poses uniform over all headings. Another 30 % sit at a height
    uniform in 0.8 to 3 m with the pitch scattered by 6 degrees, the rest as mounted.

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
    cut = _LATERAL_MAX / _LATERAL_SD
    lateral = _LATERAL_SD * np.asarray(
        truncnorm.rvs(-cut, cut, size=n, random_state=rng)
    )
    any_heading = rng.uniform(size=n) < _ANY_HEADING_SHARE
    heading = np.where(
        any_heading,
        rng.uniform(-np.pi, np.pi, n),
        rng.normal(0, np.radians(_HEADING_SD_DEG), n),
    )
    is_other = rng.uniform(size=n) < _OTHER_HEIGHT_SHARE
    height = np.where(is_other, rng.uniform(*_HEIGHT_RANGE, n), mount.height_m)
    pitch = mount.pitch_deg + is_other * rng.normal(0, _PITCH_SD_DEG, n)
    poses = []
    for i in range(n):
        route = routes[i % len(routes)]
        state = route.pose_at(along[i] * route.length, lateral[i], heading[i])
        here = CameraMount(float(height[i]), mount.forward_m, float(pitch[i]))
        poses.append(mount_matrix(state, here)[0])
    return np.stack(poses)


def capture_scene(
    scene_path: str | Path,
    routes_path: str | Path,
    out_folder: str | Path,
    n: int,
    camera: Camera,
    spp: int,
    seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write posed sRGB images of a driving scene, for fitting a field.

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

    Returns:
        Path of `transforms.json`.
    """
    table = files.read_json(routes_path)
    if not isinstance(table, dict) or not table:
        raise InputError(f"{routes_path}: needs an object with one key per route")
    routes = [Route.from_file(routes_path, name) for name in table]
    poses = drive_poses(routes, n, seed)
    scene = load_scene(scene_path)
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
