"""What the fitting commands show and write: progress, scores, the file, a report."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from mi_nerfattack.commands.shared.progress import StageBars
from mi_nerfattack.commands.shared.terminal import Result, console

if TYPE_CHECKING:
    from mi_nerfattack.capture.posed_images import PosedImages
    from mi_nerfattack.fit.options import FitProgress, FitResult


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


@contextmanager
def begun_fit(output: Path) -> Iterator[Path]:
    """Check that a fit may begin, and keep other processes out until it ends.

    It claims the folder of its report.

    Args:
        output: field file.

    Returns:
        the path of its checkpoint.
    """
    from mi_nerfattack.io import locks

    check_output(output)
    with locks.claimed(report_folder(output)):
        checkpoint = output.with_suffix(".checkpoint.safetensors")
        yield checkpoint


def report_folder(output: Path) -> Path:
    """Return the folder of the report that belongs to a field file."""
    return output.with_suffix(".report")


def finish(
    result: FitResult,
    images: PosedImages,
    output: Path,
    provenance: Mapping[str, str],
    checkpoint: Path,
) -> Result:
    """Write the field and the report of its fit, and return the scores.

    Args:
        result: of the fit.
        images: that were fitted to.
        output: field file; the report is written next to it, see `report_folder`.
        provenance: source and settings, for the file's header.
        checkpoint: of the fit; removed when all is written.
    """
    from mi_nerfattack.report.pages.fit import (
        judge_fit,
        scores_table,
        summary,
        write_fit_report,
    )
    from mi_nerfattack.report.pages.verdict import verdict

    result.save(output, provenance)
    title = f"Fit of {output.name}"
    page = write_fit_report(report_folder(output), result, images, title=title)
    checkpoint.unlink(missing_ok=True)  # before a closed pipe can end this

    size = result.field.upper - result.field.lower

    def show() -> None:
        out = console()
        out.print(scores_table(result))
        out.print(
            f"{verdict(judge_fit(result))}\n{result.steps} steps in "
            f"{result.wall_s:.0f} s. The field's box has {size[0]:.2f} x {size[1]:.2f} "
            f"x {size[2]:.2f} m. Wrote {output} and {page}.",
            soft_wrap=True,
            highlight=False,
        )

    return Result(summary(result), show)
