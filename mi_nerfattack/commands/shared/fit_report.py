"""What the fitting commands show and write: progress, scores, the file, a report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from mi_nerfattack.commands.shared.progress import StageBars

if TYPE_CHECKING:
    import numpy as np

    from mi_nerfattack.capture.posed_images import PosedImages
    from mi_nerfattack.commands.shared.compare_report import CompareArguments
    from mi_nerfattack.fit.fit import FitProgress, FitResult


def show_fit(bars: StageBars, at: FitProgress) -> None:
    """Show the state of a fit."""
    state = f"step {at.step}  loss {at.loss:.4f}  PSNR {at.psnr_db:.2f} dB"
    bars.show("fitting", at.fraction, 1.0, state)


def check_output(path: Path) -> None:
    """Raise InputError if a field or policy could not be written to a path.

    Called before the work starts, so that a mistyped path costs no fit.
    """
    from mi_nerfattack.errors import InputError
    from mi_nerfattack.io import files

    if path.suffix != ".safetensors":
        raise InputError(f"{path}: this file must end in .safetensors")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: is not a folder; make it first")
    files.check_writable(path)


def report_folder(output: Path) -> Path:
    """Return the folder of the report that belongs to a field file."""
    return output.with_suffix(".report")


def finish(
    result: FitResult,
    images: PosedImages,
    output: Path,
    provenance: Mapping[str, str],
    as_json: bool,
    checkpoint: Path,
    depth: np.ndarray | None = None,
    against: CompareArguments | None = None,
) -> None:
    """Write the field and the report of its fit, compare it, and print the scores.

    Args:
        result: of the fit.
        images: that were fitted to.
        output: field file; the report lies beside it, see `report_folder`.
        provenance: source and settings, for the file's header.
        as_json: print one line of JSON in place of the table.
        checkpoint: of the fit; removed when all is written.
        depth: (n, height, width), metres along the ray, or None.
        against: the scene to compare with; None, or one without a scene, compares
            with nothing.
    """
    from mi_nerfattack.commands.shared.compare_report import print_comparison
    from mi_nerfattack.fields import save_field
    from mi_nerfattack.report.pages.compare import document
    from mi_nerfattack.report.pages.fit import judge_fit, summary, write_fit_report
    from mi_nerfattack.report.pages.verdict import verdict

    result.field.info.update(
        {f"fit.{key}": value for key, value in provenance.items()}
        | {
            "fit.steps": str(result.steps),
            "fit.held_out": "every 8th image, from the first",
            "fit.frame": "that of the poses, right-handed",
            "fit.psnr_heldout_db": f"{result.psnr_heldout_db:.3f}",
            "fit.ssim_heldout": f"{result.ssim_heldout:.4f}",
        }
    )
    save_field(output, result.field)
    title = f"Fit of {output.name}"
    page = write_fit_report(report_folder(output), result, images, depth, title)
    write_cameras(report_folder(output) / "cameras.json", result, images)
    comparison = None if against is None else against.run(result.field, output)
    checkpoint.unlink(missing_ok=True)  # before a closed pipe can end this
    if as_json:
        more = {} if comparison is None else {"compare": document(comparison)}
        print(json.dumps(summary(result) | more))
        return
    _print_scores(result)
    Console().print(
        f"{verdict(judge_fit(result))}\n"
        f"{result.steps} steps in {result.wall_s:.0f} s. Wrote {output} and {page}.",
        soft_wrap=True,
        highlight=False,
    )
    if comparison is not None:
        print_comparison(comparison, output)


def write_cameras(path: Path, result: FitResult, images: PosedImages) -> None:
    """Write what the fit learned of the cameras, image by image; nothing if nothing.

    Args:
        path: JSON file: for each fitted image its ``file_path`` and, where learned,
            ``exposure`` (factors of linear radiance) and ``transform_matrix`` (OpenGL).
        result: of the fit.
        images: that were fitted to.
    """
    from mi_nerfattack.capture.posed_images import held_out
    from mi_nerfattack.io import files
    from mi_nerfattack.render.camera.conventions import opencv_to_opengl

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


def _print_scores(result: FitResult) -> None:
    table = Table("held-out view", "PSNR dB", "SSIM")
    for score in sorted(result.per_view, key=lambda score: score.psnr_db):
        table.add_row(score.name, f"{score.psnr_db:.2f}", f"{score.ssim:.4f}")
    mean = f"{result.psnr_heldout_db:.2f}", f"{result.ssim_heldout:.4f}"
    table.add_row("mean", *mean, style="bold")
    Console().print(table)
