"""``python -m bench gaps FOLDER``: how far apart photographs may be taken."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchGaps:
    """Fit small fields to ever fewer photographs, and score what they have not seen.

    Prints, for each share of the photographs, how far the others are from those fitted
    to, as seen from what they show, and their PSNR beside that of those fitted to. What
    `capture` and `fit` warn of was set by this.
    """

    folder: tyro.conf.Positional[Path]
    """What `capture` wrote of many photographs of one scene."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder for the fields, where the same command goes on."""
    every: tuple[int, ...] = (1, 2, 4, 8)
    """Keep every so manieth photograph; of those, every 8th is not fitted to."""
    steps: int = 600
    """Of each fit."""
    long_edge: int = 320
    """Of the photographs, pixels."""
    json: bool = False
    """Print one line of JSON in place of a table."""

    def run(self) -> Result:
        """Fit, score and print."""
        from bench.gaps import thinned
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.options import check_positive
        from mi_nerfattack.io import files

        variant.ensure()
        check_positive(self, "steps", "long_edge")
        work = files.make_folder(self.output)
        rows = [
            thinned(self.folder, work, each, self.steps, self.long_edge)
            for each in self.every
        ]

        def show() -> None:
            print("fitted to  PSNR of these   others: gap   PSNR")
            for row in rows:
                print(
                    f"{row['fitted']:9d} {row['psnr_fitted_db']:11.2f} dB "
                    f"{row['gap_deg']:13.1f} deg {row['psnr_db']:6.2f} dB"
                )

        return Result({"rows": rows}, show)
