"""The report of a bake: how its pictures differ from those of the field."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.fit.bake.scores import BakedView
from mi_nerfattack.io import files
from mi_nerfattack.report.pages.elements import render
from mi_nerfattack.report.pages.fit import finite
from mi_nerfattack.report.plots.views import ViewPair, write_colours, write_depths

_SCORES = ("psnr_db", "ssim", "depth_m")


def write_bake_report(
    folder: Path,
    views: Sequence[BakedView],
    facts: dict[str, Any],
    title: str,
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
    kept = [view for view in views if view.pictures is not None]
    worst = [_pair(view) for view in sorted(kept, key=lambda view: view.psnr_db)]
    write_colours(root / "worst.png", worst, "field", "bricks")
    write_depths(root / "depth.png", worst, titles=("bricks", "field"))
    entries = [
        {
            name: getattr(view, name)
            for name in ("route", "arc_m", "lateral_m", *_SCORES)
        }
        for view in views
    ]
    document = {**facts, **bake_summary(views), "per_view": entries}
    files.write_json(root / "metrics.json", finite(document))
    text = render(
        "bake.html.j2",
        title=title,
        verdict=bake_verdict(views),
        facts=facts,
        views=sorted(views, key=lambda view: view.psnr_db),
        root=root,
    )
    files.write_text(root / "report.html", text)
    return root / "report.html"


def bake_summary(views: Sequence[BakedView]) -> dict[str, Any]:
    """Return the means over views, None where nothing is known, and the least PSNR."""
    means = {}
    for name in _SCORES:
        values = np.array([getattr(view, name) for view in views])
        known = values[~np.isnan(values)]
        means[name] = float(known.mean()) if known.size else None
    return {**means, "psnr_least_db": min(view.psnr_db for view in views)}


def bake_verdict(views: Sequence[BakedView]) -> str:
    """Sum up in words how far bricks and field agree."""
    found = bake_summary(views)
    depth = found["depth_m"]
    far = "" if depth is None else f"; depths differ by {100 * depth:.1f} cm"
    return (
        f"On {len(views)} views along the routes and beside, the bricks are "
        f"{found['psnr_db']:.1f} dB from the field on average and "
        f"{found['psnr_least_db']:.1f} dB at worst (SSIM {found['ssim']:.3f}){far}."
    )


def _pair(view: BakedView) -> ViewPair:
    assert view.pictures is not None
    wanted, shown = view.pictures
    title = f"{view.route}, {view.arc_m:.1f} m, {view.lateral_m:+.2g} m beside"
    title = f"{title}: {view.psnr_db:.2f} dB, SSIM {view.ssim:.3f}"
    known = np.where(wanted.opacity > 0.5, wanted.depth, np.inf)
    return ViewPair(title, wanted.image, shown.image, shown.opacity, shown.depth, known)
