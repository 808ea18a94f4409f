"""Draw objects in several lights: path-traced, by light maps, and by `relit`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from images import write_jpeg
from PIL import Image

from mi_nerfattack.capture import Placement
from mi_nerfattack.capture.mesh.mesh import mitsuba_shapes
from mi_nerfattack.fields import load_grid
from mi_nerfattack.render.camera.conventions import mitsuba_sensor_dict
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.lighting.lights import Lighting, Sunlight
from mi_nerfattack.render.lighting.shading import light_maps
from mi_nerfattack.render.march import march
from mi_nerfattack.render.pathtrace.views import iterate_views
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Gain, Rays
from mi_nerfattack.scenes import bundled

HEIGHTS = {"hydrant": 0.75, "car": 1.45}
SUNS = [
    Sunlight(60.0, 150.0, 0.75),
    Sunlight(18.0, 262.0, 0.8, 4000.0),
    Sunlight(25.0, 100.0, 0.7, 4500.0),
    Sunlight(50.0, 180.0, 0.0),
]
TOWARDS = np.array([0.75, -1.0, 0.35])  # the camera
OPAQUE = 0.98  # of the pixels that errors are of


class Subject:
    """A bundled object and a camera that looks at it.

    Args:
        name: of `HEIGHTS`.
        size: width and height of the pictures, pixels.
        spp: samples per pixel of the path tracer.
    """

    def __init__(self, name: str, size: int, spp: int) -> None:
        self.size, self.spp = size, spp
        self.file = bundled(f"{name}/field.safetensors")
        mesh = Placement(height_m=HEIGHTS[name]).mesh(bundled(f"{name}/{name}.glb"))
        self.shapes = mitsuba_shapes(mesh)
        field = load_grid(self.file)
        field.see_all()
        self.posed, self.maps = PosedField(field), light_maps(field)
        self.posed.light_maps = self.maps
        centre = (field.lower + field.upper) / 2
        reach = float(np.linalg.norm(field.upper - field.lower))
        offset = 1.2 * reach * TOWARDS / np.linalg.norm(TOWARDS)
        self.pose, self.camera = (
            look_at(centre + offset, centre),
            from_fov(size, size, 40.0),
        )

    def traced(self, emitters: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Path-trace the mesh in direct light: linear (h, w, 3), and alpha (h, w)."""
        scene = mi.load_dict({"type": "scene", **emitters, **self.shapes})
        path = {"type": "path", "max_depth": 2, "hide_emitters": True}
        poses, integrator = self.pose[None], mi.load_dict(path)
        views = iterate_views(scene, self.camera, poses, self.spp, 0, integrator)
        view = next(iter(views))
        return np.array(view.rgb), np.array(view.alpha)

    def mapped(self, row: int) -> tuple[np.ndarray, np.ndarray]:
        """March the field with a map of light: linear (h, w, 3), and opacity."""
        rays = Rays(*generate_rays(self.camera, *pose_arrays(self.pose), 1))
        gain = Gain(mi.Color3f(1), mi.UInt32(row))
        marched = march(self.posed.with_gain(gain), rays)
        colour, opacity, n = marched.radiance.numpy().T, marched.opacity, self.size
        return colour.reshape(n, n, 3), opacity.numpy().reshape(n, n)

    def relit(self, emitters: dict[str, Any]) -> np.ndarray:
        """Render the field `relit`, linear (h, w, 3)."""
        volume = {"type": "grid_field", "filename": str(self.file), "relit": True}
        fields = {"type": "field_integrator", "relit_samples": 32, "object": volume}
        spp = self.spp // 4  # each with 32 light samples
        sensor = mitsuba_sensor_dict(self.camera, self.pose, spp)
        view = {"sensor": sensor, "integrator": fields}
        scene = mi.load_dict({"type": "scene", **emitters, **view})
        return np.array(mi.render(scene, spp=spp))[..., :3]

    def columns(self, name: str) -> Iterator[np.ndarray]:
        """Yield the pictures of each light below each other, and print their errors."""
        reference, alpha = self.traced({"light": Lighting().emitter()})
        captured, opacity = self.mapped(0)
        solid = (alpha > OPAQUE) & (opacity > OPAQUE)

        def relative_error(image: np.ndarray) -> str:
            error = np.abs(image - reference)[solid].mean()
            return f"{error / reference[solid].mean():.1%}"

        print(f"{name}, light of the capture: {relative_error(captured)}", flush=True)
        yield np.concatenate([reference, captured, np.ones_like(captured)])
        for sun, row in zip(SUNS, self.maps.rows(SUNS, np.eye(3)), strict=True):
            reference, _ = self.traced(sun.emitters())
            mapped, relit = self.mapped(row)[0], self.relit(sun.emitters())
            best = captured * (reference[solid].mean(0) / captured[solid].mean(0))
            errors = [relative_error(image) for image in (mapped, relit, best)]
            print(f"{name}, {sun}: map, relit, one factor: {errors}", flush=True)
            yield np.concatenate([reference, mapped, relit])


def draw_light_maps(folder: Path, small: bool) -> None:
    """Draw both objects, one column for each light.

    Args:
        folder: where `light_maps.jpg` goes.
        small: render few samples of small images.
    """
    size, spp = (64, 4) if small else (256, 64)
    subjects = {name: Subject(name, size, spp) for name in HEIGHTS}
    columns = [image for k, item in subjects.items() for image in item.columns(k)]
    pixels = np.asarray(
        mi.Bitmap(np.concatenate(columns, 1)).convert(
            mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True
        )
    )
    write_jpeg(folder / "light_maps.jpg", Image.fromarray(pixels))
