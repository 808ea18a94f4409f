"""A sweep: all cells done once, failed ones tried again, one table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import drjit as dr
import pandas as pd

from mi_nerfattack import variant
from mi_nerfattack.errors import InputError, RefusedError
from mi_nerfattack.experiment.cases import need_one_process
from mi_nerfattack.experiment.job import quiet
from mi_nerfattack.experiment.sweep.cell import (
    CELLS,
    PROVENANCE,
    Cell,
    folder_of,
    is_complete,
    run_cell,
    scenarios_of,
)
from mi_nerfattack.experiment.sweep.grid import load_cells
from mi_nerfattack.experiment.sweep.summary import SUMMARY, Taken, write_summary
from mi_nerfattack.experiment.sweep.table import (
    RESULTS,
    Row,
    complete_rows,
    failed_row,
    labels_of,
    made_of,
    read_table,
    write_table,
)
from mi_nerfattack.io import files, locks
from mi_nerfattack.system.workers import (
    AbstractWork,
    AbstractWorkers,
    InThisProcess,
    OnUnits,
    Processes,
)

#: How often a cell is tried in one run of a sweep.
ATTEMPTS = 3
#: Folder of what failed cells told.
FAILED = "failed"
#: Does a cell in the sweep's folder, and tells of each control period.
Task = Callable[[Cell, Path, Callable[[], None]], None]


@dataclass(frozen=True)
class Cells(AbstractWork):
    """The cells of a sweep, as work for any executor.

    Attributes:
        cells: all.
        folder: of the sweep.
        threads: of each cell's rendering.
        task: does one.
    """

    cells: tuple[Cell, ...]
    folder: Path
    threads: int = 1
    task: Task = run_cell

    def open(self) -> int:
        """Set up the renderer; returns its threads before."""
        variant.ensure()
        before = dr.thread_count()
        dr.set_thread_count(self.threads)
        return before

    def do(self, opened: Any, index: int, report: OnUnits) -> None:
        """Do a cell."""
        self.task(self.cells[index], self.folder, partial(report, 1))

    def close(self, opened: Any) -> None:
        """Let the renderer have its threads again."""
        dr.set_thread_count(opened)


@dataclass(eq=False)
class Sweep:
    """What a sweep has come to.

    Attributes:
        work: its cells.
        on_change: called when anything has happened.
        taken: cells that were done elsewhere; a cell that is done here replaces its
            copy.
        steps: control periods that the cells have reported.
        complete: cells that are done, by their index.
        already_complete: number of cells that were done when this run began.
        errors: why other cells failed at their last attempt.
    """

    work: Cells
    on_change: Callable[[Sweep], None] = lambda sweep: None
    taken: Taken = field(default_factory=Taken)
    steps: int = 0
    complete: set[int] = field(default_factory=set)
    already_complete: int = 0
    errors: dict[int, str] = field(default_factory=dict)
    _rows: dict[int, list[Row]] = field(default_factory=dict)
    _made: dict[int, dict[str, Any]] = field(default_factory=dict)
    _refused: set[int] = field(default_factory=set)

    @property
    def table(self) -> Path:
        """The file of the table."""
        return self.work.folder / RESULTS

    def run(self, workers: AbstractWorkers) -> None:
        """Do all cells that are not complete.

        A cell that fails, or whose process dies, is tried `ATTEMPTS` times; each goes
        on from the cell's last checkpoint. One whose attack would prove nothing is
        refused once. The table is written after each cell.

        Args:
            workers: who does them.

        Raises:
            InputError: another process works on the sweep, or a file cannot be read or
                written.
        """
        work = self.work
        with locks.exclusive(files.make_folder(work.folder)):
            for path in filter(locks.is_partial, work.folder.iterdir()):
                path.unlink()  # below, jobs of a killed sweep may still write
            for name in (CELLS, FAILED):
                files.make_folder(work.folder / name)
            for index, cell in enumerate(work.cells):
                if is_complete(work.folder, cell):
                    self._take(index)
                elif rows := self.taken.rows.get(cell.id):
                    self.complete.add(index)
                    self._rows[index] = [row | labels_of(cell) for row in rows]
                    self._made[index] = self.taken.made[cell.id]
                elif (path := self._failure(index)).exists():
                    self._fail(index, files.read_text(path))
            self.already_complete = len(self.complete)
            self._write()
            for _ in range(ATTEMPTS):
                ended = self.complete | self._refused
                left = [i for i in range(len(work.cells)) if i not in ended]
                workers.run(work, left, self._count, self._end)

    def _count(self, steps: int) -> None:
        self.steps += steps
        self.on_change(self)

    def _end(self, index: int, error: Exception | None) -> None:
        cell, folder = self.work.cells[index], self.work.folder
        if error is None and not is_complete(folder, cell):
            error = InputError(
                f"{folder_of(folder, cell)}: the cell ended, and its files are not "
                "there; the sweep's folder must be on a disk that all machines share"
            )
        path = self._failure(index)
        if error is None:
            path.unlink(missing_ok=True)
            self._take(index)
        else:
            if isinstance(error, RefusedError):
                self._refused.add(index)
            files.write_text(path, str(error))
            self._fail(index, str(error))
        self._write()

    def _take(self, index: int) -> None:
        self.errors.pop(index, None)
        self.complete.add(index)
        cell, folder = self.work.cells[index], self.work.folder
        self._rows[index] = complete_rows(cell, folder)
        provenance = files.read_json(folder_of(folder, cell) / PROVENANCE)
        self._made[index] = made_of(cell, provenance["versions"])

    def _fail(self, index: int, error: str) -> None:
        self.errors[index], cell = error, self.work.cells[index]
        self._rows[index], self._made[index] = [failed_row(cell, error)], made_of(cell)

    def _failure(self, index: int) -> Path:
        return self.work.folder / FAILED / f"{self.work.cells[index].id}.txt"

    def _write(self) -> None:
        order = sorted(self._rows)
        rows = [row for index in order for row in self._rows[index]]
        made = {self.work.cells[index].id: self._made[index] for index in order}
        write_table(self.work.folder, rows, made)
        self.on_change(self)


@dataclass(frozen=True)
class FinishedSweep:
    """What a sweep has written.

    Args:
        folder: of the sweep, or a folder with a copy of its tables.
    """

    folder: Path

    @cached_property
    def drives(self) -> pd.DataFrame:
        """A table with one row per drive; a cell that failed has one row."""
        return read_table(self.folder / RESULTS)

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of ``summary.json``."""
        return files.read_json(self.folder / SUMMARY)


def sweep(
    grid: str | Path,
    folder: str | Path,
    *,
    workers: int = 1,
    progress: Callable[[str, int, int, str], None] = quiet,
) -> FinishedSweep:
    """Attack in every cell of a grid: ``mi-nerfattack sweep``.

    Args:
        grid: TOML file.
        folder: of the sweep: new, or of the same grid, which then goes on.
        workers: cells that are done at a time; see `evaluate_policy`.
        progress: called with stage, cells done, cells in all and a remark, for example
            `mi_nerfattack.progress()`.

    Raises:
        InputError: the grid or a file is wrong, several workers are given for CARLA,
            or another process works in the folder.
    """
    variant.ensure()
    cells = tuple(load_cells(Path(grid)))

    def show(state: Sweep) -> None:
        remark = f"{state.steps} control periods, {len(state.errors)} failed"
        progress("cells", len(state.complete), len(cells), remark)

    work = Cells(cells, files.make_folder(Path(folder)).resolve())
    need_one_process(scenarios_of(cells), workers)  # refuses others
    crew = Processes(workers, pieces_each=1) if workers > 1 else InThisProcess()
    Sweep(work, show).run(crew)
    write_summary(work.folder)
    return FinishedSweep(work.folder)
