"""Sensors and scenes that tests of cameras share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import mitsuba as mi
import numpy as np

from mi_nerfattack.render.camera.intrinsics import Camera

WIDTH, HEIGHT, FOCAL = 48, 32, 30.0
CROP = {"crop_width": 20, "crop_height": 16, "crop_offset_x": 15, "crop_offset_y": 7}
LENS = {"fx": 30.0, "fy": 36.0, "cx": 22.5, "cy": 18.0}
LENS |= {"k1": -0.08, "k2": 0.02, "p1": 2e-3, "p2": -3e-3}
RADIAL = Camera(48, 32, **LENS)
NARROW = Camera(
    64, 48, 30.0, 32.0, 31.0, 25.0, -0.03, 0.012, 0, 0, -0.004, 0.0006, is_fisheye=True
)
WIDE = replace(NARROW, fx=20.0, fy=19.0)  # sees up to 114 degrees from its axis
PINHOLE = {"type": "opencv_camera", "fx": FOCAL, "cx": 20.0, "cy": 18.0}
STOCK = {
    "type": "perspective",
    "fov": float(np.degrees(2 * np.arctan(0.5 * WIDTH / FOCAL))),
    "fov_axis": "x",
    "principal_point_offset_x": 0.5 - 20 / WIDTH,
    "principal_point_offset_y": 0.5 - 18 / HEIGHT,
}
EYE = [1.0, 2.0, -3.0]
INTEGRATORS = {
    "path": {"type": "path", "max_depth": 3},
    "direct": {"type": "direct"},
    "prb": {"type": "prb", "max_depth": 3},
    "aov": {
        "type": "aov",
        "aovs": "d:depth,x:position,u:duv_dx,v:duv_dy",
        "inner": {"type": "direct"},
    },
}


def block(centre: list[float], half: list[float]) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate(centre).scale(half)
    return {"type": "cube", "to_world": place}


def film(**properties: Any) -> dict[str, Any]:
    pixels = "luminance" if mi.is_monochromatic else "rgb"
    base = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}
    return {**base, "pixel_format": pixels, "component_format": "float32", **properties}


def sensor(description: dict[str, Any], **film_properties: Any) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().look_at(EYE, [0, 0, 0], [0, 1, 0])
    return {**description, "to_world": to_world, "film": film(**film_properties)}


def load(description: dict[str, Any]) -> Any:
    return mi.load_dict(description, parallel=False)


def world(
    camera: dict[str, Any], integrator: dict[str, Any], **objects: Any
) -> mi.Scene:
    """Load a chequered ball under a sky, with the camera as `eye`."""
    chequers = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": [0.8, 0.3, 0.1]},
        "to_uv": mi.ScalarTransform4f().scale([8, 8, 1]),
    }
    ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": chequers}}
    scene = {"type": "scene", "integrator": integrator, "eye": camera, "ball": ball}
    return mi.load_dict(scene | {"sky": {"type": "constant"}} | objects, parallel=False)


def rays(camera: mi.Sensor, pixel: np.ndarray) -> tuple[mi.RayDifferential3f, Any]:
    """Sample the rays of pixels (n, 2), counted in the full film."""
    crop = np.array(camera.film().crop_size())
    place = (pixel - np.array(camera.film().crop_offset())) / crop
    sample = mi.Point2f(np.ascontiguousarray(place.T, np.float32))
    return camera.sample_ray_differential(
        mi.Float(0), mi.Float(0.3), sample, mi.Point2f(0)
    )


def grid_of_pixels(step: float = 4.0) -> np.ndarray:
    u, v = np.meshgrid(np.arange(0, WIDTH + 1, step), np.arange(0, HEIGHT + 1, step))
    return np.stack([u.ravel(), v.ravel()], 1)


def pixels(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return the centres of all pixels, row by row."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return u.ravel(), v.ravel()


def directions(camera: Camera, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return what pixels show, (n, 3), right, down, forward, in float64.

    Of a fisheye by bisection, of other lenses by a fixed point.
    """
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    if camera.is_fisheye:
        radius = np.hypot(x, y)
        low, high = np.zeros_like(radius), np.full_like(radius, np.pi)
        for _ in range(80):
            mid = (low + high) / 2
            bent = mid + camera.k1 * mid**3 + camera.k2 * mid**5
            bent += camera.k3 * mid**7 + camera.k4 * mid**9
            low, high = np.where(bent < radius, [mid, high], [low, mid])
        sine = np.sin(low) / np.maximum(radius, 1e-300)
        return np.stack([x * sine, y * sine, np.cos(low)], -1)
    a, b = x, y
    for _ in range(80):
        squared, across = a * a + b * b, 2 * a * b
        radial = 1 + camera.k1 * squared + camera.k2 * squared**2
        shift_a = camera.p1 * across + camera.p2 * (squared + 2 * a * a)
        shift_b = camera.p1 * (squared + 2 * b * b) + camera.p2 * across
        a, b = (x - shift_a) / radial, (y - shift_b) / radial
    result = np.stack([a, b, np.ones_like(a)], -1)
    return result / np.linalg.norm(result, axis=1, keepdims=True)
