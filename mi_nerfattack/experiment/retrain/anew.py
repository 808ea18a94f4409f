"""The same attacks again, on a retrained policy: what an attacker still finds."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.retrain.compare import read_with_policy
from mi_nerfattack.experiment.sweep.cell import Cell, folder_of
from mi_nerfattack.experiment.sweep.grid import axis_name
from mi_nerfattack.experiment.sweep.sweep import Cells
from mi_nerfattack.experiment.transfer.found import FoundAttack, read_found
from mi_nerfattack.io import files, locks
from mi_nerfattack.scenario.named_file import portable_text
from mi_nerfattack.system.workers import (
    AbstractWorkers,
    Processes,
    raise_failure,
    tally,
)


def attack_anew(
    attacks: Sequence[FoundAttack],
    policy: str,
    folder: Path,
    workers: AbstractWorkers,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[FoundAttack]:
    """Make the attacks of runs again, their scenarios unchanged but for the policy.

    Each is a cell of a sweep, and done as one: what is there is not done again, and an
    interrupted attack goes on from its checkpoint.

    Args:
        attacks: whose scenarios are attacked, see `check_scenarios`.
        policy: that is attacked, see `compare.with_policy`.
        folder: of the cells; made if missing.
        workers: who does them.
        progress: called with attacks done and wanted.

    Returns:
        what was found, in the order of `attacks`.

    Raises:
        InputError: another process works in the folder, or an attack fails.
    """
    cells = tuple(_cell(attack, policy) for attack in attacks)
    count = tally(progress, 0, len(cells))
    if isinstance(workers, Processes):  # a process keeps the memory of its attack
        workers = replace(workers, pieces_each=1)

    def on_end(index: int, error: Exception | None) -> None:
        raise_failure(index, error)
        count(1)

    files.make_folder(folder)
    with locks.exclusive(folder):
        every = range(len(cells))
        workers.run(Cells(cells, folder), every, lambda units: None, on_end)
    return list(read_found([folder_of(folder, cell) for cell in cells]))


def check_scenarios(attacks: Sequence[FoundAttack]) -> None:
    """Refuse runs of one scenario: the attack that is made again is the same for both.

    Raises:
        InputError: there are such runs.
    """
    folders: dict[str, Path] = {}
    for attack in attacks:
        digest = attack.scenario.digests()["scenario"]
        first = folders.setdefault(digest, attack.folder)
        if first != attack.folder:
            raise InputError(
                f"{attack.folder}: its scenario is that of {first}, so an attack that "
                "is made again is the same for both; leave out one of the runs"
            )


def _cell(attack: FoundAttack, policy: str) -> Cell:
    """Return a run's scenario with another policy as a cell of a sweep.

    What the checks before an attack find is told by its flags, and refuses nothing: the
    run counted, too.
    """
    scenario, text = read_with_policy(attack, policy)
    ids = "+".join(item.id for item in scenario.objects)
    return Cell(
        route=axis_name(attack.route.name),
        objects=axis_name(ids),
        method=scenario.attack.method.kind,
        budget=None,
        seed=scenario.seed,
        text=portable_text(scenario, text),
        digests=scenario.digests(),
        anyway=True,
    )
