"""Rows of the tables of the page: the paper's figures, a sweep's, a retraining's."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_nerfattack.errors import InputError
from mi_nerfattack.evaluation.pairs import DEPARTED_S, over_attacks
from mi_nerfattack.experiment.retrain.compare import AFTER, BEFORE, OLD
from mi_nerfattack.experiment.sweep.summary import GRADIENT
from mi_nerfattack.io import files
from mi_nerfattack.rollout.drive import ATTACK, BEST_RANDOM, NO_OBJECT, OWN, RANDOM
from mi_nerfattack.scenario.deployment import DEPLOYMENT, SURROGATE

RETRAINED = "retrained"
#: Steps of the paper's drives, and metre-steps of one that never leaves the lane's
#: centre: its errors are from a line 2 m beside it.
STEPS, FLOOR = 600, 1200
#: Total error in metre-steps, mean and deviation. Source: appendix C.1, Table 2.
PAPER: dict[str, dict[str, tuple[int, int | None]]] = {
    "straight": {
        NO_OBJECT: (1166, None),
        RANDOM: (1193, 19),
        ATTACK: (1702, 160),
        RETRAINED: (1250, None),
    },
    "right": {
        NO_OBJECT: (1315, None),
        RANDOM: (1476, 12),
        ATTACK: (2101, 75),
        RETRAINED: (1307, None),
    },
    "left": {
        NO_OBJECT: (1448, None),
        RANDOM: (1158, 163),
        ATTACK: (2240, 574),
        RETRAINED: (1419, None),
    },
}
COLUMNS = {
    NO_OBJECT: "unperturbed",
    RANDOM: "random",
    ATTACK: "gradient",
    RETRAINED: "gradient, after retraining",
}
_ALL = {**{OWN: "objects as they are", BEST_RANDOM: "best of the looks"}, **COLUMNS}
#: Least ratio to random looks' mean error.
_AIMS = {SURROGATE: 3.0, DEPLOYMENT: 2.0}
#: Largest ratios to the unperturbed error, after retraining.
_AIM_OLD, _AIM_CLEAN = 1.2, 1.1
#: What `retrain` calls the environments.
NAMES = {SURROGATE: "surrogate", DEPLOYMENT: "mitsuba"}
TITLES = {
    DEPLOYMENT: "Deployment: the path-traced scene, objects pasted",
    SURROGATE: "Surrogate: the fitted fields",
}

METHOD_HEADER = (
    "route",
    "method",
    "frames",
    "past random looks",
    "past the attack",
    "ratio",
)

Figures = Mapping[str, Any]
#: By route (None: all), environment and case.
Table = dict[tuple[str | None, str, str], Figures]


def read_retrained(data: Path, cells: Collection[str]) -> Table:
    """Read what `mi-nerfattack retrain` drove past the attacks that it trained on.

    Args:
        data: its ``--data``.
        cells: of the sweep, whose attacks they must be.

    Returns:
        figures of `over_attacks` of drives without objects and past attacks, before
        and after; cases are ``before no_object``, ``after attack`` and so on.

    Raises:
        InputError: a file is missing or damaged, or an attack is of no such cell.
    """
    found: Table = {}
    for stage in (BEFORE, AFTER):
        path = data / f"{OLD}_{stage}" / "transfer.json"
        document = files.read_json(path)
        routes = {about["label"]: about["route"] for about in document["attacks"]}
        if others := sorted(routes.keys() - cells):
            raise InputError(
                f"{path}: {', '.join(others)}: no cells of the sweep; give the --data "
                "of a retraining on FOLDER/cells/*"
            )
        rows: dict[tuple[str | None, str, str], list[Figures]] = {}
        for row in document["rows"]:
            for route in (routes[row["attack"]], None):
                for case, figures in row["cases"].items():
                    key = route, row["environment"], f"{stage} {case}"
                    rows.setdefault(key, []).append(figures)
        for key, cases in rows.items():
            errors, out_s = (
                np.array([case[name] for case in cases])
                for name in ("cross_track_mean_m", "wheel_out_s")
            )
            found[key] = over_attacks(errors, out_s, 0)
    return found


def make_table(summary: Figures, retrained: Table) -> Table:
    """Return the figures of all cells of the page's tables.

    Args:
        summary: ``summary.json`` of the sweep.
        retrained: of :func:`read_retrained`; may be empty.

    Raises:
        InputError: the sweep has no such attacks, or several budgets.
    """
    found: Table = {}
    for group in summary["groups"]:
        if group["method"] == GRADIENT:
            key = group["route"], group["environment"], group["case"]
            if key in found:
                raise InputError("summary: several budgets; make a sweep of one")
            found[key] = group
    if (None, DEPLOYMENT, ATTACK) not in found:
        raise InputError(
            f"summary: no complete attack by {GRADIENT!r} was driven in "
            f"{DEPLOYMENT!r}; give a sweep of scenes/table2.toml"
        )
    for environment, name in NAMES.items():
        for (route, where, case), figures in retrained.items():
            if (where, case) == (name, f"{AFTER} {ATTACK}"):
                found[route, environment, RETRAINED] = figures
    return found


def routes_of(table: Table) -> list[str]:
    """Return the routes of the paper that are in the table."""
    return [route for route in PAPER if (route, DEPLOYMENT, ATTACK) in table]


def own_rows(table: Table, environment: str) -> Iterator[Sequence[str]]:
    """Yield a row a route: ours in one environment."""
    for route in (*routes_of(table), None):
        cells = [table.get((route, environment, case)) for case in COLUMNS]
        yield route or "all", *map(cell, cells)


def cell(figures: Figures | None) -> str:
    """Return mean, deviation, interval, attacks, and how many of them are out."""
    if figures is None:
        return ""
    mean, count = f"{figures['cross_track_mean_m']:.3f}", figures["attacks"]
    if figures["cross_track_sd_m"] is not None:
        mean += f" ± {figures['cross_track_sd_m']:.3f}"
    ends = interval(figures["cross_track_mean_ci95_m"])
    return f"{mean}{ends} ({count}); {_out(figures)}"


def interval(ends: Sequence[float] | None) -> str:
    """Return an interval after a space, or nothing."""
    return "" if ends is None else f" [{ends[0]:.3f}, {ends[1]:.3f}]"


def _out(figures: Figures) -> str:
    return _share(
        figures["attacks_out"], figures["attacks"], figures["attacks_out_rate_ci95"]
    )


def _share(count: int, total: int, ends: Sequence[float]) -> str:
    low, high = (round(100 * end) for end in ends)
    return f"{count}/{total} out [{low}, {high}]"


def paper_rows(table: Table) -> Iterator[Sequence[str]]:
    """Yield rows a route: the paper's totals, and ours as it would count them."""
    for route in routes_of(table):
        theirs = PAPER[route]
        yield route, "paper", *(_theirs(*theirs[case]) for case in COLUMNS)
        for environment in TITLES:
            cells = [table.get((route, environment, case)) for case in COLUMNS]
            yield "", f"ours, {environment}", *(map(_converted, cells))


