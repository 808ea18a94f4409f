"""What the fitting commands show and write: progress, scores, pictures, the file."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

if TYPE_CHECKING:
    from mi_nerfattack.capture.fit import FitProgress, FitResult
    from mi_nerfattack.capture.frames import PosedImages

_SHOWN_VIEWS = 4
_PLAIN_EVERY = 10  # reports, where the output is no terminal


class Bars:
    """Progress on standard error: bars in a terminal, plain lines elsewhere."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[state]}"),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
        )
        self._tasks: dict[str, int] = {}
        self._reports = 0

    def __enter__(self) -> Bars:
        if self._console.is_terminal:
            self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._console.is_terminal:
            self._bars.stop()

    def views(self, done: int, total: int) -> None:
        """Show how many views are rendered."""
        self._show("rendering views", done / total, f"{done}/{total}", done == total)

    def fit(self, at: FitProgress) -> None:
        """Show the state of a fit."""
        state = (
            f"step {at.step}  loss {at.loss:.5f}  PSNR {at.psnr_db:.2f} dB  "
            f"occupied {100 * at.occupied:.1f} %"
        )
        if not self._console.is_terminal:
            state += f"  {at.elapsed_s:.0f} s done, {at.remaining_s:.0f} s left"
        self._show("fitting", at.fraction, state, at.fraction >= 1)

    def _show(self, name: str, fraction: float, state: str, last: bool) -> None:
        if self._console.is_terminal:
            if name not in self._tasks:
                self._tasks[name] = self._bars.add_task(name, total=1.0, state="")
            task = self._bars.tasks[self._tasks[name]].id
            self._bars.update(task, completed=fraction, state=state)
        else:
            self._reports += 1
            if last or self._reports % _PLAIN_EVERY == 1:
                self._console.print(f"{name}: {state}", highlight=False, soft_wrap=True)


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
