"""Posed renders of a mesh on its own, for fitting an object's field."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import straight_rgba
from mi_nerfattack.capture.mesh.mesh import TexturedMesh, mitsuba_shapes
from mi_nerfattack.capture.posed_images import PosedImages
from mi_nerfattack.errors import InputError
from mi_nerfattack.render.camera.intrinsics import Camera, from_fov, look_at
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.lighting.lights import Lighting
from mi_nerfattack.render.pathtrace.views import iterate_views

_FOV_DEG = 40.0
_MARGIN = 1.05
_MAX_LAYERS = 64  # of transparent surfaces on one ray
_SHARE_BELOW, _LOWEST = 0.15, -0.4


def sphere_poses(
    n: int, centre: np.ndarray, distance: float, seed: int = 0
) -> np.ndarray:
    """Place cameras on a sphere along a Fibonacci spiral, looking at its centre.

    85 % of them are above the horizon, uniform per area; the rest reach down to
    24 degrees below it, less than half as dense.

    Args:
        n: number of cameras.
        centre: (3,), metres.
        distance: metres.
        seed: turns the spiral about z and shuffles it.

    Returns:
        camera_to_world: (n, 4, 4), OpenCV axes, in random order, so that every 8th view
        (see `held_out`) is not a pattern on the sphere.
    """
    share = (np.arange(n) + 0.5) / n
    above = 1 - share / (1 - _SHARE_BELOW)
    below = _LOWEST * (share - 1 + _SHARE_BELOW) / _SHARE_BELOW
    z = np.where(share < 1 - _SHARE_BELOW, above, below)
    if seed < 0:
        raise InputError(f"seed: {seed}; at least 0")
    turn = np.random.default_rng(seed).uniform(0, 2 * np.pi)
    phi = turn + np.arange(n) * np.pi * (3 - math.sqrt(5))
    radius = np.sqrt(1 - z**2)
    offsets = np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)
    order = np.random.default_rng(seed).permutation(n)
    return np.stack([look_at(centre + distance * o, centre) for o in offsets[order]])


def render_asset(
    mesh: TexturedMesh,
    n_views: int,
    size_px: int,
    seed: int = 0,
    lighting: Lighting | None = None,
    spp: int = 25,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[PosedImages, np.ndarray]:
    """Render a mesh from all sides without background.

    Direct light only, so that no colour bleeds; materials are diffuse.

    Args:
        mesh: in metres; see `normalise`.
        n_views: number of views; see `sphere_poses`.
        size_px: width and height of the views.
        seed: of views and samples.
        lighting: None for the default.
        spp: samples per pixel.
        progress: called with (views done, n_views) after each view.

    Returns:
        Images (RGBA, alpha from the geometry, not premultiplied), and depth (n_views,
        size_px, size_px), float32, metres along the ray to the first surface that is
        at least half opaque. The depth is infinite where the ray misses the mesh.
    """
    if n_views < 1 or size_px < 1 or spp < 1:
        raise InputError(
            f"n_views {n_views}, size_px {size_px}, spp {spp}; each at least 1"
        )
    low, high = mesh.bounds
    reach = 0.5 * float(np.linalg.norm(high - low))
    distance = _MARGIN * reach / math.sin(math.radians(0.5 * _FOV_DEG))
    camera = from_fov(size_px, size_px, _FOV_DEG)
    poses = sphere_poses(n_views, 0.5 * (low + high), distance, seed=seed)
    light = Lighting() if lighting is None else lighting
    scene = mi.load_dict(
        {"type": "scene", "light": light.emitter(), **mitsuba_shapes(mesh)},
        parallel=False,
    )
    is_solid = all(part.is_solid for part in mesh.submeshes)
    # volpath alone does not count passing through a mask as a bounce
    kind = "path" if is_solid else "volpath"
    integrator = mi.load_dict({"type": kind, "max_depth": 2, "hide_emitters": True})
    images = np.empty((n_views, size_px, size_px, 4), np.uint8)
    depth = np.empty((n_views, size_px, size_px), np.float32)
    views = iterate_views(
        scene, camera, poses, spp=spp, seed=seed, integrator=integrator
    )
    for i, view in enumerate(views):
        images[i] = straight_rgba(view.rgb, view.alpha[..., None])
        depth[i] = view.depth if is_solid else _solid_depth(scene, camera, poses[i])
        progress(i + 1, n_views)
    names = tuple(f"{mesh.name}:{i:04d}" for i in range(n_views))
    return PosedImages(images, poses, camera, names=names), depth


def _solid_depth(scene: Any, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Return the depth image of surfaces that are at least half opaque."""
    o, d = generate_rays(camera, *pose_arrays(pose), 1)
    ray, active = mi.Ray3f(o, d), mi.Bool(True)
    depth = mi.Float(dr.inf)
    for _ in range(_MAX_LAYERS):
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        through = dr.mean(si.bsdf(ray).eval_null_transmission(si, active))
        goes_on = active & (through > 0.5)
        depth = dr.select(active & ~goes_on, dr.norm(si.p - o), depth)
        ray, active = si.spawn_ray(d), goes_on
        dr.eval(depth, ray, active)
        if not dr.any(active):
            break
    return depth.numpy().reshape(camera.height, camera.width)
