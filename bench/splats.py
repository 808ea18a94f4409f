"""``python -m bench splats``: frames of splats beside Mitsuba's ray tracing."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from bench.results import Comparison, Progress, compare, read_sizes, timed
from bench.tables import markdown
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.ranges import Count
from mi_nerfattack.scenes import bundled

#: Sides, and the parameters that each is differentiated by.
SIDES = {
    "ours": ("opacity", "harmonics"),
    "volprim_rf_basic": ("opacities", "sh_coeffs"),
}
EYE, AHEAD = (-20.0, -1.75, 1.4), (-19.0, -1.65, 1.32)  # on the road, metres
WARM_UP = 2
FLAT = 100_000  # square metres of a shape that goes to the horizon
FAR_M = 80.0


@dataclass(frozen=True)
class BenchSplats(Comparison):
    """Measure frames of splats, and their gradients, against Mitsuba's integrator.

    Splats of degree 3 lie on the surfaces of the bundled intersection. Mitsuba's
    `volprim_rf_basic` traces rays through them, and lays them over each other in the
    order in which a ray enters them. Gradients are by opacities and harmonics. Both
    sides run in turns; medians of processor time count. Takes about 2 minutes.
    """

    sizes: tuple[str, ...] = ("200x66", "366x188")
    """Widths and heights of the camera's image, pixels."""
    splats: Count = 330_000
    """Number of splats."""

    def run(self) -> Result:
        """Measure, print and write."""
        read_sizes(self.sizes)
        return compare("splats", self, measure, lines=lines)


def measure(options: BenchSplats, folder: Path, show: Progress) -> dict[str, Any]:
    """Measure everything, and return the document, but for its stamp."""
    count = 1_000 if options.quick else options.splats
    path = folder / "street.ply"
    write_street(path, count)
    document: dict[str, Any] = {"sizes": {}, "splats": count}
    for text, size in zip(options.sizes, read_sizes(options.sizes), strict=True):
        sides = {name: _side(name, path, size) for name in SIDES}
        turns: dict[str, list[float]] = {}
        for turn in range(WARM_UP + options.repeats):
            show(f"splats {text}", turn, WARM_UP + options.repeats, "")
            for name, tasks in sides.items():
                for task, work in tasks.items():
                    turns.setdefault(f"{name}_{task}", []).append(timed(work))
        row = {k: statistics.median(v[WARM_UP:]) for k, v in turns.items()}
        for task in ("frame", "gradient"):
            peer = row[f"volprim_rf_basic_{task}"]
            row[f"{task}_ratio"] = peer / row[f"ours_{task}"]
        document["sizes"][text] = row
    return document


def _side(
    name: str, path: Path, size: tuple[int, int]
) -> dict[str, Callable[[], None]]:
    """Return what renders a frame, and what differentiates it."""
    file = {"filename": str(path)}
    if name == "ours":
        splats = {"type": "splat_background", **file}
        shown = {"a": {"type": "field_integrator", "composite": "depth", "s": splats}}
    else:
        traced = {"type": name, "max_depth": 4096}
        shown = {"a": traced, "s": {"type": "ellipsoids", **file}}
    film = {"type": "hdrfilm", "rfilter": {"type": "box"}}
    film |= dict(zip(("width", "height"), size, strict=True))
    view = mi.ScalarTransform4f().look_at(EYE, AHEAD, (0, 0, 1))
    camera = {"type": "perspective", "fov": 70, "to_world": view, "near_clip": 1e-3}
    scene = mi.load_dict({"type": "scene", **shown, "camera": camera | {"film": film}})
    params = mi.traverse(scene)
    keys = [key for key, _ in params if key.endswith(SIDES[name])]

    def frame() -> None:
        dr.eval(mi.render(scene, spp=1))

    def gradient() -> None:
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, spp=1), axis=None))
        dr.eval([dr.grad(params[key]) for key in keys])
        for key in keys:
            dr.disable_grad(params[key])

    return {"frame": frame, "gradient": gradient}


def write_street(path: Path, count: int) -> None:
    """Write splats on the surfaces of the bundled intersection, as a PLY file."""
    from scipy.spatial import KDTree
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    places, normals, colours = _on_surfaces(rng, count)
    spacing = KDTree(places).query(places, 4)[0][:, 1:].mean(1)
    flat = np.clip(0.8 * spacing, 0.004, 0.8)[:, None] * [1, 1, 0.1]
    scales = flat * np.exp(rng.normal(0, 0.4, flat.shape) * [1, 1, 0])
    side = np.cross(normals, rng.normal(size=normals.shape))
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    axes = np.stack([side, np.cross(normals, side), normals], 2)
    opacity = np.clip(rng.beta(2, 1, len(places)), 0.02, 0.99)
    display = np.array(dr.linear_to_srgb(mi.Color3f(colours.T))).T
    columns = {
        "x y z": places,
        "nx ny nz": normals,
        "f_dc_0 f_dc_1 f_dc_2": (display - 0.5) * 2 * np.sqrt(np.pi),
        " ".join(f"f_rest_{k}" for k in range(45)): rng.normal(
            0, 0.04, (len(places), 45)
        ),
        "opacity": np.log(opacity / (1 - opacity))[:, None],
        "scale_0 scale_1 scale_2": np.log(scales),
        "rot_0 rot_1 rot_2 rot_3": Rotation.from_matrix(axes).as_quat()[
            :, [3, 0, 1, 2]
        ],
    }
    names = " ".join(columns).split()
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(places)}"]
    head += [f"property float {name}" for name in names] + ["end_header\n"]
    rows = np.concatenate(list(columns.values()), 1).astype("<f4")
    path.write_bytes("\n".join(head).encode() + rows.tobytes())


def _on_surfaces(
    rng: np.random.Generator, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw places, normals and linear colours, (count, 3) each.

    As many on the ground that goes to the horizon as on all other shapes.
    """
    scene = mi.load_file(str(bundled("intersection/scene.xml")))
    areas = np.array([float(np.ravel(s.surface_area())[0]) for s in scene.shapes()])
    wide = areas > FLAT  # of which little is near
    share = np.where(wide, 40, 2 * areas / areas[~wide].sum())
    surfels = []
    for shape, drawn in zip(scene.shapes(), share * count / 2, strict=True):
        sample = mi.Point2f(rng.random((2, int(drawn) + 1)))
        at = shape.sample_position(mi.Float(0), sample)
        ray = mi.Ray3f(at.p + 0.01 * at.n, -at.n)
        si = scene.ray_intersect(ray)
        colour = si.bsdf().eval_diffuse_reflectance(si)
        part = np.concatenate([np.array(x) for x in (at.p, at.n, colour)]).T
        near = np.abs(part[:, :2]).max(1) < FAR_M
        surfels.append(part[np.array(si.is_valid()) & near])
    rows = rng.permutation(np.concatenate(surfels))[:count].astype(np.float64)
    return rows[:, :3], rows[:, 3:6], rows[:, 6:]


def lines(document: dict[str, Any]) -> list[str]:
    """Return the table."""
    rows = [
        (size, task, *(f"{row[f'{side}_{task}']:.3f}" for side in SIDES))
        + (f"{row[f'{task}_ratio']:.1f}",)
        for size, row in document["sizes"].items()
        for task in ("frame", "gradient")
    ]
    header = ("pixels", "CPU s of", *SIDES, "ratio")
    return [markdown(header, rows), f"{document['splats']} splats"]
