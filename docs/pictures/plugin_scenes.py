"""Pictures of the plugin reference: one scene for each plugin."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import mitsuba as mi
import numpy as np
from images import write_jpeg
from PIL import Image

from mi_nerfattack.fields import load_field, save_field
from mi_nerfattack.fit.bake.bake import BakeOptions, bake, plan_bricks
from mi_nerfattack.render.camera.intrinsics import CameraMount, from_fov
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.scenes import bundled
from mi_nerfattack.vehicle.route.route import load_routes

ROOT = Path(__file__).resolve().parents[2]
WIDTH_PX, HEIGHT_PX = 320, 200
SPP = {"field_emitter": 256}  # path-traced, so noisier than the others
Description: TypeAlias = dict[str, object]


def plugins(folder: Path, small: bool) -> None:
    """Render `plugin_NAME.jpg` for each plugin.

    Args:
        folder: where the pictures go.
        small: render one sample per pixel.
    """
    for name, describe in SCENES.items():
        scene = mi.load_dict(describe(), parallel=False)
        image = mi.render(scene, spp=1 if small else SPP.get(name, 16))
        colour = image[..., :3]
        if name in ("grid_field", "splat_background"):  # on white
            colour += 1 - image[..., 3:4]
        pixels = np.array(mi.util.convert_to_bitmap(colour))
        write_jpeg(folder / f"plugin_{name}.jpg", Image.fromarray(pixels))


def glass(folder: Path, small: bool) -> None:
    """Render `glass.jpg` of docs/examples/glass.xml.

    Args:
        folder: where the picture goes.
        small: render few samples of a small image.
    """
    size = {"width": 160, "height": 80} if small else {"width": 640, "height": 320}
    scene = mi.load_file(str(ROOT / "docs/examples/glass.xml"), parallel=False, **size)
    image = mi.render(scene, spp=4 if small else 32)
    pixels = np.array(mi.util.convert_to_bitmap(image))
    write_jpeg(folder / "glass.jpg", Image.fromarray(pixels))


def field(kind: str, name: str, **properties: object) -> Description:
    """Describe a bundled field."""
    filename = str(ROOT / f"scenes/{name}/field.safetensors")
    return {"type": kind, "filename": filename, **properties}


def camera(eye: list[float], target: list[float], **lens: object) -> Description:
    """Describe a camera that looks from one point at another."""
    film = {
        "type": "hdrfilm",
        "width": WIDTH_PX,
        "height": HEIGHT_PX,
        "pixel_format": "rgba",
    }
    return {
        "to_world": mi.ScalarTransform4f().look_at(eye, target, [0, 0, 1]),
        "film": film | {"rfilter": {"type": "box"}},
        **lens,
    }


def composite(sensor: Description, **fields: object) -> Description:
    """Describe a scene that consists of fields."""
    integrator = {"type": "field_integrator", **fields}
    return {"type": "scene", "integrator": integrator, "sensor": sensor}


def hydrant_alone() -> Description:
    """Show an object on white."""
    view = camera([1.9, -1.2, 0.75], [0, 0, 0.37], type="perspective", fov=40)
    return composite(view, object=field("grid_field", "hydrant"))


def intersection() -> Description:
    """Show a reconstructed scene as a driver sees it."""
    view = camera([-4, -1.75, 1.4], [6, -4, 1.1], type="perspective", fov=65)
    return composite(view, scene=field("ngp_field", "intersection"))


def intersection_in_bricks() -> Description:
    """Show the same scene, baked in a pass of few views."""
    camera_on_car = from_fov(200, 66, 90.0)
    scene = PosedField(load_field(bundled("intersection/field.safetensors")))
    routes = load_routes(bundled("intersection/routes.json"))
    options = BakeOptions(passes=1, views=10)
    plan = plan_bricks(scene, routes, options)
    bricks = bake(scene, routes, camera_on_car, CameraMount(), options, plan)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "bricks.safetensors"
        save_field(path, bricks)
        volume = mi.load_dict({"type": "brick_field", "filename": str(path)})
    view = camera([-4, -1.75, 1.4], [6, -4, 1.1], type="perspective", fov=65)
    return composite(view, scene=volume)


def hydrant_at_the_road() -> Description:
    """Show an object in a reconstructed scene."""
    pose = mi.ScalarTransform4f().translate([6, -6.2, 0.12]).scale(2)
    view = camera([1.2, -3, 1.4], [6, -6.2, 0.95], type="perspective", fov=50)
    return composite(
        view,
        scene=field("ngp_field", "intersection"),
        object=field("grid_field", "hydrant", to_world=pose),
    )


def checkerboard_through_a_lens() -> Description:
    """Show straight lines that a lens bends."""
    board = {
        "type": "checkerboard",
        "color0": {"type": "rgb", "value": 0.03},
        "color1": {"type": "rgb", "value": 0.9},
        "to_uv": mi.ScalarTransform4f().scale([16, 10, 1]),
    }
    pose = mi.ScalarTransform4f().look_at([0, 0, 0], [1, 0, 0], [0, 0, 1])
    lens = {"fx": 190.0, "k1": -0.22, "k2": 0.03}
    return {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": camera([1.3, 0, 0], [0, 0, 0], type="opencv_camera", **lens),
        "wall": {
            "type": "rectangle",
            "to_world": pose.scale([1.6, 1, 1]),
            "bsdf": {"type": "diffuse", "reflectance": board},
        },
        "light": {"type": "constant"},
    }


def hydrant_as_lamp() -> Description:
    """Show an object as a light, before a mirror ball that reflects it."""
    transform = mi.ScalarTransform4f()
    box = transform.translate([0, 0, 0.375]).scale([0.22, 0.24, 0.4])
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}}
    emitter = {"type": "field_emitter", "object": field("grid_field", "hydrant")}
    mirror = {"type": "conductor", "material": "Ag"}
    ball = {"type": "sphere", "center": [-0.4, -0.8, 0.3], "radius": 0.3}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": camera(
            [2.4, -1.6, 0.9], [-0.1, -0.3, 0.3], type="perspective", fov=36
        ),
        "shape": {"type": "cube", "to_world": box, "bsdf": black, "emitter": emitter},
        "ball": ball | {"bsdf": mirror},
        "floor": {"type": "rectangle", "to_world": transform.scale(4)},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.15}},
    }


def hydrant_before_splats() -> Description:
    """Show an object before a wall of splats in the colours of a rainbow."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "splats.ply"
        write_wall_of_splats(path)
        street = mi.load_dict({"type": "splat_background", "filename": str(path)})
    return composite(
        camera([1.9, -1.2, 0.75], [0, 0, 0.37], type="perspective", fov=40),
        composite="depth",
        street=street,
        object=field("grid_field", "hydrant"),
    )


