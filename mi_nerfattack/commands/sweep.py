"""``mi-nerfattack sweep``: the attacks of a grid, and one table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import tyro

from mi_nerfattack.commands.shared.terminal import Result, console

if TYPE_CHECKING:
    from mi_nerfattack.experiment.sweep.cell import Cell
    from mi_nerfattack.experiment.sweep.summary import Taken
    from mi_nerfattack.system.workers import AbstractWorkers


@dataclass(frozen=True)
class Sweep:
    """Attack in every cell of a grid: routes, objects, methods, budgets and seeds.

    Writes one run folder per cell, one table of all drives, results.csv, and their
    summary, summary.json, whose flags are printed first. The same command continues:
    complete cells are never done again, failed ones are. Ends with 0, or with 1 if
    cells failed. check says before what the cells of a grid would cost.
    """

    continues: ClassVar[bool] = True

    grid: tyro.conf.Positional[Path]
    """Grid file (TOML)."""
    output: Path
    """Folder of the sweep, new or begun."""
    take: tuple[Path, ...] = ()
    """Folders with results.csv, cells.json and summary.json of sweeps done elsewhere:
    cells of the grid that are complete there are not done again."""
    workers: int | None = None
    """Cells that are done at a time, each by a process or job; by default one a core,
    and 256 jobs."""
    cores: int = 1
    """Cores that each cell renders with."""
    ray: str | None = None
    """Ray cluster that does the cells: HOST:PORT, ray://HOST:PORT, auto, or local."""
    submitit: str | None = None
    """Partition of a SLURM cluster that does the cells, a job each."""
    memory_gb: float = 4.0
    """Memory of each cell, which the cluster is asked for."""
    minutes: int = 240
    """Time limit of a SLURM job; it is submitted again, up to three times."""
    json: bool = False

    def run(self) -> Result:
        """Do the cells of the grid."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.options import check_positive
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.sweep.grid import load_cells
        from mi_nerfattack.experiment.sweep.summary import read_taken
        from mi_nerfattack.io import files

        check_positive(self, "cores", "memory_gb", "minutes")
        if self.ray is not None and self.submitit is not None:
            raise InputError("--ray: stands beside --submitit; give one of them")
        files.check_folder(self.output)
        variant.ensure()
        cells = load_cells(self.grid)
        return self._run(cells, self._workers(cells), read_taken(self.take))

    def _workers(self, cells: list[Cell]) -> AbstractWorkers:
        from mi_nerfattack.commands.shared.cells import cell_workers, chosen_count
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.system.ray_tasks import RayTasks
        from mi_nerfattack.system.slurm import SlurmJobs
        from mi_nerfattack.system.workers import MOST, InThisProcess

        local = cell_workers(cells, self.workers, self.cores)  # checks the number, too
        if self.ray is None and self.submitit is None:
            return local
        if isinstance(local, InThisProcess):
            raise InputError(
                f"{self.grid}: a deployment in CARLA, whose server one process steps; "
                "leave out --ray and --submitit"
            )
        count = chosen_count(cells, self.workers)
        if self.ray is not None:
            return RayTasks(self.ray, self.cores, self.memory_gb, count=count)
        return SlurmJobs(
            self.output.resolve() / "slurm",
            self.submitit,
            self.cores,
            memory_gb=self.memory_gb,
            minutes=self.minutes,
            count=MOST if count is None else count,
        )

    def _run(self, cells: list[Cell], workers: AbstractWorkers, taken: Taken) -> Result:
        from mi_nerfattack.commands.shared.cells import do_cells
        from mi_nerfattack.experiment.sweep.summary import write_summary
        from mi_nerfattack.report.table import sweep_table

        sweep = do_cells(cells, self.output, self.cores, workers=workers, taken=taken)
        document = write_summary(sweep.work.folder, taken.attacks)
        failed = {cells[i].id: error for i, error in sorted(sweep.errors.items())}
        summary = {
            "cells": len(cells),
            "complete": len(sweep.complete),
            "failed": failed,
            "flags": document["flags"],
            "table": str(sweep.table),
        }

        def show() -> None:
            out = console()
            for flag in document["flags"]:
                line = f"flag: {flag}"
                out.print(line, style="bold", highlight=False)
            out.print(sweep_table(document))
            print(f"{len(sweep.complete)} of {len(cells)} cells: {sweep.table}")
            for cell, error in failed.items():
                print(f"failed: {cell}: {error.splitlines()[-1]}")

        return Result(summary, show, int(bool(failed)))
