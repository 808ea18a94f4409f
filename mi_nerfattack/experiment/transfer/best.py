"""The best attacks of sweeps, to be driven in other environments."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mi_nerfattack.drives.table import records
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.summary import summary
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.experiment.sweep.table import RESULTS, read_table
from mi_nerfattack.rollout.drive import ATTACK
from mi_nerfattack.scenario.deployment import SURROGATE


def chosen_runs(folders: Sequence[Path], best: int | None) -> list[Path]:
    """Return run folders; those of sweeps are of their best attacks.

    Args:
        folders: of runs, or of sweeps.
        best: attacks of each route of all sweeps; None where there are only runs.

    Raises:
        InputError: it is missing, or says nothing.
    """
    sweeps = [folder for folder in folders if (folder / RESULTS).is_file()]
    if sweeps and best is None:
        raise InputError(
            f"{sweeps[0]}: is of a sweep; say by --best how many attacks of each route"
        )
    if best is None:
        return list(folders)
    if best < 1:
        raise InputError(f"--best: {best}; at least 1")
    if not sweeps:
        raise InputError("--best: is of sweeps, and no FOLDER is of one; leave it out")
    runs = [folder for folder in folders if folder not in sweeps]
    return [*runs, *best_attacks(sweeps, best)]


def best_attacks(sweeps: Sequence[Path], of_route: int) -> list[Path]:
    """Return the folders of the best attacks, route by route, best first.

    They are those with the largest mean error in the surrogate. Of a method at a place,
    which is a route with its objects and a seed, the better attack alone counts.

    Args:
        sweeps: folders of sweeps on the same routes, or copies of their tables.
        of_route: so many of each route.

    Raises:
        InputError: a route has fewer.
    """
    best: dict[str, dict[tuple[Any, ...], tuple[float, Path]]] = {}
    for folder in sweeps:
        table = read_table(folder / RESULTS)
        own = table[(table["environment"] == SURROGATE) & (table["case"] == ATTACK)]
        by = ["route", "objects", "seed", "method", "cell"]
        for row in records(summary(own, by, ["cell"])):
            known = best.setdefault(row["route"], {})
            candidate = row["cross_track_mean_m"], folder / CELLS / row["cell"]
            place = row["objects"], row["seed"], row["method"]
            known[place] = max(candidate, known.get(place, candidate))
    ranked = {route: sorted(own.values(), reverse=True) for route, own in best.items()}
    for route, pairs in ranked.items():
        if len(pairs) < of_route:
            raise InputError(
                f"--best: {of_route}; {route} has {len(pairs)} attacks: lower it, or "
                "finish the sweep"
            )
    return [path for pairs in ranked.values() for _, path in pairs[:of_route]]