def write_wall_of_splats(path: Path) -> None:
    """Write splats in a plane x = -1.2 m as a 3D Gaussian splatting trainer does."""
    y, z = (grid.ravel() for grid in np.mgrid[-3:5.01:0.1, -2:4.01:0.1])
    zero = np.zeros_like(y)
    colours = 1.5 * np.cos(y[:, None] * 1.5 + np.array([0, 2, 4]))
    opacity, scales = [zero + 2.0], [zero - 4, zero - 2.6, zero - 2.6]
    rotation = [zero + 1, zero, zero, zero]
    rows = np.column_stack(
        [zero - 1.2, y, z, colours] + opacity + scales + rotation,
    )
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2".split()
    names += "rot_0 rot_1 rot_2 rot_3".split()
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    head += [*(f"property float {name}" for name in names), "end_header"]
    np.savetxt(path, rows, "%.5f", header="\n".join(head), comments="")


SCENES: dict[str, Callable[[], Description]] = {
    "grid_field": hydrant_alone,
    "ngp_field": intersection,
    "brick_field": intersection_in_bricks,
    "splat_background": hydrant_before_splats,
    "field_emitter": hydrant_as_lamp,
    "field_integrator": hydrant_at_the_road,
    "opencv_camera": checkerboard_through_a_lens,
}
