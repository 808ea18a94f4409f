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


def cells_at_a_time(workers: int | None, cores: int) -> int:
    """Return `workers`, by default how many of so many cores have room here."""
    from mi_nerfattack.system.workers import available_cores

    return max(1, available_cores() // cores) if workers is None else workers


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
