"""Make the pictures of the plugin reference and the gallery in build/pictures.

A picture that is younger than what it is made by is kept; `make docs` runs this.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import follow

ROOT = Path(__file__).parents[1]
GALLERY = ROOT / "docs/gallery.md"
FOLDER = ROOT / "build/pictures"
WIDTH, HEIGHT, SPP = 480, 200, 16


def field(kind: str, name: str, **more: Any) -> dict[str, Any]:
    """Describe a bundled field."""
    filename = str(ROOT / f"scenes/{name}/field.safetensors")
    return {"type": kind, "filename": filename, **more}


def sensor(eye: list, target: list, fov: float, **lens: Any) -> dict[str, Any]:
    """Describe a camera; those with a lens are ours."""
    import mitsuba as mi

    kind = {"type": "opencv_camera"} | lens if lens else {"type": "perspective"}
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT}
    return {
        **(kind if lens else kind | {"fov": fov}),
        "to_world": mi.ScalarTransform4f().look_at(eye, target, [0, 0, 1]),
        "film": film | {"rfilter": {"type": "box"}},
    }


def composite(view: dict[str, Any], **fields: Any) -> dict[str, Any]:
    """Describe a scene of nothing but fields."""
    integrator = {"type": "field_integrator", **fields}
    return {"type": "scene", "integrator": integrator, "sensor": view}


def hydrant_alone() -> dict[str, Any]:
    """Show an object, before nothing."""
    view = sensor([2.2, -1.4, 0.8], [0, 0, 0.37], 45)
    return composite(view, object=field("grid_field", "hydrant"))


def intersection() -> dict[str, Any]:
    """Show a reconstructed scene as a driver sees it."""
    view = sensor([-4, -1.75, 1.4], [6, -4, 0.9], 70)
    return composite(view, scene=field("ngp_field", "intersection"))


def both() -> dict[str, Any]:
    """Show an object in a reconstructed scene."""
    import mitsuba as mi

    pose = mi.ScalarTransform4f().translate([6, -6.2, 0.12]).scale(2)
    return composite(
        sensor([1.2, -3, 1.4], [6, -6.2, 0.95], 60),
        scene=field("ngp_field", "intersection"),
        object=field("grid_field", "hydrant", to_world=pose),
    )


def through_a_lens() -> dict[str, Any]:
    """Show the scene through a lens that bends it."""
    lens = {"fx": 260.0, "fy": 260.0, "k1": -0.22, "k2": 0.03}
    view = sensor([-4, -1.75, 1.4], [6, -4, 0.9], 0, **lens)
    return composite(view, scene=field("ngp_field", "intersection"))


def lamp() -> dict[str, Any]:
    """Show an object as a light in a room of ordinary surfaces."""
    import mitsuba as mi

    transform = mi.ScalarTransform4f()
    box = transform.translate([0, 0, 0.375]).scale([0.22, 0.24, 0.4])
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0}}
    emitter = {"type": "field_emitter", "object": field("grid_field", "hydrant")}
    mirror = {"type": "conductor", "material": "Ag"}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": sensor([2.4, -1.6, 0.9], [0, 0, 0.3], 45),
        "shown": {"type": "cube", "to_world": box, "bsdf": black, "emitter": emitter},
        "ball": {"type": "sphere", "center": [-0.4, -0.8, 0.3], "radius": 0.3}
        | {"bsdf": mirror},
        "floor": {"type": "rectangle", "to_world": transform.scale(4)},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.15}},
    }


def before_splats() -> dict[str, Any]:
    """Show an object before a wall of splats in the colours of a rainbow."""
    import numpy as np

    y, z = (grid.ravel() for grid in np.mgrid[-2:2.01:0.1, 0:1.61:0.1])
    zero = np.zeros_like(y)
    colours = 1.5 * np.cos(y[:, None] * 1.5 + np.array([0, 2, 4]))
    rows = np.column_stack(
        [zero - 1.2, y, z, colours, zero + 2.0, zero - 4, zero - 3.2, zero - 3.2]
        + [zero + 1, zero, zero, zero]
    )
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1"
    names = [*names.split(), "rot_2", "rot_3"]
    head = ["ply", "format ascii 1.0", f"element vertex {len(rows)}"]
    head += [*(f"property float {name}" for name in names), "end_header"]
    path = FOLDER / "splats.ply"
    np.savetxt(path, rows, "%.5f", header="\n".join(head), comments="")
    return composite(
        sensor([2.2, -1.4, 0.8], [0, 0, 0.37], 45),
        composite="depth",
        street={"type": "splat_background", "filename": str(path)},
        object=field("grid_field", "hydrant"),
    )


SCENES: dict[str, Callable[[], dict[str, Any]]] = {
    "grid_field": hydrant_alone,
    "ngp_field": intersection,
    "splat_background": before_splats,
    "field_emitter": lamp,
    "field_integrator": both,
    "opencv_camera": through_a_lens,
}


def is_stale(name: str, *sources: Path) -> bool:
    """Tell whether a picture is missing, or older than what it is made by."""
    picture = FOLDER / name
    return not picture.exists() or any(
        source.stat().st_mtime > picture.stat().st_mtime for source in sources
    )


def draw_gallery() -> None:
    """Run the gallery's blocks, unless all of its pictures are there."""
    names = re.findall(r"\.\./build/pictures/(\S+)\)", GALLERY.read_text("utf-8"))
    sources = (GALLERY, *(ROOT / "docs/examples").iterdir())
    if any(is_stale(name, *sources) for name in names):
        for line in follow.follow(GALLERY, ROOT, long=False):
            print(line, flush=True)


def main() -> None:
    """Make what is stale."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    draw_gallery()
    plugins = ROOT / "plugins"
    names = [
        name
        for name in SCENES
        if is_stale(f"{name}.png", Path(__file__), plugins / f"{name}.py")
    ]
    if not names:
        return
    import mi_nerfattack  # before mitsuba

    mi_nerfattack.variant.ensure()
    import mitsuba as mi

    for name in names:
        scene = mi.load_dict(SCENES[name](), parallel=False)
        image = mi.render(scene, spp=64 if name == "field_emitter" else SPP)
        colour = image[..., :3]
        if name in ("grid_field", "splat_background"):  # over white
            colour += 1 - image[..., 3:4]
        mi.util.write_bitmap(str(FOLDER / f"{name}.png"), colour, write_async=False)


if __name__ == "__main__":
    main()
