"""``python -m bench accuracy``: what steps, composites and flat levels leave wrong."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from bench.results import Comparison, Progress, compare, timed
from bench.tables import markdown
from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.commands.shared.terminal import Result
from mi_nerfattack.fields import load_field, load_grid
from mi_nerfattack.render.camera.intrinsics import from_fov, look_at
from mi_nerfattack.render.camera.lens import generate_rays, pose_arrays
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import AbstractComposite, DepthComposite, Marches
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.march import march
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.scenes import bundled

#: Fields, eyes and targets, metres, and horizontal angles of view, degrees.
VIEWS = {
    "hydrant from 1.5 m": ("hydrant", (-1.5, 0.2, 0.5), (0, 0, 0.38), 45),
    "hydrant from 8 m": ("hydrant", (-8, 0.5, 1.2), (0, 0, 0.38), 9),
    "street": ("intersection", (-22, -1.75, 1.4), (0, -1.75, 1), 90),
    "street from 12 m above": ("intersection", (-15, -10, 12), (5, 0, 0), 90),
}
FACTORS = (1, 2, 4, 8)  # by which the step of the file is divided
FINEST = {"hydrant": 32, "intersection": 16}
STOP = 1e-4  # transmittance at which a ray ends
#: Where the hydrant of 1.5 m stands; heights of its foot above the road, metres.
PLACE, EYE, SCALE = (2.0, -1.75), (-3.5, -1.75, 1.4), 2.0
HEIGHTS = (0.8, 0.1, 0.0, -0.1, -0.75, -1.2)
OBJECTS = ("hydrant", "cube", "car")
TURNS = 6  # views around each
PRESENT = 0.01  # opacity from which a pixel counts as the object's


@dataclass(frozen=True)
class BenchAccuracy(Comparison):
    """Measure what the marching step, the composite and one level leave wrong.

    The bundled fields are marched in steps that are 2, 4 and 8 times as fine as those
    of the file. A hydrant stands in the road, composited by depth and exactly. Each
    bundled object is shown as one level and with all levels. The medians of the times
    count. Takes about a minute.
    """

    def run(self) -> Result:
        """Measure, print and write."""
        return compare("accuracy", self, measure, lines=lines)


def measure(options: BenchAccuracy, folder: Path, show: Progress) -> dict[str, Any]:
    """Measure everything, and return the document, but for its stamp."""
    del folder
    scale = 5 if options.quick else 1  # of the pixels
    stages = {
        "steps": (VIEWS, _steps(200 // scale, 66 // scale, options.repeats)),
        "composite": (HEIGHTS, _composites(366 // scale, 188 // scale)),
        "one_level": (OBJECTS, _levels(96 // scale, 72 // scale)),
    }
    document: dict[str, Any] = {name: {} for name in stages}
    for name, (all_rows, rows) in stages.items():
        for key, row in rows:
            document[name][key] = row
            show(name, len(document[name]), len(all_rows), key)
    return document


def _steps(
    width: int, height: int, repeats: int
) -> Iterator[tuple[str, dict[str, float]]]:
    """Compare the steps of a march with the finest one."""
    for view, (name, eye, target, angle) in VIEWS.items():
        field = load_field(bundled(f"{name}/field.safetensors"))
        own, composite = field.step_m, DepthComposite()
        rays = _rays(width, height, angle, pose=look_at(eye, target))
        field.refine(own / FINEST[name])
        posed = PosedField(field)  # reads the step
        exact = _picture(composite.render([posed], rays, 0.0), [posed], rays)
        row = {}
        for factor in FACTORS:
            field.refine(own / factor)
            posed = PosedField(field)
            marches = composite.render([posed], rays, STOP)
            row[f"psnr_db_{factor}"] = _psnr(_picture(marches, [posed], rays) - exact)
            row[f"cpu_seconds_{factor}"] = _seconds(
                lambda p=posed, r=rays: march(p, r, STOP), repeats
            )
        yield view, row


def _composites(width: int, height: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Compare composites in the pixels of an object that stands in the road."""
    scene = PosedField(load_field(bundled("intersection/field.safetensors")))
    item = load_field(bundled("hydrant/field.safetensors"))
    rays = _rays(width, height, angle=45, pose=look_at(EYE, (*PLACE, 0.9)))
    ways: tuple[AbstractComposite, ...] = (DepthComposite(), InterleavedComposite())
    for foot in HEIGHTS:
        z = foot - SCALE * float(item.lower[2])
        fields = [scene, PosedField(item, Pose.upright((*PLACE, z), 0.0, SCALE))]
        marches = [way.render(fields, rays, STOP) for way in ways]
        folded, exact = (_picture(some, fields, rays) for some in marches)
        error = 255 * np.abs(folded - exact)
        error = error[marches[0].layers[1].opacity.numpy() > PRESENT]
        yield (
            f"{foot:g}",
            {
                "mean_255": float(error.mean()),
                "largest_255": float(error.max()),
                "pixels_above_1": float((error.max(1) > 1).mean()),
            },
        )


