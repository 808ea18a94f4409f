"""What a sweep came to: ``summary.json``, made of its table and its cells' folders.

An attack, of one cell, counts as one: its drives are averaged first, since starts and
looks tell nothing about other attacks.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from mi_nerfattack.drives.table import records, with_starts
from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.flags import black_box_better, noise_larger
from mi_nerfattack.evaluation.pairs import Effect, compare, compare_departures
from mi_nerfattack.evaluation.summary import DEPARTED_S, summary
from mi_nerfattack.experiment.run_folder import METRICS
from mi_nerfattack.experiment.sweep.cell import CELLS
from mi_nerfattack.experiment.sweep.table import (
    LABELS,
    RESULTS,
    Row,
    read_made,
    read_table,
)
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


#: What drives have in common that are summarised together; no route: all routes.
_GROUP = ["route", "method", "budget", "environment", "case"]
_OF_GROUP = (
    *(*_GROUP, "places", "seeds", "frames", "attacks", "cross_track_mean_m"),
    *("cross_track_sd_m", "cross_track_mean_ci95_m", "wheel_out_s", "attacks_out"),
    *("attacks_out_rate_ci95", "cross_track_total", "drives", "drives_departed"),
    "departure_rate_ci95",
)


def write_summary(
    folder: Path, known: Mapping[str, Mapping[str, Any]] = MappingProxyType({})
) -> dict[str, Any]:
    """Summarise a sweep, and write ``summary.json`` next to its table.

    Args:
        folder: of the sweep.
        known: attacks of other summaries, see :func:`read_attacks`.

    Returns:
        the document.

    Raises:
        InputError: the table is missing or wrong, or a file cannot be read or written.
    """
    table = read_table(folder / RESULTS)
    document = summarise(table, read_attacks(folder, table, known))
    files.write_json(folder / SUMMARY, document)
    return document


def summarised_attacks(folder: Path) -> dict[str, dict[str, Any]]:
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
    table: pd.DataFrame,
    known: Mapping[str, Mapping[str, Any]] = MappingProxyType({}),
) -> list[dict[str, Any]]:
    """Read the attacks of a sweep, each from its cell's folder or from a summary.

    Args:
        folder: of the sweep.
        table: of the sweep.
        known: attacks by cell, from :func:`summarised_attacks` of other folders. A
            cell's own folder comes first, then the sweep's own summary, then `known`.

    Returns:
        one row per attack, in the table's order: labels, `attack_method`,
        `converged`, `flags` and `curve`. Rows from a cell's folder also have `section`,
        the section `attack` of the scenario.

    Raises:
        InputError: a file is damaged.
    """
    complete = table[table["status"] == "complete"]
    cells = {row["cell"]: row for row in records(complete.drop_duplicates("cell"))}
    earlier = {**known, **summarised_attacks(folder)}
    attacks = []
    for cell, row in cells.items():
        path = folder / CELLS / cell / METRICS
        if path.exists():
            document = files.read_json(path)
            attack = {name: row[name] for name in LABELS}
            section = document["scenario"]["attack"]
            attack |= {"section": section, "attack_method": section["method"]["kind"]}
            attack |= {key: document[key] for key in ("converged", "flags")}
            attacks.append(attack | {"curve": document.get("curve")})
        elif cell in earlier:
            attacks.append(dict(earlier[cell]))
    return attacks


def summarise(
    table: pd.DataFrame, attacks: Sequence[Mapping[str, Any]] = ()
) -> dict[str, Any]:
    """Return what ``summary.json`` holds; docs/reference/sweep.md says what it means.

    Args:
        table: of the sweep.
        attacks: as of :func:`read_attacks`.
    """
    is_complete = table["status"] == "complete"
    failed, drives = table[~is_complete], with_starts(table[is_complete], "cell")
    drives["scenario"] = drives["route"] + ", " + drives["objects"]
    everywhere = drives.copy()
    everywhere["route"] = None
    compared = [*_comparisons(drives), *_comparisons(everywhere)]
    return {
        "schema": SCHEMA,
        "flags": [*_black_box(attacks), *_noise(compared), *_own_flags(attacks)],
        "cells": table["cell"].nunique(),
        "complete": drives["cell"].nunique(),
        "failed": records(failed[[*LABELS, "error"]]),
        "departed_s": DEPARTED_S,
        "groups": [*_groups(drives), *_groups(everywhere)],
        "comparisons": compared,
        "attacks": [
            {key: value for key, value in attack.items() if key != "section"}
            for attack in attacks
        ],
    }


def _groups(drives: pd.DataFrame) -> list[dict[str, Any]]:
    """Summarise groups over their attacks, each of which is a cell."""
    figures = summary(drives, _GROUP, ["cell"], seed=_SEED)
    if figures.empty:
        return []
    groups = drives.groupby(_GROUP, sort=False, dropna=False)
    numbers = groups.agg(places=("scenario", "nunique"), seeds=("seed", "nunique"))
    figures[["places", "seeds"]] = numbers.to_numpy()
    return records(figures[list(_OF_GROUP)])


def _comparisons(drives: pd.DataFrame) -> list[dict[str, Any]]:
    """Compare attacks with other cases of theirs, and methods with the gradient."""
    comparisons = []
    attacked = drives[drives["case"] == ATTACK]
    for _, one in attacked.groupby(_GROUP, sort=False, dropna=False):
        [labels] = records(one[_GROUP].head(1))
        others = [labels | {"case": case} for case in (RANDOM, BEST_RANDOM, NO_OBJECT)]
        if labels["method"] != GRADIENT:
            others.append(labels | {"method": GRADIENT})
        for other in others:
            second = _where(drives, other)
            if _attacks(one) & _attacks(second):
                reference = {
                    "other_method": other["method"],
                    "other_case": other["case"],
                }
                effect = asdict(compare(one, second, _ERROR, seed=_SEED))
                left = asdict(compare_departures(one, second))
                comparisons.append(
                    labels | reference | {"effect": effect, "departures": left}
                )
    return comparisons


def _attacks(drives: pd.DataFrame) -> set[tuple[str, int]]:
    return set(zip(drives["scenario"], drives["seed"], strict=True))


def _where(drives: pd.DataFrame, labels: Mapping[str, Any]) -> pd.DataFrame:
    for name, value in labels.items():
        own = drives[name].isna() if value is None else drives[name] == value
        drives = drives[own]
    return drives


def _black_box(attacks: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    """Tell of searches that find more than the best gradient, by route and method."""
    by_place: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for attack in attacks:
        if attack["curve"] is not None:
            place = (attack[name] for name in ("route", "objects", "budget", "seed"))
            by_place.setdefault(tuple(place), []).append(attack)
    flags_by_method: dict[tuple[str, str], list[list[str]]] = {}
    for own in by_place.values():
        gradients = [attack for attack in own if attack["attack_method"] == GRADIENT]
        if not gradients:
            continue
        # of several settings, the one whose last objective is the least
        gradient = min(gradients, key=lambda one: one["curve"]["objective"][-1])
        for attack in own:
            if attack["attack_method"] not in _NOT_COMPARED:
                name = f"{attack['method']} ({attack['cell']})"
                key = attack["route"], attack["method"]
                flags_by_method.setdefault(key, []).append(
                    list(black_box_better(gradient["curve"], {name: attack["curve"]}))
                )
    for (route, method), flags in flags_by_method.items():
        if better := list(chain.from_iterable(flags)):
            share = f"{len(better)} of {len(flags)} comparisons on {route}"
            yield f"{better[0]}; {method} is better in {share}"


def _noise(comparisons: Iterable[Mapping[str, Any]]) -> Iterator[str]:
    for row in comparisons:
        if row["other_case"] == RANDOM and row["route"] is not None:
            labels = (row[name] for name in ("route", "method", "budget"))
            where = " ".join(str(label) for label in labels if label is not None)
            there = f"{row['environment']} over random textures"
            what = f"mean error in {there}, {where} (m)"
            yield from noise_larger(Effect(**row["effect"]), what)


def _own_flags(attacks: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Tell of each flag that attacks raised how many did, and what the first said."""
    occurrences: dict[str, list[tuple[str, str]]] = {}
    for attack in attacks:
        by_name = {}
        for flag in attack["flags"]:
            name, _, remark = flag.partition(": ")
            by_name.setdefault(name, (attack["cell"], remark))
        for name, first in by_name.items():
            occurrences.setdefault(name, []).append(first)
    for name, raised in occurrences.items():
        cell, remark = raised[0]
        yield f"{name}: in {len(raised)} of {len(attacks)} attacks; in {cell}: {remark}"


@dataclass(frozen=True)
class Taken:
    """Results of other sweeps, for cells that are not done again.

    Attributes:
        rows: of the table, of each complete cell.
        made: programs and files that made these cells.
        attacks: of the summary, by cell.
    """

    rows: Mapping[str, Sequence[Row]] = field(default_factory=dict)
    made: Mapping[str, Any] = field(default_factory=dict)
    attacks: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)


def read_taken(folders: Iterable[Path]) -> Taken:
    """Read the complete cells of other sweeps.

    Args:
        folders: with ``results.csv``, ``cells.json`` and, for curves and flags,
            ``summary.json``; of a cell that several have, the first one's counts.

    Raises:
        InputError: a table is missing, or a file is damaged.
    """
    taken = Taken({}, {}, {})
    for folder in folders:
        table = read_table(folder / RESULTS)
        groups = table[table["status"] == "complete"].groupby("cell", sort=False)
        own = {str(cell): records(drives) for cell, drives in groups}
        made = {
            cell: provenance
            for cell, provenance in read_made(folder).items()
            if cell in own
        }
        attacks = summarised_attacks(folder) | dict(taken.attacks)
        taken = Taken(own | dict(taken.rows), made | dict(taken.made), attacks)
    return taken
