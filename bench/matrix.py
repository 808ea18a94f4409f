"""The best attacks of sweeps in every environment: which, and a page in Markdown."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.table2.page import section
from bench.table2.rows import cell
from mi_nerfattack.commands.transfer import Transfer
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.pairs import DEPARTED_S
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.experiment.transfer.columns import ENVIRONMENTS, make_columns
from mi_nerfattack.experiment.transfer.figures import column_figures, compare_rows
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.deployment import SURROGATE

Row = dict[str, Any]

#: Attacks of each route.
OF_ROUTE = 8
CASES = (NO_OBJECT, ATTACK)
FIGURES = (
    "n",  # drives
    "cross_track_mean_m",
    "cross_track_max_m",
    "wheel_out_s",
    "drives_departed",
)
#: Seed of starts and intervals.
SEED = Transfer.seed
_KEY = ("attack", "environment", "condition", "case")
_AT_A_TIME = 3  # conditions
_NONE: Row = {"cases": {}}
_INTRODUCTION = """\
# The best attacks in every environment

The {count} best attacks of [Table 2](../table2/README.md) and of
[the methods at equal frames](../methods/README.md), driven past, unchanged, in every
environment and under every condition of [`transfer`](../transfer.md). Best are, of each
route, the {of_route} with the largest mean error in the surrogate from starts that no
search had seen; of a method at a place the better one alone. Number, environments,
conditions, starts ({starts}) and samples a pixel were settled before the first drive.
{whole} of {total} columns are driven to their end; the page shows these alone.

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


def passes() -> list[list[str]]:
    """Return all conditions, those that are driven together side by side; day first."""
    plain, *rest = Transfer.conditions
    groups = [rest[i : i + _AT_A_TIME] for i in range(0, len(rest), _AT_A_TIME)]
    return [[plain], *groups]


def columns_of(conditions: Sequence[str]) -> list[tuple[str, str]]:
    """Return environment and condition of each column."""
    columns = make_columns(ENVIRONMENTS, conditions, 1)
    return [(column.environment, column.condition.label) for column in columns]


def table_rows(
    document: Mapping[str, Any], settings: Mapping[str, Any]
) -> Iterator[Row]:
    """Yield a row an attack, column and case of a ``transfer.json``, whole or not.

    Args:
        document: as read.
        settings: of its drives, ``starts`` among them.
    """
    about = {item["label"]: item for item in document["attacks"]}
    for row in document["rows"]:
        attack = about[row["attack"]]
        for case, figures in row["cases"].items():
            labels = row["attack"], row["environment"], row["condition"], case
            found = dict(zip(_KEY, labels, strict=True))
            found |= {name: attack[name] for name in ("route", "found_sha256")}
            yield found | {name: figures[name] for name in FIGURES} | dict(settings)


def merged(known: Iterable[Row], new: Iterable[Row]) -> list[Row]:
    """Return all rows, later ones in place of earlier ones."""
    return list({tuple(row[k] for k in _KEY): row for row in (*known, *new)}.values())


def left(
    rows: Iterable[Row], labels: Iterable[str], columns: Iterable[tuple[str, str]]
) -> list[str]:
    """Return the attacks of which a column is not driven."""
    there = {tuple(row[k] for k in _KEY) for row in rows}
    wanted = [(*column, case) for column in columns for case in CASES]
    return [a for a in labels if any((a, *rest) not in there for rest in wanted)]


def check_same(rows: Iterable[Row], found: Mapping[str, str], path: Path) -> None:
    """Raise InputError if rows are of other attacks by the same names.

    Args:
        rows: of the table.
        found: digests of what was found, by attack.
        path: of the table.
    """
    for row in rows:
        name = row["attack"]
        if found.get(name, row["found_sha256"]) != row["found_sha256"]:
            raise InputError(
                f"{path}: {name} was found with other digits where its rows were "
                "driven, perhaps on another machine; choose another folder with -o"
            )


def document_of(rows: Sequence[Row], labels: Collection[str]) -> dict[str, Any]:
    """Return rows, attacks and whole columns as in ``transfer.json``.

    Args:
        rows: of the table.
        labels: of all attacks; a column is whole with all of them.
    """
    order = [column for group in passes() for column in columns_of(group)]
    order.sort(key=lambda column: ENVIRONMENTS.index(column[0]))
    cells: dict[tuple[str, str], dict[str, Row]] = {column: {} for column in order}
    for row in rows:
        about = {name: row[name] for name in _KEY[:3]} | {"cases": {}}
        key = row["environment"], row["condition"]
        if key not in cells:
            raise InputError(
                f"drives.parquet: {' under '.join(key)}: no column of the matrix; "
                "choose another folder with -o"
            )
        column = cells[key]
        cases = column.setdefault(row["attack"], about)["cases"]
        cases[row["case"]] = {name: row[name] for name in FIGURES}
    whole = [
        column[label]
        for column in cells.values()
        if all(set(CASES) == set(column.get(label, _NONE)["cases"]) for label in labels)
        for label in labels
    ]
    compare_rows(whole)
    there = {row["condition"] for row in whole}
    routes = {row["attack"]: row["route"] for row in rows}
    return {
        "attacks": [{"label": name, "route": routes.get(name)} for name in labels],
        "conditions": [c for group in passes() for c in group if c in there],
        "starts": rows[0]["starts"] if rows else 0,
        "success_s": DEPARTED_S,
        "cases": CASES,
        "rows": whole,
        "columns": column_figures(whole, SEED),
        "total": len(order),
    }


def page(document: Mapping[str, Any], made: Mapping[str, Any]) -> str:
    """Return the page.

    Args:
        document: of :func:`document_of`, with a column at least.
        made: date, machine and command, as of `bench.results.stamp`.
    """
    attacks, columns = document["attacks"], document["columns"]
    routes = {about["route"] for about in attacks}
    told = {"count": len(attacks), "of_route": len(attacks) // len(routes)}
    told |= {"whole": len(columns)} | {k: document[k] for k in ("total", "starts")}
    parts = [_INTRODUCTION.format(**told)]
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
