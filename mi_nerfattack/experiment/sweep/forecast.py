"""What a sweep would cost, and what of it would be refused."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.errors import InputError, SetupError
from mi_nerfattack.experiment.checks.check import Check, duration
from mi_nerfattack.experiment.checks.cost import Cost, estimate
from mi_nerfattack.experiment.sweep.cell import Cell, is_complete
from mi_nerfattack.scenario.world import build_world

#: What cells have in common that stand at one place: route, objects.
Place = tuple[str, str]


@dataclass(eq=False)
class Forecast:
    """What is known of a sweep before it is made.

    Of each place (a route with its objects), the first cell is checked as
    ``mi-nerfattack check`` does; of each further method and budget there, the first
    seed's attack is timed. Other seeds are taken to be like the first.

    Attributes:
        cells: all.
        folder: of the sweep, which may be missing; None if it is unknown.
        on_progress: called with a stage, units done, all units, and a remark.
        refused: why `attack` would refuse the cells of a place, one sentence per
            reason.
        doubts: settings that `attack` accepts but users seldom mean.
        costs: of one attack of each place, method and budget; None where no attack
            could be tried.
    """

    cells: Sequence[Cell]
    folder: Path | None
    on_progress: Callable[[str, int, int, str], None] = lambda *progress: None
    refused: dict[Place, list[str]] = field(default_factory=dict)
    doubts: dict[Place, list[str]] = field(default_factory=dict)
    costs: dict[tuple[Any, ...], Cost | None] = field(default_factory=dict)

    def run(self, drives: bool = True) -> None:
        """Find what there is to find.

        Args:
            drives: make the drives of the checks, and time the attacks; otherwise only
                what needs none is found.
        """
        first = {cell.kind: cell for cell in reversed(self.cells)}
        kinds = list(dict.fromkeys(cell.kind for cell in self.cells))
        period_s: dict[Place, dict[str, float]] = {}
        for number, kind in enumerate(kinds):
            cell, place = first[kind], kind[:2]
            self.on_progress("checking", number, len(kinds), _words(kind))
            if place not in self.refused:
                with one_thread():  # as each cell of the sweep
                    self._check(cell, place, drives)
                if cost := self.costs[kind]:
                    period_s[place] = cost.period_s
            elif place in period_s:
                self.costs[kind] = self._price(cell, period_s[place])
            else:
                self.costs[kind] = None
        self.on_progress("checking", len(kinds), len(kinds), "")

    def _check(self, cell: Cell, place: Place, drives: bool) -> None:
        self.refused[place], self.doubts[place] = [], []
        self.costs[cell.kind] = None
        try:
            check = Check(build_world(cell.scenario, cell.scenario.build_policy()))
            check.run(drives)
        except (InputError, SetupError) as err:
            self.refused[place].append(str(err))
            return
        if drives:
            check.price()
        findings = self.doubts if cell.anyway else self.refused
        findings[place] += check.refused
        self.doubts[place] += check.doubts
        self.costs[cell.kind] = check.cost

    def _price(self, cell: Cell, period_s: dict[str, float]) -> Cost | None:
        try:
            world = build_world(cell.scenario, cell.scenario.build_policy())
            return estimate(world, period_s)
        except (InputError, SetupError) as err:
            self.refused[cell.kind[:2]].append(f"{cell.method}: {err}")
            return None

    def _is_complete(self, cell: Cell) -> bool:
        return self.folder is not None and is_complete(self.folder, cell)

    def document(self) -> dict[str, Any]:
        """Return all that was found, as JSON takes it."""
        left = [cell for cell in self.cells if not self._is_complete(cell)]
        costs = [self.costs[cell.kind] for cell in left]
        known = [cost for cost in costs if cost is not None]
        all_timed = len(known) == len(left)
        costs_by_kind = {
            _words(kind): None if cost is None else cost.document()
            for kind, cost in self.costs.items()
        }
        return {
            "cells": len(self.cells),
            "complete": len(self.cells) - len(left),
            "frames": sum(cost.frames for cost in known) if all_timed else None,
            "wall_s": sum(cost.wall_s for cost in known) if all_timed else None,
            "disk_mb": sum(cost.disk_mb for cost in known) if all_timed else None,
            "disk_free_mb": _free_mb(self.folder or Path()),
            "memory_mb": max((c.memory_mb for c in known), default=None),
            "refused": {" ".join(p): lines for p, lines in self.refused.items()},
            "doubts": {" ".join(p): lines for p, lines in self.doubts.items()},
            "costs": costs_by_kind,
        }


def sentences(document: dict[str, Any], workers: int) -> list[str]:
    """Tell a forecast in words.

    Args:
        document: of :meth:`Forecast.document`.
        workers: cells that are done at a time.
    """
    cells, complete = document["cells"], document["complete"]
    head, separator = f"{cells} cells", ": "
    if complete:
        head, separator = f"{head}, {complete} complete", "; the rest: "
    if document["wall_s"] is None:
        head += "; not all of them could be timed"
    elif complete < cells:
        head += (
            f"{separator}{document['frames']} frames, "
            f"{duration(document['wall_s'] / workers)} for {workers} at a time, as "
            f"busy as this machine is, {document['disk_mb']:.0f} MB of disk "
            f"({document['disk_free_mb']:.0f} MB are free), at most "
            f"{document['memory_mb']:.0f} MB of memory each"
        )
    lines = [head]
    for name, cost in document["costs"].items():
        if cost is not None and cost["period_s"]["backward"]:
            times = cost["period_s"]
            multiple = times["backward"] / times["forward"]
            lines.append(f"{name}: a backward pass costs {multiple:.1f} drives")
    for word in ("refused", "doubts"):
        shown = "refused" if word == "refused" else "look at"
        for place, findings in document[word].items():
            lines += [f"{shown}: {place}: {line}" for line in findings]
    return lines


def _words(kind: tuple[Any, ...]) -> str:
    return " ".join(str(part) for part in kind if part is not None)


def _free_mb(folder: Path) -> float:
    folder = folder.resolve()
    there = next(path for path in (folder, *folder.parents) if path.exists())
    return shutil.disk_usage(there).free / 1e6
