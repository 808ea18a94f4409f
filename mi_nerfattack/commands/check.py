"""``mi-nerfattack check``: look at a scenario or a grid before its attacks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from mi_nerfattack.commands.shared.options import Settings, check_suffix
from mi_nerfattack.commands.shared.terminal import Result

if TYPE_CHECKING:
    from mi_nerfattack.commands.shared.progress import StageBars

OnProgress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Check:
    """Show a scenario from above and through the lens, or price the cells of a grid.

    Prints why attack would refuse the scenario or a cell, and what the attacks would
    cost. Of a grid, one cell is checked at each place. Ends with 0, or with 1 if attack
    would refuse.
    """

    file: tyro.conf.Positional[Path]
    """Scenario or grid file (TOML)."""
    output: Path | None = None
    """Picture of a scenario (.png), SCENARIO-check.png by default; of a grid, the
    sweep's folder, whose complete cells cost nothing."""
    settings: Settings = ()
    """Set a key of the scenario: seed=1. A grid sets keys itself."""
    take: tuple[Path, ...] = ()
    """Of a grid: folders of sweeps whose complete cells are taken, as of sweep."""
    workers: int | None = None
    """Of a grid: cells that are done at a time; one a core by default."""
    no_drives: bool = False
    """Make no drive, unattacked, from each start, and time no attack."""
    json: bool = False

    def run(self) -> Result:
        """Check, draw and tell."""
        from mi_nerfattack import variant
        from mi_nerfattack.backend.determinism import one_thread
        from mi_nerfattack.commands.shared.progress import StageBars
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.io import files

        is_grid = "scenario" in files.read_toml(self.file)
        if is_grid and self.settings:
            raise InputError(f"--set: {self.file} is a grid; set the key in it")
        if not is_grid and (self.take or self.workers is not None):
            raise InputError(f"--take, --workers: {self.file} is not a grid")
        picture = self.output or Path(f"{self.file.stem}-check.png")
        if not is_grid:
            check_suffix(picture, ".png")
            files.check_writable(picture)
        variant.ensure()
        with StageBars() as bars, one_thread():
            show = _shown(bars)
            return self._grid(show) if is_grid else self._scenario(picture, show)

    def _scenario(self, picture: Path, show: OnProgress) -> Result:
        from mi_nerfattack.experiment.checks import check as checks
        from mi_nerfattack.scenario.scenario import load_scenario
        from mi_nerfattack.scenario.world import build_world

        scenario, _ = load_scenario(self.file, settings=self.settings)
        world = build_world(scenario, scenario.build_policy())
        check = checks.Check(world, show)
        check.run(not self.no_drives)
        show("drawing", 0, 1, "")
        drawn = picture if check.picture(picture) else None
        show("drawing", 1, 1, "")
        check.price()
        document = {**check.document(), "picture": drawn and str(drawn)}
        lines = checks.sentences(check, str(self.file), drawn, settings=self.settings)
        code = int(bool(check.refused))
        return Result(document, lambda: print(*lines, sep="\n"), code)

    def _grid(self, show: OnProgress) -> Result:
        from mi_nerfattack.commands.shared.cells import cells_at_a_time
        from mi_nerfattack.commands.shared.options import check_positive
        from mi_nerfattack.experiment.sweep.forecast import Forecast, sentences
        from mi_nerfattack.experiment.sweep.grid import load_cells
        from mi_nerfattack.experiment.sweep.summary import read_taken

        if self.workers is not None:
            check_positive(self, "workers")
        taken = read_taken(self.take).rows
        cells = [cell for cell in load_cells(self.file) if cell.id not in taken]
        forecast = Forecast(cells, self.output and self.output.resolve(), show)
        forecast.run(not self.no_drives)
        document = forecast.document()
        lines = sentences(document, cells_at_a_time(cells, self.workers))
        code = int(any(document["refused"].values()))
        return Result(document, lambda: print(*lines, sep="\n"), code)


def _shown(bars: StageBars) -> OnProgress:
    def show(stage: str, done: int, total: int, remark: str) -> None:
        bars.show(stage, done, total, f"{done}/{total} {remark}")

    return show