def _theirs(total: int, deviation: int | None) -> str:
    spread = "" if deviation is None else f" ± {deviation}"
    return f"{total}{spread} ({(total - FLOOR) / STEPS:+.3f} m)"


def _converted(figures: Figures | None) -> str:
    if figures is None:
        return ""
    total = FLOOR + STEPS * figures["cross_track_mean_m"]
    spread = figures["cross_track_sd_m"]
    told = "" if spread is None else f" ± {STEPS * spread:.0f}"
    return f"{total:.0f}{told} ({figures['cross_track_mean_m']:.3f} m)"


def against_rows(comparisons: Iterable[Figures]) -> Iterator[Sequence[str]]:
    """Yield a row an environment and route: attacks beside random looks."""
    for row in comparisons:
        if (row["method"], row["other_case"]) != (GRADIENT, RANDOM):
            continue
        effect, left = row["effect"], row["departures"]
        ratio = "" if effect["ratio"] is None else f"{effect['ratio']:.2f}"
        spread = "" if effect["spread"] is None else f"{effect['spread']:.3f}"
        yield (
            row["environment"],
            row["route"] or "all",
            ratio + interval(effect["ratio_ci95"]),
            f"{effect['difference']:.3f}{interval(effect['difference_ci95'])}",
            spread,
            f"{left['both'] + left['other']}/{effect['attacks']}",
            f"{left['both'] + left['one']}/{effect['attacks']}",
            f"{left['p_value']:.2g}",
        )


