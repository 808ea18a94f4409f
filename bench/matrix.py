"""The best attacks of sweeps in every environment: which, and a page in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.table2.page import section
from bench.table2.rows import cell
from mi_nerfattack.errors import InputError
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.deployment import SURROGATE

#: Attacks of each route.
OF_ROUTE = 8
FIGURES = ("cross_track_mean_m", "cross_track_max_m", "wheel_out_s", "drives_departed")
_INTRODUCTION = """\
# The best attacks in every environment

The {count} best attacks of [Table 2](../table2/README.md) and of
[the methods at equal frames](../methods/README.md), driven past, unchanged, in every
environment and under every condition of [`transfer`](../transfer.md). Best are, of each
route, the {of_route} with the largest mean error in the surrogate from starts that no
search had seen; of a method at a place the better one alone. Number, environments,
conditions, starts ({starts}) and samples a pixel were settled before the first drive.

Figures are mean distances from the lane's centre, metres: mean ± standard deviation
over attacks [95 % interval, BCa] (attacks); then how many of them have a wheel out of
the lane for 1 s [95 % interval, Wilson, per cent]. *Kept* are, of the attacks that
succeed so in the surrogate by day, those that do here [95 % interval, Wilson, per
cent]. The ratio is of the mean error past the attack to that in the surrogate by day
(geometric mean)."""
_HEADER = ["condition", "no object", "attack", "ratio", "kept"]


def best_attacks(
    sweeps: Iterable[tuple[Path, Iterable[Mapping[str, Any]]]], of_route: int = OF_ROUTE
) -> list[Path]:
    """Return the folders of the best attacks, route by route, best first.

    Args:
        sweeps: folder and rows of the table of each.
        of_route: so many of each route; of a method at a place the better one alone.

    Raises:
        InputError: a route has fewer.
    """
    errors: dict[tuple[str, int, str], dict[Path, list[float]]] = {}
    for folder, rows in sweeps:
        for row in rows:
            if (row["environment"], row["case"]) == (SURROGATE, ATTACK):
                key = row["route"], row["seed"], row["method"]
                known = errors.setdefault(key, {})
                path = folder / CELLS / row["cell"]
                known.setdefault(path, []).append(row["cross_track_mean_m"])
    ranked: dict[str, list[tuple[float, Path]]] = {}
    for (route, _, _), known in errors.items():
        means = ((float(np.mean(values)), path) for path, values in known.items())
        ranked.setdefault(route, []).append(max(means))
    for route, pairs in ranked.items():
        if len(pairs) < of_route:
            raise InputError(f"{route}: {len(pairs)} attacks, not {of_route}")
        pairs.sort(reverse=True)
    return [path for pairs in ranked.values() for _, path in pairs[:of_route]]


def drives_of(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of a ``transfer.json``: a row an attack, column and case."""
    return [
        {name: row[name] for name in ("attack", "environment", "condition")}
        | {"case": case}
        | {name: figures[name] for name in FIGURES}
        for row in document["rows"]
        for case, figures in row["cases"].items()
    ]


def page(document: Mapping[str, Any], made: Mapping[str, Any]) -> str:
    """Return the page.

    Args:
        document: ``transfer.json``, complete.
        made: date, machine and command, as of `bench.results.stamp`.
    """
    attacks, columns = document["attacks"], document["columns"]
    routes = {about["route"] for about in attacks}
    told = {"count": len(attacks), "of_route": len(attacks) // len(routes)}
    parts = [_INTRODUCTION.format(starts=document["starts"], **told)]
    for environment in dict.fromkeys(column["environment"] for column in columns):
        own = [c for c in columns if c["environment"] == environment]
        parts.append(section(environment, "", _HEADER, map(_row, own)))
    environments, rows = _of_attacks(document)
    header = ["attack", *environments]
    text = "Mean error past each attack by day, metres; bold where it succeeds."
    parts.append(section("Attacks", text, header, rows))
    machine = ", ".join(f"{key}: {value}" for key, value in made["machine"].items())
    versions = ", ".join(f"{key} {value}" for key, value in made["versions"].items())
    parts.append(
        f"## How it was made\n\n```\n{made['command']}\n```\n\n"
        f"- page written on {made['date']}; {machine}\n- {versions}\n"
        "- beside it `drives.parquet`: a row an attack, environment, condition and case"
    )
    return "\n\n".join(parts) + "\n"


def _row(column: Mapping[str, Any]) -> Sequence[str]:
    cases, transfer, kept = column["cases"], column["transfer"], ""
    if transfer is not None:
        low, high = (round(100 * end) for end in transfer["rate_ci95"])
        kept = f"{transfer['kept']}/{transfer['of']} [{low}, {high}]"
    ratio = column["ratio_to_surrogate"]
    return (
        column["condition"],
        f"{cases[NO_OBJECT]['cross_track_mean_m']:.3f}",
        cell(cases[ATTACK]),
        "" if ratio is None else f"{ratio:.2f}",
        kept,
    )


def _of_attacks(
    document: Mapping[str, Any],
) -> tuple[list[str], Iterator[Sequence[str]]]:
    """Return the environments, and a row an attack: its error in each, by day."""
    errors: dict[tuple[str, str], str] = {}
    for row in document["rows"]:
        if row["condition"] == "day":
            told = f"{row['cases'][ATTACK]['cross_track_mean_m']:.3f}"
            told = f"**{told}**" if row["succeeds"] else told
            errors[row["attack"], row["environment"]] = told
    environments = list(dict.fromkeys(name for _, name in errors))
    rows = (
        (label, *(errors.get((label, name), "") for name in environments))
        for label in (about["label"] for about in document["attacks"])
    )
    return environments, rows
