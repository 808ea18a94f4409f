"""``mi-nerfattack sweep``: the attacks of a grid, and one table."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from mi_nerfattack.commands.shared.result import Result
from mi_nerfattack.commands.shared.terminal import console

if TYPE_CHECKING:
    from mi_nerfattack.experiment.sweep.cell import Cell
    from mi_nerfattack.experiment.sweep.taken import Taken
    from mi_nerfattack.system.workers import AbstractWorkers


@dataclass(frozen=True)
class Sweep:
    """Attack in every cell of a grid: routes, objects, methods, budgets and seeds.

    Writes a run folder a cell, one table of all drives, results.parquet, and what they
    came to, summary.json, whose flags are told first. Stopped, or killed, the same
    command continues; complete cells are never done again, failed ones are. Ends with
    0, or with 1 if cells failed (with --check, if some would be refused).
    """

    grid: tyro.conf.Positional[Path]
    """Grid file (TOML)."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """Folder of the sweep, new or begun."""
    take: tuple[Path, ...] = ()
    """Folders with results.parquet and summary.json of a sweep that was done elsewhere,
    whole or in part: cells of the grid that are complete there are not done again."""
    check: bool = False
    """Do nothing yet: tell how many cells and frames there are, what time and disk they
    would take, and what would be refused."""
    no_drives: bool = False
    """With --check: tell only what needs no drive; by default, it drives once from each
    start at each place, unattacked, and times the attacks."""
    workers: int | None = None
    """Cells that are done at a time, each by a process or job of its own; by default as
    many as there are cores for, and 256 jobs. Of a Ray cluster of several machines, its
    own matter."""
    cores: int = 1
    """Cores that each cell renders with."""
    ray: str | None = None
    """Ray cluster that does the cells in place of this machine alone: HOST:PORT,
    ray://HOST:PORT, auto (the one that this machine is part of), or local (one that is
    made of this machine, for as long as it takes)."""
    submitit: str | None = None
    """Partition of a SLURM cluster that does the cells, a job each, in place of this
    machine."""
    memory_gb: float = 4.0
    """Memory of each cell, which the cluster is asked for."""
    minutes: int = 240
    """After which SLURM stops a job; it is submitted again, up to three times."""
    json: bool = False
    """End with one line of JSON in place of the sentences."""

    @property
    def continues(self) -> bool:
        """Whether the same command finds what this one left."""
        return not self.check

    def run(self) -> Result:
        """Check the grid, or do its cells."""
        from mi_nerfattack import variant
        from mi_nerfattack.commands.shared.options import check_positive
        from mi_nerfattack.experiment.sweep.grid import load_cells
        from mi_nerfattack.experiment.sweep.taken import read_taken
        from mi_nerfattack.io import files

        check_positive(self, "cores", "memory_gb", "minutes")
        workers = self._workers()
        if not self.check:
            files.check_folder(self.output)
        variant.ensure()
        cells, taken = load_cells(self.grid), read_taken(self.take)
        if self.check:
            return self._check([cell for cell in cells if cell.id not in taken.rows])
        return self._run(cells, workers, taken)

    def _count(self) -> int:
        from mi_nerfattack.commands.shared.cells import cells_at_a_time
        from mi_nerfattack.system.workers import MOST

        if self.workers is None and self.submitit is not None:
            return MOST
        return cells_at_a_time(self.workers, self.cores)

    def _workers(self) -> AbstractWorkers:
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.system.ray_tasks import RayTasks
        from mi_nerfattack.system.slurm import SlurmJobs
        from mi_nerfattack.system.workers import Processes

        if self.ray is not None and self.submitit is not None:
            raise InputError("--ray: stands beside --submitit; give one of them")
        alone = Processes(self._count(), pieces_each=1)  # checks the number, too
        each = self.cores, self.memory_gb
        if self.ray is not None:
            return RayTasks(self.ray, *each, self.workers)
        if self.submitit is None:
            return alone
        jobs = self.output.resolve() / "slurm", self.submitit, *each, self.minutes
        return SlurmJobs(*jobs, self._count())

    def _check(self, cells: list[Cell]) -> Result:
        from mi_nerfattack.backend.determinism import one_thread
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.experiment.sweep.forecast import Forecast, sentences

        with StageBars() as bars, one_thread():

            def show(stage: str, done: int, total: int, remark: str) -> None:
                bars.show(stage, done, total, f"{done}/{total} {remark}")

            forecast = Forecast(cells, self.output.resolve(), show)
            forecast.run(not self.no_drives)
        document = forecast.document()
        told = sentences(document, self._count())
        code = int(any(document["refused"].values()))
        return Result(document, lambda: print(*told, sep="\n"), code)

    def _run(self, cells: list[Cell], workers: AbstractWorkers, taken: Taken) -> Result:
        from mi_nerfattack.commands.shared.cells import do_cells
        from mi_nerfattack.experiment.sweep.summary import write_summary
        from mi_nerfattack.report.table import sweep_table

        sweep = do_cells(cells, self.output, self.cores, workers, taken)
        document = write_summary(sweep.work.folder, taken.attacks)
        failed = {cells[i].id: error for i, error in sorted(sweep.errors.items())}
        found = {
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

        return Result(found, show, int(bool(failed)))
