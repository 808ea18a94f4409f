"""``python -m bench study``: many attacks at drawn places, a row each."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from mi_nerfattack.commands.shared.result import Result

if TYPE_CHECKING:
    from bench.study import rows


@dataclass(frozen=True)
class BenchStudy:
    """Make the attacks of a study, and append a row for each to a table.

    `steps`: parametrisations of colour and learning rates at six places. `robust`: what
    disturbances of the optimisation do for the transfer. `textures`: the price of
    smooth and coarse textures. `distribution`: 24 places, two sizes. Each of these
    takes hours on two cores, `seeds`, three attacks, minutes. Stopped, the same
    command continues from OUTPUT. Ends with the table in Markdown.
    """

    study: tyro.conf.Positional[
        Literal["steps", "robust", "textures", "seeds", "distribution"]
    ]
    """Which."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Table to write, row by row (.jsonl). The picture of `distribution` is written
    beside it (.png)."""
    table: bool = False
    """Add no row; print what there is."""
    json: bool = False
    """End with one line of JSON, the rows, in place of the table."""

    def run(self) -> Result:
        """Make the rows that are missing."""
        from rich.console import Console

        from bench.study import distribution, robust, rows, seeds, steps, textures
        from mi_nerfattack.errors import InputError

        studies = {
            "steps": steps,
            "robust": robust,
            "textures": textures,
            "seeds": seeds,
            "distribution": distribution,
        }
        study = studies[self.study]
        if self.table:
            found = rows.pick(rows.read(self.output), study.keys())
            if not found:
                raise InputError(f"{self.output}: no rows; leave out --table")
        else:
            found = self._fill(study.keys(), study.attack_row)
        if self.study == "distribution":
            distribution.draw(self.output.with_suffix(".png"), found)
        table = study.table(found)
        return Result({"rows": found}, lambda: Console(width=400).print(table))

    def _fill(self, keys: list[rows.Row], work: Callable[[rows.Key], rows.Row]) -> Any:
        import torch

        from bench.study import rows
        from mi_nerfattack import variant
        from mi_nerfattack.io import files

        files.check_writable(self.output)
        torch.set_num_threads(1)
        variant.ensure()

        def on_row(done: int, count: int, key: str) -> None:
            print(f"{done}/{count}: {key}", file=sys.stderr, flush=True)

        return rows.fill(self.output, keys, work, on_row)
