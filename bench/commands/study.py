"""``python -m bench study``: many attacks at drawn places, a row each."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class BenchStudy:
    """Make the attacks of a study, and append a row for each to a table.

    `steps`: parametrisations of colour and learning rates at six places. `robust`: what
    disturbances of the optimisation do for the transfer. `textures`: the price of
    smooth and coarse textures, and half the iterations. `distribution`: 24 places, two
    sizes. Each takes hours on two cores; stopped, the same command continues from
    OUTPUT.
    """

    study: tyro.conf.Positional[Literal["steps", "robust", "textures", "distribution"]]
    """Which."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Table to write, row by row (.jsonl)."""

    def run(self) -> int:
        """Make the rows that are missing."""
        import torch

        from bench.study import distribution, robust, rows, steps, textures
        from mi_nerfattack import variant
        from mi_nerfattack.io import files

        files.check_writable(self.output)
        torch.set_num_threads(1)
        variant.ensure()

        def on_row(done: int, count: int, key: str) -> None:
            print(f"{done}/{count}: {key}", file=sys.stderr, flush=True)

        studies = {
            "steps": steps,
            "robust": robust,
            "textures": textures,
            "distribution": distribution,
        }
        study = studies[self.study]
        found = rows.fill(self.output, study.keys(), study.attack_row, on_row)
        print(f"{len(found)} rows in {self.output}", file=sys.stderr)
        return 0
