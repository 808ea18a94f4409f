"""How far the `depth` composite is from the exact one, by where an object stands."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from mi_nerfattack.backend.colour import linear_to_srgb_numpy
from mi_nerfattack.fields import load_field
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.intrinsics import (
    from_fov,
    generate_rays,
    look_at,
    pose_arrays,
)
from mi_nerfattack.render.camera.pose import Pose
from mi_nerfattack.render.composite import AbstractComposite, DepthComposite
from mi_nerfattack.render.interleaved import InterleavedComposite
from mi_nerfattack.render.posed import PosedField
from mi_nerfattack.render.rays import Rays
from mi_nerfattack.report.plots.charts import BLUE, ORANGE
from mi_nerfattack.scenes import bundled

PLACE = (2.0, -1.75)  # in the lane; the road is at z = 0
EYE, FOV_DEG = (-3.5, -1.75, 1.4), 45.0
SCALE = 2.0  # of a hydrant 0.75 m tall
HEIGHTS = (1.2, 0.8, 0.4, 0.2, 0.1, 0.0, -0.1, -0.2, -0.4, -0.75, -1.2)
SHOWN = {"far from the road": 0.8, "touching it": 0.0, "half inside it": -0.75}
_PRESENT = 0.01  # opacity from which a pixel counts as the object's


@dataclass(frozen=True)
class Difference:
    """Depth composite against interleaved one, in the object's pixels.

    Attributes:
        height_m: of the object's foot above the road.
        mean: absolute difference, sRGB in [0, 1], mean of pixels and channels.
        largest: absolute difference, sRGB.
        above_1_255: share of the pixels where a channel differs by more than 1/255.
        depth_mean_m: absolute difference of the expected depth, metres.
    """

    height_m: float
    mean: float
    largest: float
    above_1_255: float
    depth_mean_m: float


Pictures = dict[float, tuple[np.ndarray, np.ndarray]]


def run(
    size_px: tuple[int, int], show: Callable[[int, int], None]
) -> tuple[list[Difference], Pictures]:
    """Render the bundled intersection with the hydrant at several heights.

    Args:
        size_px: width and height.
        show: called with the number of heights done and of all.

    Returns:
        the differences, and by shown height the sRGB pictures of both composites.
    """
    scene = PosedField(load_field(bundled("intersection/field.safetensors")))
    item = load_field(bundled("hydrant/field.safetensors"))
    rays = _rays(*size_px)
    results, pictures = [], {}
    for done, height in enumerate(HEIGHTS):
        foot = -float(item.lower[2]) * SCALE
        pose = Pose.upright((*PLACE, foot + height), 0.0, SCALE)
        fields = [scene, PosedField(item, pose)]
        folded, folded_depth, mask = _render(DepthComposite(), fields, rays)
        exact, exact_depth, _ = _render(InterleavedComposite(), fields, rays)
        results.append(_compare(height, folded, exact, folded_depth, exact_depth, mask))
        if height in SHOWN.values():
            shape = (size_px[1], size_px[0], 3)
            pictures[height] = folded.reshape(shape), exact.reshape(shape)
        show(done + 1, len(HEIGHTS))
    return results, pictures


def to_document(results: list[Difference], size_px: tuple[int, int]) -> dict[str, Any]:
    """Return the differences as JSON."""
    rows = [asdict(result) for result in results]
    return {"size": f"{size_px[0]}x{size_px[1]}", "heights": rows}


def write_figure(
    path: str | Path, results: list[Difference], pictures: Pictures
) -> None:
    """Draw the pictures, their difference, and the differences by height as PNG."""
    figure = Figure(figsize=(10, 8), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(SHOWN) + 1, 3)
    for row, (name, height) in enumerate(SHOWN.items()):
        folded, exact = pictures[height]
        change = np.clip(8 * np.abs(folded - exact), 0, 1)
        titles = ("depth", "interleaved (exact)", "difference, 8 times")
        for column, image in enumerate((folded, exact, change)):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(image)
            axes.set(xticks=[], yticks=[])
            if row == 0:
                axes.set_title(titles[column])
            if column == 0:
                axes.set_ylabel(f"{name}\n({height:+.2f} m)")
    axes = figure.add_subplot(grid[len(SHOWN), :])
    heights = [result.height_m for result in results]
    for key, line, colour in (("mean", "o-", BLUE), ("largest", "s--", ORANGE)):
        values = [255 * getattr(result, key) for result in results]
        axes.plot(heights, values, line, color=colour, label=key)
    axes.set_yscale("symlog", linthresh=0.1)
    axes.axvline(0, color="#9a9a9a", lw=1)
    axes.set(
        xlabel="height of the object's foot above the road, metres",
        ylabel="difference, sRGB / 255",
    )
    axes.legend()
    axes.grid(alpha=0.3)
    stream = io.BytesIO()
    figure.savefig(stream, format="png")
    files.write_bytes(path, stream.getvalue())


def _rays(width: int, height: int) -> Rays:
    target = (*PLACE, 0.9)
    origin, rotation = pose_arrays(look_at(EYE, target))
    o, d = generate_rays(from_fov(width, height, FOV_DEG), origin, rotation, 1)
    rays = Rays(o, d, dr.opaque(mi.Float, dr.inf), dr.opaque(mi.Float, 0.5))
    dr.eval(rays)
    return rays


def _render(
    composite: AbstractComposite, fields: list[PosedField], rays: Rays
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return sRGB (n, 3), depth (n,), and where the object is (n,)."""
    seen = composite.render(fields, rays, 1e-4)
    total = seen.total
    behind = fields[0].background(rays.direction)
    linear = total.radiance + (1 - total.opacity) * behind
    dr.eval(linear, total, seen.layers[1].opacity)
    present = seen.layers[1].opacity.numpy() > _PRESENT
    depth = total.depth.numpy().copy()
    return linear_to_srgb_numpy(linear.numpy().T), depth, present


def _compare(
    height: float,
    folded: np.ndarray,
    exact: np.ndarray,
    folded_depth: np.ndarray,
    exact_depth: np.ndarray,
    mask: np.ndarray,
) -> Difference:
    if not mask.any():
        return Difference(height, 0.0, 0.0, 0.0, 0.0)
    error = np.abs(folded - exact)[mask]
    depth_error = np.abs(folded_depth[mask] - exact_depth[mask])
    return Difference(
        height,
        float(error.mean()),
        float(error.max()),
        float((error.max(axis=1) > 1 / 255).mean()),
        float(depth_error.mean()),
    )
