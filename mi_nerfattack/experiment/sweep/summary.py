"""What a sweep came to: ``summary.json``, made of its table and its cells' folders.

An attack, of one cell, counts as one: its drives are averaged first, since starts and
looks tell nothing about other attacks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from itertools import chain, product
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.flags import black_box_better, noise_larger
from mi_nerfattack.evaluation.intervals import share_interval
from mi_nerfattack.evaluation.pairs import (
    DEPARTED_S,
    Effect,
    Outcome,
    compare,
    compare_departures,
    over_attacks,
)
from mi_nerfattack.experiment.run_folder import METRICS
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.experiment.sweep.table import LABELS, RESULTS, Row, read_table
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, NO_OBJECT, RANDOM

SCHEMA = 1
SUMMARY = "summary.json"
#: Method, and choice of that name, that others are compared with.
GRADIENT = "gradient"
#: Their curves are a gradient's, or of another loop than the gradient's.
_NOT_COMPARED = (GRADIENT, "open_loop", "single_frame")
_ERROR = "cross_track_mean_m"
_SEED = 0  # of the resampling


class Group(NamedTuple):
    """What drives have in common that are summarised together.

    Attributes:
        route: None of all routes together.
        method: name of the choice.
        budget: frames; None where the grid has none.
        environment: name.
        case: what objects showed.
    """

    route: str | None
    method: str
    budget: int | None
    environment: str
    case: str


def write_summary(
    folder: Path, known: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
) -> dict[str, Any]:
    """Summarise a sweep, and write ``summary.json`` beside its table.

    Args:
        folder: of the sweep.
        known: attacks of other summaries, see :func:`read_attacks`.

    Returns:
        the document.

    Raises:
        InputError: the table is missing or wrong, or a file cannot be read or written.
        SetupError: pyarrow is not installed.
    """
    rows = read_table(folder / RESULTS)
    document = summarise(rows, read_attacks(folder, rows, known))
    files.write_json(folder / SUMMARY, document)
    return document


def told_attacks(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the attacks of a folder's ``summary.json`` by cell; none without one.

    Raises:
        InputError: the file is damaged, or of another version.
    """
    path = folder / SUMMARY
    if not path.exists():
        return {}
    document = files.read_json(path)
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise InputError(
            f"{path}: no summary of a sweep with schema {SCHEMA}; give the sweep's "
            "command again, which makes it anew"
        )
    return {attack["cell"]: attack for attack in document["attacks"]}


