"""What the fitting commands show and write: progress, scores, pictures, the file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table

from mi_nerfattack.commands.bars import StageBars

if TYPE_CHECKING:
    from mi_nerfattack.capture.fit import FitProgress, FitResult
    from mi_nerfattack.capture.frames import PosedImages

_SHOWN_VIEWS = 4


def show_fit(bars: StageBars, at: FitProgress) -> None:
    """Show the state of a fit."""
    state = (
        f"step {at.step}  loss {at.loss:.4f}  PSNR {at.psnr_db:.2f} dB  "
        f"{at.remaining_s:.0f} s left"
    )
    bars.show("fitting", at.fraction, 1.0, state)


def show_views(bars: StageBars, done: int, total: int) -> None:
    """Show how many views are rendered."""
    bars.show("rendering views", done, total, f"{done}/{total}")


def check_output(path: Path) -> None:
    """Raise InputError if a field file could not be written to a path.

    Called before the work starts, so that a mistyped path costs no fit.
    """
    from mi_nerfattack.errors import InputError

    if path.suffix != ".safetensors":
        raise InputError(f"{path}: field files end in .safetensors")
    if not path.parent.is_dir():
        raise InputError(f"{path.parent}: is not a folder; make it first")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give a file")


def finish(
    result: FitResult,
    images: PosedImages,
    output: Path,
    provenance: Mapping[str, str],
    as_json: bool,
) -> None:
    """Write the field and the picture of its worst views, and print the scores.

    Args:
        result: of the fit.
        images: that were fitted to.
        output: field file; the picture has its name and the suffix .png.
        provenance: source and settings, for the file's header.
        as_json: print one line of JSON in place of the table.
    """
    from mi_nerfattack import files
    from mi_nerfattack.capture.evaluation import comparison
    from mi_nerfattack.fields import save_field

    result.field.info.update(
        {f"fit.{key}": value for key, value in provenance.items()}
        | {
            "fit.steps": str(result.steps),
            "fit.psnr_heldout_db": f"{result.psnr_heldout_db:.3f}",
            "fit.ssim_heldout": f"{result.ssim_heldout:.4f}",
        }
    )
    save_field(output, result.field)
    picture = output.with_suffix(".png")
    worst = comparison(result.field, images, result.per_view, _SHOWN_VIEWS)
    files.write_image(picture, worst)
    if as_json:
        print(json.dumps(summary(result)))
        return
    table = Table("held-out view", "PSNR dB", "SSIM")
    for score in sorted(result.per_view, key=lambda score: score.psnr_db):
        table.add_row(score.name, f"{score.psnr_db:.2f}", f"{score.ssim:.4f}")
    mean = f"{result.psnr_heldout_db:.2f}", f"{result.ssim_heldout:.4f}"
    table.add_row("mean", *mean, style="bold")
    console = Console()
    console.print(table)
    console.print(
        f"{result.steps} steps in {result.wall_s:.0f} s. Wrote {output} and {picture} "
        "(worst views: image, field, four times the difference).",
        soft_wrap=True,
        highlight=False,
    )


def summary(result: FitResult) -> dict[str, object]:
    """Return the scores as they are printed with --json."""
    return {
        "psnr_heldout_db": result.psnr_heldout_db,
        "ssim_heldout": result.ssim_heldout,
        "wall_s": result.wall_s,
        "steps": result.steps,
        "per_view": [asdict(score) for score in result.per_view],
    }
