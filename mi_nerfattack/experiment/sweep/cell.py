"""One cell of a sweep: a scenario, and the run folder that is made of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mi_nerfattack.backend.determinism import one_thread
from mi_nerfattack.backend.versions import versions
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.claim import claimed
from mi_nerfattack.experiment.job import Job
from mi_nerfattack.io import files, locks
from mi_nerfattack.io.strict import parse_toml
from mi_nerfattack.scenario.named_file import portable_text
from mi_nerfattack.scenario.scenario import Scenario

#: Folder of the cells, in that of the sweep.
CELLS = "cells"
#: Folder of drives that cells have in common, in that of the sweep.
SHARED = "shared"
#: Empty file in the folder of a cell that is done.
COMPLETE = "_complete"
#: What a cell was done of: its row of the grid, digests and versions.
PROVENANCE = "cell.json"


@dataclass(frozen=True)
class Cell:
    """A row of the grid, with the whole scenario.

    Attributes:
        route: name of the grid's choice of route.
        objects: name of the grid's choice of objects.
        method: name of the grid's choice of method.
        budget: rendered frames that the attack may cost; None: as the scenario says.
        seed: of the scenario.
        text: the scenario file, its paths absolute.
        digests: of the scenario and the files that it names.
        anyway: attack although the checks before find that it proves nothing.
        pictures: write frames, plots and page, too.
        name: of the folder, if it is not made from route to digest.
    """

    route: str
    objects: str
    method: str
    budget: int | None
    seed: int
    text: str
    digests: dict[str, str]
    anyway: bool = False
    pictures: bool = False
    name: str = ""

    @property
    def id(self) -> str:
        """Name of the folder: no other scenario has it."""
        if self.name:
            return self.name
        words = [self.route, self.objects, self.method, self.budget, self.seed]
        words.append(self.digests["scenario"])
        return "-".join(str(word) for word in words if word is not None)

    @property
    def kind(self) -> tuple[Any, ...]:
        """What cells have in common that differ in their seed alone."""
        return self.route, self.objects, self.method, self.budget

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario.

        Raises:
            InputError: what it names is not usable here.
        """
        return _scenario(self.id, self.text)


def scenarios_of(cells: Sequence[Cell]) -> list[Scenario]:
    """Return a scenario of each kind of cell; others differ in their seed alone.

    Raises:
        InputError: see `Cell.scenario`.
    """
    return [cell.scenario for cell in {cell.kind: cell for cell in cells}.values()]


def absolute_text(name: str, text: str, folder: Path) -> str:
    """Return the scenario of a cell with absolute paths.

    Args:
        name: of the cell.
        text: of its scenario.
        folder: where relative paths begin.

    Raises:
        InputError: what the scenario names is not usable here.
    """
    return portable_text(_scenario(name, text, folder), text)


def _scenario(name: str, text: str, folder: Path | None = None) -> Scenario:
    context = None if folder is None else {"folder": folder}
    try:
        return Scenario.model_validate(parse_toml(name, text), context=context)
    except ValidationError as err:  # it was valid where the cell was made
        raise InputError(f"{name}: {err}; is a file missing here?") from err


def folder_of(sweep: Path, cell: Cell) -> Path:
    """Return the run folder of a cell."""
    return sweep / CELLS / cell.id


def is_complete(sweep: Path, cell: Cell) -> bool:
    """Whether a cell is done, and need never be done again."""
    return (folder_of(sweep, cell) / COMPLETE).exists()


def changed(cell: Cell) -> list[str]:
    """Return the keys of what is of other content here than in a cell's digests.

    Raises:
        InputError: a file is missing.
    """
    current, recorded = cell.scenario.digests(), cell.digests
    return sorted(
        k for k in current.keys() | recorded.keys() if current.get(k) != recorded.get(k)
    )


def run_cell(cell: Cell, sweep: Path, on_step: Callable[[], None]) -> None:
    """Do a cell, or what is left of it, as ``mi-nerfattack attack`` would.

    Drives that another cell has in common with it are taken from there. What an earlier
    run of the sweep left at work on it is waited for.

    Args:
        cell: what to do.
        sweep: folder of the sweep.
        on_step: called after each control period of a drive.

    Raises:
        InputError: a file has changed since the sweep began; or as of :meth:`Job.run`.
        SetupError: as of :meth:`Job.run`.
    """
    output, scenario = folder_of(sweep, cell), cell.scenario
    locks.wait_for(output)
    with claimed(output):
        if is_complete(sweep, cell):
            return
        if wrong := changed(cell):
            raise InputError(
                f"{cell.id}: {', '.join(wrong)}: other content here than where the "
                "sweep began; give the same command again, and all machines one disk"
            )
        policy, frames = scenario.build_policy(), 3 if cell.pictures else None
        job = Job(scenario, cell.text, policy, output, lambda *progress: on_step())
        job.frames, job.shared = frames, sweep / SHARED
        with one_thread():
            document = job.run_claimed(anyway=cell.anyway)
        if "curve" not in document:
            raise InputError(
                f"{output}: was continued with --force, so nobody knows the frames of "
                "its search; remove the folder, and give the sweep's command again"
            )
        provenance = asdict(cell) | {"versions": versions()}
        del provenance["text"]  # the run folder's scenario.toml
        files.write_json(output / PROVENANCE, provenance)
        files.write_bytes(output / COMPLETE, b"")
