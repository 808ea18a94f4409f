"""What the marching step and the end of rays cost, and leave wrong."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.fields import AbstractField, load_field
from mi_nerfattack.render.camera.intrinsics import (
    from_fov,
    generate_rays,
    look_at,
    pose_arrays,
)
from mi_nerfattack.render.march import STOP, march, march_derivative
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import March, Rays
from mi_nerfattack.scenes import bundled

#: Fields, eyes and targets, metres, and horizontal angle of view, degrees.
VIEWS = {
    "hydrant from 1.5 m": ("hydrant", (-1.5, 0.2, 0.5), (0.0, 0.0, 0.38), 45.0),
    "hydrant from 8 m": ("hydrant", (-8.0, 0.5, 1.2), (0.0, 0.0, 0.38), 9.0),
    "street": ("intersection", (-22.0, -1.75, 1.4), (0.0, -1.75, 1.0), 90.0),
    "street from 12 m above": ("intersection", (-15.0, -10.0, 12.0), (5, 0, 0), 90.0),
}
FACTORS = (1.0, 0.5, 0.25, 0.125)
STOPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
_REFERENCE = {"hydrant": 1 / 32, "intersection": 1 / 16}
_SOLID = 0.5  # opacity from which a pixel has a depth


@dataclass(frozen=True)
class Row:
    """One way to march one view.

    Attributes:
        view: of `VIEWS`.
        factor: of the field's own step, which grows with distance in proportion.
        stop: transmittance at which a ray ends.
        psnr_db: sRGB, against the finest step and no end of rays.
        largest: absolute difference, sRGB in [0, 1].
        depth_m: absolute difference of the expected depth, mean of what is solid.
        forward_s: of a march, median.
        derivative_s: of its derivative by the rays, median.
    """

    view: str
    factor: float
    stop: float
    psnr_db: float
    largest: float
    depth_m: float
    forward_s: float
    derivative_s: float


def run(
    size_px: tuple[int, int], repeats: int, show: Callable[[int, int], None]
) -> list[Row]:
    """March bundled fields with several steps and ends of rays.

    Args:
        size_px: width and height.
        repeats: of each time.
        show: called with the number of rows done and of all.
    """
    cases = [(factor, STOP) for factor in FACTORS] + [(1.0, stop) for stop in STOPS]
    rows: list[Row] = []
    for view, (name, eye, target, angle) in VIEWS.items():
        field = load_field(bundled(f"{name}/field.safetensors"))
        own = field.step_m
        pose = look_at(np.array(eye, float), np.array(target, float))
        rays = Rays(*generate_rays(from_fov(*size_px, angle), *pose_arrays(pose), 1))
        dr.make_opaque(rays)
        field.refine(own * _REFERENCE[name])
        expected = _image(field, march(PosedField(field), rays, 0.0), rays)
        for factor, stop in cases:
            field.refine(own * factor)
            rows.append(_row((view, factor, stop), field, rays, expected, repeats))
            show(len(rows), len(VIEWS) * len(cases))
    return rows


def _row(
    case: tuple[str, float, float],
    field: AbstractField,
    rays: Rays,
    expected: tuple[np.ndarray, np.ndarray],
    repeats: int,
) -> Row:
    posed, stop = PosedField(field), case[2]
    forward, seen = _time(lambda: march(posed, rays, stop), repeats)
    ones = March(mi.Color3f(1), mi.Float(1), mi.Float(0))
    fixed = dr.ADMode.Backward, posed, rays, seen, ones, stop
    derivative, _ = _time(lambda: march_derivative(*fixed, with_rays=True), repeats)
    image, depth = _image(field, seen, rays)
    error = np.abs(image - expected[0])
    both = np.isfinite(depth) & np.isfinite(expected[1])
    return Row(
        *case,
        -10 * float(np.log10(max(np.mean(error**2), 1e-12))),
        float(error.max()),
        float(np.abs(depth - expected[1])[both].mean()),
        forward,
        derivative,
    )


def _time(work: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    times: list[float] = []
    result: Any = None
    for _ in range(repeats + 1):  # the first compiles
        start = time.perf_counter()
        result = work()
        dr.eval(result)
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    return statistics.median(times[1:]), result


def _image(
    field: AbstractField, seen: March, rays: Rays
) -> tuple[np.ndarray, np.ndarray]:
    """Return sRGB (n, 3) over the background, and depth (n,), NaN where none is."""
    linear = seen.radiance + (1 - seen.opacity) * field.background(rays.direction)
    depth = dr.select(seen.opacity > _SOLID, seen.depth, dr.nan)
    return linear_to_srgb_numpy(linear.numpy().T), depth.numpy()


def to_document(rows: Sequence[Row], size_px: tuple[int, int]) -> dict[str, Any]:
    """Return the rows as JSON."""
    return {"size": f"{size_px[0]}x{size_px[1]}", "rows": [asdict(row) for row in rows]}
