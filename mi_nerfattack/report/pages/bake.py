"""The report of a bake: how its pictures differ from those of the field."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.fit.scores import ViewScore, least, mean, worst_views
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import finite
from mi_nerfattack.report.columns import Column, Table
from mi_nerfattack.report.pages.sections import Picture, write_report
from mi_nerfattack.report.plots.views import write_colours, write_depths

_VIEWS = (
    Column("route", "{route}"),
    Column("m along", "{arc_m:.1f}"),
    Column("m beside", "{lateral_m:+.2g}"),
    Column("PSNR dB", "{psnr_db:.2f}"),
    Column("SSIM", "{ssim:.4f}"),
    Column("depth, cm", "{depth_median_m:.1%}"),
)


def write_bake_report(
    folder: Path, views: Sequence[ViewScore], facts: Mapping[str, Any], title: str
) -> Path:
    """Write `report.html`, `metrics.json`, `worst.png` and `depth.png`.

    Args:
        folder: made if needed; files of these names are replaced.
        views: from `fit.bake.scores.score_bake`.
        facts: numbers of the bake by name.
        title: of the page.

    Returns:
        Path of the page, which is written last.
    """
    root = files.make_folder(folder)
    colours, depths = root / "worst.png", root / "depth.png"
    write_colours(colours, worst_views(views), "field", shown="bricks")
    write_depths(depths, worst_views(views), titles=("bricks", "field"))
    entries = [
        view.entry("route arc_m lateral_m psnr_db ssim")
        | {"depth_m": view.depth_median_m}
        for view in views
    ]
    ranked = sorted(views, key=lambda view: view.psnr_db)
    sections = {
        "Worst views": [
            Picture("field, bricks, and their difference", colours),
            Picture("depth of the bricks, of the field, and their difference", depths),
        ],
        "All views": [Table.of(map(vars, ranked), _VIEWS)],
        "The bake": [{name: str(value) for name, value in facts.items()}],
    }
    metrics = {**facts, **bake_summary(views), "per_view": entries}
    return write_report(
        root, title, bake_verdict(views), metrics=metrics, sections=sections
    )


def bake_summary(views: Sequence[ViewScore]) -> dict[str, Any]:
    """Return the means over views, None where nothing is known, and the least PSNR."""
    return finite(
        {
            "psnr_db": mean(views, "psnr_db"),
            "ssim": mean(views, "ssim"),
            "depth_m": mean(views, "depth_median_m"),
            "psnr_least_db": least(views, "psnr_db"),
        }
    )


def bake_verdict(views: Sequence[ViewScore]) -> str:
    """Sum up in words how far bricks and field agree."""
    depth = 100 * mean(views, "depth_median_m")
    far = "" if math.isnan(depth) else f"; depths differ by {depth:.1f} cm"
    psnr, ssim = mean(views, "psnr_db"), mean(views, "ssim")
    worst = least(views, "psnr_db")
    return (
        f"On {len(views)} views along the routes and beside, the bricks are {psnr:.1f} "
        f"dB from the field on average and {worst:.1f} dB at worst (SSIM {ssim:.3f})"
        f"{far}."
    )
