"""The cells of a sweep: how many at a time, and done with a bar."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mi_nerfattack.experiment.sweep.cell import Cell
    from mi_nerfattack.experiment.sweep.summary import Taken
    from mi_nerfattack.experiment.sweep.sweep import Sweep
    from mi_nerfattack.system.workers import AbstractWorkers


def chosen_count(cells: Sequence[Cell], workers: int | None) -> int | None:
    """Return how many cells are done at a time; None: as many as there is room for.

    Args:
        cells: of the sweep.
        workers: as the user chose it.

    Raises:
        InputError: several in CARLA.
    """
    from mi_nerfattack.experiment.cases import need_one_process
    from mi_nerfattack.experiment.sweep.cell import scenarios_of

    return 1 if need_one_process(scenarios_of(cells), workers) else workers


def cells_at_a_time(cells: Sequence[Cell], workers: int | None, cores: int = 1) -> int:
    """Return how many cells, of so many cores each, this machine does at a time.

    Raises:
        InputError: see `chosen_count`.
    """
    from mi_nerfattack.system.workers import available_cores

    count = chosen_count(cells, workers)
    return max(1, available_cores() // cores) if count is None else count


def cell_workers(
    cells: Sequence[Cell], workers: int | None, cores: int
) -> AbstractWorkers:
    """Return who does cells on this machine: this process, where they are in CARLA.

    Raises:
        InputError: see `chosen_count`, or the number is out of range.
    """
    from mi_nerfattack.experiment.cases import drives_in_carla
    from mi_nerfattack.experiment.sweep.cell import scenarios_of
    from mi_nerfattack.system.workers import InThisProcess, Processes

    count = cells_at_a_time(cells, workers, cores)
    if drives_in_carla(scenarios_of(cells)):
        return InThisProcess()  # it gives the server back, however the work ends
    return Processes(count, pieces_each=1)


def do_cells(
    cells: Sequence[Cell],
    folder: Path,
    cores: int,
    workers: AbstractWorkers,
    taken: Taken | None = None,
) -> Sweep:
    """Do all cells that are not complete, and return the sweep with their results.

    Args:
        cells: of the sweep.
        folder: of the sweep.
        cores: that each cell renders with.
        workers: who does them.
        taken: cells that were done elsewhere, if any.

    Raises:
        InputError: see `Sweep.run`.
        SetupError: see `Sweep.run`.
    """
    from mi_nerfattack.commands.shared.progress import StageBars
    from mi_nerfattack.experiment.checks.cost import planned_periods
    from mi_nerfattack.experiment.sweep.summary import Taken
    from mi_nerfattack.experiment.sweep.sweep import Cells, Sweep

    each = {cell.kind: cell for cell in cells}
    periods = {kind: planned_periods(cell.scenario) for kind, cell in each.items()}
    planned = [periods[cell.kind] for cell in cells]
    resumed_periods = 0
    with StageBars() as bars:

        def show(sweep: Sweep) -> None:
            nonlocal resumed_periods
            done = sum(planned[index] for index in sweep.complete)
            if not sweep.steps and len(sweep.complete) == sweep.already_complete:
                resumed_periods = done
            state = f"{len(sweep.complete)}/{len(cells)}, {sweep.steps} control periods"
            if sweep.errors:
                state += f", {len(sweep.errors)} failed"
            # A cell may take more periods than planned, and is not done before its end.
            done = max(done, min(resumed_periods + sweep.steps, sum(planned) - 1))
            bars.show(
                "cells", done, sum(planned), state, resumed=done == resumed_periods
            )

        work = Cells(tuple(cells), folder.resolve(), cores)
        sweep = Sweep(work, show, taken or Taken())
        sweep.run(workers)
        return sweep
