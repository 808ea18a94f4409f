"""The report of a fit: a folder with a page, its pictures, and its numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from mi_nerfattack.capture.posed_images import PosedImages, held_out
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fit.options import FitProgress, FitResult
from mi_nerfattack.fit.scores import SOLID, ViewScore, reference, worst_views
from mi_nerfattack.io import files
from mi_nerfattack.render.camera.conventions import opencv_to_opengl
from mi_nerfattack.report.pages.elements import render
from mi_nerfattack.report.pages.verdict import (
    OBJECT,
    SCENE,
    Criterion,
    judge,
    pooled_db,
    verdict,
)
from mi_nerfattack.report.plots.fit import write_curve, write_histogram
from mi_nerfattack.report.plots.views import (
    ViewPair,
    abs_difference,
    write_colours,
    write_depths,
)

_SHOWN_VIEWS = 4


def write_fit_report(
    folder: Path,
    result: FitResult,
    images: PosedImages,
    depth: np.ndarray | None,
    title: str,
) -> Path:
    """Write `report.html`, `metrics.json`, `worst.png`, `depth.png`, ... of a fit.

    The page holds its pictures, and needs no network. No view is rendered again.

    Args:
        folder: made if needed; files of these names are replaced.
        result: of the fit.
        images: that were fitted to.
        depth: (n, height, width), metres along the ray, infinite where nothing is
            known; None if there is none.
        title: of the page.

    Returns:
        Path of the page, which is written last.
    """
    root = files.make_folder(folder)
    fitted_db = _fitted_db(result.history)
    criteria = judge_fit(result)
    worst = worst_views(result.per_view, _SHOWN_VIEWS)
    shown = [_pair(score, images, depth) for score in worst]
    depth_m = _depth_error(shown)
    write_colours(root / "worst.png", shown, "image")
    write_depths(root / "depth.png", shown, _unit(result))
    write_curve(root / "curve.png", result.history, result.psnr_heldout_db)
    write_histogram(root / "views.png", result.per_view)
    document = summary(result) | {
        "psnr_fitted_db": fitted_db,
        "depth_error_median_m": depth_m,
        "criteria": [_entry(item) for item in criteria],
        "good_enough": all(item.met for item in criteria),
        "settings": result.field.metadata(),
    }
    files.write_json(root / "metrics.json", finite(document))
    text = render(
        "fit.html.j2",
        title=title,
        root=root,
        verdict=verdict(criteria),
        criteria=criteria,
        facts=_facts(result, fitted_db, depth_m),
        has_depth=depth is not None,
        scores=sorted(result.per_view, key=lambda score: score.psnr_db),
        settings=result.field.metadata(),
    )
    write_cameras(root / "cameras.json", result, images)
    files.write_text(root / "report.html", text)
    return root / "report.html"


def write_cameras(path: Path, result: FitResult, images: PosedImages) -> None:
    """Write what the fit learned of the cameras, image by image; nothing if nothing.

    Args:
        path: JSON file: for each fitted image its ``file_path`` and, where learned,
            ``exposure`` (factors of linear radiance) and ``transform_matrix`` (OpenGL).
        result: of the fit.
        images: that were fitted to.
    """
    if result.exposure is None and result.poses is None:
        path.unlink(missing_ok=True)  # of an earlier fit
        return
    skipped = set(held_out(len(images)).tolist())
    names = [name for i, name in enumerate(images.names) if i not in skipped]
    frames: list[dict[str, object]] = [{"file_path": name} for name in names]
    for i, frame in enumerate(frames):
        if result.exposure is not None:
            frame["exposure"] = result.exposure[i].tolist()
        if result.poses is not None:
            frame["transform_matrix"] = opencv_to_opengl(result.poses[i]).tolist()
    files.write_json(path, {"frames": frames})


def scores_table(result: FitResult) -> Table:
    """Return the scores of the held-out views as a table for a terminal."""
    table = Table("held-out view", "PSNR dB", "SSIM")
    for score in sorted(result.per_view, key=lambda score: score.psnr_db):
        table.add_row(score.name, f"{score.psnr_db:.2f}", f"{score.ssim:.4f}")
    mean = f"{result.psnr_heldout_db:.2f}", f"{result.ssim_heldout:.4f}"
    table.add_row("mean", *mean, style="bold")
    return table


def summary(result: FitResult) -> dict[str, Any]:
    """Return the scores of a fit as JSON has them; infinite PSNR becomes null."""
    document = {
        "psnr_heldout_db": result.psnr_heldout_db,
        "ssim_heldout": result.ssim_heldout,
        "wall_s": result.wall_s,
        "steps": result.steps,
        "per_view": [view_entry(score) for score in result.per_view],
    }
    return finite(document)


def view_entry(score: ViewScore) -> dict[str, Any]:
    """Return the score of one view without its pictures."""
    names = ("index", "name", "psnr_db", "ssim", "hazy", "holes")
    return {name: getattr(score, name) for name in names}


def judge_fit(result: FitResult) -> list[Criterion]:
    """Judge a fit by its held-out views and the rays it was fitted to.

    A grid holds an object, any other field a scene.
    """
    subject = OBJECT if isinstance(result.field, GridField) else SCENE
    return judge(result.per_view, _fitted_db(result.history), subject)


def _fitted_db(history: Sequence[FitProgress]) -> float | None:
    """Return the PSNR of the rays fitted to in the last tenth of a fit."""
    if not history:
        return None
    late = [at.psnr_db for at in history if at.step >= 0.9 * history[-1].step]
    return pooled_db(late)


def _pair(score: ViewScore, images: PosedImages, depth: np.ndarray | None) -> ViewPair:
    rendering = score.rendering
    assert rendering is not None
    title = f"{score.name}: {score.psnr_db:.2f} dB, SSIM {score.ssim:.3f}"
    known = None if depth is None else depth[score.index]
    return ViewPair(
        title,
        reference(images, score.index),
        rendering.image,
        rendering.opacity,
        rendering.depth,
        known,
    )


def _depth_error(views: Sequence[ViewPair]) -> float | None:
    """Return the median error over rays that both stop; None if there are none."""
    errors = []
    for view in views:
        if view.known_depth is not None:
            solid = np.where(view.opacity >= SOLID, view.depth, np.inf)
            error = abs_difference(solid, view.known_depth)
            errors.append(error[np.isfinite(error)])
    if not any(error.size for error in errors):
        return None
    return float(np.median(np.concatenate(errors)))


def _facts(
    result: FitResult, fitted_db: float | None, depth_m: float | None
) -> dict[str, Any]:
    field = result.field
    low, high = (
        ", ".join(f"{v:.2f}" for v in corner) for corner in (field.lower, field.upper)
    )
    facts = {
        "mean PSNR, held-out views": f"{result.psnr_heldout_db:.2f} dB",
        "mean SSIM, held-out views": f"{result.ssim_heldout:.4f}",
        "held-out views": str(len(result.per_view)),
        "steps": f"{result.steps:,}",
        "wall time of fit and scores": _duration(result.wall_s),
        "box": f"({low}) to ({high})",
        "frame": "that of the poses",
        "unit": _unit(result),
        "source": field.info.get("fit.source", "unknown"),
    }
    if fitted_db is not None:
        facts["PSNR of the rays fitted to, at the end"] = f"{fitted_db:.2f} dB"
    if depth_m is not None:
        facts["median depth error, worst views"] = f"{depth_m:.3f} {_unit(result)}"
    return facts


def _unit(result: FitResult) -> str:
    unit = result.field.info.get("fit.source_unit", "metre")
    return "m" if unit == "metre" else f"of {unit} length"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{seconds:.1f} s"


def _entry(item: Criterion) -> dict[str, Any]:
    names = ("name", "value", "limit", "at_least", "met")
    return {name: getattr(item, name) for name in names}


def finite(value: Any) -> Any:
    """Replace infinite and undefined numbers, which JSON has not, by null."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
