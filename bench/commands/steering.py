"""``python -m bench steering``: how hard the policy steers back at a sweep's places."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

from mi_nerfattack.commands.shared.result import Result


@dataclass(frozen=True)
class BenchSteering:
    """Set attacks at a sweep's places beside how the policy steers back there.

    At each place of a sweep with one method, from along the lane's centre, in the
    surrogate: the share of the pixels that textures can change, and by how much the
    policy's control, without objects, changes aside of the centre, and turned. With
    --cells, by how much attacks changed the control at most. Nothing is attacked.
    """

    folder: tyro.conf.Positional[Path] = Path("docs/table2")
    """Of a finished sweep, or a copy of its table."""
    cells: Path | None = None
    """Folder of the sweep, or of a `mi-nerfattack reproduce -o` of some of its rows."""
    json: bool = False
    """Print a line of JSON for each place in place of the table."""

    def run(self) -> Result:
        """Look, and print."""
        from bench.table2.page import section
        from bench.table2.steering import (
            CHANGED,
            HEADER,
            changed_lines,
            errors,
            largest_change,
            lines,
            measure,
        )
        from mi_nerfattack import variant
        from mi_nerfattack.errors import InputError
        from mi_nerfattack.experiment.sweep.cell import folder_of
        from mi_nerfattack.experiment.sweep.reproduce import read_replay
        from mi_nerfattack.experiment.sweep.table import RESULTS, read_table
        from mi_nerfattack.scenario.world import build_world

        variant.ensure()
        rows = read_table(self.folder / RESULTS)
        if len(methods := {row["method"] for row in rows}) > 1:
            raise InputError(
                f"{self.folder / RESULTS}: has the methods {', '.join(sorted(methods))}"
                "; give a sweep with one, such as docs/table2"
            )
        places = []
        every = [str(index) for index in range(len(rows))]
        for cell in read_replay(self.folder, every).cells:
            world = build_world(cell.scenario, cell.scenario.policy.build())
            place = {"route": cell.route, "seed": cell.seed, "looks": measure(world)}
            if self.cells is not None:
                steps = folder_of(self.cells, cell) / "steps.csv"
                if steps.exists():
                    period_m = world.route.speed_ms * world.place.period
                    place["change"] = largest_change(steps, period_m)
            places.append(place | errors(rows, cell.id))
        parts = [section("Steering", "", HEADER, lines(places))]
        if self.cells is not None:
            parts.append(section("Attacked", "", CHANGED, changed_lines(places)))
        return Result({"places": places}, lambda: print(*parts, sep="\n\n"))