def aim_rows(
    summary: Figures, drives: Iterable[Figures], table: Table, retrained: Table
) -> Iterator[tuple[str, str, str]]:
    """Yield what was aimed at, what was found, and whether it is met.

    Args:
        summary: ``summary.json`` of the sweep.
        drives: rows of its table.
        table: of :func:`make_table`.
        retrained: of :func:`read_retrained`; may be empty.
    """
    for environment, least in _AIMS.items():
        for row in summary["comparisons"]:
            labels = row["environment"], row["method"], row["other_case"]
            if labels != (environment, GRADIENT, RANDOM):
                continue
            ratio, where = row["effect"]["ratio"], row["route"] or "all routes"
            told = "" if ratio is None else f"{ratio:.2f}"
            yield (
                f"{where}: mean error at least {least:g} times that of random, "
                f"{environment}",
                told + interval(row["effect"]["ratio_ci95"]),
                _met(ratio is not None and ratio >= least),
            )
    attack = table[None, DEPLOYMENT, ATTACK]
    half = 2 * attack["attacks_out"] >= attack["attacks"]
    yield f"at least half of the attacks out, {DEPLOYMENT}", _out(attack), _met(half)
    looks = [
        row["wheel_out_s"] >= DEPARTED_S
        for row in drives
        if (row["method"], row["environment"], row["case"])
        == (GRADIENT, DEPLOYMENT, RANDOM)
    ]
    told = f"{sum(looks)} of {len(looks)} drives"
    yield f"no random look out, {DEPLOYMENT}", told, _met(not any(looks))
    for name in NAMES.values():
        if (None, name, f"{AFTER} {ATTACK}") in retrained:
            old, clean = _ratios(retrained, name)
            what = f"times the unperturbed error before, {name}"
            for case, ratio, most in (
                ("past old attacks", old, _AIM_OLD),
                ("without objects", clean, _AIM_CLEAN),
            ):
                about = f"after retraining, {case} at most {most:g} {what}"
                yield about, f"{ratio:.2f}", _met(ratio <= most)


def _met(is_met: bool) -> str:
    return "met" if is_met else "**not met**"


def _ratios(retrained: Table, name: str) -> tuple[float, float]:
    """Return errors after, past attacks and without objects, to that before."""
    clean, *after = (
        retrained[None, name, case]["cross_track_mean_m"]
        for case in (
            f"{BEFORE} {NO_OBJECT}",
            f"{AFTER} {ATTACK}",
            f"{AFTER} {NO_OBJECT}",
        )
    )
    return after[0] / clean, after[1] / clean


def detail_rows(table: Table) -> Iterator[Sequence[str]]:
    """Yield a row for each case of each route and environment."""
    for environment in TITLES:
        for route in (*routes_of(table), None):
            for case, title in _ALL.items():
                figures = table.get((route, environment, case))
                if figures is None or case == RETRAINED:
                    continue
                spread = figures["cross_track_sd_m"]
                left = figures["drives_departed"], figures["drives"]
                yield (
                    environment,
                    route or "all",
                    title,
                    str(figures["attacks"]),
                    str(figures["drives"]),
                    f"{figures['cross_track_mean_m']:.3f}",
                    "" if spread is None else f"{spread:.3f}",
                    interval(figures["cross_track_mean_ci95_m"]).strip(),
                    f"{figures['cross_track_total']:.2f}",
                    _share(*left, figures["departure_rate_ci95"]),
                    _out(figures),
                )


def method_rows(
    summary: Figures, environment: str, methods: Sequence[str]
) -> Iterator[Sequence[str]]:
    """Yield a row for each method on each route, then on all, beside the gradient."""
    groups = {
        (group["route"], group["method"], group["case"]): group
        for group in summary["groups"]
        if group["environment"] == environment
    }
    ratios = {
        (row["route"], row["method"]): row["effect"]
        for row in summary["comparisons"]
        if (row["environment"], row["other_method"], row["other_case"])
        == (environment, GRADIENT, ATTACK)
    }
    for route in dict.fromkeys(key[0] for key in groups):
        for method in methods:
            attack = groups.get((route, method, ATTACK))
            if attack is None:
                continue
            effect, ratio = ratios.get((route, method)), ""
            if effect is not None and effect["ratio"] is not None:
                ratio = f"{effect['ratio']:.2f}{interval(effect['ratio_ci95'])}"
            yield (
                route or "all",
                method,
                f"{attack['frames']:.0f}",
                cell(groups.get((route, method, RANDOM))),
                cell(attack),
                ratio,
            )