def read_attacks(
    folder: Path,
    rows: Iterable[Row],
    known: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> list[dict[str, Any]]:
    """Return what is told of each attack: by its cell's folder, or a summary.

    Args:
        folder: of the sweep.
        rows: of its table.
        known: attacks by cell, of :func:`told_attacks` elsewhere; those of cells
            without a folder count, and before them those of the sweep's own summary.

    Returns:
        a row each, in the table's order: labels, `section` (`attack` of the
        scenario; a folder alone tells it), `attack_method` (its own word),
        `converged`, `flags` and `curve`.

    Raises:
        InputError: a file is damaged.
    """
    cells = {row["cell"]: row for row in rows if row["status"] == "complete"}
    earlier = {**known, **told_attacks(folder)}
    found = []
    for cell, row in cells.items():
        path = folder / CELLS / cell / METRICS
        if path.exists():
            document = files.read_json(path)
            attack = {name: row[name] for name in LABELS}
            section = document["scenario"]["attack"]
            attack |= {"section": section, "attack_method": section["method"]}
            attack |= {key: document[key] for key in ("converged", "flags")}
            found.append(attack | {"curve": document.get("curve")})
        elif cell in earlier:
            found.append(dict(earlier[cell]))
    return found


def summarise(
    rows: Sequence[Row], attacks: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """Return what ``summary.json`` holds; docs/sweep.md says what it means.

    Args:
        rows: of the table.
        attacks: as of :func:`read_attacks`.
    """
    failed = [row for row in rows if row["status"] != "complete"]
    groups = _grouped(_with_starts(row for row in rows if row["status"] == "complete"))
    compared = _comparisons(groups)
    cells = {row["cell"] for row in rows}
    return {
        "schema": SCHEMA,
        "flags": [*_black_box(attacks), *_noise(compared), *_own_flags(attacks)],
        "cells": len(cells),
        "complete": len(cells) - len(failed),
        "failed": [{k: row[k] for k in (*LABELS, "error")} for row in failed],
        "departed_s": DEPARTED_S,
        "groups": [_about(group, own) for group, own in groups.items()],
        "comparisons": compared,
        "attacks": [
            {key: value for key, value in attack.items() if key != "section"}
            for attack in attacks
        ],
    }


def _grouped(rows: Sequence[Row]) -> dict[Group, list[Row]]:
    """Return the drives of each route, then those of all, in the table's order."""
    found: dict[Group, list[Row]] = {}
    for together, row in product((False, True), rows):
        route = None if together else row["route"]
        rest = (row[name] for name in ("method", "budget", "environment", "case"))
        found.setdefault(Group(route, *rest), []).append(row)
    return found


def _about(group: Group, rows: Sequence[Row]) -> dict[str, Any]:
    """Summarise one group over its attacks."""
    by_cell: dict[str, list[Row]] = {}
    for row in rows:
        by_cell.setdefault(row["cell"], []).append(row)
    attacks = list(by_cell.values())

    def over(figure: Callable[[Row], float]) -> np.ndarray:
        return np.array([np.mean([figure(row) for row in own]) for own in attacks])

    left = sum(row["departed"] for row in rows)
    errors, out_s = over(lambda row: row[_ERROR]), over(lambda row: row["wheel_out_s"])
    return {
        **group._asdict(),
        "places": len({(row["route"], row["objects"]) for row in rows}),
        "seeds": len({row["seed"] for row in rows}),
        "frames": float(over(lambda row: row["frames"]).mean()),
        **over_attacks(errors, out_s, _SEED),
        "cross_track_total": float(over(lambda r: r[_ERROR] * r["steps"]).mean()),
        "drives": len(rows),
        "drives_departed": left,
        "departure_rate_ci95": share_interval(left, len(rows)),
    }


def _comparisons(groups: Mapping[Group, Sequence[Row]]) -> list[dict[str, Any]]:
    """Compare attacks with other cases of theirs, and methods with the gradient."""
    sides = {group: _outcomes(rows) for group, rows in groups.items()}
    found = []
    for group in groups:
        if group.case != ATTACK:
            continue
        others = [group._replace(case=c) for c in (RANDOM, BEST_RANDOM, NO_OBJECT)]
        if group.method != GRADIENT:
            others.append(group._replace(method=GRADIENT))
        for other in others:
            one, second = sides[group], sides.get(other, [])
            if _attacks(one) & _attacks(second):
                about = {"other_method": other.method, "other_case": other.case}
                effect = asdict(compare(one, second, _ERROR, _SEED))
                left = asdict(compare_departures(one, second))
                about |= {"effect": effect, "departures": left}
                found.append(group._asdict() | about)
    return found


def _outcomes(rows: Sequence[Row]) -> list[Outcome]:
    """Return drives as they are paired: by route, objects, seed and start."""
    return [
        Outcome(
            scenario=f"{row['route']}, {row['objects']}",
            seed=row["seed"],
            environment=row["environment"],
            case=row["case"],
            run=row["run"],
            start=row["start"],
            figures=row,
        )
        for row in rows
    ]


def _attacks(side: Iterable[Outcome]) -> set[tuple[str, int]]:
    return {(drive.scenario, drive.seed) for drive in side}


def _with_starts(rows: Iterable[Row]) -> list[Row]:
    """Say which start each drive is from: looks go through those of other cases."""
    rows, starts = list(rows), {}
    for row in rows:
        if row["case"] != RANDOM:
            cell = row["cell"]
            starts[cell] = max(starts.get(cell, 1), row["run"] + 1)
    return [row | {"start": row["run"] % starts.get(row["cell"], 1)} for row in rows]


def _black_box(attacks: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Tell of searches that find more than the best gradient, by route and method."""
    by_place: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for attack in attacks:
        if attack["curve"] is not None:
            place = (attack[name] for name in ("route", "objects", "budget", "seed"))
            by_place.setdefault(tuple(place), []).append(attack)
    told: dict[tuple[str, str], list[list[str]]] = {}
    for own in by_place.values():
        gradients = [attack for attack in own if attack["attack_method"] == GRADIENT]
        if not gradients:
            continue
        # of several settings, the one whose last objective is the least
        gradient = min(gradients, key=lambda one: one["curve"]["objective"][-1])
        for attack in own:
            if attack["attack_method"] not in _NOT_COMPARED:
                name = f"{attack['method']} ({attack['cell']})"
                curves = gradient["curve"], {name: attack["curve"]}
                key = attack["route"], attack["method"]
                told.setdefault(key, []).append(list(black_box_better(*curves)))
    for (route, method), flags in told.items():
        if better := list(chain.from_iterable(flags)):
            share = f"{len(better)} of {len(flags)} comparisons on {route}"
            yield f"{better[0]}; {method} is better in {share}"


def _noise(comparisons: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    for row in comparisons:
        if row["other_case"] == RANDOM and row["route"] is not None:
            labels = (row[name] for name in ("route", "method", "budget"))
            where = " ".join(str(label) for label in labels if label is not None)
            what = f"mean error in {row['environment']} over random looks, {where} (m)"
            yield from noise_larger(Effect(**row["effect"]), what)


def _own_flags(attacks: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Tell of each flag that attacks raised how many did, and what the first said."""
    told: dict[str, list[tuple[str, str]]] = {}
    for attack in attacks:
        by_name = {}
        for flag in attack["flags"]:
            name, _, rest = flag.partition(": ")
            by_name.setdefault(name, (attack["cell"], rest))
        for name, first in by_name.items():
            told.setdefault(name, []).append(first)
    for name, raised in told.items():
        cell, rest = raised[0]
        yield f"{name}: in {len(raised)} of {len(attacks)} attacks; in {cell}: {rest}"
