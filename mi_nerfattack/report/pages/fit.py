"""The report of a fit: a folder with a page, its pictures, and its numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.capture.posed_images import PosedImages, held_out
from mi_nerfattack.fields.grid import GridField
from mi_nerfattack.fit.options import FitProgress, FitResult
from mi_nerfattack.fit.scores import ViewScore, mean, worst_views
from mi_nerfattack.io import files
from mi_nerfattack.io.strict import finite
from mi_nerfattack.render.camera.conventions import opencv_to_opengl
from mi_nerfattack.report.columns import Column, Table
from mi_nerfattack.report.pages.sections import Picture, write_report
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
    abs_difference,
    write_colours,
    write_depths,
)

_CRITERIA = (
    Column("measured", "{name}"),
    Column("value", "{value:.4g}"),
    Column("limit", "at {side} {limit:g}"),
    Column("", "{met}"),
)
_VIEWS = (
    Column("held-out view", "{name}"),
    Column("PSNR (dB)", "{psnr_db:.2f}"),
    Column("SSIM", "{ssim:.4f}"),
    Column("hazy (%)", "{hazy:.1%}"),
    Column("holes (%)", "{holes:.1%}"),
)


def write_fit_report(
    folder: Path, result: FitResult, images: PosedImages, title: str
) -> Path:
    """Write `report.html`, `metrics.json`, `worst.png`, `depth.png`, ... of a fit.

    The page holds its pictures, and needs no network. No view is rendered again.

    Args:
        folder: made if needed; files of these names are replaced.
        result: of the fit.
        images: that were fitted to.
        title: of the page.

    Returns:
        Path of the page, which is written last.
    """
    root = files.make_folder(folder)
    criteria, worst = judge_fit(result), worst_views(result.per_view)
    fitted_db, depth_m = _fitted_db(result.history), _depth_error(worst)
    write_colours(root / "worst.png", worst, "image")
    write_depths(root / "depth.png", worst, _unit(result))
    write_curve(root / "curve.png", result.history, result.psnr_heldout_db)
    write_histogram(root / "views.png", result.per_view)
    write_cameras(root / "cameras.json", result, images)
    metrics = summary(result) | {
        "psnr_fitted_db": fitted_db,
        "depth_error_median_m": depth_m,
        "criteria": [
            {key: getattr(item, key) for key in ("name", "value", "limit", "at_least")}
            | {"met": item.met}
            for item in criteria
        ],
        "good_enough": all(item.met for item in criteria),
        "settings": result.field.metadata(),
    }
    caption, depth = "Of the worst views", "depth of the field"
    if any(view.pictures and view.pictures.depth is None for view in worst):
        caption += "; there is no depth to compare with"
    else:
        depth += ", depth that was given, and their difference"
    sections = {
        "Criteria": [_judged(criteria)],
        "Summary": [_facts(result, fitted_db, depth_m)],
        "Worst held-out views": [
            Picture("image, field, and their difference", root / "worst.png")
        ],
        "Depth": [
            f"{caption}. Grey: the field stops less than half of the light, or no "
            "depth is known.",
            Picture(depth, root / "depth.png"),
        ],
        "The fit": [Picture("loss and PSNR, single and averaged", root / "curve.png")],
        "All held-out views": [
            Picture("held-out views by PSNR", root / "views.png"),
            scores_table(result),
        ],
        "Settings": [result.field.metadata()],
    }
    return write_report(
        root, title, verdict(criteria), metrics=metrics, sections=sections
    )


def _judged(criteria: Sequence[Criterion]) -> Table:
    """Set what a fit reached beside what it should."""
    rows = [
        {
            **vars(item),
            "side": "least" if item.at_least else "most",
            "met": "met" if item.met else "not met",
            "bad": () if item.met else ("value",),
        }
        for item in criteria
    ]
    return Table.of(rows, _CRITERIA)


def scores_table(result: FitResult) -> Table:
    """Return the scores of the held-out views, worst first, and their means."""
    views = sorted(result.per_view, key=lambda score: score.psnr_db)
    means = {name: mean(views, name) for name in ("psnr_db", "ssim", "hazy", "holes")}
    return Table.of([*map(vars, views), {"name": "mean", **means}], _VIEWS)


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


def summary(result: FitResult) -> dict[str, Any]:
    """Return the scores of a fit as JSON has them; infinite PSNR becomes null."""
    document = {
        "psnr_heldout_db": result.psnr_heldout_db,
        "ssim_heldout": result.ssim_heldout,
        "wall_s": result.wall_s,
        "steps": result.steps,
        "per_view": [
            score.entry("index name psnr_db ssim hazy holes")
            for score in result.per_view
        ],
    }
    return finite(document)


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


def _depth_error(views: Sequence[ViewScore]) -> float | None:
    """Return the median error over rays that both stop; None if there are none."""
    errors = [
        abs_difference(view.pictures.shown.solid_depth, view.pictures.depth)
        for view in views
        if view.pictures is not None and view.pictures.depth is not None
    ]
    known = [error[np.isfinite(error)] for error in errors]
    if not any(error.size for error in known):
        return None
    return float(np.median(np.concatenate(known)))


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
    minutes, remainder = divmod(round(seconds), 60)
    return f"{minutes} min {remainder} s" if minutes else f"{seconds:.1f} s"