def _levels(width: int, height: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Compare objects as one level with all their levels, from around them."""
    for name in OBJECTS:
        field = load_grid(bundled(f"{name}/field.safetensors"))
        finest, posed = field.levels()[-1], PosedField(field)
        size = float((field.upper - field.lower).max())
        ways: tuple[Callable[[], AbstractContextManager[None]], ...] = (
            nullcontext,
            lambda f=field, level=finest: f.one_level(level),
        )
        errors, own = [], []
        for turn in np.arange(TURNS) * 2 * np.pi / TURNS:
            eye = 2 * size * np.cos(turn), 2 * size * np.sin(turn), 0.5 * size
            rays = _rays(width, height, angle=40, pose=look_at(eye, (0, 0, 0.5 * size)))
            pictures, opacities = [], []
            for way in ways:
                with way():
                    marches = DepthComposite().render([posed], rays, STOP)
                    pictures.append(_picture(marches, [posed], rays))
                    opacities.append(marches.total.opacity.numpy())
            errors.append(pictures[1] - pictures[0])
            own.append(opacities[0] > PRESENT)
        error, present = np.concatenate(errors), np.concatenate(own)
        yield (
            name,
            {
                "psnr_db": _psnr(error[present]),
                "psnr_db_of_views": _psnr(error),
            },
        )


def _rays(width: int, height: int, angle: float, pose: np.ndarray) -> Rays:
    """Return a ray through the centre of each pixel, evaluated."""
    camera = from_fov(width, height, angle)
    rays = Rays(*generate_rays(camera, *pose_arrays(pose), 1))
    dr.make_opaque(rays)
    return rays


def _picture(marches: Marches, fields: list[PosedField], rays: Rays) -> np.ndarray:
    """Return sRGB (n, 3) over the background of the first field."""
    behind = fields[0].background(rays.direction)
    linear = marches.total.radiance + (1 - marches.total.opacity) * behind
    return linear_to_srgb_numpy(linear.numpy().T)


def _psnr(error: np.ndarray) -> float:
    return -10 * float(np.log10(max(np.square(error).mean(), 1e-12)))


def _seconds(work: Callable[[], Any], repeats: int) -> float:
    """Return the median of the processor times, after a first one that compiles."""
    times = [timed(lambda: dr.eval(work())) for _ in range(repeats + 1)]
    return statistics.median(times[1:])


def lines(document: dict[str, Any]) -> list[str]:
    """Return the tables."""
    steps = [
        (view, *(_step(row, factor) for factor in FACTORS))
        for view, row in document["steps"].items()
    ]
    composite = [
        (foot, f"{row['mean_255']:.2g}", f"{row['largest_255']:.1f}")
        + (f"{row['pixels_above_1']:.1%}",)
        for foot, row in document["composite"].items()
    ]
    levels = [
        (name, f"{row['psnr_db']:.1f}", f"{row['psnr_db_of_views']:.1f}")
        for name, row in document["one_level"].items()
    ]
    header = ("view", "the step of the file", *(f"1/{f}" for f in FACTORS[1:]))
    return [
        markdown(header, steps),
        "",
        markdown(("foot, m", "mean, of 255", "largest", "above 1"), composite),
        "",
        markdown(("object", "PSNR, dB", "of views, dB"), levels),
    ]


def _step(row: dict[str, float], factor: int) -> str:
    db, seconds = row[f"psnr_db_{factor}"], row[f"cpu_seconds_{factor}"]
    return f"{db:.1f} dB, {1e3 * seconds:.0f} ms"
